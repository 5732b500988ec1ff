"""The CUDA kernels of correlation and patch extraction against their torch twins: values, gradients, odd inputs."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from devo.altcorr import corr, patchify
from devo.errors import DevoError, InputError
from tests.devo.cuda_backends import Kernels, assert_close
from tests.devo.test_altcorr import random_problem
from tests.tolerances import CUDA_CORRELATION

DTYPES = [torch.float32, torch.float64, torch.float16, torch.bfloat16]


# --- correlation ------------------------------------------------------------------------------------------------


def problem(device: torch.device, dtype: torch.dtype = torch.float64, edges: int = 24, channels: int = 8,
            patch: int = 3, size: tuple[int, int] = (9, 12), coord_dtype: torch.dtype = torch.float32,
            seed: int = 0) -> tuple[Tensor, ...]:
    """Patches, maps, positions (a third of them outside), patch and frame of each edge."""
    fmap1, fmap2, coords, ii, jj = random_problem(seed, edges, channels, patch, size)
    floats = fmap1.to(dtype), fmap2.to(dtype), coords.to(coord_dtype)
    return tuple(tensor.to(device) for tensor in (*floats, ii, jj))


def compare_corr(kernels: Kernels, given: tuple[Tensor, ...], radius: int, dropout: float = 1.0) -> None:
    """Values and gradients of both implementations."""
    tolerance = CUDA_CORRELATION[given[0].dtype]
    results = []
    for run in (kernels.ours, kernels.twin):
        maps = [map_.detach().requires_grad_() for map_ in given[:2]]
        out = run(corr, *maps, *given[2:], radius, dropout, generator=torch.Generator().manual_seed(3))
        towards = torch.linspace(-1, 1, out.numel(), device=out.device).view(out.shape).to(out.dtype)
        results.append([out.detach(), *torch.autograd.grad(out, maps, towards)])
    for ours, twin in zip(*results):
        assert_close(ours, twin, tolerance)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("coord_dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("radius", [0, 1, 3])
def test_corr_dtypes(kernels: Kernels, dtype: torch.dtype, coord_dtype: torch.dtype, radius: int) -> None:
    compare_corr(kernels, problem(kernels.device, dtype, coord_dtype=coord_dtype), radius)


@pytest.mark.parametrize(
    ("channels", "patch", "size", "radius"),
    [(1, 1, (1, 1), 3), (5, 2, (3, 30), 2), (33, 3, (9, 12), 1), (128, 3, (20, 15), 3), (130, 1, (7, 5), 4),
     (257, 2, (4, 4), 1), (4, 5, (6, 7), 2), (3, 1, (30, 45), 17)],
)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float16])
def test_corr_sizes(kernels: Kernels, channels: int, patch: int, size: tuple[int, int], radius: int,
                    dtype: torch.dtype) -> None:
    compare_corr(kernels, problem(kernels.device, dtype, 9, channels, patch, size, seed=1), radius)


@pytest.mark.parametrize("layout", ["channels last", "strided", "unaligned"])
def test_corr_layouts(kernels: Kernels, layout: str) -> None:
    fmap1, fmap2, coords, ii, jj = problem(kernels.device, torch.float32, seed=2)
    if layout == "channels last":
        fmap2 = fmap2[0].contiguous(memory_format=torch.channels_last)[None]
    elif layout == "strided":
        fmap2 = fmap2.repeat_interleave(2, dim=3)[:, :, :, ::2]
    else:  # channels-last maps that start between two multiples of 16 bytes
        memory = torch.zeros(fmap2.numel() + 1, device=fmap2.device)[1:]
        fmap2 = memory.view(3, 9, 12, 8).copy_(fmap2[0].permute(0, 2, 3, 1)).permute(0, 3, 1, 2)[None]
        assert fmap2[0].permute(0, 2, 3, 1).is_contiguous() and fmap2.data_ptr() % 16
    compare_corr(kernels, (fmap1, fmap2, coords.transpose(3, 4), ii, jj), 2)


@pytest.mark.parametrize(
    "value", [float("nan"), float("inf"), -float("inf"), 1e20, -1e20, 3e9, -(2.0**31), 1e6, 2.0**63]
)
@pytest.mark.parametrize("axis", [0, 1])
def test_corr_odd_positions(kernels: Kernels, value: float, axis: int) -> None:
    given = problem(kernels.device, torch.float32, seed=3)
    given[2][0, 4, axis, 1, 2] = value
    compare_corr(kernels, given, 2)


@pytest.mark.parametrize("edges", [0, 1, 2])
def test_corr_few_edges(kernels: Kernels, edges: int) -> None:
    compare_corr(kernels, problem(kernels.device, torch.float32, edges), 3)


def test_corr_all_outside(kernels: Kernels) -> None:
    given = problem(kernels.device, torch.float32)
    compare_corr(kernels, (*given[:2], given[2] - 40, *given[3:]), 3)


@pytest.mark.parametrize("dropout", [0.0, 0.3, 0.8])
def test_corr_dropout(kernels: Kernels, dropout: float) -> None:
    compare_corr(kernels, problem(kernels.device, torch.float64, 60), 1, dropout)


@pytest.mark.parametrize("number", [0, 1])
def test_corr_needed_gradient_only(kernels: Kernels, number: int) -> None:
    given = problem(kernels.device)
    gradients = []
    for run in (kernels.ours, kernels.twin):
        maps = [map_.clone() for map_ in given[:2]]
        maps[number].requires_grad_()
        gradients.append(torch.autograd.grad(run(corr, *maps, *given[2:], 2).square().sum(), maps[number])[0])
    assert_close(*gradients, CUDA_CORRELATION[torch.float64])


def test_corr_of_edges_that_do_not_exist(kernels: Kernels) -> None:
    fmap1, fmap2, coords, ii, jj = problem(kernels.device, torch.float32)
    ii[3], jj[5], jj[6] = 7, -1, 1 << 40
    fmap1.requires_grad_()
    out = kernels.ours(corr, fmap1, fmap2, coords, ii, jj, 2)
    broken = out.isnan().flatten(2).any(2)[0]
    assert broken.nonzero().flatten().tolist() == [3, 5, 6] and out[0, broken].isnan().all()
    (gradient,) = torch.autograd.grad(out, fmap1, torch.ones_like(out))
    assert gradient.isfinite().all()


@pytest.mark.parametrize(("radius", "patch", "edges"), [(0, 2, 4), (1, 1, 3)])
def test_corr_gradcheck(kernels: Kernels, radius: int, patch: int, edges: int) -> None:
    fmap1, fmap2, coords, ii, jj = problem(kernels.device, torch.float64, edges, 2, patch, (3, 4), torch.float64, 4)
    maps = (fmap1[:, :3].clone().requires_grad_(), fmap2.requires_grad_())
    kernels.ours(torch.autograd.gradcheck, lambda a, b: corr(a, b, coords, ii % 3, jj, radius), maps,
                 nondet_tol=1e-9)


# --- patches ----------------------------------------------------------------------------------------------------


def compare_patchify(kernels: Kernels, net: Tensor, coords: Tensor, radius: int, mode: str) -> None:
    tolerance = CUDA_CORRELATION[net.dtype]
    results = []
    for run in (kernels.ours, kernels.twin):
        maps = net.detach().requires_grad_()
        out = run(patchify, maps, coords, radius, mode)
        towards = torch.linspace(-1, 1, out.numel(), device=out.device).view(out.shape).to(out.dtype)
        results.append([out.detach(), *torch.autograd.grad(out, maps, towards)])
    for ours, twin in zip(*results):
        assert_close(ours, twin, tolerance)


def maps_and_positions(device: torch.device, dtype: torch.dtype, coord_dtype: torch.dtype = torch.float32,
                       points: int = 11) -> tuple[Tensor, Tensor]:
    source = torch.Generator().manual_seed(0)
    net = torch.randn(2, 5, 7, 10, generator=source, dtype=torch.float64)
    coords = torch.rand(2, points, 2, generator=source, dtype=torch.float64) * 14 - 3
    coords[:, ::3] = coords[:, ::3].round()
    return net.to(device, dtype), coords.to(device, coord_dtype)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("coord_dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("radius", [0, 1, 4])
@pytest.mark.parametrize("mode", ["bilinear", "nearest"])
def test_patchify(kernels: Kernels, dtype: torch.dtype, coord_dtype: torch.dtype, radius: int, mode: str) -> None:
    compare_patchify(kernels, *maps_and_positions(kernels.device, dtype, coord_dtype), radius, mode)


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -1e20, 3e9, 2.0**63, -1.0, 10.0])
@pytest.mark.parametrize("mode", ["bilinear", "nearest"])
def test_patchify_odd_positions(kernels: Kernels, value: float, mode: str) -> None:
    net, coords = maps_and_positions(kernels.device, torch.float32)
    coords[0, 2, 0], coords[1, 3, 1] = value, value
    compare_patchify(kernels, net, coords, 1, mode)


@pytest.mark.parametrize("layout", ["channels last", "strided", "expanded"])
def test_patchify_layouts(kernels: Kernels, layout: str) -> None:
    net, coords = maps_and_positions(kernels.device, torch.float32)
    if layout == "channels last":
        net = net.contiguous(memory_format=torch.channels_last)
    elif layout == "strided":
        net = net.repeat_interleave(2, dim=2)[:, :, ::2]
    else:
        net = net[:, :1].expand(-1, 5, -1, -1)
    compare_patchify(kernels, net, coords.flip(2), 2, "bilinear")


@pytest.mark.parametrize("points", [0, 1])
def test_patchify_few_points(kernels: Kernels, points: int) -> None:
    compare_patchify(kernels, *maps_and_positions(kernels.device, torch.float32, points=points), 1, "bilinear")


@pytest.mark.parametrize("mode", ["bilinear", "nearest"])
def test_patchify_gradcheck(kernels: Kernels, mode: str) -> None:
    net, coords = maps_and_positions(kernels.device, torch.float64, torch.float64, 3)
    net = net[:, :2].clone().requires_grad_()
    kernels.ours(torch.autograd.gradcheck, lambda maps: patchify(maps, coords, 1, mode), (net,), nondet_tol=1e-9)


def test_other_dtypes_are_refused(kernels: Kernels) -> None:
    net, coords = maps_and_positions(kernels.device, torch.float32)
    with pytest.raises(InputError, match="expect one of"):
        kernels.ours(patchify, net.to(torch.int32), coords, 1)


# --- library ----------------------------------------------------------------------------------------------------


def test_errors_of_the_library_are_reported(kernels: Kernels) -> None:
    library = kernels.modules["altcorr"].LIBRARY
    maps = torch.zeros(1, device=kernels.device)
    with pytest.raises(DevoError, match="devo_patchify_forward failed"):
        library.launch("devo_patchify_forward", kernels.device, 9, 9, maps, maps, *[1] * 11, maps)
    with pytest.raises(InputError, match="expected one device"):
        library.launch("devo_patchify_forward", kernels.device, 0, 0, torch.zeros(1, device="meta"))
