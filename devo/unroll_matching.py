"""Parts of the training pass that supervise matching alone: updates of edges for which nothing is solved."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from devo.edges import EdgeGroups

if TYPE_CHECKING:
    from devo.unroll_state import JoinedClips

PROBE_REACH = 3  # frames
PROBE_BACKWARDS = 0.25
OFFSET_REACH = 4  # frames
OFFSET_OCTAVES = (-2.0, 1.5)  # log2 of the standard deviation of the offsets of a clip, quarter-resolution pixels


class MatchUpdate(NamedTuple):
    """One update of edges that stand alone; coordinates (x, y) in quarter-resolution pixels."""

    predicted: Tensor
    """(1,E,2) patch centre plus revision."""
    predicted_gt: Tensor
    """(1,E,2)."""
    predicted_valid: Tensor
    """(1,E) bool: in front of the camera, inside the image, not hidden."""
    centre: Tensor
    """(1,E,2) patch centre before the revision."""
    weight: Tensor
    """(1,E,2) confidence."""
    correlation: Tensor
    """(1,E,7,7) correlation of the patch at shifts (x, y) of -3..3 pixels from the centre, mean over its pixels."""


def match_frames(clips: JoinedClips) -> MatchUpdate:
    """Match each frame's patches with one other frame of its clip, from a zero state and without motion.

    This is what the tracker does to find out whether the camera moved at all, before anything is known.
    """
    device = clips.patches.device
    source = torch.arange(clips.frames, device=device)
    reach = torch.randint(1, PROBE_REACH + 1, (clips.frames,)).to(device)
    backwards = torch.rand(clips.frames).to(device) < PROBE_BACKWARDS
    other = (source + torch.where(backwards, -reach, reach)).clamp(0, clips.frames - 1)
    other = torch.where(other == source, torch.where(source > 0, source - 1, source + 1), other)
    kk = torch.arange(clips.frames * clips.per_frame, device=device)
    edges = clips.edges(kk // clips.per_frame, other.repeat_interleave(clips.per_frame), kk)
    coords = clips.patches_gt[:, edges[2], :2].permute(0, 1, 3, 4, 2)
    return _updates(clips, edges, clips.truth(*edges), coords, 1)[0]


def match_offsets(clips: JoinedClips, updates: int) -> list[MatchUpdate]:
    """Match patches that start off the truth, each by an offset of its own plus one common to its pair of frames.

    Inside the bundle adjustment loop all patches of a frame are off in nearly the same way, and an operator that
    averages over the frame gets by; one that does so cannot correct a single patch, whose depth then stays wrong.

    Args:
        clips: with true poses and depths.
        updates: how often, from a zero state; every update starts where the one before ended.
    """
    device = clips.patches.device
    frames, per_frame = clips.frames, clips.per_frame
    near = [(i, j) for i in range(frames) for j in range(frames) if 0 < abs(i - j) <= OFFSET_REACH]
    first, second = torch.tensor(near, device=device).unbind(1)
    kk = (first[:, None] * per_frame + torch.arange(per_frame, device=device)).reshape(-1)
    edges = clips.edges(first.repeat_interleave(per_frame), second.repeat_interleave(per_frame), kk)
    low, high = OFFSET_OCTAVES
    spread = 2.0 ** (low + (high - low) * torch.rand(2, clips.clips, 1, 1, 1))
    common = torch.randn(clips.clips, len(near), 1, 2) * spread[0]
    own = torch.randn(clips.clips, len(near), per_frame, 2) * spread[1]
    truth = clips.truth(*edges)
    coords = truth[0] + (common + own).reshape(1, -1, 1, 1, 2).to(device)
    return _updates(clips, edges, truth, coords, updates)


def _updates(
    clips: JoinedClips,
    edges: tuple[Tensor, Tensor, Tensor],
    truth: tuple[Tensor, Tensor, Tensor],
    coords: Tensor,
    updates: int,
) -> list[MatchUpdate]:
    """Revise positions (1,E,P,P,2) from a zero state, each time from where the last revision led."""
    groups = EdgeGroups.build(*edges)
    net = clips.context.new_zeros(1, len(edges[2]), clips.context.shape[1], dtype=torch.float32)
    middle = coords.shape[2] // 2
    centre_gt, visible = truth[0][:, :, middle, middle], truth[2]
    steps = []
    for _ in range(updates):
        corr = clips.look_up(coords, *edges[1:])
        net, delta, weight = clips.revise(net, corr, *edges, groups)
        centre = coords[:, :, middle, middle]
        side = 2 * clips.correlate.radius + 1
        finest = corr.float().view(1, -1, side, side, coords.shape[2] ** 2, len(clips.correlate.levels))[..., 0]
        steps.append(MatchUpdate(centre + delta, centre_gt, visible, centre, weight, finest.mean(dim=-1)))
        coords = coords + delta.detach()[:, :, None, None]
    return steps
