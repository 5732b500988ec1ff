"""Patch selection: published picks, properties on arbitrary maps, quirks that trained weights rely on."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from devo.errors import InputError
from devo.selector import METHODS, PIXELS, PatchSelector, Scorer, event_gradient, suppress_neighbours

CELL_METHODS = ("multi", "topk", "nms")


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


@pytest.mark.parametrize("grid", [True, False])
def test_topk_equals_reference(fixture_npz, grid: bool) -> None:
    reference = fixture_npz("network_small")
    name = "topk_grid" if grid else "topk_nogrid"
    x, y = PatchSelector("topk", grid)(torch.from_numpy(reference["selector_scores"]), 24)
    assert torch.equal(x, torch.from_numpy(reference[f"{name}_x"]))
    assert torch.equal(y, torch.from_numpy(reference[f"{name}_y"]))


@settings(max_examples=60, deadline=None)
@given(
    method=st.sampled_from(METHODS),
    grid=st.booleans(),
    pixel=st.sampled_from(PIXELS),
    height=st.integers(16, 45),
    width=st.integers(16, 45),
    ppi=st.integers(1, 40),
    kind=st.sampled_from(["noise", "zero", "constant", "one peak", "tiny"]),
    seed=st.integers(0, 1000),
)
def test_positions_lie_on_the_map(method, grid, pixel, height, width, ppi, kind, seed) -> None:
    scores = torch.rand(2, 1, height, width, generator=generator(seed))
    if kind == "zero":
        scores.zero_()
    elif kind == "constant":
        scores.fill_(0.5)
    elif kind == "one peak":
        scores = (scores == scores.amax()).float()
    elif kind == "tiny":
        scores *= 1e-30
    before = scores.clone()
    x, y = PatchSelector(method, grid, pixel)(scores, ppi, generator(seed))
    assert x.shape == y.shape == (2, ppi)
    assert x.dtype == y.dtype == torch.int64
    assert int(x.min()) >= 0 and int(x.max()) < width
    assert int(y.min()) >= 0 and int(y.max()) < height
    assert torch.equal(scores, before)
    again = PatchSelector(method, grid, pixel)(scores, ppi, generator(seed))
    assert torch.equal(x, again[0]) and torch.equal(y, again[1])


@pytest.mark.parametrize("method", METHODS)
def test_global_seed_decides(method: str) -> None:
    scores = torch.rand(1, 3, 40, 56, generator=generator())
    picks = []
    for seed in (3, 3, 4):
        torch.manual_seed(seed)
        picks.append(torch.stack(PatchSelector(method, True)(scores, 24)))
    assert torch.equal(picks[0], picks[1])
    assert torch.equal(picks[0], picks[2]) == (method in ("topk", "nms"))


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("ppi", [24, 26, 27])
def test_grid_serves_quadrants_in_turn(method: str, ppi: int) -> None:
    x, y = PatchSelector(method, grid=True)(torch.rand(4, 1, 32, 48, generator=generator()), ppi, generator())
    quadrant = 2 * (y >= 16) + (x >= 24)
    assert torch.equal(quadrant, (torch.arange(ppi) % 4).expand(4, ppi))


@pytest.mark.parametrize("peak, returned", [((6, 9), (7, 10)), ((4, 8), (5, 9)), ((1, 2), (2, 3))])
def test_lone_peak_is_returned_one_pixel_off(peak, returned) -> None:
    """The published fine stage weights a pixel by the score up and left of it; trained networks know that."""
    scores = torch.zeros(1, 1, 32, 32)
    scores[0, 0, peak[1], peak[0]] = 1.0
    for grid in (True, False):
        ppi = 4 if grid else 1
        x, y = PatchSelector("multi", grid)(scores, ppi, generator())
        assert returned in set(zip(x[0].tolist(), y[0].tolist()))
        for pixel in ("drawn", "best"):
            x, y = PatchSelector("multi", grid, pixel)(scores, ppi, generator())
            assert peak in set(zip(x[0].tolist(), y[0].tolist()))


def test_peak_in_last_row_and_column_gives_random_offset() -> None:
    scores = torch.zeros(400, 1, 32, 32)
    scores[:, :, 11, 7] = 1.0
    x, y = PatchSelector("multi")(scores, 1, generator())
    assert torch.equal(x // 4, torch.ones_like(x)) and torch.equal(y // 4, 2 * torch.ones_like(y))
    counts = torch.bincount((y % 4 * 4 + x % 4).flatten(), minlength=16)
    assert int(counts.min()) >= 8 and int(counts.max()) <= 50  # 25 expected, standard deviation 4.8


def test_best_pixels_are_the_maxima_of_their_cells_and_no_place_is_taken_twice_at_first() -> None:
    scores = torch.rand(50, 1, 16, 16, generator=generator())
    cells = scores[:, 0].unfold(1, 4, 4).unfold(2, 4, 4).flatten(3)
    x, y = PatchSelector("multi", grid=True, pixel="best")(scores, 16, generator())
    frame = torch.arange(50)[:, None]
    assert torch.equal(scores[frame, 0, y, x], cells[frame, y // 4, x // 4].amax(-1))
    x, y = PatchSelector("multi", grid=True, pixel="best")(scores, 32, generator())  # every cell twice
    places = (16 * y + x).unflatten(1, (2, 16)).sort(dim=2).values
    assert torch.equal(places[:, 0].diff(dim=1) > 0, torch.ones(50, 15, dtype=torch.bool))
    assert float((places[:, 1] == places[:, 0]).all(dim=1).float().mean()) < 0.1, "later turns must look elsewhere"


def test_multi_follows_the_scores() -> None:
    scores = torch.zeros(4000, 1, 8, 8)
    scores[:, :, 1:3, 1:3] = 1.0
    scores[:, :, 5:7, 5:7] = 3.0
    x, _ = PatchSelector("multi", pixel="drawn")(scores, 1, generator())
    share = float((x >= 4).float().mean())
    assert abs(share - 0.75) < 0.03  # standard deviation 0.007
    x, y = PatchSelector("multi", pixel="drawn")(scores, 2, generator())
    assert bool((x[:, 0] // 4 != x[:, 1] // 4).all()), "a cell was used twice"
    assert bool(((x % 4 >= 1) & (x % 4 <= 2) & (y % 4 >= 1) & (y % 4 <= 2)).all())


def test_multi_uses_each_cell_once() -> None:
    scores = torch.rand(3, 1, 24, 40, generator=generator())
    for grid in (True, False):
        x, y = PatchSelector("multi", grid)(scores, 60, generator())  # 6 x 10 cells: all of them
        assert all(len(set(cells.tolist())) == 60 for cells in y // 4 * 10 + x // 4)


def test_three_times_random_keeps_the_best_third_in_ascending_order() -> None:
    scores = torch.arange(24 * 40, dtype=torch.float32).view(1, 1, 24, 40)
    x, y = PatchSelector("3xrandom")(scores, 50, generator())
    value = scores[0, 0][y[0], x[0]]
    assert bool((value.diff() >= 0).all())
    assert float(value.min()) > 0.5 * 24 * 40  # the best third of uniform draws starts near 2/3
    assert float(value.min()) < 0.8 * 24 * 40


@pytest.mark.parametrize("method", ["random", "3xrandom"])
def test_uniform_methods_reach_every_pixel(method: str) -> None:
    x, y = PatchSelector(method)(torch.zeros(1, 1, 5, 7), 4000, generator())
    assert set(x[0].tolist()) == set(range(7)) and set(y[0].tolist()) == set(range(5))


def greedy(scores: torch.Tensor) -> list[tuple[int, int]]:
    """Textbook non-maximum suppression over the maxima of 4x4 cells, best first."""
    h, w = scores.shape
    candidates = []
    for top in range(0, h, 4):
        for left in range(0, w, 4):
            cell = scores[top : top + 4, left : left + 4]
            index = int(cell.flatten().argmax())
            candidates.append((float(cell.max()), left + index % 4, top + index // 4))
    candidates.sort(key=lambda candidate: -candidate[0])
    kept: list[tuple[int, int]] = []
    for _, x, y in candidates:
        box = max(x - 1.5, 0), max(y - 1.5, 0)
        for other in kept:
            corner = max(other[0] - 1.5, 0), max(other[1] - 1.5, 0)
            inside = max(0, 3 - abs(box[0] - corner[0])) * max(0, 3 - abs(box[1] - corner[1]))
            if inside / (18 - inside) > 0.4:
                break
        else:
            kept.append((x, y))
    return kept


@pytest.mark.parametrize("seed", range(8))
def test_nms_equals_greedy_suppression(seed: int) -> None:
    scores = torch.rand(48, 64, generator=generator(seed))
    # maxima along cell borders, where neighbouring boxes touch
    scores[:, 3::4] += torch.rand(48, 16, generator=generator(seed))
    scores[3::4] += torch.rand(12, 64, generator=generator(seed + 1))
    kept = greedy(scores)
    assert len(kept) < 12 * 16, "nothing was suppressed, so the test shows nothing"
    x, y = PatchSelector("nms")(scores[None, None], len(kept))
    assert list(zip(x[0].tolist(), y[0].tolist())) == kept


def test_nms_fills_up_with_suppressed_maxima() -> None:
    scores = torch.zeros(1, 1, 8, 8)
    scores[0, 0, 3, 3], scores[0, 0, 3, 4], scores[0, 0, 4, 4], scores[0, 0, 7, 0] = 4.0, 3.0, 2.0, 1.0
    x, y = PatchSelector("nms")(scores, 4)
    assert list(zip(x[0].tolist(), y[0].tolist())) == [(3, 3), (4, 4), (0, 7), (4, 3)]


def test_nms_keeps_quadrants_apart() -> None:
    value = torch.tensor([[[2.0, 1.0], [0.5, 0.4]]])
    position = torch.tensor([[[3, 4], [4 * 8, 6 * 8 + 7]]])
    assert suppress_neighbours(value, position, 8, grid=False).tolist() == [[[True, False], [True, True]]]
    assert suppress_neighbours(value, position, 8, grid=True).all()


@pytest.mark.parametrize("grid", [True, False])
@pytest.mark.parametrize("method", CELL_METHODS)
def test_more_patches_than_cells_begin_again(method: str, grid: bool) -> None:
    x, y = PatchSelector(method, grid, pixel="drawn")(torch.rand(2, 1, 16, 16, generator=generator()), 37, generator())
    cells = y // 4 * 4 + x // 4
    for row in cells:
        assert len(set(row[:16].tolist())) == len(set(row[16:32].tolist())) == 16


def test_unknown_method_lists_the_known() -> None:
    with pytest.raises(InputError, match="'multinomial'.*multi, topk, nms, 3xrandom, random"):
        PatchSelector("multinomial")
    with pytest.raises(InputError, match="'aligned'.*shifted, drawn, best"):
        PatchSelector(pixel="aligned")


@pytest.mark.parametrize(
    "size, scorer, gradient",
    [((480, 640), (118, 158), (119, 159)), ((260, 344), (63, 84), (64, 85)), ((180, 240), (43, 58), (44, 59))],
)
def test_map_sizes(size, scorer, gradient) -> None:
    images = torch.zeros(1, 1, 5, *size)
    with torch.no_grad():
        assert Scorer()(images).shape == (1, 1, *scorer)
    assert event_gradient(images[0]).shape == (1, *gradient)


def test_event_gradient_of_a_ramp() -> None:
    y, x = torch.meshgrid(torch.arange(16.0), torch.arange(24.0), indexing="ij")
    images = (3 * x + 4 * y).expand(1, 5, 16, 24) / 5
    assert torch.allclose(event_gradient(images), torch.full((1, 3, 5), 5.0))
