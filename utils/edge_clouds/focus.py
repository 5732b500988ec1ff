"""The focus-refined edge cloud: every edge pixel gets the depth at which the event images around it agree.

For an edge pixel with ray `s` and inverse depths `rho` around a prior, the pixel is moved into the event images of
neighbouring times, `X_k ~ R_k R^T s + rho b_k` with `b_k = t_k - R_k R^T t` (poses `cam_T_world = (R, t)`), and the
images are summed there. The sum is largest where the rays of the same edge meet. This is a one-dimensional, per-pixel
form of the ray density of EMVS (Rebecq et al., IJCV 2018).
"""

from __future__ import annotations

import itertools
from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np
import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor

from devo.errors import InputError
from devo.lietorch import SE3
from utils.clouds.cloud import PointCloud
from utils.edge_clouds.edges import points_of_frame
from utils.edge_clouds.images import (
    RES,
    camera_rays,
    crop_of,
    edge_pixels,
    event_image,
    interpolate_inv_depths,
    normalised,
    pooled_to_qres,
    ridge_pixels,
)
from utils.edge_clouds.settings import FocusSettings
from utils.eval_utils import Frame
from utils.frame_bundle import FrameBundle

_MIN_Z = 1e-6
_MIN_INV_DEPTH = 1e-6
_MIN_RIVAL = 1e-6
_FLAT = 1e-6  # relative difference below which samples are equally high
_SAMPLES_PER_CHUNK = 1 << 18


@dataclass(frozen=True, eq=False)
class Slice:
    """The pooled, normalised event image of a frame.

    Attributes:
        image: `(h,w)`. cam_T_world: `(7,)` float64. frame: row in the bundle. crop: (top, left) px, see `crop_of`.
    """

    image: Tensor
    cam_T_world: Tensor  # noqa: N815 - the frame notation of the project
    frame: int
    crop: tuple[int, int] = (0, 0)


@dataclass(frozen=True, eq=False)
class FocusPeak:
    """Where the focus score of each pixel peaks.

    Attributes:
        inv_depth: `(N,)`, refined between the samples.
        score: `(N,)`, height of the peak.
        confidence: `(N,)`, peak over its strongest rival, see `_strongest_rival`.
        accepted: `(N,)` bool.
    """

    inv_depth: Tensor
    score: Tensor
    confidence: Tensor
    accepted: Tensor


def refine_edges(frames: Iterable[Frame], bundle: FrameBundle, settings: FocusSettings,
                 device: torch.device | str = "cpu", *, image_dtype: torch.dtype = torch.float16) -> Iterator[
                     PointCloud]:
    """Refined edge points, one cloud per reference frame, while a recording streams by.

    Args:
        frames: the voxel grids of the recording in time order, `(voxel, intrinsics, t_us)`; those that belong to no
            frame of the bundle (by time stamp) are passed over.
        bundle: final poses and depths of the run.
        settings: see `FocusSettings`.
        device: where to compute.
        image_dtype: type in which the images of the window wait; the window holds `2 support support_stride + 1`.

    Yields:
        Per reference frame the accepted points with the scalars of `points_of_frame` and `prior_inv_depth`, `score`,
        `confidence`; the metadata `band_travel_px` says how far a pixel moves in the farthest image between the ends
        of the tried band (pooled px, median). Below about 3 px nothing can be told apart.

    Raises:
        InputError: the recording and the bundle share no time stamp.
    """
    slices = _slices(frames, bundle, settings, device, image_dtype)
    references = ((reference, support) for reference, support in _with_support(slices, settings)
                  if reference.frame % settings.keyframe_stride == 0)
    for reference, support in itertools.islice(references, settings.max_keyframes or None):
        yield _refine(reference, support, bundle, settings)


