"""Forward pass of training: the update operator and bundle adjustment, unrolled over a growing patch graph.

Several clips of equal length are joined into one block-diagonal graph: frame `f` of clip `c` has index `c*n + f`, patch
`p` of clip `c` has index `c*n*M + p`. All clips have the same edges, so that every operation runs once for all of them.
"""

from __future__ import annotations

import contextlib
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from devo.errors import InputError
from devo.unroll_matching import MatchUpdate, match_frames, match_offsets
from devo.unroll_state import GrowingGraph, JoinedClips, UnrollSettings
from devo.voxel_augment import random_voxel_augment

if TYPE_CHECKING:
    from devo.enet import eVONet
    from devo.lietorch import SE3

BOUNDS_MARGIN = 64.0  # quarter-resolution pixels around the image within which a reprojection is used
SOLVER_DAMPING = 10.0
DEPTH_DAMPING = 1e-4


class UnrollStep(NamedTuple):
    """What one update produced; the first thirteen fields are those of the published training code.

    Coordinates are quarter-resolution pixels (x,y). `*_full` fields, `scores`, `kk_full` and `frame_distance` are given
    for the last update only, None before.
    """

    valid: Tensor
    """(1,S) bool: the true point of this supervised edge lies in front of the camera."""
    coords: Tensor | None
    """(1,S,P,P,2) reprojection after bundle adjustment; None where this update's adjustment carries no gradient."""
    coords_gt: Tensor
    """(1,S,P,P,2)."""
    poses: SE3 | None
    """(B,n) world -> camera after bundle adjustment; None as `coords`."""
    patches: Tensor
    """(1,B*n*M,3,P,P) patches after bundle adjustment."""
    kl: float
    scores: Tensor | None
    """(B*n,M) score of each patch."""
    valid_full: Tensor | None
    coords_full: Tensor | None
    coords_gt_full: Tensor | None
    weight_full: Tensor | None
    kk_full: Tensor | None
    frame_distance: Tensor | None
    predicted: Tensor
    """(1,E,2) patch centre plus revision of all edges, before bundle adjustment."""
    predicted_gt: Tensor
    """(1,E,2)."""
    predicted_valid: Tensor
    """(1,E) bool: in front of the camera, inside the image, not hidden."""
    weight: Tensor
    """(1,E,2) confidence."""
    start_error: Tensor
    """(1,E) distance between reprojection and truth before the revision, no gradient."""


class UnrollResult(NamedTuple):
    """Everything the losses need."""

    steps: list[UnrollStep]
    poses_gt: SE3
    """(B,n) world -> camera, first frame of each clip = identity."""
    probe: MatchUpdate | None
    """Start-up matching, see `UnrollSettings.probe`."""
    matches: list[MatchUpdate]
    """Updates of edges that start away from the truth, see `UnrollSettings.match_updates`."""


def unroll(
    network: eVONet,
    images: Tensor,
    poses: SE3,
    disps: Tensor,
    intrinsics: Tensor,
    *,
    STEPS: int = 12,
    structure_only: bool = False,
    patches_per_image: int = 80,
) -> list[UnrollStep]:
    """Training pass with the published schedule on raw clips; normalises `images` as `network.norm` says.

    Arguments as in `unroll_clips`, `STEPS` updates; one `UnrollStep` per update.
    """
    settings = UnrollSettings(steps=STEPS, patches_per_image=patches_per_image, structure_only=structure_only)
    return unroll_clips(network, prepare_images(network, images), poses, disps, intrinsics, settings).steps


def prepare_images(network: eVONet, images: Tensor) -> Tensor:
    """Normalise raw clips (B,n,C,H,W) as the network wants them, and augment them where it trains with `randaug`."""
    images = network.normalize(images)
    if network.training and getattr(network, "randaug", False):
        return random_voxel_augment(images)
    return images


def unroll_clips(
    network: eVONet,
    images: Tensor,
    poses: SE3,
    disps: Tensor,
    intrinsics: Tensor,
    settings: UnrollSettings | None = None,
    start_fraction: Tensor | None = None,
) -> UnrollResult:
    """Run the training pass on B clips of n frames.

    Args:
        network: the network under training; its mode decides how patches are chosen.
        images: (B,n,5,H,W) float32 normalised voxel grids (or (B,n,3,H,W) images), H and W multiples of 4.
        poses: (B,n) true world -> camera.
        disps: (B,n,H,W) true inverse depth in the unit of the poses.
        intrinsics: (B,n,4) fx fy cx cy, full-resolution pixels.
        settings: graph schedule.
        start_fraction: (B,) start each clip's poses between identity (0) and the truth (1); default identity.

    Raises:
        InputError: shapes that do not fit.
    """
    _check_shapes(images, disps, intrinsics)
    settings = settings or UnrollSettings()
    clips = JoinedClips(network, images, poses, disps, intrinsics, settings)
    truth = type(clips.poses_gt)(clips.poses_gt.data.view(clips.clips, clips.frames, 7))
    several = clips.frames > 1
    probe = match_frames(clips) if settings.probe and several else None
    matches = match_offsets(clips, settings.match_updates) if settings.match_updates and several else []
    if settings.steps == 0:
        return UnrollResult([], truth, probe, matches)
    if not settings.structure_only:
        clips.poses = clips.start_poses(start_fraction)
    graph = GrowingGraph(clips)
    steps = []
    for step in range(settings.steps):
        if step >= settings.initial_frames and graph.frames < clips.frames:
            graph.grow()
        last = step == settings.steps - 1
        differentiable = last or step % settings.solver_gradient_every == 0
        match = step % settings.match_gradient_every == 0
        steps.append(_one_update(clips, graph, differentiable, match, last))
        clips.poses, clips.patches = clips.poses.detach(), clips.patches.detach()
        if not last and float(torch.rand(())) < settings.depth_noise:
            clips.disturb_depths()
    return UnrollResult(steps, truth, probe, matches)


