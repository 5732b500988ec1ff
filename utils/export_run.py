"""From a recording to all its products: the work behind `scripts/export_pointcloud.py`."""

from __future__ import annotations

import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tqdm import tqdm

from devo.checkpoint import builtin_weights, default_weights, load_network
from devo.config import Config
from devo.device import fast_dtype, resolve_device
from devo.errors import InputError, TrackingError
from devo.kernels import active_kernels
from devo.result import TrackingResult
from utils.clouds.cloud import PointCloud
from utils.clouds.filters import FilterReport
from utils.datasets.recognise import AUTO
from utils.datasets.registry import Sequence, SequenceOptions, locate_sequence, open_sequence
from utils.eval_utils import track
from utils.export_products import (
    CONVENTIONS,
    Products,
    observables_to_cloud,
    run_environment,
    save_frame_bundle,
    save_json,
    write_cleaned,
    write_preview,
    write_tracking,
)
from utils.map_recorder import MapRecorder

MAX_RELATIVE_SIGMA = 0.1  # cleaned clouds keep depths that are known to ten per cent
ROOT = Path(__file__).resolve().parents[1]
DEFAULT_CONFIG = {"fpv": "eval_fpv.yaml", "rpg": "eval_rpg.yaml", "vector": "eval_vector.yaml"}


@dataclass
class ExportOptions:
    """What `scripts/export_pointcloud.py` was asked for; the field names are those of its flags."""

    datapath: str
    dataset: str = "auto"
    config: str | None = None
    opts: list[str] | None = None
    weights: str | None = None
    out: str = "point_cloud.npy"
    rgb: bool = False
    stride: int = 1
    side: str = "left"
    start_us: float | None = None
    stop_us: float | None = None
    window_ms: float | None = None
    window_events: int | None = None
    calib: str | None = None
    image_size: list[int] | None = None
    intrinsics: list[float] | None = None
    device: str = "auto"
    seed: int = 0
    viz: bool = False
    viz_flow: bool = False
    debug: bool = False
    save_per_frame_cloud: bool = False
    save_per_frame_cloud_path: str = "results/clouds"
    voxel_size: float = 0.05
    export_frame_data: bool = False
    frame_data_out: str | None = None
    frame_mode: str = "final"
    save_dpviewer_cloud: bool = False
    convert_ply: bool = False
    cleanup: bool = True
    cleanup_algo: str = "sor"
    sor_nb_neighbors: int = 20
    sor_std_ratio: float = 2.0
    ror_radius: float | None = None
    ror_min_neighbors: int | None = None

    def sequence_options(self) -> SequenceOptions:
        """The part that concerns the recording."""
        return SequenceOptions(
            side=self.side, stride=self.stride, start_us=self.start_us, stop_us=self.stop_us, window_ms=self.window_ms,
            window_events=self.window_events, calib=Path(self.calib) if self.calib else None,
            image_size=(self.image_size[0], self.image_size[1]) if self.image_size else None,
            intrinsics=tuple(self.intrinsics) if self.intrinsics else None)

    def cleanup_steps(self) -> list[str | tuple[str, dict[str, Any]]]:
        """Quality first, then the chosen outlier filter."""
        quality = ("quality", {"max_relative_sigma": MAX_RELATIVE_SIGMA})
        if self.cleanup_algo == "ror":
            return [quality, ("ror", {"radius": self.ror_radius, "min_neighbors": self.ror_min_neighbors})]
        return [quality, ("sor", {"neighbors": self.sor_nb_neighbors, "std_ratio": self.sor_std_ratio})]


def find_config(name: str | None, dataset: str, weights: str = "") -> Path:
    """The settings file: as given, or in the project's `config/`.

    Without a name: the preset of the built-in weights (`tiny.yaml` for `devo-tiny`), else that of the dataset.

    Raises:
        InputError: no such file.
    """
    preset = f"{weights.removeprefix('devo-')}.yaml" if weights in builtin_weights() else ""
    if not preset or not (ROOT / "config" / preset).is_file():
        preset = DEFAULT_CONFIG.get(dataset, "default.yaml")
    wanted = Path(name or f"config/{preset}")
    for candidate in (wanted, ROOT / wanted, ROOT / "config" / wanted.name):
        if candidate.is_file():
            return candidate
    presets = ", ".join(sorted(path.stem for path in (ROOT / "config").glob("*.yaml")))
    raise InputError(f"--config {wanted}: no such file; presets in config/: {presets}")


