"""Correlation and patch extraction: reference arrays, closed forms, borders, odd inputs, gradients."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from devo.altcorr import corr, patchify
from devo.errors import InputError
from tests.tolerances import (
    CORRELATION_CLOSED_FORM,
    CORRELATION_GRADIENT,
    CORRELATION_HALF,
    CORRELATION_PARITY,
    PATCHIFY_PARITY,
)

Arrays = Callable[[str], dict[str, np.ndarray]]


def random_problem(
    seed: int, edges: int = 30, channels: int = 8, patch: int = 3, size: tuple[int, int] = (9, 12)
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Patches, maps, positions (a third of them outside), patch and frame of each edge; float64."""
    source = torch.Generator().manual_seed(seed)
    fmap1 = torch.randn(1, 7, channels, patch, patch, generator=source, dtype=torch.float64)
    fmap2 = torch.randn(1, 3, channels, *size, generator=source, dtype=torch.float64)
    extent = torch.tensor([size[1], size[0]], dtype=torch.float64).view(1, 1, 2, 1, 1)
    coords = (torch.rand(1, edges, 2, patch, patch, generator=source, dtype=torch.float64) * 2 - 0.5) * extent
    ii, jj = (torch.randint(0, count, (edges,), generator=source) for count in (7, 3))
    return fmap1, fmap2, coords, ii, jj


def sampled(maps: Tensor, x: Tensor, y: Tensor) -> Tensor:
    """Bilinear samples (N, C, ...) of maps (N, C, H, W), zero outside, by the sampler of torch."""
    height, width = maps.shape[-2:]
    grid = torch.stack([2 * x / (width - 1) - 1, 2 * y / (height - 1) - 1], dim=-1)
    flat = grid.flatten(1, -2)[:, None]
    out = torch.nn.functional.grid_sample(maps, flat, "bilinear", "zeros", align_corners=True)
    return out[:, :, 0].unflatten(2, x.shape[1:])


def closed_form(fmap1: Tensor, fmap2: Tensor, coords: Tensor, ii: Tensor, jj: Tensor, radius: int) -> Tensor:
    shift = torch.arange(-radius, radius + 1, dtype=coords.dtype)
    x = coords[0, :, 0, None, None] + shift[:, None, None, None]
    y = coords[0, :, 1, None, None] + shift[:, None, None]
    x, y = torch.broadcast_tensors(x, y)
    samples = sampled(fmap2[0, jj], x, y)
    return torch.einsum("ecij,ecabij->eabij", fmap1[0, ii], samples)[None]


# --- reference arrays ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("radius", [1, 3])
def test_corr_and_gradients_equal_the_reference(fixture_npz: Arrays, radius: int) -> None:
    data = {key: torch.from_numpy(value) for key, value in fixture_npz("altcorr").items()}
    fmap1, fmap2 = data["fmap1"].requires_grad_(), data["fmap2"].requires_grad_()
    out = corr(fmap1, fmap2, data["coords"], data["ii"], data["jj"], radius)
    expected = data[f"r{radius}_out"]
    assert out.shape == expected.shape and out.dtype == torch.float32
    assert (out - expected).abs().max() <= CORRELATION_PARITY
    (out * data[f"r{radius}_w"]).sum().backward()
    for map_, name in ((fmap1, "fmap1"), (fmap2, "fmap2")):
        assert map_.grad is not None
        wanted = data[f"r{radius}_grad_{name}"]
        assert (map_.grad - wanted).abs().max() <= CORRELATION_GRADIENT * wanted.abs().max()


@pytest.mark.parametrize("radius", [0, 1, 2])
def test_patchify_and_gradient_equal_the_reference(fixture_npz: Arrays, radius: int) -> None:
    data = {key: torch.from_numpy(value) for key, value in fixture_npz("altcorr").items()}
    net = data["patchify_net"].requires_grad_()
    out = patchify(net, data["patchify_coords"], radius)
    assert (out - data[f"patchify{radius}_out"]).abs().max() <= PATCHIFY_PARITY
    (out * data[f"patchify{radius}_w"]).sum().backward()
    assert net.grad is not None
    assert (net.grad - data[f"patchify{radius}_grad"]).abs().max() <= PATCHIFY_PARITY


