"""From a recording to all its products: the work behind `scripts/export_pointcloud.py`."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from devo.checkpoint import builtin_weights, default_weights, load_network
from devo.config import Config
from devo.device import fast_dtype, resolve_device
from devo.devo import DEVO
from devo.errors import InputError, TrackingError
from devo.result import TrackingResult
from utils.array_files import save_arrays
from utils.clouds.cloud import PointCloud
from utils.colmap.observations import Observations, observations_of, save_observations
from utils.datasets.prefetch import LOOK_AHEAD, prefetch, prefetch_tasks
from utils.datasets.recognise import AUTO
from utils.datasets.registry import Recording, locate_sequence, open_sequence
from utils.edge_clouds.edges import EdgeRecorder
from utils.edge_clouds.run import collect_focus_cloud
from utils.eval_utils import Frame, track
from utils.export_meta import ExportRecord
from utils.export_options import ExportOptions
from utils.export_products import (
    Products,
    observables_to_cloud,
    save_json,
    write_cleaned,
    write_edge_cloud,
    write_frame_table,
    write_preview,
    write_tracking,
)
from utils.frame_bundle import FrameBundle, write_frame_bundle
from utils.map_recorder import MapRecorder
from utils.messages import say

__all__ = ["ExportOptions", "export_pointcloud", "find_config", "find_weights", "say"]

ROOT = Path(__file__).resolve().parents[1]
DEFAULT_CONFIG = {"ecd": "eval_rpg.yaml"} | {
    name: f"eval_{name}.yaml" for name in ("fpv", "rpg", "vector", "tumvie", "eds", "hku", "mvsec")}


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
    options.check()
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
    recorders = _Recorders(options, products)
    result = recorders.track(sequence, cfg, network, device)
    record = ExportRecord(options, config, cfg, weights, sequence.describe(), sequence.width, sequence.height,
                          sequence.intrinsics, result)
    _write_clouds(products, record)
    recorders.note(products, record)
    bundle = _write_frames(products, record)
    if result.flowdata is not None:
        products.written.append(_save_flow(products, result.flowdata))
    if bundle is not None and recorders.edges is not None:
        _write_edges(products, record, "edge_cloud", recorders.edges.cloud(bundle))
    if options.export_focus_edge_cloud and result.counters.get("interrupted"):
        say("interrupted: the focus-refined edge cloud, which takes another pass over the recording, is left out")
    elif bundle is not None and options.export_focus_edge_cloud:
        _write_meta(products, record, started)  # the next step reads the recording again and may be interrupted
        _write_edges(products, record, "focus_edge_cloud", _focus_cloud(sequence, bundle, options, device))
    meta = _write_meta(products, record, started)
    _report(record, products)
    return meta


def _recognised(options: ExportOptions) -> ExportOptions:
    """Replace the data set "auto" and its path by what the files say, and tell why."""
    if options.dataset != AUTO:
        return options
    found = locate_sequence(AUTO, options.datapath, options.sequence_options()).require_ready()
    say(f"recognised: {found}")
    return replace(options, dataset=found.dataset, datapath=str(found.path))


@contextlib.contextmanager
def _stream(sequence: Recording, options: ExportOptions) -> Iterator[Iterable[Frame]]:
    """The frames of the recording, made in advance by threads that end with the block."""
    workers = options.workers
    ahead = (prefetch(sequence.frames(), LOOK_AHEAD if workers else 0) if options.rgb
             else prefetch_tasks(sequence.voxel_tasks(), workers))
    with contextlib.closing(ahead):
        yield ahead


class _Recorders:
    """What watches the tracker while it runs."""

    def __init__(self, options: ExportOptions, products: Products) -> None:
        self.options = options
        folder = Path(options.save_per_frame_cloud_path) if options.save_per_frame_cloud else None
        dpviewer = products.path("_dpviewer.npy") if options.save_dpviewer_cloud else None
        self.map = MapRecorder(folder, options.voxel_size, dpviewer, keep=options.per_frame_keep)
        self.edges = EdgeRecorder(options.edge) if options.export_edge_cloud else None
        self.observations: Observations | None = None

    def track(self, sequence: Recording, cfg: Config, network: torch.nn.Module, device: torch.device) -> TrackingResult:
        """Run the odometry."""
        options = self.options
        with _stream(sequence, options) as frames:
            return track(
                frames if self.edges is None else self.edges.tap(frames), cfg, network, events=not options.rgb,
                height=sequence.height, width=sequence.width, seed=options.seed, colors=True, viz=options.viz,
                frame_mode=options.frame_mode if options.wants_frames else None, accumulate_map=self.map.wants_map,
                viz_flow=options.viz_flow, device=device, total=sequence.expected_length, progress=True,
                keep_on_interrupt=True, on_frame=self._on_frame, on_end=self._on_end)

    def _on_frame(self, tracker: DEVO) -> None:
        self.map.on_frame(tracker)
        if self.edges is not None:
            self.edges.on_frame(tracker)
        if self.options.viz_flow:
            tracker.flow_data.get(tracker.counter - 1, {}).pop("img", None)  # not written, but megabytes per frame
        if self.options.debug:
            explained = "not initialised" if not tracker.tracked else "explained" if tracker.tracked[-1] else "lost"
            say(f"frame {tracker.counter - 1} at {tracker.tlist[-1]:.0f} us: {tracker.n} keyframes, {tracker.m} "
                f"points, {len(tracker.kk)} edges, {explained}")

    def _on_end(self, tracker: DEVO) -> None:
        self.map.on_end(tracker)
        if self.options.save_observations and tracker.is_initialized:
            self.observations = observations_of(tracker)

    def note(self, products: Products, record: ExportRecord) -> None:
        """Enter the files of the map into the record, and write the observations."""
        if self.observations is not None:
            products.written.append(save_observations(products.path("_observations.npz"), self.observations))
        products.written += self.map.written
        record.frame_clouds = self.map.frame_clouds
        if self.map.full_map_out is not None and Path(self.map.full_map_out) in self.map.written:
            record.files["dpviewer_cloud"] = Path(self.map.full_map_out)


def _write_clouds(products: Products, record: ExportRecord) -> None:
    """Raw arrays always; the cleaned cloud and the preview only where the structure means something."""
    result, options = record.result, record.options
    if not record.tracked:
        result.observables = None  # random depths of a run that never started are no structure
    write_tracking(products, result)
    if result.observables is None:
        return
    raw = cloud = observables_to_cloud(result.observables)
    if options.cleanup:
        cloud, record.filters = write_cleaned(products, raw, options.cleanup_steps())
        record.cleaned_points = len(cloud)
    shown, title = (cloud, products.base.name) if len(cloud) else (
        raw, f"{products.base.name} (raw: no point passed the cleaning)")
    write_preview(products, shown, result.poses, title)


def _write_frames(products: Products, record: ExportRecord) -> FrameBundle | None:
    """The structure per frame, on disk if it was asked for; None if nothing was recorded."""
    result = record.result
    if result.frame_data is None or result.observables is None:
        return None
    bundle = FrameBundle.from_frames(result.frame_data, np.unique(result.observables.host_frame))
    if record.options.export_frame_data:
        target = write_frame_bundle(record.options.frame_data_out or products.path("_frames.npz"), bundle)
        table = target.with_suffix(".csv")
        write_frame_table(table, bundle)
        products.written += [target, table]
        record.files["frame_data"] = target
    return bundle


def _focus_cloud(sequence: Recording, bundle: FrameBundle, options: ExportOptions, device: torch.device) -> PointCloud:
    """The focus-refined edge cloud from a second pass over the recording; only a window of it is held."""
    with _stream(sequence, options) as frames:
        return collect_focus_cloud(frames, bundle, options.focus, device)


def _write_edges(products: Products, record: ExportRecord, product: str, cloud: PointCloud) -> None:
    """An edge cloud (`edge_cloud` or `focus_edge_cloud`) and its cleaned version."""
    ending = product.removesuffix("_cloud") + "s"  # _edges, _focus_edges
    target = record.options.edge_cloud_file(product) or products.path(f"_{ending}{products.suffix}")
    step = record.options.outlier_step() if record.options.cleanup and len(cloud) else None
    record.edge_filters[product] = write_edge_cloud(products, target, cloud, step)
    record.files[product], record.edge_points[product] = target, len(cloud)


def _save_flow(products: Products, flowdata: dict[int, dict[str, Any]]) -> Path:
    """`<base>_flow.npz`: per frame `{frame}_{ii,jj,kk,coords_est,n}`; arrays only, no pickle."""
    arrays = {f"{frame}_{key}": np.asarray(value) for frame, entry in flowdata.items() for key, value in entry.items()}
    return save_arrays(products.path("_flow.npz"), arrays, compressed=True)


def _write_meta(products: Products, record: ExportRecord, started: float) -> dict[str, Any]:
    meta = record.describe()
    meta["runtime_s"] = round(time.perf_counter() - started, 3)
    path = products.path("_meta.json")
    meta["files"] = [str(written) for written in dict.fromkeys([*products.written, path])]
    save_json(path, meta)
    return meta


def _report(record: ExportRecord, products: Products) -> None:
    """Tell people what came out; an unusable run ends with an error that names what was kept."""
    result = record.result
    for report in record.filters:
        say(str(report))
    for product, count in record.edge_points.items():
        say(f"{product.replace('_', ' ')}: {count} points")
    interrupted = bool(result.counters.get("interrupted"))
    files = ", ".join(path.name for path in [*products.written, products.path("_meta.json")])
    if record.frame_clouds:
        files += f"; {record.frame_clouds} clouds per frame in {record.options.save_per_frame_cloud_path}"
    if not result.ok or interrupted:
        found = f"interrupted; {result.message}" if interrupted else result.message
        raise TrackingError(f"{found}. Kept in {products.base.parent}: {files}")
    raw = 0 if result.observables is None else len(result.observables)
    cleaned = "not cleaned" if record.cleaned_points is None else f"{record.cleaned_points} after cleaning"
    say(f"{result.message}; {raw} points, {cleaned}; {result.tracked_share:.0%} of the frames explained; "
        f"scale is arbitrary. Wrote to {products.base.parent}: {files}")
