"""Drivers: feed a stream of frames to the tracker and return trajectory and structure.

`track` returns a typed `TrackingResult`; `run_voxel`, `run_rgb` and `run_voxel_norm_seq` return the published tuples.
"""

from __future__ import annotations

import contextlib
import itertools
import signal
import threading
from collections.abc import Callable, Iterable, Iterator
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from tqdm import tqdm

from devo.config import Config
from devo.devo import DEVO
from devo.errors import DevoError, InputError
from devo.normalize import normalize_sequence
from devo.result import TrackingResult, TrackingStatus

Frame = tuple[Tensor, Tensor, float]
"""`(tensor, intrinsics (4,), t_us)`: voxel grid `(5,H,W)` or BGR image `(3,H,W)`, full-resolution `fx fy cx cy`."""

NetworkLike = nn.Module | str | PathLike[str]


def track(
    frames: Iterable[Frame], cfg: Config, network: NetworkLike, *, events: bool = True, height: int | None = None,
    width: int | None = None, scale: float = 1.0, seed: int | None = 0, observables: bool = True, colors: bool = False,
    frame_mode: str | None = None, accumulate_map: bool = False, viz: bool = False, viz_flow: bool = False,
    device: str | torch.device | None = None, total: int | None = None, progress: bool = False,
    keep_on_interrupt: bool = False, on_frame: Callable[[DEVO], None] | None = None,
    on_end: Callable[[DEVO], None] | None = None,
) -> TrackingResult:
    """Run the odometry over a stream of frames.

    Args:
        frames: yields `(tensor, intrinsics, t_us)`; consumed one by one, nothing is kept.
        cfg: settings; a copy is used.
        network: a network object, a checkpoint path, the name of built-in weights, or `random:SEED`.
        events: True for voxel grids, False for BGR images.
        height, width: expected frame size [px]; the first frame decides where they are not given.
        scale: input rescaling factor of the caller (lowers the motion threshold before initialisation).
        seed: seed of patch selection and initial depths; the global generator is left as it was. None: do not seed.
        observables, colors: fill `TrackingResult.observables` and its colours.
        frame_mode: `final` or `online` fills `TrackingResult.frame_data`.
        accumulate_map: keep removed keyframes (for `devo.trajectory.accumulated_map` in `on_end`).
        device: `auto`, `cpu`, `cuda[:i]`; None keeps a network object where it is.
        total: number of frames for the progress bar, if known.
        progress: show a progress bar on stderr.
        keep_on_interrupt: let Ctrl-C end the stream instead of the run; `counters["interrupted"]` is then 1.
        on_frame: called with the tracker after every accepted frame. on_end: called before the result is collected.

    Returns:
        The result; look at `status` before using it.

    Raises:
        InputError: frames of wrong shape or with values that are not finite.
    """
    cfg = cfg.clone()
    tracker: DEVO | None = None
    bar = tqdm(total=total, disable=not progress, unit="frame", desc="track")
    with torch.no_grad(), _seeded(seed), bar, _interrupts(keep_on_interrupt) as interrupt:
        try:
            for image, intrinsics, t_us in frames:
                if tracker is None:
                    tracker = DEVO(cfg, network, evs=events, ht=height or image.shape[-2], wd=width or image.shape[-1],
                                   viz=viz, viz_flow=viz_flow, accumulate_map=accumulate_map, device=device,
                                   record_frame_observables=frame_mode is not None)
                accepted = tracker(t_us, image, intrinsics, scale=scale)
                if accepted and on_frame is not None:
                    on_frame(tracker)
                bar.update()
                bar.set_postfix(keyframes=tracker.n, refresh=False)
                if interrupt.is_set():
                    break
        except KeyboardInterrupt:
            # the first can only come from the stream, between two frames; a second one may tear a frame
            if not keep_on_interrupt or interrupt.is_set():
                raise
            interrupt.set()
        if tracker is None:
            return _nothing(interrupt.is_set())
        tracker.refine()
        if on_end is not None:
            on_end(tracker)
        result = tracker.result(observables=observables, include_colors=colors, frame_mode=frame_mode)
    result.counters["interrupted"] = int(interrupt.is_set())
    return result


@contextlib.contextmanager
def _interrupts(deferred: bool) -> Iterator[threading.Event]:
    """Yield an event; if `deferred`, the first Ctrl-C sets it instead of tearing a frame apart, the second one raises.

    Signals can only be handled in the main thread; elsewhere nothing is deferred.
    """
    event = threading.Event()
    if not deferred or threading.current_thread() is not threading.main_thread():
        yield event
        return
    previous = signal.getsignal(signal.SIGINT)

    def note(*_: object) -> None:
        event.set()
        signal.signal(signal.SIGINT, previous)

    signal.signal(signal.SIGINT, note)
    try:
        yield event
    finally:
        signal.signal(signal.SIGINT, previous)