def find_weights(name: str | None) -> str:
    """The weights to load: as given, else the built-in default, else `DEVO.pth` in the working directory.

    Raises:
        InputError: nothing was given and nothing is there.
    """
    if name:
        return name
    builtin = default_weights()
    if builtin is not None:
        return builtin
    if Path("DEVO.pth").is_file():
        return "DEVO.pth"
    raise InputError("no weights: none ship with this version and there is no DEVO.pth here; pass --weights FILE, "
                     "or --weights random:0 to try the machinery with an untrained network")


def export_pointcloud(options: ExportOptions) -> dict[str, Any]:
    """Track a recording and write every product next to `options.out`.

    Returns:
        The description of the run, as written to `<base>_meta.json`; `files` lists what was written.

    Raises:
        InputError: unusable arguments or input.
        TrackingError: the run was not initialised, lost, empty or interrupted; what exists was written and is named.
        OutputError: a file could not be written.
    """
    started = time.perf_counter()
    products = Products.of(options.out)
    options = _recognised(options)
    device = resolve_device(options.device)
    weights = find_weights(options.weights)
    config = find_config(options.config, options.dataset, weights)
    cfg = Config().merge_from_file(config).merge_from_list(options.opts or [])
    sequence = open_sequence(options.dataset, options.datapath, options.sequence_options())
    # the frame network has no scorer
    selector = "random" if options.rgb and cfg.PATCH_SELECTOR == "scorer" else cfg.PATCH_SELECTOR
    network = load_network(weights, patch_selector=selector, device=device)
    say(f"{sequence.name}: {sequence.width}x{sequence.height} px, weights {weights}, config {config.name}, "
        f"{device} ({str(fast_dtype(device, cfg.MIXED_PRECISION)).removeprefix('torch.')})")
    result, recorder = _track(sequence, cfg, network, device, options, products)
    products.written += recorder.written
    cloud, reports = _write_clouds(products, result, options)
    if options.export_frame_data and result.frame_data is not None:
        target = options.frame_data_out or products.path("_frames.npz")
        products.written.append(save_frame_bundle(target, result.frame_data))
    if result.flowdata is not None:
        products.written.append(_save_flow(products, result.flowdata))
    meta = _describe(options, config, cfg, weights, sequence, result, cloud, reports)
    meta["runtime_s"] = round(time.perf_counter() - started, 3)
    products.written.append(products.path("_meta.json"))
    meta["files"] = [str(path) for path in products.written]
    save_json(products.path("_meta.json"), meta)
    _report(result, cloud, reports, products)
    return meta


def _recognised(options: ExportOptions) -> ExportOptions:
    """Replace the data set "auto" and its path by what the files say, and tell why."""
    if options.dataset != AUTO:
        return options
    found = locate_sequence(AUTO, options.datapath, options.sequence_options()).require_ready()
    say(f"recognised: {found}")
    return replace(options, dataset=found.dataset, datapath=str(found.path))


def _track(sequence: Sequence, cfg: Config, network: torch.nn.Module, device: torch.device, options: ExportOptions,
           products: Products) -> tuple[TrackingResult, MapRecorder]:
    dpviewer = products.path("_dpviewer.npy") if options.save_dpviewer_cloud else None
    folder = Path(options.save_per_frame_cloud_path) if options.save_per_frame_cloud else None
    recorder = MapRecorder(folder, options.voxel_size, dpviewer)
    result = track(
        sequence.frames() if options.rgb else sequence.voxels(), cfg, network, events=not options.rgb,
        height=sequence.height, width=sequence.width, seed=options.seed, colors=True, viz=options.viz,
        frame_mode=options.frame_mode if options.export_frame_data else None, accumulate_map=recorder.wants_map,
        viz_flow=options.viz_flow, device=device, total=sequence.expected_length, progress=True, keep_on_interrupt=True,
        on_frame=recorder.on_frame, on_end=recorder.on_end)
    return result, recorder