def _slices(frames: Iterable[Frame], bundle: FrameBundle, settings: FocusSettings, device: torch.device | str,
            image_dtype: torch.dtype) -> Iterator[Slice]:
    """The slices whose time stamp is that of a frame, at most one per frame.

    Stamps agree to the microsecond when the recording is read as it was tracked; a quarter of the spacing is allowed
    for windows that were cut a little differently.
    """
    tolerance_us = 0.25 * float(np.median(np.diff(bundle.t_us))) if len(bundle) > 1 else 1.0
    last = -1
    for voxel, _, t_us in frames:
        index = int(np.abs(bundle.t_us - t_us).argmin()) if len(bundle) else -1
        if index <= last or abs(bundle.t_us[index] - t_us) > tolerance_us:
            continue
        last = index
        image = normalised(event_image(voxel.to(device), settings.downsample))
        yield Slice(image.to(image_dtype), torch.from_numpy(bundle.cam_T_world[index]).to(device), index,
                    crop_of(*voxel.shape[-2:]))
    if last < 0:
        raise InputError(f"no window of the recording belongs to one of the {len(bundle)} frames, which lie between "
                         f"{bundle.t_us.min(initial=np.inf):.0f} us and {bundle.t_us.max(initial=-np.inf):.0f} us; "
                         "use the recording and the window options that made the frames")


def _with_support(slices: Iterable[Slice], settings: FocusSettings) -> Iterator[tuple[Slice, list[Slice]]]:
    """Every slice with the slices that support it: `support` on each side, fewer at the ends of the recording."""
    reach = settings.support * settings.support_stride
    window: deque[Slice | None] = deque(maxlen=2 * reach + 1)
    for item in itertools.chain(itertools.repeat(None, reach), slices, itertools.repeat(None, reach)):
        window.append(item)
        reference = window[reach] if len(window) > 2 * reach else None
        if reference is not None:
            around = list(window)[::settings.support_stride]
            yield reference, [other for other in around if other is not None and other is not reference
                              and _baseline(other, reference) >= settings.min_baseline]


def _baseline(a: Slice, b: Slice) -> float:
    """Distance between two camera centres [trajectory units]."""
    first, second = (SE3(item.cam_T_world).inv().data[:3] for item in (a, b))
    return float((first - second).norm())


def _refine(reference: Slice, support: list[Slice], bundle: FrameBundle, settings: FocusSettings) -> PointCloud:
    """The refined points of one slice."""
    device = reference.image.device
    find = ridge_pixels if settings.edges == "ridge" else edge_pixels
    pixels = find(reference.image.float(), settings.topk, settings.border)
    xy = pooled_to_qres(pixels, settings)
    rows, prior = interpolate_inv_depths(xy, *bundle.seeds(reference.frame, device), settings)
    xy = xy[rows]
    intrinsics = torch.from_numpy(bundle.intrinsics[reference.frame]).to(device)
    tried = _tried(prior, settings)
    peak = focus_peaks(xy, tried, intrinsics, reference.cam_T_world, support, settings)
    keep = peak.accepted
    cloud = points_of_frame(bundle, reference.frame, xy[keep], peak.inv_depth[keep], reference.crop,
                            prior_inv_depth=prior[keep], score=peak.score[keep], confidence=peak.confidence[keep])
    travel = _band_travel(xy, tried, intrinsics, reference.cam_T_world, support, settings)
    return replace(cloud, metadata={"band_travel_px": f"{travel:.3f}"})


def _tried(prior: Tensor, settings: FocusSettings) -> Tensor:
    """The inverse depths `(N,S)` that are tried around the priors `(N,)`."""
    width = prior * settings.rho_rel if settings.rho_abs is None else torch.full_like(prior, settings.rho_abs)
    steps = torch.linspace(-1.0, 1.0, settings.rho_samples, device=prior.device)
    return (prior[:, None] + width[:, None] * steps).clamp(min=_MIN_INV_DEPTH)


def focus_peaks(xy: Tensor, tried: Tensor, intrinsics: Tensor, cam_T_world: Tensor, support: list[Slice],
                settings: FocusSettings) -> FocusPeak:
    """Choose among the tried inverse depths of each pixel.

    Args:
        xy: `(N,2)` qres px in the reference camera. tried: `(N,S)` inverse depths in ascending order.
        intrinsics: `(4,)` qres, the same for all images. cam_T_world: `(7,)` of the reference.
        support: the images to look into; without any no peak is accepted.
        settings: see `FocusSettings`.
    """
    if not support or len(xy) == 0:
        empty = tried.new_zeros(len(tried))
        return FocusPeak(empty, empty, empty, torch.zeros_like(empty, dtype=torch.bool))
    return _find_peaks(tried, focus_scores(xy, tried, intrinsics, cam_T_world, support, settings), settings)


