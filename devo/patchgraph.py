"""Keyframes, patches and the edges between them: the state that the tracker updates.

Edge `e` is the triple `(ii, jj, kk)`: patch `kk`, its host keyframe `ii`, and the keyframe `jj` it is seen in.
Poses are `cam_T_world`, coordinates quarter-resolution pixels, depths inverse z-depths in the host camera.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from devo.lietorch import SE3

_ROW_BUFFERS = ("tstamps_", "poses_", "patches_", "intrinsics_", "colors_")


_EDGE_FIELDS = ("ii", "jj", "kk", "target", "weight")


@dataclass
class EdgeRecords:
    """Edges as observations: what is left of them for the point quality at the end.

    `ii, jj, kk` are integers `(E,)` (int32 once retired), `target` `(E,2)` the measured centre position in keyframe
    `jj` (quarter-resolution px) and `weight` `(E,2)` its confidence in (0,1). `newest` is the largest keyframe index
    that occurs, known without looking at the tensors.
    """

    ii: Tensor
    jj: Tensor
    kk: Tensor
    target: Tensor
    weight: Tensor
    newest: int = -1

    def __len__(self) -> int:
        return len(self.kk)

    def select(self, mask: Tensor) -> EdgeRecords:
        """The edges where `mask` (bool `(E,)`) is set."""
        ii, jj, kk = self.ii[mask], self.jj[mask], self.kk[mask]
        return EdgeRecords(ii, jj, kk, self.target[mask], self.weight[mask], self.newest)

    def compact(self) -> EdgeRecords:
        """The same edges with int32 indices, for keeping over a long run."""
        newest = int(torch.maximum(self.ii, self.jj).max()) if len(self) else -1
        return EdgeRecords(self.ii.int(), self.jj.int(), self.kk.int(), self.target, self.weight, newest)

    @staticmethod
    def concatenate(records: list[EdgeRecords]) -> EdgeRecords:
        """All edges of a non-empty list in order, with int64 indices."""
        columns = [torch.cat([getattr(record, name) for record in records]) for name in _EDGE_FIELDS]
        return EdgeRecords(columns[0].long(), columns[1].long(), columns[2].long(), columns[3], columns[4])


@dataclass
class DroppedFrame:
    """What is kept of a keyframe that was removed: its patch centres and its pose relative to an older keyframe.

    `counter` counts accepted frames; `patches (M,3,1,1)` (no more than centres, as runs are long) and `intrinsics (4,)`
    are at quarter resolution; `colors (M,3)` uint8.
    """

    counter: int
    patches: Tensor
    intrinsics: Tensor
    colors: Tensor


class PatchGraph:
    """Keyframe buffers that grow on demand, and the edge list.

    Buffers (first dimension: keyframe slot, `n` of `N` in use): `tstamps_ (N,)` int64 accepted-frame counter,
    `poses_ (N,7)` `cam_T_world`, `patches_ (N,M,3,P,P)` with channels x, y, inverse depth, `intrinsics_ (N,4)`
    at quarter resolution, `colors_ (N,M,3)` uint8, `index_ (N,M)` host keyframe of each patch.
    `delta[t] = (t0, t_T_t0)` says how a frame without keyframe hangs on an earlier frame `t0`.
    """

    def __init__(self, patches_per_frame: int, patch_size: int, capacity: int, hidden_dim: int,
                 device: torch.device, *, keep_dropped_frames: bool = False) -> None:
        self.M, self.P, self.N = patches_per_frame, patch_size, capacity
        self.device = device
        self.n = 0  # keyframes
        self.m = 0  # patches
        self.tstamps_ = torch.zeros(capacity, dtype=torch.int64, device=device)
        self.poses_ = _identity_poses(capacity, device)
        self.patches_ = torch.zeros(capacity, self.M, 3, self.P, self.P, device=device)
        self.intrinsics_ = torch.zeros(capacity, 4, device=device)
        self.colors_ = torch.zeros(capacity, self.M, 3, dtype=torch.uint8, device=device)
        self.index_ = _patch_hosts(capacity, self.M, device)
        self.net = torch.zeros(1, 0, hidden_dim, device=device)
        self.ii = torch.zeros(0, dtype=torch.int64, device=device)
        self.jj = torch.zeros_like(self.ii)
        self.kk = torch.zeros_like(self.ii)
        self.target_ = torch.zeros(1, 0, 2, device=device)
        self.weight_ = torch.zeros(1, 0, 2, device=device)
        self.delta: dict[int, tuple[int, Tensor]] = {}
        self.retired_edges: list[EdgeRecords] = []
        self.keep_dropped_frames = keep_dropped_frames
        self.dropped_frames: list[DroppedFrame] = []

    @property
    def poses(self) -> SE3:
        """`cam_T_world` of all slots as a group element of batch shape `(1, N)`."""
        return SE3(self.poses_[None])

    @property
    def patches(self) -> Tensor:
        """All patches, `(1, N*M, 3, P, P)`, a view of the buffer."""
        return self.patches_.view(1, self.N * self.M, 3, self.P, self.P)

    def patch_centers(self, rows: int | slice) -> Tensor:
        """The centres of the patches of some keyframes, `(..., M, 3, 1, 1)`, a view of the buffer."""
        centre = slice(self.P // 2, self.P // 2 + 1)
        return self.patches_[rows, ..., centre, centre]

    @property
    def intrinsics(self) -> Tensor:
        """Quarter-resolution `fx fy cx cy` of all slots, `(1, N, 4)`, a view of the buffer."""
        return self.intrinsics_[None]

    @property
    def ix(self) -> Tensor:
        """Host keyframe of every patch, `(N*M,)` int64."""
        return self.index_.view(-1)

    def reserve(self, keyframes: int) -> None:
        """Make room for at least `keyframes` slots by doubling the buffers; contents stay."""
        if keyframes <= self.N:
            return
        capacity = max(2 * self.N, keyframes)
        extra = capacity - self.N
        for name in _ROW_BUFFERS:
            old = getattr(self, name)
            fresh = _identity_poses(extra, self.device) if name == "poses_" else old.new_zeros(extra, *old.shape[1:])
            setattr(self, name, torch.cat([old, fresh]))
        self.index_ = _patch_hosts(capacity, self.M, self.device)
        self.N = capacity

    def append_factors(self, patch_ids: Tensor, jj: Tensor) -> None:
        """Connect patches `patch_ids (E,)` with keyframes `jj (E,)`; hidden states start at zero."""
        count = len(patch_ids)
        self.jj = torch.cat([self.jj, jj])
        self.kk = torch.cat([self.kk, patch_ids])
        self.ii = torch.cat([self.ii, self.ix[patch_ids]])
        self.net = torch.cat([self.net, self.net.new_zeros(1, count, self.net.shape[2])], dim=1)
        self.target_ = torch.cat([self.target_, self.target_.new_zeros(1, count, 2)], dim=1)
        self.weight_ = torch.cat([self.weight_, self.weight_.new_zeros(1, count, 2)], dim=1)

    def remove_factors(self, mask: Tensor, *, retire: bool = False) -> None:
        """Drop the edges where `mask` (bool `(E,)`) is set; `retire` keeps them as observations.

        Only edges that were measured at least once (weight above zero) are worth keeping.
        """
        if retire:
            measured = mask & (self.weight_[0] > 0).any(dim=1)
            if bool(measured.any()):
                self.retired_edges.append(self.active_edges().select(measured).compact())
        keep = torch.nonzero(~mask)[:, 0]
        self.ii, self.jj, self.kk = self.ii[keep], self.jj[keep], self.kk[keep]
        self.net = self.net[:, keep]
        self.target_ = self.target_[:, keep]
        self.weight_ = self.weight_[:, keep]

    def active_edges(self) -> EdgeRecords:
        """The edges that are still being optimised, with their latest measurements."""
        return EdgeRecords(self.ii, self.jj, self.kk, self.target_[0], self.weight_[0])

    def all_edges(self) -> EdgeRecords:
        """Retired and active edges between keyframes that still exist."""
        return EdgeRecords.concatenate([*self.retired_edges, self.active_edges()])

    def forward_edges(self, lifetime: int) -> tuple[Tensor, Tensor]:
        """Patches of the `lifetime - 1` keyframes before the newest one, seen in the newest."""
        first = self.M * max(self.n - lifetime, 0)
        patch_ids = torch.arange(first, self.M * max(self.n - 1, 0), device=self.device)
        return patch_ids, torch.full_like(patch_ids, self.n - 1)

    def backward_edges(self, lifetime: int) -> tuple[Tensor, Tensor]:
        """Patches of the newest keyframe, seen in the last `lifetime` keyframes and in their own."""
        patch_ids = torch.arange(self.M * max(self.n - 1, 0), self.m, device=self.device)
        frames = torch.arange(max(self.n - lifetime, 0), self.n, device=self.device)
        return patch_ids.repeat_interleave(len(frames)), frames.repeat(len(patch_ids))

    def drop_keyframe(self, k: int) -> None:
        """Remove keyframe `k`: later slots move down by one, its pose stays known relative to keyframe `k-1`."""
        before, counter = int(self.tstamps_[k - 1]), int(self.tstamps_[k])
        relative = SE3(self.poses_[k].clone()) * SE3(self.poses_[k - 1].clone()).inv()
        self.delta[counter] = (before, relative.data)
        if self.keep_dropped_frames:
            self.dropped_frames.append(DroppedFrame(
                counter, self.patch_centers(k).clone(), self.intrinsics_[k].clone(), self.colors_[k].clone()))
        self.remove_factors((self.ii == k) | (self.jj == k))
        self._renumber(self, k)
        self.retired_edges = [self._without_keyframe(record, k) for record in self.retired_edges]
        for name in _ROW_BUFFERS:
            buffer = getattr(self, name)
            buffer[k:self.n - 1] = buffer[k + 1:self.n].clone()
        self.n -= 1
        self.m -= self.M

    def _renumber(self, edges: PatchGraph | EdgeRecords, k: int) -> None:
        # the patch shift needs the host index from before the shift
        edges.kk = torch.where(edges.ii > k, edges.kk - self.M, edges.kk)
        edges.ii = torch.where(edges.ii > k, edges.ii - 1, edges.ii)
        edges.jj = torch.where(edges.jj > k, edges.jj - 1, edges.jj)

    def _without_keyframe(self, record: EdgeRecords, k: int) -> EdgeRecords:
        if record.newest < k:  # nearly all retired edges are far older than the removed keyframe
            return record
        kept = record.select((record.ii != k) & (record.jj != k))
        self._renumber(kept, k)
        kept.newest -= 1
        return kept


def _identity_poses(count: int, device: torch.device) -> Tensor:
    poses = torch.zeros(count, 7, device=device)
    poses[:, 6] = 1.0
    return poses


def _patch_hosts(count: int, patches_per_frame: int, device: torch.device) -> Tensor:
    hosts = torch.arange(count, device=device)
    return hosts[:, None].expand(count, patches_per_frame).contiguous()