def _write_clouds(products: Products, result: TrackingResult, options: ExportOptions) -> tuple[
        PointCloud | None, list[FilterReport]]:
    """Raw arrays always; the cleaned cloud and the preview only where the structure means something."""
    if not np.isfinite(result.poses).all() or len(result.poses) == 0:
        result.observables = None  # random depths of a run that never started are no structure
    write_tracking(products, result)
    if result.observables is None:
        return None, []
    cloud = observables_to_cloud(result.observables)
    reports: list[FilterReport] = []
    if options.cleanup:
        cloud, reports = write_cleaned(products, cloud, options.cleanup_steps())
    shown, title = (cloud, products.base.name) if len(cloud) else (
        observables_to_cloud(result.observables), f"{products.base.name} (raw: no point passed the cleaning)")
    write_preview(products, shown, result.poses, title)
    return cloud, reports


def _save_flow(products: Products, flowdata: dict[int, dict[str, Any]]) -> Path:
    """`<base>_flow.npz`: per frame `{frame}_{ii,jj,kk,coords_est,n}`; arrays only, no pickle."""
    from utils.atomic import atomic_path

    arrays = {f"{frame}_{key}": np.asarray(value) for frame, entry in flowdata.items()
              for key, value in entry.items() if key != "img"}
    with atomic_path(products.path("_flow.npz")) as temporary:
        np.savez_compressed(temporary, **arrays)  # type: ignore[arg-type]
    return products.path("_flow.npz")


def _describe(options: ExportOptions, config: Path, cfg: Config, weights: str, sequence: Sequence,
              result: TrackingResult, cloud: PointCloud | None, reports: list[FilterReport]) -> dict[str, Any]:
    observables = result.observables
    count = 0 if observables is None else len(observables)
    tracked = len(result.poses) > 0 and bool(np.isfinite(result.poses).all())
    return {
        **CONVENTIONS, "dataset": options.dataset, "datapath": str(options.datapath), "side": options.side,
        "config": str(config), "settings": cfg.as_dict(), "weights": weights, "edge_cloud_exported": False,
        "edge_cloud_path": None, "focus_edge_cloud_exported": False, "focus_edge_cloud_path": None,
        "start_us": options.start_us, "stop_us": options.stop_us, "H": sequence.height, "W": sequence.width,
        "intrinsics_fx_fy_cx_cy": [float(value) for value in sequence.intrinsics],
        "start_pose_xyz_quat_xyzw": result.poses[0].tolist() if tracked else None,
        "start_timestamp_us": float(result.tstamps[0]) if len(result.tstamps) else None,
        "num_poses": len(result.poses), "point_cloud_shape": [count, 3], "depths_shape": [count],
        "flow_saved": result.flowdata is not None, "export_frame_data": options.export_frame_data,
        "save_per_frame_cloud": options.save_per_frame_cloud, "seed": options.seed, "device": str(options.device),
        "kernels": active_kernels(), "status": result.status.value, "message": result.message,
        "tracked_share": round(result.tracked_share, 4), "n_keyframes": result.counters.get("keyframes", 0),
        "n_skipped_voxels": result.counters.get("frames_too_empty", 0), "counters": result.counters,
        "timings_s": {stage: round(seconds, 3) for stage, seconds in result.timings.items()},
        "cleaned_points": None if cloud is None else len(cloud),
        "filters": [{"name": r.name, "before": r.before, "after": r.after, "parameters": r.parameters,
                     "removed": r.removed, "skipped": list(r.skipped)} for r in reports],
        "sequence": sequence.describe(), **run_environment(),
    }


def _report(result: TrackingResult, cloud: PointCloud | None, reports: list[FilterReport], products: Products) -> None:
    """Tell people what came out; an unusable run ends with an error that names what was kept."""
    for report in reports:
        say(str(report))
    interrupted = bool(result.counters.get("interrupted"))
    files = ", ".join(path.name for path in products.written)
    if not result.ok or interrupted:
        found = f"interrupted; {result.message}" if interrupted else result.message
        raise TrackingError(f"{found}. Kept in {products.base.parent}: {files}")
    raw = 0 if result.observables is None else len(result.observables)
    cleaned = "not cleaned" if cloud is None or not reports else f"{len(cloud)} after cleaning"
    say(f"{result.message}; {raw} points, {cleaned}; {result.tracked_share:.0%} of the frames explained; "
        f"scale is arbitrary. Wrote to {products.base.parent}: {files}")


def say(text: str) -> None:
    """One line on stderr that does not tear the progress bar."""
    tqdm.write(text, file=sys.stderr)
