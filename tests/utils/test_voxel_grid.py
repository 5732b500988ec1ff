"""Voxel grids against the definition event by event, and the laws that follow from it."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from devo.errors import InputError
from tests.tolerances import VOXEL, VOXEL_RECTIFIED
from tests.utils.event_samples import HEIGHT, WIDTH, random_events
from utils.events import Events, make_events
from utils.voxel_grid import VoxelRectifier, remove_hot_pixels, resize_voxel, scale_intrinsics, to_voxel_grid


def by_definition(x: np.ndarray, y: np.ndarray, t: np.ndarray, p: np.ndarray, H: int, W: int, B: int = 5) -> np.ndarray:
    """The definition, one event and one corner at a time, in float64."""
    grid = np.zeros((B, H, W))
    duration = float(t[-1]) - float(t[0])
    for xk, yk, tk, pk in zip(x, y, t, p):
        tau = (B - 1) * (float(tk) - float(t[0])) / duration if duration else 0.0
        sign = -1.0 if pk == 0 else float(pk)
        corners = itertools.product(*((int(np.floor(v)), int(np.floor(v)) + 1) for v in (tau, yk, xk)))
        for Z, Y, X in corners:
            if 0 <= X < W and 0 <= Y < H and 0 <= Z < B:
                grid[Z, Y, X] += sign * (1 - abs(X - xk)) * (1 - abs(Y - yk)) * (1 - abs(Z - tau))
    return grid


def close(grid: torch.Tensor, reference: np.ndarray | torch.Tensor, tolerance: float = VOXEL) -> bool:
    return float(np.abs(grid.numpy() - np.asarray(reference)).max()) <= tolerance


def columns(count: int, seed: int, fractional: bool) -> list[np.ndarray]:
    rng = np.random.default_rng(seed)
    x, y = rng.integers(0, 12, count), rng.integers(0, 9, count)
    if fractional:
        x, y = x + rng.uniform(-2, 2, count), y + rng.uniform(-2, 2, count)
    return [x, y, np.sort(rng.integers(0, 10**6, count)), rng.integers(0, 2, count)]


def test_published_vector() -> None:
    grid = to_voxel_grid(np.array([1.25, 2, -0.5, 3.5]), np.array([0.5, 1, 1, 2.5]), np.array([100, 150, 200, 300]),
                         np.array([1, 0, 1, 1]), H=3, W=4)
    expected = torch.zeros(5, 3, 4)
    expected[0, 0, 1] = expected[0, 1, 1] = 0.375
    expected[0, 0, 2] = expected[0, 1, 2] = 0.125
    expected[1, 1, 2], expected[2, 1, 0], expected[4, 2, 3] = -1, 0.5, 0.25
    assert grid.dtype == torch.float32
    assert torch.equal(grid, expected)


@pytest.mark.parametrize("fractional", [False, True])
@pytest.mark.parametrize("count", [1, 2, 3, 500])
@pytest.mark.parametrize("bins", [1, 2, 5, 8])
def test_definition(fractional: bool, count: int, bins: int) -> None:
    x, y, t, p = columns(count, count, fractional)
    assert close(to_voxel_grid(x, y, t, p, 9, 12, bins), by_definition(x, y, t, p, 9, 12, bins))


@pytest.mark.parametrize("fractional", [False, True])
def test_unsorted_stamps_follow_the_definition_too(fractional: bool) -> None:
    x, y, t, p = columns(300, 7, fractional)
    t = np.random.default_rng(8).permutation(t)
    assert close(to_voxel_grid(x, y, t, p, 9, 12), by_definition(x, y, t, p, 9, 12))


def test_whole_numbers_as_floats_give_the_same() -> None:
    x, y, t, p = columns(500, 3, False)
    assert close(to_voxel_grid(x.astype(float), y.astype(np.float32), t, p, 9, 12), to_voxel_grid(x, y, t, p, 9, 12))


@pytest.mark.parametrize(("dtype", "negative"), [(bool, 0), (np.uint8, 0), *itertools.product(
    (np.int8, np.int64, np.float32, np.float64), (0, -1))])
def test_every_spelling_of_polarity_gives_one_answer(dtype: type, negative: int) -> None:
    x, y, t, p = columns(200, 4, True)
    spelled = np.where(p == 0, negative, 1).astype(dtype)
    assert torch.equal(to_voxel_grid(x, y, t, spelled, 9, 12), to_voxel_grid(x, y, t, p, 9, 12))


@pytest.mark.parametrize("dtype", [np.uint16, np.int16, np.uint32, np.int64])
def test_every_integer_type_gives_one_answer(dtype: type) -> None:
    x, y, t, p = columns(200, 5, False)
    reference = to_voxel_grid(x, y, t, p, 9, 12)
    assert torch.equal(to_voxel_grid(x.astype(dtype), y.astype(dtype), t.astype(np.uint32), p, 9, 12), reference)
    assert torch.equal(to_voxel_grid(*(torch.from_numpy(c) for c in (x, y, t, p)), 9, 12), reference)


def test_inputs_stay_as_they_were() -> None:
    for fractional in (False, True):
        inputs = columns(300, 6, fractional)
        copies = [column.copy() for column in inputs]
        for column in inputs:
            column.setflags(write=False)
        to_voxel_grid(*inputs, 9, 12)
        assert all(np.array_equal(one, other) for one, other in zip(inputs, copies))


def test_zero_duration_and_no_events() -> None:
    single = to_voxel_grid([1], [2], [5000], [0], 9, 12)
    assert single[0, 2, 1] == -1
    assert single.abs().sum() == 1
    equal_stamps = to_voxel_grid([1, 1, 3], [2, 2, 0], [7, 7, 7], [1, 1, 0], 9, 12)
    assert (equal_stamps[0, 2, 1], equal_stamps[0, 0, 3], equal_stamps.abs().sum()) == (2, -1, 3)
    assert torch.equal(to_voxel_grid([], [], [], [], 9, 12), torch.zeros(5, 9, 12))


def test_first_and_last_event_fill_one_bin_each() -> None:
    grid = to_voxel_grid([1, 2], [0, 0], [10, 20], [1, 1], 3, 4)
    assert grid.nonzero().tolist() == [[0, 0, 1], [4, 0, 2]]


EVENTS = st.lists(st.tuples(st.floats(-2, 13), st.floats(-2, 10), st.integers(0, 1000), st.integers(0, 1)),
                  min_size=1, max_size=40).map(lambda rows: sorted(rows, key=lambda row: row[2]))


def split(rows: list[tuple[float, float, int, int]]) -> list[np.ndarray]:
    return [np.array(column) for column in zip(*rows)]


@settings(max_examples=100, deadline=None)
@given(rows=EVENTS)
def test_definition_on_anything(rows: list[tuple[float, float, int, int]]) -> None:
    x, y, t, p = split(rows)
    assert close(to_voxel_grid(x, y, t, p, 9, 12), by_definition(x, y, t, p, 9, 12))


@settings(max_examples=60, deadline=None)
@given(rows=EVENTS, shift=st.integers(1, 10**15))
def test_laws(rows: list[tuple[float, float, int, int]], shift: int) -> None:
    x, y, t, p = split(rows)
    grid = to_voxel_grid(x, y, t, p, 9, 12)
    assert torch.equal(to_voxel_grid(x, y, t + shift, p, 9, 12), grid)  # time shift
    assert torch.equal(to_voxel_grid(x, y, t * 7, p, 9, 12), grid)  # time unit
    assert close(to_voxel_grid(x, y, t, 1 - p, 9, 12), -grid)  # polarity flip
    moved = to_voxel_grid(np.concatenate([x]) + 3, y + 2, t, p, 9 + 2, 12 + 3)
    inner = to_voxel_grid(x, y, t, p, 9, 12)
    assert close(moved[:, 3:, 4:], inner[:, 1:, 1:], 1e-5)  # translation, away from the border
    inside = (x >= 0) & (x <= 11) & (y >= 0) & (y <= 8)
    if inside.all():
        assert abs(float(grid.double().sum()) - float((2 * p - 1).sum())) < 1e-4  # nothing gets lost
    order = np.lexsort((np.random.default_rng(0).permutation(len(t)), t))
    assert close(to_voxel_grid(x[order], y[order], t[order], p[order], 9, 12), grid)  # order of simultaneous events


@pytest.mark.parametrize(("bad", "message"), [
    ({"x": [0.0, np.nan]}, "coordinate is not finite"), ({"y": [0.0, np.inf]}, "coordinate is not finite"),
    ({"t": [0.0, np.nan]}, "stamp is not finite"), ({"x": [1]}, r"expected \(N,\) each"),
    ({"x": [[1, 2]]}, r"expected \(N,\) each"), ({"H": 0}, "at least 1"), ({"nb_of_time_bins": 0}, "at least 1"),
])
def test_bad_input(bad: dict[str, object], message: str) -> None:
    good: dict[str, object] = {"x": [0, 1], "y": [0, 1], "t": [0, 1], "p": [0, 1], "H": 4, "W": 4}
    with pytest.raises(InputError, match=message):
        to_voxel_grid(**{**good, **bad})  # type: ignore[arg-type]


def distorting_map(seed: int) -> np.ndarray:
    rows, cols = np.mgrid[:HEIGHT, :WIDTH].astype(np.float32)
    noise = np.random.default_rng(seed).uniform(-3, 3, (HEIGHT, WIDTH, 2))
    return (np.stack([1.05 * cols - 2, 0.97 * rows + 1], axis=-1) + noise).astype(np.float32)


@pytest.mark.parametrize("count", [1, 2, 5000])
def test_rectifier_equals_looking_up_every_event(count: int) -> None:
    events = random_events(count, seed=count)
    positions = distorting_map(1)
    x, y = positions[events.y, events.x].T
    reference = to_voxel_grid(x.astype(float), y.astype(float), events.t_us, events.p, HEIGHT, WIDTH)
    grid = VoxelRectifier(positions)(events)
    assert grid.shape == reference.shape
    assert grid.is_contiguous()
    assert close(grid, reference, VOXEL_RECTIFIED)


def test_rectifier_with_points_that_leave_the_image() -> None:
    positions = distorting_map(2)
    positions[3, 4] = np.nan
    positions[5, 6] = -1e6
    rectifier = VoxelRectifier(positions)
    assert rectifier(make_events([4, 6], [3, 5], [0, 9], [1, 1])).abs().sum() == 0
    assert torch.equal(rectifier(Events.empty()), torch.zeros(5, HEIGHT, WIDTH))
    with pytest.raises(InputError, match="belongs to another sensor"):
        rectifier(make_events([WIDTH], [0], [0], [1]))
    with pytest.raises(InputError, match=r"expected \(H, W, 2\)"):
        VoxelRectifier(np.zeros((4, 5)))


def test_identity_map_changes_nothing() -> None:
    events = random_events(2000)
    rows, cols = np.mgrid[:HEIGHT, :WIDTH]
    grid = VoxelRectifier(np.stack([cols, rows], axis=-1))(events)
    assert torch.equal(grid, to_voxel_grid(events.x, events.y, events.t_us, events.p, HEIGHT, WIDTH))


def test_hot_pixels_of_the_published_example() -> None:
    grid = torch.zeros(5, 10, 10)
    grid[0, 0, 0], grid[1, 2, 3], grid[4, 5, 6] = 100, -100, 1
    kept = remove_hot_pixels(grid, num_stds=6)
    assert kept.nonzero().tolist() == [[4, 5, 6]]
    assert grid[0, 0, 0] == 100
    assert remove_hot_pixels(grid, num_hot_pixels=1).count_nonzero() == 2
    assert remove_hot_pixels(grid, num_hot_pixels=10**6).count_nonzero() == 0
    for arguments in ({}, {"num_stds": 6, "num_hot_pixels": 1}, {"num_hot_pixels": -1}):
        with pytest.raises(InputError):
            remove_hot_pixels(grid, **arguments)  # type: ignore[arg-type]


def test_resizing_scales_the_camera_along() -> None:
    grid = torch.rand(5, 8, 12)
    assert resize_voxel(grid, 8, 12) is grid
    half = resize_voxel(grid, 4, 6)
    assert torch.allclose(half, torch.nn.functional.avg_pool2d(grid, 2), atol=1e-6)
    assert scale_intrinsics([10, 20, 6, 4], (12, 8), (6, 2)).tolist() == [5, 5, 3, 1]


def test_names_that_users_know_are_where_they_look() -> None:
    import utils.event_utils as event_utils
    import utils.events as events
    import utils.load_utils as load_utils

    assert event_utils.to_voxel_grid is to_voxel_grid
    assert event_utils.EventSlicer is events.EventSlicer
    assert event_utils.compute_ms_to_idx is events.compute_ms_to_idx
    assert event_utils.write_evs_arr_to_h5 is events.write_evs_arr_to_h5
    assert callable(load_utils.video_iterator)
    for module in (event_utils, events, load_utils):
        assert all(hasattr(module, name) for name in module.__all__)