@pytest.mark.parametrize(("name", "radius"), [("gmap", 1), ("imap", 0)])
def test_patchify_cuts_the_patches_of_the_reference_network(fixture_npz: Arrays, name: str, radius: int) -> None:
    data = {key: torch.from_numpy(value) for key, value in fixture_npz("network_small").items() if "/" not in key}
    maps = data["fmap" if name == "gmap" else "imap_full"][0]
    out = patchify(maps, data["coords"].float(), radius)
    assert torch.equal(out.flatten(0, 1)[None], data[name])


# --- closed form --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("radius", [0, 1, 2, 3])
@pytest.mark.parametrize(("channels", "patch"), [(8, 3), (5, 3), (1, 1), (16, 2), (24, 5)])
def test_corr_is_the_product_with_bilinear_samples(seed: int, radius: int, channels: int, patch: int) -> None:
    problem = random_problem(seed, 12, channels, patch)
    ours, wanted = corr(*problem, radius), closed_form(*problem, radius)
    assert ours.shape == wanted.shape
    assert (ours - wanted).abs().max() <= CORRELATION_CLOSED_FORM


@pytest.mark.parametrize("size", [(1, 1), (1, 9), (9, 1), (2, 3), (30, 4)])
def test_corr_on_maps_smaller_than_the_window(size: tuple[int, int]) -> None:
    fmap1, fmap2, coords, ii, jj = random_problem(5, size=size)
    big = torch.nn.functional.pad(fmap2[0], (6, 6, 6, 6))[None]
    assert (corr(fmap1, fmap2, coords, ii, jj, 3) - corr(fmap1, big, coords + 6, ii, jj, 3)).abs().max() < 1e-12


@pytest.mark.parametrize("radius", [0, 1, 2])
@pytest.mark.parametrize("seed", range(3))
def test_patchify_is_bilinear_sampling(seed: int, radius: int) -> None:
    source = torch.Generator().manual_seed(seed)
    net = torch.randn(2, 4, 7, 10, generator=source, dtype=torch.float64)
    coords = torch.rand(2, 11, 2, generator=source, dtype=torch.float64) * 14 - 3
    shift = torch.arange(-radius, radius + 1, dtype=torch.float64)
    x = (coords[..., 0, None, None] + shift).expand(-1, -1, len(shift), -1)
    y = (coords[..., 1, None, None] + shift[:, None]).expand(-1, -1, -1, len(shift))
    assert (patchify(net, coords, radius) - sampled(net, x, y).transpose(1, 2)).abs().max() <= CORRELATION_CLOSED_FORM


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64, torch.float16, torch.bfloat16])
def test_integer_positions_slice(dtype: torch.dtype) -> None:
    net = torch.randn(1, 6, 9, 12).to(dtype)
    coords = torch.tensor([[[4.0, 3.0], [2.0, 6.0], [9.0, 2.0]]])
    out = patchify(net, coords, 2)
    for number, (x, y) in enumerate(coords[0].long().tolist()):
        assert torch.equal(out[0, number].to(dtype), net[0, :, y - 2 : y + 3, x - 2 : x + 3])


def test_raw_windows_start_at_the_floor_and_are_zero_outside() -> None:
    net = torch.arange(1.0, 31).view(1, 1, 5, 6)
    windows = patchify(net, torch.tensor([[[2.7, 1.2], [0.0, -0.4]]]), 1, mode="nearest")
    assert windows.shape == (1, 2, 1, 4, 4)
    assert torch.equal(windows[0, 0, 0], net[0, 0, 0:4, 1:5])
    assert torch.equal(windows[0, 1, 0, :2], torch.zeros(2, 4))
    assert torch.equal(windows[0, 1, 0, 2:, 1:], net[0, 0, 0:2, 0:3])
    assert not windows[0, 1, 0, :, 0].any()


def test_shift_along_x_comes_first() -> None:
    fmap2 = torch.zeros(1, 1, 1, 7, 9)
    fmap2[0, 0, 0, 3, 5] = 1
    coords = torch.tensor([4.0, 3.0]).view(1, 1, 2, 1, 1)
    index = torch.zeros(1, dtype=torch.long)
    out = corr(torch.ones(1, 1, 1, 1, 1), fmap2, coords, index, index, 2)
    assert out[0, 0, 3, 2, 0, 0] == 1 and out.sum() == 1


# --- borders and odd positions ------------------------------------------------------------------------------


