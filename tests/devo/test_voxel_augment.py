"""The published voxel augmentation, operation by operation on small images."""

from __future__ import annotations

import pytest
import torch

from devo.voxel_augment import OPERATIONS, random_voxel_augment, voxel_augment


def image(*rgb: float) -> torch.Tensor:
    return torch.tensor(rgb).view(3, 1, 1).expand(3, 4, 4).contiguous()


@pytest.mark.parametrize(
    ("name", "strength", "expected"),
    [
        ("brightness", 0, (10.0, 0.0, 20.0)),
        ("invert", 3, (155.0, 255.0, 55.0)),
        ("posterize", 9, (96.0, 0.0, 192.0)),
        ("posterize", 0, (100.0, 0.0, 200.0)),
        ("solarize", 9, (155.0, 0.0, 55.0)),
        # grey = floor(0.2989 * 100 + 0.114 * 200) = 52; 0.2 * image + 0.8 * 52
        ("saturation", 9, (61.0, 41.0, 81.0)),
        ("contrast", 9, (61.0, 41.0, 81.0)),
        ("sharpness", 9, (100.0, 0.0, 200.0)),
    ],
)
def test_operations_on_a_uniform_image(name: str, strength: int, expected: tuple[float, ...]) -> None:
    operation, strengths = OPERATIONS[name]
    assert operation(image(100.0, 0.0, 200.0), strengths[strength])[:, 2, 2].tolist() == list(expected)


def test_sharpness_amplifies_a_peak_and_leaves_the_border() -> None:
    dot = torch.zeros(3, 5, 5)
    dot[2, 2, 2], dot[2, 0, 0] = 130.0, 130.0
    sharper = OPERATIONS["sharpness"][0](dot, 2.0)
    assert sharper[2, 2, 2] == 210.0  # 2 * 130 - 50
    assert sharper[2, 0, 0] == 130.0
    assert OPERATIONS["sharpness"][0](dot, 0.0)[2, 1, 2] == 10.0


def test_strengths_are_the_published_ones() -> None:
    assert OPERATIONS["posterize"][1] == [8, 8, 7, 7, 6, 6, 5, 5, 4, 4]
    assert OPERATIONS["solarize"][1] == [0, 3, 7, 10, 13, 17, 20, 23, 27, 30]


def test_inverting_exchanges_polarities() -> None:
    voxels = torch.randn(1, 2, 5, 8, 8, generator=torch.Generator().manual_seed(0))
    plain, inverted = voxel_augment(voxels, "posterize", 0), voxel_augment(voxels, "invert", 0)
    rescaled_mean = (plain + inverted).abs().max()
    assert rescaled_mean < 0.1  # equal up to the mean that standardising removes
    assert float((plain * inverted).sum()) < 0


@pytest.mark.parametrize("name", list(OPERATIONS))
def test_result_is_standardised_and_finite_even_for_empty_clips(name: str) -> None:
    voxels = torch.randn(2, 2, 5, 8, 8, generator=torch.Generator().manual_seed(0))
    voxels[0] = 0
    result = voxel_augment(voxels, name, 4)
    assert bool(torch.isfinite(result).all())
    assert result[0].abs().max() == 0
    cells = result[1][result[1] != 0]
    assert cells.mean().item() == pytest.approx(0, abs=1e-4)
    assert cells.std(unbiased=False).item() == pytest.approx(1, abs=1e-3)


def test_probability() -> None:
    voxels = torch.ones(1, 1, 5, 4, 4)
    assert random_voxel_augment(voxels, 0.0) is voxels
    torch.manual_seed(0)
    assert random_voxel_augment(torch.randn(1, 1, 5, 4, 4), 1.0).shape == voxels.shape