def _one_update(clips: JoinedClips, graph: GrowingGraph, differentiable: bool, match: bool, last: bool) -> UnrollStep:
    """Revise all edges once and solve for poses and depths; leaves the new state in `clips` and `graph`."""
    from devo import projective_ops as pops
    from devo.ba import BA

    settings = clips.settings
    ii, jj, kk = graph.edges
    with torch.no_grad():
        coords = pops.transform(clips.poses, clips.patches, clips.intrinsics, ii, jj, kk)
    net, delta, weight = clips.update(graph.net.reshape(1, len(kk), -1), coords, ii, jj, kk, graph.groups, match)
    graph.net = net.view(graph.net.shape)
    middle = coords.shape[2] // 2
    centre = coords[:, :, middle, middle]
    target = centre + delta
    bounds = [-BOUNDS_MARGIN, -BOUNDS_MARGIN, clips.width + BOUNDS_MARGIN, clips.height + BOUNDS_MARGIN]
    with contextlib.nullcontext() if differentiable else torch.no_grad():
        for _ in range(settings.solver_iterations):
            clips.poses, clips.patches = BA(
                clips.poses,
                clips.patches,
                clips.intrinsics,
                target,
                weight,
                DEPTH_DAMPING,
                ii,
                jj,
                kk,
                bounds,
                ep=SOLVER_DAMPING,
                fixedp=1,
                structure_only=settings.structure_only,
                clips=clips.clips,
                blocks=graph.blocks,
            )
    truth = graph.coords_gt[:, :, middle, middle].reshape(1, -1, 2)
    start_error = (centre - truth).norm(dim=-1)
    near = graph.select(graph.near)
    moved = pops.transform(clips.poses, clips.patches, clips.intrinsics, *near) if differentiable else None
    step = UnrollStep(
        valid=graph.valid[:, graph.near].reshape(1, -1),
        coords=moved,
        coords_gt=graph.coords_gt[:, graph.near].reshape(1, -1, *graph.coords_gt.shape[2:]),
        poses=clips.poses_of(graph.frames) if differentiable else None,
        patches=clips.patches,
        kl=0.0,
        scores=None,
        valid_full=None,
        coords_full=None,
        coords_gt_full=None,
        weight_full=None,
        kk_full=None,
        frame_distance=None,
        predicted=target,
        predicted_gt=truth,
        predicted_valid=graph.visible.reshape(1, -1),
        weight=weight,
        start_error=start_error,
    )
    return _with_scores(step, clips, graph) if last else step


def _with_scores(step: UnrollStep, clips: JoinedClips, graph: GrowingGraph) -> UnrollStep:
    """Add what the scorer loss needs, without gradients except through the scores."""
    from devo import projective_ops as pops

    local = graph.scored
    edges = graph.select(local)
    with torch.no_grad():
        coords = pops.transform(clips.poses, clips.patches, clips.intrinsics, *edges)
    return step._replace(
        scores=clips.scores,
        valid_full=graph.valid[:, local].reshape(1, -1),
        coords_full=coords,
        coords_gt_full=graph.coords_gt[:, local].reshape(1, -1, *graph.coords_gt.shape[2:]),
        weight_full=step.weight.detach().view(clips.clips, -1, 2)[:, local].reshape(1, -1, 2),
        kk_full=edges[2],
        frame_distance=graph.distance[local].repeat(clips.clips),
    )


def _check_shapes(images: Tensor, disps: Tensor, intrinsics: Tensor) -> None:
    if images.dim() != 5 or images.shape[-1] % 4 or images.shape[-2] % 4:
        raise InputError(
            f"images have shape {tuple(images.shape)}; expected (clips, frames, channels, H, W) with H and W "
            "multiples of 4, so crop or pad them"
        )
    clips, frames, _, height, width = images.shape
    for name, value, expected in (
        ("disps", disps, (clips, frames, height, width)),
        ("intrinsics", intrinsics, (clips, frames, 4)),
    ):
        if tuple(value.shape) != expected:
            raise InputError(f"{name} has shape {tuple(value.shape)}; expected {expected} to match the images")
