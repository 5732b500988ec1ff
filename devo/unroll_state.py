"""State of the unrolled training pass: the joined clips with their truth, and the growing graph of their edges."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
import torch.nn.functional as F
from torch import Tensor

from devo.edges import EdgeGroups
from devo.graph import pair_blocks

if TYPE_CHECKING:
    from devo.enet import eVONet
    from devo.lietorch import SE3

FLAT_INV_DEPTH = 0.5
FLAT_SPREAD = 0.5  # standard deviation, in octaves
DISTURBANCE = 0.4  # standard deviation of ln(inverse depth)
DISTURBED_SHARE = 0.5  # of the patches
DEPTH_TOLERANCE = 0.15  # relative excess of inverse depth beyond which a point counts as hidden behind another


@dataclass(frozen=True)
class UnrollSettings:
    """How the graph is built and what is reported.

    Attributes:
        steps: number of updates; 0 for matching alone (`probe`, `match_updates`).
        patches_per_image: patches per frame, M.
        structure_only: poses start at the truth and stay; only inverse depths are solved.
        initial_frames: frames of the dense first graph; it also is the number of updates before the graph grows.
        drop_probability: chance, per growth step, to delete all edges of the frame four before the new one.
        flat_depth: chance, per clip, to start with equal inverse depths for all patches (about `FLAT_INV_DEPTH`, as the
            tracker does) instead of values drawn from U(0,1). Random depths often lead to the mirrored solution.
        flow_radius, score_radius: largest frame distance of the edges reported for the flow and the scorer loss.
        solver_iterations: Gauss-Newton steps per update.
        solver_gradient_every: 1: gradients flow through every bundle adjustment; k: through every k-th (and the last),
            the others only move the geometry.
        match_gradient_every: the correlation features carry gradient to the encoders in every k-th update.
        probe: also run one update from a zero state on single edges between two frames, as the tracker's start-up does.
        match_updates: also run so many updates on edges that start off the truth, each in its own way.
        depth_noise: chance, per update, that the inverse depths of half of the patches are disturbed after it.
        mixed_precision: None (float32) or the type of autocast for encoders and update operator.
    """

    steps: int = 12
    patches_per_image: int = 80
    structure_only: bool = False
    initial_frames: int = 8
    drop_probability: float = 0.1
    flat_depth: float = 0.0
    flow_radius: int = 2
    score_radius: int = 16
    solver_iterations: int = 2
    solver_gradient_every: int = 1
    match_gradient_every: int = 1
    probe: bool = False
    match_updates: int = 0
    depth_noise: float = 0.0
    mixed_precision: torch.dtype | None = None


class JoinedClips:
    """Features, truth and current estimate of all clips of one step."""

    def __init__(
        self, network: eVONet, images: Tensor, poses: SE3, disps: Tensor, intrinsics: Tensor, settings: UnrollSettings
    ) -> None:
        from devo.altcorr import CorrBlock
        from devo.lietorch import SE3

        self.clips, self.frames = images.shape[:2]
        self.per_frame = settings.patches_per_image
        self.settings = settings
        self.network = network
        flat = self.clips * self.frames
        disps = disps[..., 1::4, 1::4]
        with self.autocast():
            fmap, gmap, imap, patches, _, *rest = network.patchify(
                images, patches_per_image=self.per_frame, disps=disps
            )
        self.scores: Tensor | None = rest[0] if rest else None
        self.height, self.width = fmap.shape[-2:]
        self.patches_gt = patches.detach().float()
        self.patches = self._with_depth(self._start_depth())
        fmap = fmap.float().reshape(1, flat, *fmap.shape[2:])
        self.correlate = CorrBlock(
            fmap, gmap.float(), clips=self.clips, compute_dtype=settings.mixed_precision or torch.float32
        )
        self.context = imap.reshape(flat * self.per_frame, -1)
        self.intrinsics = (intrinsics / network.RES).reshape(1, flat, 4)
        self.nearest_point_free = -F.max_pool2d(-disps.reshape(flat, 1, *disps.shape[-2:]), 3, 1, 1)[:, 0]
        world = poses.data.reshape(self.clips, self.frames, 7)
        relative = SE3(world) * SE3(world[:, :1]).inv()  # the first frame of each clip is its world frame
        self.poses_gt = SE3(relative.data.reshape(1, flat, 7))
        self.poses = self.poses_gt

    def autocast(self) -> contextlib.AbstractContextManager[object]:
        """Lower precision for encoders and update operator, if asked for."""
        kind = self.settings.mixed_precision
        if kind is None:
            return contextlib.nullcontext()
        device = next(self.network.parameters()).device.type
        return torch.autocast(device, dtype=kind)

    def _start_depth(self) -> Tensor:
        """Inverse depths (1,B*n*M,1,1,1) before the first update."""
        device = self.patches_gt.device
        random = torch.rand(self.clips, self.frames * self.per_frame).to(device)
        level = (FLAT_INV_DEPTH * 2.0 ** (FLAT_SPREAD * torch.randn(self.clips, 1))).to(device)
        flat = (torch.rand(self.clips, 1) < self.settings.flat_depth).to(device)
        return torch.where(flat, level.expand_as(random), random).view(1, -1, 1, 1, 1)

    def _with_depth(self, inv_depth: Tensor) -> Tensor:
        return torch.cat([self.patches_gt[:, :, :2], inv_depth.expand_as(self.patches_gt[:, :, 2:])], dim=2)

    def disturb_depths(self) -> None:
        """Multiply the inverse depths of some patches by random factors, so that each needs a correction of its own."""
        count = self.patches.shape[1]
        factor = torch.where(
            torch.rand(count) < DISTURBED_SHARE, torch.exp(DISTURBANCE * torch.randn(count)), torch.ones(count)
        )
        self.patches = self._with_depth(self.patches[:, :, 2:] * factor.to(self.patches).view(1, -1, 1, 1, 1))

    def start_poses(self, fraction: Tensor | None) -> SE3:
        """Poses between identity (fraction 0) and the truth (1) along the geodesic of each frame.

        Args:
            fraction: (B,) or None for identity.
        """
        from devo.lietorch import SE3

        if fraction is None:
            return SE3.Identity(1, self.clips * self.frames, device=self.patches.device, dtype=self.patches.dtype)
        tangent = self.poses_gt.log().view(self.clips, self.frames, 6) * fraction.view(-1, 1, 1).to(self.patches)
        return SE3.exp(tangent.view(1, -1, 6))

    def start_frame(self, new: int) -> None:
        """Start frame `new` of each clip: pose of the frame before, depths at the median of the two frames before."""
        from devo.lietorch import SE3

        if not self.settings.structure_only:
            poses = self.poses.data.view(self.clips, self.frames, 7)
            poses = torch.cat([poses[:, :new], poses[:, new - 1 : new].expand(-1, self.frames - new, -1)], dim=1)
            self.poses = SE3(poses.reshape(1, -1, 7))
        patches = self.patches.view(self.clips, self.frames, self.per_frame, *self.patches.shape[2:]).clone()
        recent = patches[:, max(new - 2, 0) : new, :, 2].reshape(self.clips, -1)
        patches[:, new, :, 2] = recent.median(dim=1).values.view(-1, 1, 1, 1)
        self.patches = patches.view_as(self.patches)

    def poses_of(self, frames: int) -> SE3:
        """Current poses of the first `frames` frames of each clip, (B, frames)."""
        from devo.lietorch import SE3

        return SE3(self.poses.data.view(self.clips, self.frames, 7)[:, :frames])

    def edges(self, ii: Tensor, jj: Tensor, kk: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Global indices, clip-major, of edges given for one clip."""
        clip = torch.arange(self.clips, device=ii.device)[:, None]
        frames = clip * self.frames
        return (
            (ii[None] + frames).reshape(-1),
            (jj[None] + frames).reshape(-1),
            (kk[None] + frames * self.per_frame).reshape(-1),
        )

    @torch.no_grad()
    def truth(self, ii: Tensor, jj: Tensor, kk: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """True reprojections (1,E,P,P,2), in front of the camera (1,E), and visible as well (1,E)."""
        from devo import projective_ops as pops

        coords, valid = pops.transform(
            self.poses_gt, self.patches_gt, self.intrinsics, ii, jj, kk, depth=True, valid=True
        )
        coords, inv_z = coords[..., :2], coords[..., 2]
        middle = coords.shape[2] // 2
        centre = coords[0, :, middle, middle]
        inv_depth = inv_z[0, :, middle, middle] * self.patches_gt[0, :, 2, middle, middle].index_select(0, kk)
        column, row = centre[:, 0].round(), centre[:, 1].round()
        inside = (column >= 0) & (row >= 0) & (column < self.width) & (row < self.height)
        cell = (jj * self.height + row.clamp(0, self.height - 1).long()) * self.width + column.clamp(
            0, self.width - 1
        ).long()
        hidden = self.nearest_point_free.reshape(-1)[cell] > inv_depth * (1.0 + DEPTH_TOLERANCE)
        valid = valid.bool()
        return coords, valid, valid & (inside & ~hidden)[None]

    def update(
        self,
        net: Tensor,
        coords: Tensor,
        ii: Tensor,
        jj: Tensor,
        kk: Tensor,
        groups: EdgeGroups,
        match_gradient: bool = True,
    ) -> tuple[Tensor, Tensor, Tensor]:
        """One update of the hidden state, `(net, delta, weight)`, at reprojections (1,E,P,P,2)."""
        with contextlib.nullcontext() if match_gradient else torch.no_grad():
            corr = self.look_up(coords, jj, kk)
        return self.revise(net, corr, ii, jj, kk, groups)

    def look_up(self, coords: Tensor, jj: Tensor, kk: Tensor) -> Tensor:
        """Correlation features (1,E,7*7*P*P*2) around reprojections (1,E,P,P,2): shift x, shift y, patch, level."""
        return self.correlate(kk, jj, coords.permute(0, 1, 4, 2, 3))

    def revise(
        self, net: Tensor, corr: Tensor, ii: Tensor, jj: Tensor, kk: Tensor, groups: EdgeGroups
    ) -> tuple[Tensor, Tensor, Tensor]:
        """What the update operator makes of correlation features: `(net, delta, weight)`."""
        with self.autocast():
            context = self.context.index_select(0, kk)[None]
            net, (delta, weight, _) = self.network.update(net, context, corr, None, ii, jj, kk, groups=groups)
        return net.float(), delta.float(), weight.float()


class GrowingGraph:
    """Edges of one clip (all have the same), their hidden states and their truth, newest edges first."""

    def __init__(self, clips: JoinedClips) -> None:
        self.source = clips
        self.frames = min(clips.settings.initial_frames, clips.frames)
        device = clips.patches.device
        self.ii = self.jj = self.kk = torch.zeros(0, dtype=torch.int64, device=device)
        dim = clips.context.shape[1]
        self.net = torch.zeros(clips.clips, 0, dim, device=device)
        patches = torch.arange(self.frames * clips.per_frame, device=device)
        self._prepend(*_all_pairs(patches, torch.arange(self.frames, device=device)))
        self._index()

    def _prepend(self, kk: Tensor, jj: Tensor) -> None:
        clips = self.source
        ii = kk // clips.per_frame
        coords, valid, visible = clips.truth(*clips.edges(ii, jj, kk))
        new = (
            coords.view(clips.clips, -1, *coords.shape[2:]),
            valid.view(clips.clips, -1),
            visible.view(clips.clips, -1),
        )
        zeros = self.net.new_zeros(clips.clips, len(kk), self.net.shape[2])
        if len(self.kk) == 0:
            self.coords_gt, self.valid, self.visible = new
            self.net = zeros
        else:
            self.coords_gt, self.valid, self.visible = (
                torch.cat([fresh, old], dim=1) for fresh, old in zip(new, (self.coords_gt, self.valid, self.visible))
            )
            self.net = torch.cat([zeros, self.net], dim=1)
        self.ii, self.jj, self.kk = (torch.cat(pair) for pair in ((ii, self.ii), (jj, self.jj), (kk, self.kk)))

    def grow(self) -> None:
        """Add the next frame: its edges, its pose (that of the frame before) and its depths (recent median)."""
        clips, new = self.source, self.frames
        per_frame, settings = clips.per_frame, clips.settings
        device = self.kk.device
        earlier = torch.arange(new * per_frame, device=device)
        own = torch.arange(new * per_frame, (new + 1) * per_frame, device=device)
        to_new = _all_pairs(earlier, torch.tensor([new], device=device))
        from_new = _all_pairs(own, torch.arange(new + 1, device=device))
        self._prepend(torch.cat([to_new[0], from_new[0]]), torch.cat([to_new[1], from_new[1]]))
        if settings.drop_probability > 0 and float(torch.rand(())) < settings.drop_probability:
            self._keep((self.ii != new - 4) & (self.jj != new - 4))
        self.frames = new + 1
        clips.start_frame(new)
        self._index()

    def _keep(self, mask: Tensor) -> None:
        keep = mask.nonzero()[:, 0]
        self.ii, self.jj, self.kk = (index[keep] for index in (self.ii, self.jj, self.kk))
        self.coords_gt, self.valid, self.visible = (x[:, keep] for x in (self.coords_gt, self.valid, self.visible))
        self.net = self.net.index_select(1, keep)

    def _index(self) -> None:
        settings = self.source.settings
        self.edges = self.source.edges(self.ii, self.jj, self.kk)
        self.groups = EdgeGroups.build(*self.edges)
        self.blocks = pair_blocks(self.edges[0], self.edges[1])
        distance = (self.ii - self.jj).abs()
        self.near = ((distance > 0) & (distance <= settings.flow_radius)).nonzero()[:, 0]
        self.scored = ((distance > 0) & (distance <= settings.score_radius)).nonzero()[:, 0]
        self.distance = distance

    def select(self, local: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Global indices of some edges of each clip."""
        return self.source.edges(self.ii[local], self.jj[local], self.kk[local])


def _all_pairs(first: Tensor, second: Tensor) -> tuple[Tensor, Tensor]:
    """All combinations, the second index varying fastest."""
    return first.repeat_interleave(len(second)), second.repeat(len(first))