@pytest.mark.parametrize("edges", [0, 1, 2, 33])
@pytest.mark.parametrize("chunk", [1, 2, 7, None])
def test_chunks_change_no_bit(edges: int, chunk: int | None) -> None:
    fmap1, fmap2, coords, ii, jj = random_problem(1, edges)
    results = []
    for size in (chunk, 1000):
        maps = [fmap1.float().requires_grad_(), fmap2.float().requires_grad_()]
        out = corr(*maps, coords.float(), ii, jj, 3, chunk_edges=size)
        assert out.shape == (1, edges, 7, 7, 3, 3)
        results.append([out, *torch.autograd.grad((out * out.detach()).sum(), maps)])
    for first, second in zip(*results):
        assert torch.equal(first, second)


def test_a_hundred_thousand_edges() -> None:
    fmap1, fmap2, coords, ii, jj = random_problem(16, 100_000, channels=3, patch=1)
    out = corr(fmap1, fmap2, coords, ii, jj, 1)
    some = slice(None, None, 997)
    wanted = closed_form(fmap1, fmap2, coords[:, some], ii[some], jj[some], 1)
    assert (out[:, some] - wanted).abs().max() <= CORRELATION_CLOSED_FORM


@pytest.mark.parametrize("value", [1e20, -1e20, 3e9, -3e9, 2.0**31, 2.0**63, -(2.0**63), 1e6])
def test_far_positions_see_nothing(value: float) -> None:
    fmap1, fmap2, coords, ii, jj = random_problem(2)
    coords = coords.float()
    coords[0, ::2] = value
    out = corr(fmap1.float(), fmap2.float(), coords, ii, jj, 3)
    assert not out[0, ::2].any() and out[0, 1::2].any()
    assert not patchify(fmap2[0].float(), torch.full((3, 4, 2), value), 1).any()


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
@pytest.mark.parametrize("axis", [0, 1])
def test_positions_that_are_not_numbers_give_nan_only_to_themselves(value: float, axis: int) -> None:
    fmap1, fmap2, coords, ii, jj = random_problem(3)
    broken = coords.clone()
    broken[0, 4, axis, 1, 2] = value
    maps = [fmap1.requires_grad_(), fmap2.requires_grad_()]
    out = corr(*maps, broken, ii, jj, 2)
    spoiled = torch.zeros_like(out, dtype=torch.bool)
    spoiled[0, 4, :, :, 1, 2] = True
    assert torch.equal(out.isnan(), spoiled)
    assert torch.equal(out[~spoiled], corr(*maps, coords, ii, jj, 2)[~spoiled])
    for gradient in torch.autograd.grad(out[~spoiled].sum(), maps):
        assert gradient.isfinite().all()
    places = torch.ones(3, 2, 2)
    places[1, 0, axis] = value
    patches = patchify(fmap2[0].detach(), places, 1)
    assert patches[1, 0].isnan().all() and not patches[1, 1].isnan().any() and not patches[::2].isnan().any()


@pytest.mark.parametrize(("x", "y"), [(-1.0, 2.0), (12.0, 2.0), (4.0, -1.0), (4.0, 9.0), (-5.5, -7.25)])
def test_one_pixel_outside_is_zero(x: float, y: float) -> None:
    fmap1, fmap2, _, ii, jj = random_problem(4, 3)
    coords = torch.tensor([x, y], dtype=torch.float64).view(1, 1, 2, 1, 1).expand(1, 3, 2, 3, 3)
    assert not corr(fmap1, fmap2, coords, ii, jj, 0).any()
    assert corr(fmap1, fmap2, coords.clamp(0, 8), ii, jj, 0).any()


@given(
    st.integers(0, 10**6), st.integers(-6, 6), st.integers(-6, 6), st.sampled_from([(4, 4), (9, 12)]), st.integers(0, 3)
)
@settings(max_examples=25, deadline=None)
def test_moving_maps_and_positions_together_changes_nothing(
    seed: int, right: int, down: int, size: tuple[int, int], radius: int
) -> None:
    fmap1, fmap2, coords, ii, jj = random_problem(seed, 6, size=size)
    # positions on a grid of 1/64 pixel, so that moving them is exact
    coords = (coords * 64).round() / 64
    moved = torch.nn.functional.pad(fmap2[0], (6 + right, 6 - right, 6 + down, 6 - down))[None]
    offset = torch.tensor([6.0 + right, 6.0 + down], dtype=torch.float64).view(1, 1, 2, 1, 1)
    assert torch.equal(corr(fmap1, fmap2, coords, ii, jj, radius), corr(fmap1, moved, coords + offset, ii, jj, radius))