@contextlib.contextmanager
def _seeded(seed: int | None) -> Iterator[None]:
    if seed is None:
        yield
        return
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        yield


def _nothing(interrupted: bool) -> TrackingResult:
    return TrackingResult(
        poses=np.zeros((0, 7), np.float32), tstamps=np.zeros(0), status=TrackingStatus.EMPTY_STREAM,
        message="the stream has no frame; check the time window (--start_us, --stop_us) and the event file",
        counters={"frames_read": 0, "interrupted": int(interrupted)})


def as_tuple(result: TrackingResult, return_observables: bool, return_frame_observables: bool,
             return_colors: bool) -> tuple[Any, ...]:
    """The published tuple of a result: `(poses, tstamps, flowdata[, point_cloud, depths[, colors]][, frame_data])`."""
    values: tuple[Any, ...] = (result.poses, result.tstamps, result.flowdata)
    if return_observables:
        structure = result.observables
        values += (np.zeros((0, 3), np.float32), np.zeros(0, np.float32)) if structure is None else (
            structure.points, structure.depths)
        if return_colors:
            values += (np.zeros((0, 3), np.float32) if structure is None else structure.colors,)
    return values + ((result.frame_data or [],) if return_frame_observables else ())


def _run(frames: Iterable[Frame], cfg: Config, network: NetworkLike, *, return_observables: bool,
         return_frame_observables: bool, return_colors: bool, record_frame_observables: bool = False,
         frame_mode: str = "final", timing: bool = False, debug: bool = False, save_per_frame_cloud: bool = False,
         save_per_frame_cloud_path: str | PathLike[str] = "results/clouds", voxel_size: float = 0.05,
         accumulate_map: bool = False, full_map_out: str | PathLike[str] | None = None,
         full_map_color_out: str | PathLike[str] | None = None, export_edge_cloud: bool = False,
         edge_cloud_out: str | PathLike[str] | None = None, **options: Any) -> tuple[Any, ...]:
    """What the three published drivers share."""
    from utils.edge_clouds.edges import EdgeRecorder
    from utils.edge_clouds.settings import EdgeSettings
    from utils.map_recorder import MapRecorder

    if return_colors and not return_observables:
        raise ValueError("return_colors needs return_observables=True")
    chosen = {name: options.pop(f"edge_{name}") for name in ("downsample", "topk", "border", "knn", "max_dist")
              if f"edge_{name}" in options}
    if export_edge_cloud and edge_cloud_out is None:
        raise InputError("export_edge_cloud needs to know where to write; pass edge_cloud_out=FILE")
    edges = EdgeRecorder(EdgeSettings(**chosen)) if export_edge_cloud else None
    wants_frames = return_frame_observables or record_frame_observables or edges is not None
    recorder = MapRecorder(Path(save_per_frame_cloud_path) if save_per_frame_cloud else None, voxel_size,
                           full_map_out, full_map_color_out)

    def on_frame(tracker: DEVO) -> None:
        recorder.on_frame(tracker)
        if edges is not None:
            edges.on_frame(tracker)

    result = track(frames if edges is None else edges.tap(frames), cfg, network, observables=return_observables,
                   colors=return_colors, frame_mode=frame_mode if wants_frames else None, on_frame=on_frame,
                   on_end=recorder.on_end, accumulate_map=accumulate_map or recorder.wants_map, **options)
    if edges is not None and edge_cloud_out is not None:
        edges.write(edge_cloud_out, result.frame_data or [])
    if timing or debug:
        total = sum(result.timings.values())
        tqdm.write(f"{result.message}; {total:.1f} s: " + ", ".join(f"{k} {v:.1f}" for k, v in result.timings.items()))
    if not result.ok:
        tqdm.write(f"warning: {result.message}")
    return as_tuple(result, return_observables, return_frame_observables, return_colors)


def _frames_of(folder: str | PathLike[str], iterator: Iterable[Frame] | None, events: bool) -> Iterable[Frame]:
    if iterator is not None:
        return iterator
    from utils.datasets.registry import SequenceOptions, open_sequence

    sequence = open_sequence("generic", folder, SequenceOptions())
    return sequence.voxels() if events else sequence.frames()