def focus_scores(xy: Tensor, inv_depths: Tensor, intrinsics: Tensor, cam_T_world: Tensor, support: list[Slice],
                 settings: FocusSettings) -> Tensor:
    """Sum over the images of the largest value within `patch_radius` of where the pixel would be seen.

    Args:
        xy: `(N,2)` qres px; inv_depths: `(N,S)` tried ones; the rest as in `focus_peaks`.

    Returns:
        `(N,S)` float32. Images are sampled bilinearly and are 0 outside; a pixel behind a camera adds nothing.
    """
    matrix = _motions(cam_T_world, support)
    rays = camera_rays(xy.float(), intrinsics.float())
    radius = settings.patch_radius
    images = _shifted(torch.stack([item.image for item in support]).float(), radius)
    chunk = max(1, _SAMPLES_PER_CHUNK // (inv_depths.shape[1] * len(support)))
    return torch.cat([
        _sample(rays[start:start + chunk], inv_depths[start:start + chunk], matrix, intrinsics, images, settings)
        for start in range(0, len(rays), chunk)])


def _motions(cam_T_world: Tensor, support: list[Slice]) -> Tensor:
    """Matrices `(K,4,4)` float32 from the reference camera to the cameras of the support."""
    reference = SE3(cam_T_world.double()).inv().data
    others = SE3(torch.stack([item.cam_T_world for item in support]).double())
    return (others * SE3(reference.expand(len(support), 7).clone())).matrix().float()


def _shifted(images: Tensor, radius: int) -> Tensor:
    """Images `(K,h,w)` as `(K,(2r+1)^2,h+2r+2,w+2r+2)`: channel c holds the value at one of the offsets within r.

    The margin of r + 1 zeros makes positions just outside interpolate towards 0.
    """
    margin = radius + 1
    padded = F.pad(images[:, None], (margin + radius,) * 2 + (margin + radius,) * 2)
    height, width = images.shape[1] + 2 * margin, images.shape[2] + 2 * margin
    offsets = range(2 * radius + 1)
    return torch.cat([padded[:, :, dy:dy + height, dx:dx + width] for dy in offsets for dx in offsets], dim=1)


def _sample(rays: Tensor, inv_depths: Tensor, matrix: Tensor, intrinsics: Tensor, images: Tensor,
            settings: FocusSettings) -> Tensor:
    """Scores `(n,S)` of a chunk; `rays (n,3)`, `inv_depths (n,S)`, `matrix (K,4,4)`, `images` of `_shifted`."""
    in_qres, in_front = _project(rays, inv_depths, matrix, intrinsics)
    margin = settings.patch_radius + 1
    pooled = in_qres * (RES / settings.downsample) - settings.pixel_shift + margin
    size = torch.tensor([images.shape[3], images.shape[2]], device=rays.device)
    grid = (2.0 * pooled + 1.0) / size - 1.0
    grid = torch.where(in_front[..., None], grid, torch.full_like(grid, -2.0))
    values = F.grid_sample(images, grid, mode="bilinear", padding_mode="zeros", align_corners=False)
    return values.amax(dim=1).sum(dim=0)


def _project(rays: Tensor, inv_depths: Tensor, matrix: Tensor, intrinsics: Tensor) -> tuple[Tensor, Tensor]:
    """Where rays `(n,3)` are seen at inverse depths `(n,S)`: qres px `(K,n,S,2)`, and whether in front `(K,n,S)`."""
    rotated = rays @ matrix[:, :3, :3].mT
    seen = rotated[:, :, None] + inv_depths[None, :, :, None] * matrix[:, None, None, :3, 3]
    in_front = seen[..., 2] > _MIN_Z * inv_depths
    projected = seen[..., :2] / torch.where(in_front, seen[..., 2], torch.ones_like(seen[..., 2]))[..., None]
    return projected * intrinsics[:2] + intrinsics[2:], in_front


def _band_travel(xy: Tensor, tried: Tensor, intrinsics: Tensor, cam_T_world: Tensor, support: list[Slice],
                 settings: FocusSettings) -> float:
    """Median over the pixels of the longest way between the ends of the band in any image [pooled px]."""
    if not support or len(xy) == 0:
        return 0.0
    seen, in_front = _project(camera_rays(xy.float(), intrinsics), tried[:, [0, -1]], _motions(cam_T_world, support),
                              intrinsics)
    way = (seen[:, :, 1] - seen[:, :, 0]).norm(dim=-1) * in_front.all(dim=2)
    return float(way.amax(dim=0).median()) * RES / settings.downsample


def _find_peaks(tried: Tensor, scores: Tensor, settings: FocusSettings) -> FocusPeak:
    """The highest sample of each row, placed between samples by a parabola, and its lead over the rivals.

    Equal neighbours at the top (a plateau) put the peak into their middle. A maximum at the end of the band is no
    peak: the right depth lies somewhere else.
    """
    samples = scores.shape[1]
    top = scores.amax(dim=1)
    at_top = scores >= (top * (1.0 - _FLAT))[:, None]
    position = torch.arange(samples, device=scores.device)
    first = torch.where(at_top, position, samples).amin(dim=1)
    last = torch.where(at_top, position, -1).amax(dim=1)
    inside = (first > 0) & (last < samples - 1)
    centre = first.clamp(1, samples - 2)
    before, peak, after = (scores.gather(1, (centre + step)[:, None])[:, 0] for step in (-1, 0, 1))
    curvature = before - 2.0 * peak + after
    offset = torch.where(curvature < 0, 0.5 * (before - after) / curvature.clamp(max=-1e-12), 0.0).clamp(-0.5, 0.5)
    place = torch.where(first == last, centre + offset, 0.5 * (first + last))
    rival = _strongest_rival(scores, first, last, settings.guard)
    gaps = at_top.sum(dim=1) < last - first + 1
    two_peaks_or_a_plain = (last - first > 2 * settings.guard + 1) | (gaps & (last - first > settings.guard))
    rival = torch.where(two_peaks_or_a_plain, top, rival)
    confidence = top / rival.clamp(min=_MIN_RIVAL)
    low = place.floor().clamp(0, samples - 2).long()
    start, end = (tried.gather(1, (low + step)[:, None])[:, 0] for step in (0, 1))
    inv_depth = start + (place - low) * (end - start)
    accepted = inside & (top > settings.min_score) & (confidence >= settings.min_peak_ratio)
    return FocusPeak(inv_depth, top, confidence, accepted)


def _strongest_rival(scores: Tensor, first: Tensor, last: Tensor, guard: int) -> Tensor:
    """The highest value `(N,)` that is not part of the peak `first .. last` of each row of `scores (N,S)`.

    Part of the peak are `guard` samples on each side and, beyond them, its flanks as long as they fall. The sample at
    the foot of a flank is a rival, so a lone peak has to rise above the ends of the band.
    """
    position = torch.arange(scores.shape[1], device=scores.device)
    feet = []
    for curve, start in ((scores, last), (scores.flip(1), scores.shape[1] - 1 - first)):
        rises = torch.cat([curve[:, 1:] > curve[:, :-1], torch.ones_like(curve[:, :1], dtype=torch.bool)], dim=1)
        stop = rises & (position >= (start + guard + 1).clamp(max=scores.shape[1] - 1)[:, None])
        feet.append(stop.int().argmax(dim=1))
    left, right = scores.shape[1] - 1 - feet[1], feet[0]
    outside = (position <= left[:, None]) | (position >= right[:, None])
    near = (position >= (first - guard)[:, None]) & (position <= (last + guard)[:, None])
    return scores.masked_fill(~outside | near, 0.0).amax(dim=1)
