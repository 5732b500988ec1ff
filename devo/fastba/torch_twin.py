"""Torch twin of the bundle adjustment kernel: the specification, on any device.

State is read and written in the caller's dtype. The normal matrix of a monocular problem is nearly singular along the
free scale, where float32 leaves little more than rounding errors. So there are two ways to set up and solve it: in
float32 in the order of the published kernel, for parity with it, and in float64 over blocks of frame pairs, which is
faster and accurate.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from devo.errors import InputError
from devo.fastba.published_order import Edges, linearize
from devo.graph import PairBlocks, frame_pairs, pair_blocks, relative_poses, unique_with_inverse
from devo.lietorch import SE3
from devo.lietorch.quaternion import quat_normalize
from devo.normal_equations import Layout, Measurements, depth_system, observe, pose_system, solve

MAX_RESIDUAL = 128.0  # pixels
MARGIN = 64.0  # pixels outside the image
POSE_DAMPING = 1.0
MAX_INV_DEPTH, RESET_INV_DEPTH, MIN_INV_DEPTH = 20.0, 1.0, 1e-4


class BAResult(NamedTuple):
    """What the solver did; E edges, M' distinct patches.

    `success`: every requested iteration was applied (True as well when there was nothing to do).
    `iterations`: number of iterations applied; after a failure the state is that of the last of them.
    `patch_ids`: (M',) int64 distinct `kk`, ascending.
    `depth_information`: (M',) float64, diagonal C of the last linearisation: information (inverse variance) of each
        inverse depth with poses held, if a weight of 1 means a standard deviation of one feature-map pixel.
    `valid`: (E,) bool, edges that took part in the last linearisation.
    `residual`: (E,2) target - projection at the last linearisation in feature-map pixels, dtype of `target`; 0 for
        edges that are not valid.
    """

    success: bool
    iterations: int
    patch_ids: Tensor
    depth_information: Tensor
    valid: Tensor
    residual: Tensor


def _rows(tensor: Tensor, dims: int, name: str) -> Tensor:
    """View without the batch dimension of size 1."""
    if tensor.dim() == dims + 1 and tensor.shape[0] == 1:
        return tensor[0]
    if tensor.dim() != dims:
        raise InputError(f"{name} has shape {tuple(tensor.shape)}; expected {dims} dimensions and a batch of at most 1")
    return tensor


def _check(target: Tensor, weight: Tensor, ii: Tensor, jj: Tensor, kk: Tensor) -> None:
    edges = kk.numel()
    if target.shape != (edges, 2) or weight.shape != (edges, 2) or ii.numel() != edges or jj.numel() != edges:
        shapes = {"target": tuple(target.shape), "weight": tuple(weight.shape), "ii": ii.numel(), "jj": jj.numel()}
        raise InputError(f"kk has {edges} edges, but {shapes}; expected target and weight (1,E,2), ii and jj (E,)")


def _limits(
    intrinsics: Tensor, frame: Tensor, image_size: tuple[float, float] | None, per_frame: bool
) -> tuple[Tensor, Tensor]:
    """Cameras (4,S or 1,1) of the target frames and the largest valid pixels (2,S or 1,1)."""
    camera = (intrinsics[frame] if per_frame else intrinsics[:1]).t().unsqueeze(2)
    if image_size is None:
        return camera, 2 * camera[2:] + MARGIN
    height, width = image_size
    return camera, camera.new_tensor([width + MARGIN, height + MARGIN]).view(2, 1, 1)


def _measure(
    blocks: PairBlocks,
    patches: Tensor,
    intrinsics: Tensor,
    target: Tensor,
    weight: Tensor,
    kk: Tensor,
    image_size: tuple[float, float] | None,
    per_frame: bool,
) -> Measurements:
    """Measurements in blocks, in float64; places with a number that is not finite are not usable and hold zeros."""
    place, size = blocks.edge.flatten(), blocks.edge.shape
    middle = patches.shape[-1] // 2
    intrinsics = intrinsics.double()
    camera, upper = _limits(intrinsics, blocks.target, image_size, per_frame)
    source = intrinsics[blocks.source].t().unsqueeze(2) if per_frame else camera
    centre = patches[:, :, middle, middle].index_select(0, kk[place]).double().t().view(3, *size)
    seen = torch.cat((target, weight), 1).index_select(0, place).double().t().view(4, *size)
    columns = torch.cat(((centre[:2] - source[2:]) / source[:2], centre[2:], seen))
    usable = torch.isfinite(columns).all(0) & blocks.used
    columns = torch.where(usable, columns, 0.0)
    return Measurements(
        ray=columns[:2],
        target=columns[3:5],
        weight=columns[5:] * (blocks.source != blocks.target)[:, None],  # self edges say nothing
        usable=usable,
        camera=camera,
        lower=torch.full_like(upper, -MARGIN),
        upper=upper,
        max_residual=MAX_RESIDUAL,
    )


def _arrange(ii: Tensor, jj: Tensor, patch: Tensor, patches: int, t0: int, t1: int) -> tuple[PairBlocks, Layout, int]:
    """Edges in blocks, those that see a free pose first, and the number of these."""
    blocks = pair_blocks(ii, jj)
    is_free = ((blocks.source >= t0) & (blocks.source < t1)) | ((blocks.target >= t0) & (blocks.target < t1))
    order = torch.argsort(is_free, descending=True, stable=True)
    blocks = PairBlocks(*(field[order] for field in blocks))
    slots = [torch.where((frame >= t0) & (frame < t1), frame - t0 + 1, 0) for frame in (blocks.source, blocks.target)]
    layout = Layout(slots[0], slots[1], patch[blocks.edge], 1, max(t1 - t0, 0), patches)
    return blocks, layout, int(is_free.sum())


def _step(
    poses: Tensor,
    inv_depth: Tensor,
    blocks: PairBlocks,
    m: Measurements,
    layout: Layout,
    moving: int,
    lmbda: Tensor,
) -> tuple[Tensor | None, Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Pose step, depth step, whether they can be used; C, valid places, residual."""
    G = relative_poses(poses, blocks.source, blocks.target)
    # A pair with a broken pose becomes G = 0, which puts its points at Z = 0: its edges are not valid.
    G = torch.where(torch.isfinite(G).flatten(1).all(1)[:, None, None], G, 0.0)
    depth = torch.where(m.usable, inv_depth[layout.patch], 0.0)
    seen, depth_terms = observe(G, depth, m)
    C, u = depth_system(depth_terms, layout)
    system = pose_system(seen.first(moving), G[:moving], layout.first(moving)) if layout.free else None
    dX, dZ, solved = solve(C, u, system, lmbda, POSE_DAMPING)
    usable = solved[0] & torch.isfinite(dZ).all()
    return dX, dZ[0], usable, C[0], seen.valid, seen.residual


class _BlockProblem:
    """The problem in float64, over blocks of frame pairs."""

    def __init__(self, poses: Tensor, patches: Tensor, intrinsics: Tensor, target: Tensor, weight: Tensor, ii: Tensor,
                 jj: Tensor, kk: Tensor, patch_of_edge: Tensor, count: int, t0: int, t1: int, lmbda: Tensor,
                 image_size: tuple[float, float] | None, per_frame: bool) -> None:
        self.poses, self.lmbda, self.target = poses, lmbda, target
        self.blocks, self.layout, self.moving = _arrange(ii, jj, patch_of_edge, count, t0, t1)
        self.measurements = _measure(self.blocks, patches, intrinsics, target, weight, kk, image_size, per_frame)
        self.valid = torch.zeros_like(self.blocks.used)
        self.residual = torch.zeros_like(self.measurements.target)

    def step(self, inv_depth: Tensor) -> tuple[Tensor | None, Tensor, Tensor, Tensor]:
        """Pose step, depth step, whether they can be used, and C."""
        dX, dZ, usable, information, self.valid, self.residual = _step(
            self.poses, inv_depth.double(), self.blocks, self.measurements, self.layout, self.moving, self.lmbda)
        return dX, dZ, usable, information

    def verdict(self) -> tuple[Tensor, Tensor]:
        """Per edge: valid `(E,)` and residual `(E,2)` at the last linearisation."""
        edge, used = self.blocks.edge[self.blocks.used], self.blocks.used
        valid = torch.zeros(len(self.target), dtype=torch.bool, device=self.target.device)
        valid[edge] = self.valid[used]
        residual = torch.zeros_like(self.target)
        residual[edge] = self.residual[:, used].t().to(self.target.dtype)
        return valid, residual


class _PublishedProblem:
    """The same problem in the caller's dtype, in the order of the published kernel."""

    def __init__(self, poses: Tensor, patches: Tensor, intrinsics: Tensor, target: Tensor, weight: Tensor, ii: Tensor,
                 jj: Tensor, kk: Tensor, patch_of_edge: Tensor, count: int, t0: int, t1: int, lmbda: Tensor,
                 image_size: tuple[float, float] | None, per_frame: bool) -> None:
        middle = patches.shape[-1] // 2
        camera = intrinsics[jj] if per_frame else intrinsics[:1]
        source = intrinsics[ii] if per_frame else camera
        upper = 2 * camera[:, 2:] if image_size is None else camera.new_tensor([[image_size[1], image_size[0]]])
        centre = patches[kk, :, middle, middle]
        ray = torch.cat(((centre[:, :2] - source[:, 2:]) / source[:, :2], torch.ones_like(centre[:, :1])), 1)
        whole = torch.isfinite(poses).all(1) & (poses[:, 3:] != 0).any(1)
        usable = torch.isfinite(torch.cat((ray, centre, target, weight), 1)).all(1) & whole[ii] & whole[jj]
        ray, target, weight = (torch.where(usable[:, None], rows, 0.0) for rows in (ray, target, weight))
        self.edges = Edges(ray, target, weight, usable, camera, upper + MARGIN, MARGIN, MAX_RESIDUAL, ii, jj,
                           patch_of_edge)
        self.poses, self.lmbda = poses, lmbda.to(poses.dtype)
        self.t0, self.free, self.count = t0, max(t1 - t0, 0), count
        self.valid, self.residual = torch.zeros_like(usable), torch.zeros_like(target)

    def step(self, inv_depth: Tensor) -> tuple[Tensor | None, Tensor, Tensor, Tensor]:
        """Pose step, depth step, whether they can be used, and C."""
        s = linearize(self.poses, inv_depth, self.edges, self.t0, self.free, self.count)
        self.valid, self.residual = s.valid, s.residual
        system = (s.B[None], s.E[None], s.v[None, :, None]) if self.free else None
        dX, dZ, solved = solve(s.C[None], s.u[None], system, self.lmbda, POSE_DAMPING)
        return dX, dZ[0], solved[0] & torch.isfinite(dZ).all(), s.C

    def verdict(self) -> tuple[Tensor, Tensor]:
        """Per edge: valid `(E,)` and residual `(E,2)` at the last linearisation."""
        return self.valid, self.residual


def _apply(poses: Tensor, depths: Tensor, dX: Tensor | None, dZ: Tensor, t0: int) -> Tensor:
    """Move the poses in place and return the new depths; numbers that are not finite stay what they are."""
    if dX is not None:
        moved = poses[t0 : t0 + dX.shape[1]]
        new = SE3.exp(dX[0].double()).mul(SE3(moved.double())).data
        new = torch.cat((new[:, :3], quat_normalize(new[:, 3:])), 1)
        moved.copy_(torch.where(torch.isfinite(new).all(1, keepdim=True), new.to(moved.dtype), moved))
    new = depths + dZ.to(depths.dtype)
    new = torch.where(new > MAX_INV_DEPTH, RESET_INV_DEPTH, new).clamp(min=MIN_INV_DEPTH)
    return torch.where(torch.isfinite(depths), new, depths)


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
    """Torch twin of `devo.fastba.BA`; the same arguments (poses as tensor) and results.

    Edges with a number that is not finite (pose, patch centre, target, weight) are not valid. An inverse depth that is
    not finite is left as it is, and so is a pose.
    """
    pose_rows = _rows(poses.detach(), 2, "poses")
    patch_rows = _rows(patches.detach(), 4, "patches")
    target_rows, weight_rows = _rows(target.detach(), 2, "target"), _rows(weight.detach(), 2, "weight")
    _check(target_rows, weight_rows, ii, jj, kk)
    if kk.numel() == 0:
        nothing = target_rows.new_zeros(0, 2)
        return BAResult(True, 0, kk.clone(), nothing.double()[:, 0], nothing[:, 0].bool(), nothing)
    t0, t1 = max(int(t0), 0), min(int(t1), pose_rows.shape[0])
    patch_ids, patch_of_edge = unique_with_inverse(kk)
    damping = torch.as_tensor(lmbda, dtype=torch.float64, device=patch_rows.device).reshape(())
    problem = (_BlockProblem if accurate else _PublishedProblem)(
        pose_rows, patch_rows, _rows(intrinsics, 2, "intrinsics"), target_rows, weight_rows, ii, jj, kk, patch_of_edge,
        patch_ids.numel(), t0, t1, damping, image_size, per_frame_intrinsics)
    middle = patch_rows.shape[-1] // 2
    done, success = 0, True
    information = damping.new_zeros(patch_ids.numel())
    for _ in range(iterations):
        dX, dZ, usable, information = problem.step(patch_rows[patch_ids, 2, middle, middle])
        if not bool(usable):
            success = False
            break
        patch_rows[patch_ids, 2] = _apply(pose_rows, patch_rows[patch_ids, 2, 0, 0], dX, dZ, t0)[:, None, None]
        done += 1
    return BAResult(success, done, patch_ids, information.double(), *problem.verdict())


@torch.no_grad()
def reproject(poses: Tensor, patches: Tensor, intrinsics: Tensor, ii: Tensor, jj: Tensor, kk: Tensor) -> Tensor:
    """Torch twin of `devo.fastba.reproject`; the same arguments (poses as tensor) and result."""
    patch_rows = _rows(patches, 4, "patches")
    pairs = frame_pairs(ii, jj)
    G = relative_poses(_rows(poses, 2, "poses"), pairs.source, pairs.target)[pairs.of_edge][..., None, None]
    fx, fy, cx, cy = _rows(intrinsics, 2, "intrinsics")[0].double()
    x, y, d = patch_rows[kk].double().unbind(1)  # (E,P,P) each
    x, y = (x - cx) / fx, (y - cy) / fy
    X, Y, Z = (G[:, r, 0] * x + G[:, r, 1] * y + G[:, r, 2] + G[:, r, 3] * d for r in range(3))
    return torch.stack((fx * X / Z + cx, fy * Y / Z + cy), 1)[None].to(patches.dtype)