# --- precision ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_half_maps(dtype: torch.dtype) -> None:
    fmap1, fmap2, coords, ii, jj = random_problem(6)
    coords, maps = coords.float(), [fmap1.to(dtype).requires_grad_(), fmap2.to(dtype).requires_grad_()]
    out = corr(*maps, coords, ii, jj, 3)
    assert out.dtype == dtype
    precise_maps = [map_.detach().float().requires_grad_() for map_ in maps]
    precise = corr(*precise_maps, coords, ii, jj, 3)
    assert (out.float() - precise).abs().max() <= CORRELATION_HALF * precise.abs().max()
    gradients = torch.autograd.grad(out.float().sum(), maps)
    for ours, wanted in zip(gradients, torch.autograd.grad(precise.sum(), precise_maps)):
        assert ours.dtype == dtype and (ours.float() - wanted).abs().max() <= CORRELATION_HALF * wanted.abs().max()
    assert patchify(maps[1][0].detach(), coords[:, :, :, 0, 0].expand(3, -1, -1), 1).dtype == torch.float32


def test_autocast_leaves_the_correlation_alone() -> None:
    problem = [tensor.float() if tensor.is_floating_point() else tensor for tensor in random_problem(7)]
    plain = corr(*problem, 3)
    with torch.autocast("cpu", torch.bfloat16):
        assert torch.equal(corr(*problem, 3), plain)


@pytest.mark.parametrize("layout", ["channels_first", "channels_last", "strided"])
def test_memory_layout_changes_no_bit(layout: str) -> None:
    fmap1, fmap2, coords, ii, jj = random_problem(8)
    if layout == "channels_last":
        stored = fmap2[0].contiguous(memory_format=torch.channels_last)[None]
    elif layout == "strided":
        stored = fmap2.repeat_interleave(2, dim=3)[:, :, :, ::2]
    else:
        stored = fmap2.contiguous()
    assert torch.equal(corr(fmap1, stored, coords, ii, jj, 3), corr(fmap1, fmap2, coords, ii, jj, 3))
    places = coords[0, :3, :, 0].transpose(1, 2)
    assert torch.equal(patchify(stored[0], places, 1), patchify(fmap2[0], places, 1))


# --- gradients ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("radius", "patch", "edges"), [(0, 3, 5), (1, 2, 4), (3, 1, 3)])
def test_gradcheck_corr(radius: int, patch: int, edges: int) -> None:
    fmap1, fmap2, coords, ii, jj = random_problem(9, edges, channels=2, patch=patch, size=(4, 5))
    maps = (fmap1[:, :3].clone().requires_grad_(), fmap2.requires_grad_())
    assert torch.autograd.gradcheck(lambda a, b: corr(a, b, coords, ii % 3, jj, radius, chunk_edges=2), maps)


@pytest.mark.parametrize("mode", ["bilinear", "raw"])
@pytest.mark.parametrize("radius", [0, 1, 2])
def test_gradcheck_patchify(radius: int, mode: str) -> None:
    net = torch.randn(2, 3, 4, 5, dtype=torch.float64, requires_grad=True)
    coords = torch.rand(2, 4, 2, dtype=torch.float64) * 8 - 2
    assert torch.autograd.gradcheck(lambda maps: patchify(maps, coords, radius, mode), (net,))


def test_no_gradient_to_positions() -> None:
    fmap1, fmap2, coords, ii, jj = random_problem(10)
    coords.requires_grad_()
    assert not corr(fmap1, fmap2, coords, ii, jj).requires_grad
    assert not patchify(fmap2[0], coords[0, :3, :, 0].transpose(1, 2), 1).requires_grad


def test_only_the_needed_gradient_is_computed() -> None:
    fmap1, fmap2, coords, ii, jj = random_problem(11)
    both = [fmap1.clone().requires_grad_(), fmap2.clone().requires_grad_()]
    expected = torch.autograd.grad(corr(*both, coords, ii, jj, 2).sum(), both)
    for number in range(2):
        maps = [fmap1.clone(), fmap2.clone()]
        maps[number].requires_grad_()
        assert torch.equal(torch.autograd.grad(corr(*maps, coords, ii, jj, 2).sum(), maps[number])[0], expected[number])


