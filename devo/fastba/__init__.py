"""Fast bundle adjustment of the tracker, edge neighbours and plain reprojection: CUDA extension or torch twin.

The torch twin in `devo.fastba.torch_twin` and `devo.fastba.edge_neighbors` is the specification; the extension offers
`ba`, `neighbors` and `reproject` with the same arguments and results.
"""

from __future__ import annotations

from typing import Any

from torch import Tensor

from devo.fastba import torch_twin
from devo.fastba.edge_neighbors import neighbors_torch
from devo.fastba.torch_twin import BAResult
from devo.kernels import cuda_kernel

__all__ = ["BA", "BAResult", "neighbors", "reproject"]


def BA(  # noqa: N802 - the published name
    poses: Any,
    patches: Tensor,
    intrinsics: Tensor,
    target: Tensor,
    weight: Tensor,
    lmbda: Tensor | float,
    ii: Tensor,
    jj: Tensor,
    kk: Tensor,
    t0: int,
    t1: int,
    iterations: int = 2,
    *,
    image_size: tuple[float, float] | None = None,
    per_frame_intrinsics: bool = False,
    accurate: bool = False,
) -> BAResult:
    """Refine poses `t0 <= i < t1` and the inverse depth of all patches in `kk` by Gauss-Newton, in place.

    Each iteration minimises sum w |target - projection of the patch centre|^2 with a Schur complement over the depths
    (Triggs et al. 2000, section 6.1); poses move by left multiplication with exp(dx). An iteration whose system cannot
    be factorised or whose step is not finite changes nothing and ends the solver with `success=False`.

    Args:
        poses: (1,N,7) or (N,7) tensor, or an object such as `SE3` with one as `.data`; world->camera. Changed in place.
        patches: (1,K,3,P,P) or (K,3,P,P), channels x, y (feature-map pixels), inverse depth. Changed in place.
        intrinsics: (1,N,4) or (N,4) `fx fy cx cy` in feature-map pixels.
        target: (1,E,2) measured position of each patch centre in frame jj, pixels.
        weight: (1,E,2) confidence of x and y.
        lmbda: damping added to the information of every inverse depth.
        ii: (E,) int64 source frames.
        jj: (E,) int64 target frames.
        kk: (E,) int64 patch rows.
        t0: first free pose.
        t1: one past the last free pose; with t1 <= t0 only depths move.
        iterations: Gauss-Newton iterations.
        image_size: (height, width) in feature-map pixels; default (2 cy, 2 cx) of the camera, as published. Projections
            more than 64 pixels outside are outliers.
        per_frame_intrinsics: use the camera of each frame instead of row 0 for all.
        accurate: set up and solve in float64 over blocks of frame pairs, several times faster on large problems;
            otherwise in the dtype of the state in the order of the published kernel, whose rounding errors are
            reproduced. The tracker uses the former; the two agree where the problem is well determined. The CUDA
            extension always works in float64.

    Returns:
        `BAResult`, see there.

    Raises:
        devo.errors.InputError: shapes do not fit together.
    """
    kernel = cuda_kernel("fastba", poses.data, patches, target)
    options: dict[str, Any] = {"image_size": image_size, "per_frame_intrinsics": per_frame_intrinsics,
                               "accurate": accurate}
    arguments = (patches, intrinsics, target, weight, lmbda, ii, jj, kk, t0, t1, iterations)
    if kernel is not None:
        return BAResult(*kernel.ba(poses.data, *arguments, **options))
    return torch_twin.ba(poses.data, *arguments, **options)


def neighbors(kk: Tensor, jj: Tensor) -> tuple[Tensor, Tensor]:
    """Find for each edge the edges of the same patch just before and after it in time.

    Args:
        kk: (E,) int64 patch of each edge.
        jj: (E,) int64 target frame of each edge.

    Returns:
        `(prev, next)` (E,) int64 edge indices, -1 where there is none. Edges of one patch are ordered by `jj`, ties by
        their position in the list.
    """
    kernel = cuda_kernel("fastba", kk, jj)
    return neighbors_torch(kk, jj) if kernel is None else kernel.neighbors(kk, jj)


def reproject(poses: Any, patches: Tensor, intrinsics: Tensor, ii: Tensor, jj: Tensor, kk: Tensor) -> Tensor:
    """Project all pixels of the patches into the target frames with camera row 0 and without any depth limit.

    Args:
        poses: (1,N,7) or (N,7) tensor, or an object such as `SE3` whose `.data` is one; world->camera.
        patches: (1,K,3,P,P) or (K,3,P,P), channels x, y, inverse depth.
        intrinsics: (1,N,4) or (N,4) `fx fy cx cy`.
        ii: (E,) int64 source frames.
        jj: (E,) int64 target frames.
        kk: (E,) int64 patch rows.

    Returns:
        (1,E,2,P,P) pixel positions in the dtype of `patches`; not finite for points in the camera plane (Z = 0).
    """
    kernel = cuda_kernel("fastba", poses.data, patches)
    implementation = torch_twin.reproject if kernel is None else kernel.reproject
    return implementation(poses.data, patches, intrinsics, ii, jj, kk)