def run_voxel(
    voxeldir: str | PathLike[str], cfg: Config, network: NetworkLike, viz: bool = False,
    iterator: Iterable[Frame] | None = None, timing: bool = False, H: int | None = None, W: int | None = None,
    viz_flow: bool = False, scale: float = 1.0, save_per_frame_cloud: bool = False,
    save_per_frame_cloud_path: str | PathLike[str] = "results/clouds", voxel_size: float = 0.05, debug: bool = False,
    accumulate_map: bool = False, full_map_out: str | PathLike[str] | None = None,
    full_map_color_out: str | PathLike[str] | None = None, return_observables: bool = False,
    return_frame_observables: bool = False, return_colors: bool = False, **kwargs: Any,
) -> tuple[Any, ...]:
    """Event odometry over voxel grids, with the published tuple as result.

    Args:
        voxeldir: folder of the sequence; read as a `generic` dataset if no `iterator` is given.
        cfg, network: as in `track`.
        iterator: yields `(voxel (5,H,W), intrinsics (4,), t_us)`.
        timing, debug: print a summary line to stderr at the end.
        H, W: expected size [px]; None takes the size of the first frame.
        save_per_frame_cloud, save_per_frame_cloud_path: write the map after every tracked frame as `cloud_%05d.ply`,
            and `combined_map.ply`, the accumulated map down-sampled to `voxel_size` (trajectory units).
        accumulate_map, full_map_out, full_map_color_out: write the accumulated map (last estimate of every patch the
            run ever had) as `(K,3)` float32 and its colours as `(K,3)` uint8.
        kwargs: further options of `track` (`seed`, `device`, `progress`, `frame_mode`, ...), and
            `export_edge_cloud=True, edge_cloud_out=FILE` with `edge_downsample`, `edge_topk`, `edge_border`, `edge_knn`
            and `edge_max_dist`: write the edge cloud, see `utils.edge_clouds`.

    Returns:
        `(poses, tstamps, flowdata[, point_cloud, depths[, colors]][, frame_data])`: poses `(T,7)` `world_T_cam`, time
        stamps `(T,)` us, depths are z-depths. Poses are NaN where the run was never initialised.

    Raises:
        ValueError: `return_colors` without `return_observables`.
        InputError: unusable frames.
    """
    return _run(_frames_of(voxeldir, iterator, True), cfg, network, events=True, viz=viz, viz_flow=viz_flow, height=H,
                width=W, scale=scale, timing=timing, debug=debug, save_per_frame_cloud=save_per_frame_cloud,
                save_per_frame_cloud_path=save_per_frame_cloud_path, voxel_size=voxel_size,
                accumulate_map=accumulate_map, full_map_out=full_map_out, full_map_color_out=full_map_color_out,
                return_observables=return_observables, return_frame_observables=return_frame_observables,
                return_colors=return_colors, **kwargs)


def run_rgb(
    imagedir: str | PathLike[str], cfg: Config, network: NetworkLike, viz: bool = False,
    iterator: Iterable[Frame] | None = None, timing: bool = False, H: int | None = None, W: int | None = None,
    viz_flow: bool = False, return_observables: bool = False, return_frame_observables: bool = False,
    return_colors: bool = False, **kwargs: Any,
) -> tuple[Any, ...]:
    """Frame odometry over BGR images `(3,H,W)` in 0..255; arguments and result as in `run_voxel`."""
    return _run(_frames_of(imagedir, iterator, False), cfg, network, events=False, viz=viz, viz_flow=viz_flow, height=H,
                width=W, timing=timing, return_observables=return_observables,
                return_frame_observables=return_frame_observables, return_colors=return_colors, **kwargs)


def run_voxel_norm_seq(
    voxeldir: str | PathLike[str], cfg: Config, network: NetworkLike, viz: bool = False,
    iterator: Iterable[Frame] | None = None, timing: bool = False, H: int | None = None, W: int | None = None,
    viz_flow: bool = False, scale: float = 1.0, N_norm: int = 15, return_observables: bool = False,
    return_frame_observables: bool = False, return_colors: bool = False, **kwargs: Any,
) -> tuple[Any, ...]:
    """Event odometry with voxels normalised jointly in blocks of `N_norm`; arguments and result as in `run_voxel`.

    Positive cells are divided by the block's maximum, negative ones by the magnitude of its minimum. Every voxel is
    tracked, the incomplete last block included.
    """
    if N_norm < 1:
        raise InputError(f"N_norm is {N_norm}; expected at least 1")
    cfg = cfg.clone()
    cfg.NORM = "none"
    blocks = normalized_in_blocks(_frames_of(voxeldir, iterator, True), N_norm)
    return _run(blocks, cfg, network, events=True, viz=viz, viz_flow=viz_flow, height=H, width=W, scale=scale,
                timing=timing, return_observables=return_observables,
                return_frame_observables=return_frame_observables, return_colors=return_colors, **kwargs)


def normalized_in_blocks(frames: Iterable[Frame], block: int) -> Iterator[Frame]:
    """Rescale voxels jointly over blocks of `block` frames; holds one block at a time."""
    stream = iter(frames)
    while batch := list(itertools.islice(stream, block)):
        voxels = normalize_sequence(torch.stack([voxel for voxel, _, _ in batch])[None].float(), "rescale")[0]
        for voxel, (_, intrinsics, t_us) in zip(voxels, batch, strict=True):
            yield voxel, intrinsics, t_us


__all__ = ["DevoError", "as_tuple", "normalized_in_blocks", "run_rgb", "run_voxel", "run_voxel_norm_seq", "track"]
