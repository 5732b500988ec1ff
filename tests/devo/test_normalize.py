"""Normalisation of voxel grids and frames."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from devo.errors import InputError
from devo.normalize import check_sequence_mode, normalize_frames, normalize_sequence, normalize_voxel
from tests.tolerances import NORMALIZE


def sparse(*shape: int, seed: int = 0, density: float = 0.2) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    values = torch.randn(shape, generator=generator) * 3 + 0.5
    return values * (torch.rand(shape, generator=generator) < density)


@pytest.mark.parametrize("mode", ["std", "Standard", "STD"])
def test_std_matches_definition(mode: str) -> None:
    voxel = sparse(5, 24, 32)
    cells = voxel[voxel != 0].double()
    expected = torch.zeros(5, 24, 32, dtype=torch.float64)
    expected[voxel != 0] = (cells - cells.mean()) / cells.std(correction=0)
    result = normalize_voxel(voxel, mode)
    assert result.dtype == torch.float32
    assert float((result - expected).abs().max()) < NORMALIZE
    assert torch.equal(result == 0, voxel == 0)


@pytest.mark.parametrize("mode", ["rescale", "NORM"])
def test_rescale_matches_definition(mode: str) -> None:
    voxel = sparse(5, 24, 32)
    result = normalize_voxel(voxel, mode)
    expected = torch.where(voxel > 0, voxel / voxel.max(), voxel / -voxel.min())
    assert float((result - expected).abs().max()) < NORMALIZE
    assert float(result.max()) == 1.0 and float(result.min()) == -1.0


def test_missing_polarity_is_left_alone() -> None:
    only_positive = sparse(5, 8, 8).abs()
    assert torch.equal(normalize_voxel(only_positive, "rescale"), only_positive / only_positive.max())
    assert torch.equal(normalize_voxel(-only_positive, "rescale"), -only_positive / only_positive.max())


@pytest.mark.parametrize("mode", ["none", "rescale", "norm", "standard", "std"])
@pytest.mark.parametrize("voxel", [torch.zeros(5, 8, 8), sparse(5, 8, 8), torch.full((5, 8, 8), -2.5)])
def test_caller_keeps_its_voxel_and_results_are_finite(mode: str, voxel: torch.Tensor) -> None:
    before = voxel.clone()
    result = normalize_voxel(voxel, mode)
    assert torch.equal(voxel, before)
    assert bool(torch.isfinite(result).all())
    if not voxel.any():
        assert torch.equal(result, voxel)


@pytest.mark.parametrize("value", [1.0, -3.7, 1e-6, 12345.678])
def test_equal_cells_are_unchanged_by_std(value: float) -> None:
    voxel = (sparse(5, 48, 64) != 0) * torch.tensor(value)
    assert torch.equal(normalize_voxel(voxel, "std"), voxel)


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 10_000), density=st.floats(0.02, 1.0), scale=st.floats(1e-3, 1e3), offset=st.floats(-5, 5))
def test_std_statistics(seed: int, density: float, scale: float, offset: float) -> None:
    voxel = sparse(5, 16, 16, seed=seed, density=density)
    voxel = torch.where(voxel != 0, voxel * scale + offset * scale, 0.0)
    cells = normalize_voxel(voxel, "std")[voxel != 0].double()
    assert abs(float(cells.mean())) < 1e-3
    assert abs(float(cells.square().mean()) - 1.0) < 1e-3


def test_sequence_statistics_are_per_voxel_or_per_clip() -> None:
    clips = torch.stack([scale * sparse(3, 5, 12, 16, seed=seed) for seed, scale in ((1, 1.0), (2, 100.0))])
    per_voxel = normalize_sequence(clips, "std")
    per_clip = normalize_sequence(clips, "std2")
    scaled = normalize_sequence(clips, "rescale")
    for clip in range(2):
        flat = clips[clip].reshape(1, 15 * 12, 16)
        assert torch.allclose(per_clip[clip].reshape(flat.shape), normalize_voxel(flat, "std"), atol=1e-5)
        assert torch.allclose(scaled[clip].reshape(flat.shape), normalize_voxel(flat, "rescale"))
        for frame in range(3):
            assert torch.allclose(per_voxel[clip, frame], normalize_voxel(clips[clip, frame], "std"), atol=1e-5)
    assert not torch.allclose(per_voxel, per_clip, atol=1e-2)
    assert torch.equal(normalize_sequence(clips, "none"), clips)


def test_unknown_modes_list_the_known() -> None:
    with pytest.raises(InputError, match="'std2'.*none, rescale, norm, standard, std"):
        normalize_voxel(torch.zeros(5, 4, 4), "std2")
    with pytest.raises(InputError, match="'median'.*standard2, std2"):
        normalize_sequence(torch.zeros(1, 1, 5, 4, 4), "median")
    assert check_sequence_mode("STD2") == "std2"


def test_frames_range() -> None:
    frames = torch.tensor([0, 255, 51], dtype=torch.uint8)
    assert torch.allclose(normalize_frames(frames), torch.tensor([-0.5, 1.5, -0.1]))