# --- dropout ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dropout", [0.0, 0.2, 0.7])
def test_dropout_keeps_whole_edges_in_the_backward_pass(dropout: float) -> None:
    fmap1, fmap2, coords, _, jj = random_problem(12, 400)
    coords = coords.clamp(1, 7)
    fmap1 = fmap1[:, :1].repeat(1, 400, 1, 1, 1).requires_grad_()
    own = torch.arange(400)  # every edge has its own patch, so its gradient tells whether the edge was kept
    full = corr(fmap1, fmap2, coords, own, jj, 1)
    (all_kept,) = torch.autograd.grad(full.sum(), fmap1)
    out = corr(fmap1, fmap2, coords, own, jj, 1, dropout, generator=torch.Generator().manual_seed(1))
    assert torch.equal(out, full)
    (gradient,) = torch.autograd.grad(out.sum(), fmap1)
    kept = gradient[0].flatten(1).any(1)
    assert torch.equal(gradient[0, kept], all_kept[0, kept])  # no rescaling
    assert abs(kept.float().mean().item() - dropout) <= 4 * (dropout * (1 - dropout) / 400) ** 0.5


def test_dropout_follows_the_generator_and_spares_inference() -> None:
    fmap1, fmap2, coords, ii, jj = random_problem(13)
    fmap1.requires_grad_()

    def gradient(seed: int) -> Tensor:
        out = corr(fmap1, fmap2, coords, ii, jj, 1, 0.5, generator=torch.Generator().manual_seed(seed))
        return torch.autograd.grad(out.sum(), fmap1)[0]

    assert torch.equal(gradient(1), gradient(1)) and not torch.equal(gradient(1), gradient(2))
    before = torch.get_rng_state()
    with torch.no_grad():
        corr(fmap1, fmap2, coords, ii, jj, 1, 0.5)
    assert torch.equal(torch.get_rng_state(), before)


# --- refused inputs and dispatch ----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"fmap1": torch.zeros(7, 8, 3, 3)}, "expected (1, K, C, P, P)"),
        ({"fmap2": torch.zeros(2, 3, 8, 9, 12, dtype=torch.float64)}, "expected (1, K, C, P, P)"),
        ({"fmap2": torch.zeros(1, 3, 4, 9, 12, dtype=torch.float64)}, "same channels"),
        ({"fmap2": torch.zeros(1, 3, 8, 9, 12)}, "same channels and dtype"),
        ({"coords": torch.zeros(1, 30, 2, 2, 2)}, "expected (1, E, 2, 3, 3)"),
        ({"coords": torch.zeros(1, 30, 2, 3, 3, dtype=torch.float16)}, "float32"),
        ({"jj": torch.zeros(29, dtype=torch.long)}, "(E,) and (E,)"),
        ({"radius": -1}, "radius >= 0"),
        ({"dropout": 1.5}, "0 <= dropout <= 1"),
    ],
)
def test_corr_refuses(change: dict[str, object], message: str) -> None:
    names = ("fmap1", "fmap2", "coords", "ii", "jj")
    arguments = dict(zip(names, random_problem(14))) | change
    with pytest.raises(InputError) as error:
        corr(**arguments)
    assert message in str(error.value)


@pytest.mark.parametrize(
    ("net", "coords", "radius"),
    [
        (torch.zeros(3, 4, 5), torch.zeros(1, 2, 2), 1),
        (torch.zeros(2, 3, 4, 5), torch.zeros(1, 2, 2), 1),
        (torch.zeros(1, 3, 4, 5), torch.zeros(1, 2, 3), 1),
        (torch.zeros(1, 3, 4, 5), torch.zeros(1, 2, 2, dtype=torch.long), 1),
        (torch.zeros(1, 3, 4, 5), torch.zeros(1, 2, 2), -1),
    ],
)
def test_patchify_refuses(net: Tensor, coords: Tensor, radius: int) -> None:
    with pytest.raises(InputError, match="patchify got"):
        patchify(net, coords, radius)


def test_insisting_on_the_extension_fails_on_the_cpu(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DEVO_KERNELS", "cuda")
    with pytest.raises(InputError, match="DEVO_KERNELS"):
        corr(*random_problem(15))
    with pytest.raises(InputError, match="DEVO_KERNELS"):
        patchify(torch.zeros(1, 1, 4, 4), torch.zeros(1, 1, 2), 0)
