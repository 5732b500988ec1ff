"""`ba`, `reproject` and `neighbors` on CUDA: the kernels of `kernels.cu` with the arguments and results of the twins.

`ba` linearises all edges in one kernel and moves the state in two; the Schur complement and its Cholesky factorisation
are those of the twin, on the device. The host waits only once, for the number of iterations that were applied.
`neighbors` is the twin itself: two sorts and a comparison leave nothing for a kernel of our own to gain. Importing this
module fails where the library is not built.
"""

from __future__ import annotations

import torch
from torch import Tensor

from devo.cuda_library import CudaLibrary
from devo.fastba import torch_twin
from devo.fastba.edge_neighbors import neighbors_torch as neighbors
from devo.fastba.torch_twin import (
    MARGIN,
    MAX_INV_DEPTH,
    MAX_RESIDUAL,
    MIN_INV_DEPTH,
    POSE_DAMPING,
    RESET_INV_DEPTH,
    BAResult,
)
from devo.graph import unique_with_inverse
from devo.normal_equations import solve

__all__ = ["ba", "neighbors", "reproject"]

SIGNATURES = {
    "devo_reproject": "ippppppiiiip",
    "devo_linearize": "ippppppppp" + "iiiiddddi" + "pppppiiipp",
    "devo_move_poses": "ippip",
    "devo_move_depths": "ipppiiidddp",
}
STATE_TYPES = {torch.float32: 0, torch.float64: 1}
LIBRARY = CudaLibrary("fastba", SIGNATURES)


@torch.no_grad()
def reproject(poses: Tensor, patches: Tensor, intrinsics: Tensor, ii: Tensor, jj: Tensor, kk: Tensor) -> Tensor:
    """Project patch pixels into the target frames; arguments and result of the torch twin.

    An edge whose frame or patch does not exist gives NaN. State that is neither float32 nor float64, or of mixed
    dtypes, is left to the twin.
    """
    pose_rows = torch_twin._rows(poses.detach(), 2, "poses")
    patch_rows = torch_twin._rows(patches.detach(), 4, "patches")
    if pose_rows.dtype != patch_rows.dtype or patch_rows.dtype not in STATE_TYPES:
        return torch_twin.reproject(poses, patches, intrinsics, ii, jj, kk)
    camera = torch_twin._rows(intrinsics, 2, "intrinsics")[0].double().contiguous()
    pose_rows, patch_rows = pose_rows.contiguous(), patch_rows.contiguous()
    edges = [index.long().contiguous() for index in (ii, jj, kk)]
    out = patch_rows.new_empty(1, kk.numel(), 2, *patch_rows.shape[2:])
    if out.numel():
        LIBRARY.launch("devo_reproject", out.device, STATE_TYPES[out.dtype], pose_rows, patch_rows, camera, *edges,
                       kk.numel(), len(pose_rows), len(patch_rows), out[0, 0, 0].numel(), out)
    return out


