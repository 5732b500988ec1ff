"""Training clips on the fly: random scenes, random motion, voxel grids straight from the pixel model.

A clip has n windows of one frame interval each. Window i covers `[i, i + 1)` frame intervals; its pose and inverse
depth belong to its middle `i + 0.5`, which is where inference stamps a voxel grid. Windows are adjacent. Bins are
placed by the borders of the window; a grid from a list of events places them by the first and last event, which differs
by less than one event spacing.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import torch

from utils.simulator.events import EventSettings, NoiseSource, PixelArray, resting_pixels
from utils.simulator.layouts import LAYOUTS, PlaneList
from utils.simulator.motion import CalibratedMotion, MotionRequest, calibrated_motion
from utils.simulator.renderer import Renderer, pinhole_rays, render_in_chunks
from utils.simulator.scenes import Planes
from utils.simulator.textures import build_atlas, texture_bank
from utils.simulator.trajectory import compose, invert
from utils.simulator.voxels import BINS, accumulate_step, scatter_events

Range = tuple[float, float]


@dataclasses.dataclass(frozen=True)
class ClipSettings:
    """What random clips look like. Ranges are drawn log-uniformly where both ends are positive.

    Attributes:
        scenes: share of each layout of `layouts.LAYOUTS`.
        motions: share of each kind of `motion.KINDS`.
        mean_flow_px: mean image motion per frame interval, full-resolution pixels, averaged over the clip.
        focal: focal length over image width.
        frame_ms: length of a frame interval; matters for noise and dead time only.
        threshold: contrast threshold, positive and negative drawn around it.
        asymmetry: largest ratio between positive and negative threshold.
        mismatch: pixel-to-pixel threshold variation.
        refractory_us: dead time; 0 with probability one half.
        leak_hz: leak events per pixel and second.
        shot_hz: random events per pixel and second.
        hot_fraction: share of hot pixels.
        hot_hz: rate of a hot pixel.
        contrast: factor on the log contrast of each texture.
        step_px: largest image motion between two renderings.
        most_steps: upper limit of renderings per window, a multiple of 4.
        tile: texels per side of a texture tile.
        bank_size: number of textures in the bank.
        bank_seed: which bank; change it now and then to see new textures.
        normalise: scale every clip so that 0.7 times the 98 % quantile of its inverse depths is 1.
    """

    scenes: tuple[tuple[str, float], ...] = (("planes", 0.3), ("room", 0.3), ("board", 0.15), ("corridor", 0.25))
    motions: tuple[tuple[str, float], ...] = (("translate", 0.4), ("orbit", 0.15), ("rotate", 0.15), ("forward", 0.15),
                                              ("shake", 0.15))
    mean_flow_px: Range = (1.0, 20.0)
    focal: Range = (0.55, 1.3)
    frame_ms: Range = (8.0, 60.0)
    threshold: Range = (0.16, 0.34)
    asymmetry: float = 1.3
    mismatch: Range = (0.01, 0.08)
    refractory_us: Range = (100.0, 1500.0)
    leak_hz: Range = (0.01, 0.3)
    shot_hz: Range = (0.02, 3.0)
    hot_fraction: Range = (1e-5, 1e-3)
    hot_hz: Range = (20.0, 500.0)
    contrast: Range = (0.35, 1.1)
    step_px: float = 0.75
    most_steps: int = 48
    tile: int = 256
    bank_size: int = 64
    bank_seed: int = 0
    normalise: bool = True

    def noiseless(self) -> ClipSettings:
        """The same clips from ideal pixels."""
        return dataclasses.replace(self, mismatch=(0.0, 0.0), refractory_us=(0.0, 0.0), leak_hz=(0.0, 0.0),
                                   shot_hz=(0.0, 0.0), hot_fraction=(0.0, 0.0))


@dataclasses.dataclass(frozen=True)
class ClipBatch:
    """B clips of n windows.

    Attributes:
        voxels: `(B, n, 5, H, W)` float32 voxel grids, signed event counts, not normalised.
        world_T_cam: `(B, n, 7)` float32 camera-to-world poses at the window middles; the first one is the identity.
        inv_depths: `(B, n, H, W)` float32 inverse z-depths at the window middles; 0 where nothing is hit (rare).
        intrinsics: `(B, n, 4)` float32 `fx fy cx cy`, full-resolution pixels.
        info: per-clip lists: `scene`, `motion`, `mean_flow_px`, `events_per_pixel` (per window), `frame_ms`, `steps`,
            `threshold`.
    """

    voxels: torch.Tensor
    world_T_cam: torch.Tensor  # noqa: N815 - the frame notation of the project
    inv_depths: torch.Tensor
    intrinsics: torch.Tensor
    info: dict[str, list[Any]]


@dataclasses.dataclass(frozen=True)
class ClipPlan:
    """Everything that defines one clip before rendering; built on the CPU from one seed.

    Attributes:
        scene: name of the layout.
        planes: the scene.
        tiles: `(P, T, T)` log-reflectance textures.
        intrinsics: `fx fy cx cy`.
        motion: pose curve in frame intervals with its measured image motion.
        frame_us: length of a frame interval in microseconds.
        pixels: parameters of the pixel array.
        steps: renderings per window.
    """

    scene: str
    planes: Planes
    tiles: torch.Tensor
    intrinsics: tuple[float, float, float, float]
    motion: CalibratedMotion
    frame_us: float
    pixels: EventSettings
    steps: list[int]


def sample_clips(batch: int, frames: int, height: int, width: int, *, generator: torch.Generator,
                 device: torch.device | str = "cpu", settings: ClipSettings | None = None) -> ClipBatch:
    """Draw random training clips; the same generator state and settings give byte-equal clips on the CPU.

    Args:
        batch: number of clips B.
        frames: windows per clip n.
        height: image height H in pixels.
        width: image width W in pixels.
        generator: CPU generator that decides everything.
        device: where rendering happens and results lie.
        settings: distribution of the clips.

    Returns:
        The clips, see `ClipBatch`.
    """
    settings = settings or ClipSettings()
    clips = []
    for _ in range(batch):
        plan = plan_clip(frames, height, width, generator, settings)
        clips.append((plan, *render_clip(plan, height, width, generator, device, settings.normalise)))
    info: dict[str, list[Any]] = {
        "scene": [plan.scene for plan, *_ in clips],
        "motion": [plan.motion.kind for plan, *_ in clips],
        "mean_flow_px": [plan.motion.mean_flow_px for plan, *_ in clips],
        "events_per_pixel": [float(count) for *_, count in clips],
        "frame_ms": [plan.frame_us / 1000 for plan, *_ in clips],
        "steps": [sum(plan.steps) for plan, *_ in clips],
        "threshold": [plan.pixels.threshold for plan, *_ in clips],
    }
    intrinsics = torch.tensor([plan.intrinsics for plan, *_ in clips], device=device)
    return ClipBatch(torch.stack([clip[1] for clip in clips]), torch.stack([clip[2] for clip in clips]),
                     torch.stack([clip[3] for clip in clips]), intrinsics[:, None].expand(-1, frames, -1).contiguous(),
                     info)


def plan_clip(frames: int, height: int, width: int, generator: torch.Generator, settings: ClipSettings) -> ClipPlan:
    """Draw scene, textures, camera, motion and pixel parameters of one clip."""
    rng = np.random.default_rng(int(torch.randint(2**62, (1,), generator=generator)))
    focal = width * _draw(rng, settings.focal)
    intrinsics = (focal, focal * rng.uniform(0.99, 1.01), (width - 1) / 2 + rng.normal(0, 0.02 * width),
                  (height - 1) / 2 + rng.normal(0, 0.02 * height))
    rays = pinhole_rays(intrinsics, height, width)
    half_view = (0.5 * width / focal, 0.5 * height / focal)
    scene = _choice(rng, settings.scenes)
    layout = PlaneList(focal, settings.tile, rng)
    LAYOUTS[scene](layout, half_view)
    planes = layout.planes()
    request = MotionRequest(_choice(rng, settings.motions), frames, _draw(rng, settings.mean_flow_px))
    motion = calibrated_motion(request, planes, rays, rng)
    steps = [min(settings.most_steps, 4 * int(np.ceil(max(flow, 1e-3) / (4 * settings.step_px))))
             for flow in motion.window_flow_px]
    return ClipPlan(scene, planes, _draw_tiles(rng, planes.origin.shape[1], settings), intrinsics, motion,
                    1000.0 * _draw(rng, settings.frame_ms), _draw_pixels(rng, settings), steps)


def _draw(rng: np.random.Generator, bounds: Range) -> float:
    low, high = bounds
    if low > 0:
        return float(np.exp(rng.uniform(np.log(low), np.log(high))))
    return float(rng.uniform(low, high))


def _choice(rng: np.random.Generator, shares: tuple[tuple[str, float], ...]) -> str:
    weights = np.array([share for _, share in shares])
    return shares[int(rng.choice(len(shares), p=weights / weights.sum()))][0]


def _draw_tiles(rng: np.random.Generator, count: int, settings: ClipSettings) -> torch.Tensor:
    """Random crops of the bank: turned, inverted in contrast now and then, with their own contrast and brightness."""
    bank = texture_bank(settings.bank_size, 2 * settings.tile, settings.bank_seed)
    tiles = []
    for choice in rng.choice(len(bank), count, replace=count > len(bank)):
        top, left = rng.integers(0, settings.tile + 1, 2)
        crop = bank[choice, top : top + settings.tile, left : left + settings.tile]
        gain = _draw(rng, settings.contrast) * (-1.0 if rng.random() < 0.2 else 1.0)
        turned = torch.rot90(crop, int(rng.integers(4))) if rng.random() < 0.5 else torch.rot90(crop.T, 1)
        tiles.append(turned * gain + rng.normal(0, 0.4))
    return torch.stack(tiles)


def _draw_pixels(rng: np.random.Generator, settings: ClipSettings) -> EventSettings:
    return EventSettings(
        threshold=_draw(rng, settings.threshold),
        mismatch=_draw(rng, settings.mismatch),
        asymmetry=float(settings.asymmetry ** rng.uniform(-1, 1)),
        refractory_us=_draw(rng, settings.refractory_us) * float(rng.random() < 0.5),
        leak_hz=_draw(rng, settings.leak_hz),
        shot_hz=_draw(rng, settings.shot_hz),
        hot_fraction=_draw(rng, settings.hot_fraction),
        hot_hz=_draw(rng, settings.hot_hz),
    )


def clip_times(steps: list[int]) -> torch.Tensor:
    """Rendering times of a clip in frame intervals `(sum(steps) + 1,)` float64: every window cut into equal steps."""
    pieces = [i + torch.arange(count, dtype=torch.float64) / count for i, count in enumerate(steps)]
    return torch.cat([*pieces, torch.tensor([float(len(steps))], dtype=torch.float64)])


def render_clip(plan: ClipPlan, height: int, width: int, generator: torch.Generator, device: torch.device | str,
                normalise: bool) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    """Voxels `(n, 5, H, W)`, poses `(n, 7)`, inverse depths `(n, H, W)` and events per pixel and window of a plan."""
    frames = len(plan.steps)
    rays = pinhole_rays(plan.intrinsics, height, width, device)
    renderer = Renderer(plan.planes.to(device), build_atlas(plan.tiles.to(device)), rays)
    middles = plan.motion.spline.poses(torch.arange(frames, dtype=torch.float64) + 0.5)
    log_intensity = render_in_chunks(renderer, plan.motion.spline.poses(clip_times(plan.steps)).to(device))
    inv_depths = renderer.inverse_depth(middles.to(device))
    array = resting_pixels((height, width), plan.pixels, generator, device)
    voxels = direct_voxels(log_intensity, plan.steps, plan.frame_us, array)
    events = voxels.new_tensor(0.0) + array.fired / (frames * height * width)
    _add_noise(voxels, plan, generator)
    world_T_cam = compose(invert(middles[:1].double()), middles.double()).float().to(device)
    if normalise:
        scale = 0.7 * torch.quantile(inv_depths[:, ::4, ::4].flatten(), 0.98)
        inv_depths = inv_depths / scale
        world_T_cam[:, :3] *= scale
    return voxels, world_T_cam, inv_depths, events


def direct_voxels(log_intensity: torch.Tensor, steps: list[int], frame_us: float, array: PixelArray) -> torch.Tensor:
    """Voxel grids `(n, 5, H, W)` of the windows, each rendered with its own number of steps (a multiple of 4)."""
    voxels = log_intensity.new_zeros(len(steps), BINS, *log_intensity.shape[1:])
    change = log_intensity[1:] - log_intensity[:-1]
    position = 0
    for window, count in enumerate(steps):
        per_bin = count // (BINS - 1)
        for step in range(count):
            crossings = array.step(change[position], frame_us / count)
            accumulate_step(voxels[window], crossings, step // per_bin, (step % per_bin) / per_bin, 1.0 / per_bin)
            position += 1
    return voxels


def _add_noise(voxels: torch.Tensor, plan: ClipPlan, generator: torch.Generator) -> None:
    """Scatter shot noise and the events of hot pixels over the windows, uniformly in time (in place)."""
    frames, _, height, width = voxels.shape
    noise = NoiseSource(plan.pixels, height * width, generator).draw(0.0, plan.frame_us * frames)
    time = (noise.t_us / plan.frame_us).clamp(max=frames * (1 - 1e-6)).float()
    scatter_events(voxels, noise.pixel.to(voxels.device), time.to(voxels.device), noise.sign.to(voxels.device))
