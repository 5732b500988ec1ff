"""Small tensor helpers."""

from __future__ import annotations

import pytest
import torch

from devo.utils import Timer, coords_grid_with_index, flatmeshgrid, pyramidify, set_depth


def test_grid_holds_column_row_depth_and_frame() -> None:
    inv_depth = torch.rand(2, 3, 4, 5, dtype=torch.float64)
    grid, index = coords_grid_with_index(inv_depth)
    assert grid.shape == (2, 3, 3, 4, 5)
    assert index.shape == (2, 3, 1, 4, 5)
    assert grid.dtype == torch.float64
    assert index.dtype == torch.int64
    assert grid[1, 2, :2, 3, 1].tolist() == [1, 3]
    assert torch.equal(grid[:, :, 2], inv_depth)
    assert index[1, 2, 0].unique().tolist() == [2]


def test_pyramid_averages() -> None:
    fmap = torch.arange(2 * 3 * 4 * 9 * 8.0).view(1, 6, 4, 9, 8)
    fine, coarse = pyramidify(fmap, lvls=(1, 4))
    assert torch.equal(fine, fmap)
    assert coarse.shape == (1, 6, 4, 2, 2)
    torch.testing.assert_close(coarse[0, 5, 3, 1, 0], fmap[0, 5, 3, 4:8, :4].mean())


def test_set_depth_writes_in_place() -> None:
    patches = torch.zeros(1, 4, 3, 3, 3)
    returned = set_depth(patches, torch.arange(4.0)[None])
    assert returned is patches
    assert (patches[0, 3, 2] == 3).all()
    assert (patches[:, :, :2] == 0).all()


def test_flatmeshgrid() -> None:
    a, b = torch.tensor([0, 1]), torch.tensor([5, 6, 7])
    first, second = flatmeshgrid(a, b, indexing="ij")
    assert first.tolist() == [0, 0, 0, 1, 1, 1]
    assert second.tolist() == [5, 6, 7, 5, 6, 7]
    first, second = flatmeshgrid(a, b, indexing="xy")
    assert list(zip(first.tolist(), second.tolist())) == [(0, 5), (1, 5), (0, 6), (1, 6), (0, 7), (1, 7)]


@pytest.mark.skipif(torch.cuda.is_available(), reason="tells about machines without CUDA")
def test_timer_is_silent_without_cuda(capsys: pytest.CaptureFixture[str]) -> None:
    with Timer("step") as timer:
        pass
    assert timer.elapsed_ms is None
    assert capsys.readouterr().out == ""


@pytest.mark.gpu
def test_timer_measures_on_cuda() -> None:
    if not torch.cuda.is_available():
        pytest.skip("needs a CUDA device")
    with Timer("step") as timer:
        torch.ones(1000, 1000, device="cuda").sum()
    assert timer.elapsed_ms is not None
    assert timer.elapsed_ms > 0