@torch.no_grad()
def ba(
    poses: Tensor,
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
    """Bundle adjustment; arguments (poses as tensor) and results of the torch twin.

    Both values of `accurate` linearise and solve in float64: atomic sums have no order in which the rounding errors of
    the published kernel could be reproduced. Edges whose frames or patch do not exist are not valid. State that is
    neither float32 nor float64, or of mixed dtypes, is left to the twin.
    """
    pose_rows = torch_twin._rows(poses.detach(), 2, "poses")
    patch_rows = torch_twin._rows(patches.detach(), 4, "patches")
    if kk.numel() == 0 or pose_rows.dtype != patch_rows.dtype or patch_rows.dtype not in STATE_TYPES:
        return torch_twin.ba(poses, patches, intrinsics, target, weight, lmbda, ii, jj, kk, t0, t1, iterations,
                             image_size=image_size, per_frame_intrinsics=per_frame_intrinsics, accurate=accurate)
    target_rows, weight_rows = (torch_twin._rows(rows.detach(), 2, name)
                                for rows, name in ((target, "target"), (weight, "weight")))
    torch_twin._check(target_rows, weight_rows, ii, jj, kk)
    t0, t1 = max(int(t0), 0), min(int(t1), len(pose_rows))
    solver = _Solver(pose_rows.contiguous(), patch_rows.contiguous(), torch_twin._rows(intrinsics, 2, "intrinsics"),
                     target_rows, weight_rows, lmbda, (ii, jj, kk), t0, t1, image_size, per_frame_intrinsics)
    applied = [solver.step() for _ in range(iterations)]
    done = int(torch.stack(applied).sum()) if applied else 0
    for rows, changed in ((pose_rows, solver.poses), (patch_rows, solver.patches)):
        if not rows.is_contiguous():
            rows.copy_(changed)
    return BAResult(done == len(applied), done, solver.patch_ids, solver.system.C, solver.valid,
                    solver.residual.to(target.dtype))


class _System:
    """Sums of the normal equations of N free poses and M depths, in one block of memory."""

    def __init__(self, free: int, depths: int, device: torch.device) -> None:
        sizes = [36 * free * free, 6 * free * depths, 6 * free, depths, depths]
        self.sums = torch.zeros(sum(sizes), dtype=torch.float64, device=device)
        B, E, self.v, self.C, self.u = self.sums.split(sizes)
        self.B, self.E = B.view(6 * free, 6 * free), E.view(6 * free, depths)

    def solve(self, lmbda: Tensor) -> tuple[Tensor | None, Tensor, Tensor]:
        """Pose steps (1, N, 6) or `None`, depth steps (1, M), and (1,) whether the system could be factorised."""
        poses = (self.B[None], self.E[None], self.v[None, :, None]) if self.v.numel() else None
        return solve(self.C[None], self.u[None], poses, lmbda, POSE_DAMPING)


class _Solver:
    """The problem on the device; `poses` and `patches` are changed in place."""

    def __init__(self, poses: Tensor, patches: Tensor, intrinsics: Tensor, target: Tensor, weight: Tensor,
                 lmbda: Tensor | float, edges: tuple[Tensor, Tensor, Tensor], t0: int, t1: int,
                 image_size: tuple[float, float] | None, per_frame: bool) -> None:
        device = patches.device
        self.poses, self.patches = poses, patches
        self.patch_ids, self.slot_of_edge = unique_with_inverse(edges[2])
        self.constants = [rows.double().contiguous() for rows in (intrinsics, target, weight)]
        self.edges = [index.long().contiguous() for index in edges]
        self.lmbda = torch.as_tensor(lmbda, dtype=torch.float64, device=device).reshape(())
        height, width = (-1.0, -1.0) if image_size is None else map(float, image_size)
        self.rules = (MARGIN, MAX_RESIDUAL, width, height, per_frame)
        self.t0, self.free = t0, max(t1 - t0, 0)
        self.frames = min(len(poses), len(intrinsics)) if per_frame else len(poses)
        self.going_on = torch.ones((), dtype=torch.bool, device=device)
        self.system = _System(self.free, len(self.patch_ids), device)
        self.valid = torch.zeros(len(edges[2]), dtype=torch.bool, device=device)
        self.residual = torch.zeros(len(edges[2]), 2, dtype=torch.float64, device=device)

    def step(self) -> Tensor:
        """One Gauss-Newton iteration; returns whether it was applied, which is False after the first failure.

        A failed iteration leaves the state as it is, so those that follow see the same system.
        """
        s, device, dtype = self.system, self.patches.device, STATE_TYPES[self.patches.dtype]
        s.sums.zero_()
        sizes = (len(self.edges[0]), self.frames, len(self.patches), self.patches.shape[-1])
        LIBRARY.launch("devo_linearize", device, dtype, self.poses, self.patches, *self.constants, *self.edges,
                       self.slot_of_edge, *sizes, *self.rules, s.B, s.E, s.v, s.C, s.u, self.t0, self.free,
                       len(self.patch_ids), self.valid, self.residual)
        pose_steps, depth_steps, solved = s.solve(self.lmbda)
        self.going_on = self.going_on & solved[0] & torch.isfinite(depth_steps).all()
        if pose_steps is not None:
            moved = self.poses[self.t0 : self.t0 + self.free]
            LIBRARY.launch("devo_move_poses", device, dtype, pose_steps.contiguous(), self.going_on, self.free, moved)
        limits = (MAX_INV_DEPTH, RESET_INV_DEPTH, MIN_INV_DEPTH)
        LIBRARY.launch("devo_move_depths", device, dtype, depth_steps.contiguous(), self.patch_ids, self.going_on,
                       len(self.patch_ids), len(self.patches), self.patches[0, 0].numel(), *limits, self.patches)
        return self.going_on
