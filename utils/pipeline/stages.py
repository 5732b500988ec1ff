"""The stages of the pipeline, from raw files to the page that shows the cloud."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from devo import __version__
from devo.checkpoint import builtin_weights
from devo.errors import InputError
from utils.clouds.filters import clean_cloud
from utils.clouds.io import SUFFIXES, read_cloud, write_cloud
from utils.datasets.files import CALIBRATION_NAMES
from utils.datasets.recognise import Recognised
from utils.export_run import ExportOptions, export_pointcloud, find_config, find_weights
from utils.pipeline.options import PipelineOptions
from utils.pipeline.runner import Stage, StageResult
from utils.pipeline.summary import cleaning_warnings, tracking_warnings
from utils.preprocessing import PREPROCESSORS, PreprocessOptions

_EDGE_CLOUDS = ("_edges", "_focus_edges")
_CLOUDS = ("", *_EDGE_CLOUDS, "_dpviewer")
_NOT_SETTINGS = ("datapath", "out", "frame_data_out")
_COUNTS = ("num_poses", "n_keyframes", "tracked_share", "point_cloud_shape", "message", "runtime_s")


class Plan:
    """All stages of one call, and the names of the files that they hand to each other.

    Args:
        options: what was asked for.
        found: the sequence.

    Raises:
        InputError: weights, settings or names of files that cannot be used.
    """

    def __init__(self, options: PipelineOptions, found: Recognised) -> None:
        self.options = options
        self.found = found
        self.folder = options.folder()
        if self.folder.absolute() == found.path.absolute():
            raise InputError(f"--outdir {self.folder} is the recording itself, expected another folder")
        suffix = Path(options.outname).suffix
        if suffix and suffix.lower() not in SUFFIXES:
            raise InputError(f"--outname {options.outname} ends in {suffix!r}; expected {', '.join(SUFFIXES)} or none")
        self.base = (self.folder / options.outname).with_suffix("")
        self.cleaned = Path(options.cleanup.output) if options.cleanup.output else self.product("_cleaned.ply")
        self.picture = self.cleaned.with_suffix(".png")
        self.page = self.product("_view.html")
        self.export = self._export_options()
        self.weights = find_weights(self.export.weights)
        self.weights_file = builtin_weights().get(self.weights, Path(self.weights))
        if not self.weights_file.is_file() and not self.weights.startswith("random:"):
            raise InputError(f"--weights {self.weights}: no such file, and no built-in weights of that name "
                             f"({', '.join(builtin_weights())})")
        self.config = find_config(self.export.config, found.dataset, self.weights)

    def product(self, ending: str) -> Path:
        """`<base><ending>` in the folder of results."""
        return self.base.with_name(self.base.name + ending)

    def stages(self) -> list[Stage]:
        """In the order in which they run."""
        stages = [self._preprocess(), self._export(), self._ply(), self._cleanup()]
        if self.options.emvs.run or self.options.emvs.needs_bag:
            from utils.pipeline.emvs_stages import emvs_stages  # an optional module, see its docstring

            stages += emvs_stages(self)
        return [*stages, self._view()] if self.options.view else stages

    def _export_options(self) -> ExportOptions:
        asked = ExportOptions.from_flags(self.options.export)
        per_frame = asked.save_per_frame_cloud_path
        if per_frame == ExportOptions.save_per_frame_cloud_path:
            per_frame = str(self.folder / "clouds")
        export = replace(
            asked, dataset=self.found.dataset, datapath=str(self.found.path), side=self.found.side,
            out=str(self.folder / self.options.outname), export_frame_data=True, cleanup=False,
            frame_data_out=str(self.folder / self.options.frame_out), save_per_frame_cloud_path=per_frame)
        export.check()
        return export

    def sequence_files(self) -> tuple[Path, ...]:
        """What of the recording decides about the result."""
        own = [Path(self.export.calib)] if self.export.calib else []
        if self.found.path.is_file():
            own += [file for name in CALIBRATION_NAMES if (file := self.found.path.parent / name).is_file()]
        return (self.found.path, *own)

    def _preprocess(self) -> Stage:
        found, overwrite = self.found, self.options.overwrite_preprocessing
        settings = {"dataset": found.dataset, "side": found.side, "images": self.export.rgb, "version": __version__}
        skip = ""
        if found.dataset not in PREPROCESSORS:
            skip = f"recordings of data set {found.dataset} need none"
        elif found.ready and not overwrite and not self.export.rgb:  # --rgb: are the images there, too?
            skip = "its products are there"

        def run() -> StageResult:
            made = PREPROCESSORS[found.dataset].run(found.path, PreprocessOptions(
                side=found.side, overwrite=overwrite, images=self.export.rgb, progress=True))
            return StageResult([path for path in made if path.is_file()], {"made": len(made)})

        products = tuple(found.path / name for name in found.missing)
        return Stage("preprocess", f"make what the reader of {found.dataset} needs", (found.source,), settings,
                     products, run, skip)

    def _export(self) -> Stage:
        asked = {name: value for name, value in asdict(self.export).items() if name not in _NOT_SETTINGS}
        settings = {**asked, "weights": self.weights, "out": self.options.outname, "frames": self.options.frame_out,
                    "version": __version__}
        files = (self.weights_file, self.config) if self.weights_file.is_file() else (self.config,)
        named = (".npy", ".ply", ".npz", "_depths.npy", "_poses.npy", "_tstamps.npy", "_trajectory.txt",
                 "_preview.png", "_meta.json")

        def run() -> StageResult:
            meta = export_pointcloud(self.export)
            return StageResult([Path(file) for file in meta["files"]], {name: meta[name] for name in _COUNTS},
                               tracking_warnings(meta))

        return Stage("export", "track the recording and write trajectory and cloud", (*self.sequence_files(), *files),
                     settings, (*map(self.product, named), self.folder / self.options.frame_out), run)

    def _ply(self) -> Stage:
        def run() -> StageResult:
            clouds = [self.product(f"{kind}.npy") for kind in _CLOUDS]
            written = {Path(file) for file in self.meta()["files"]}
            made = []
            for source in (cloud for cloud in clouds if cloud in written):
                made.append(source.with_suffix(".ply"))
                if made[-1] not in written:
                    write_cloud(made[-1], read_cloud(source))
            return StageResult(made)

        return Stage("ply", "give every cloud a PLY file", (self.product("_meta.json"), self.product(".npy")), {},
                     (self.product(".ply"),), run)

    def _cleanup(self) -> Stage:
        asked = self.options.cleanup
        filters = replace(self.export, cleanup_algo=asked.algorithm, sor_nb_neighbors=asked.nb_neighbors,
                          sor_std_ratio=asked.std_ratio, ror_radius=asked.radius, ror_min_neighbors=asked.min_neighbors)
        filters.check()

        def run() -> StageResult:
            from utils.clouds.preview import save_preview

            raw = read_cloud(self.product(".npz"))
            cleaned, reports = clean_cloud(raw, filters.cleanup_steps())
            write_cloud(self.cleaned, cleaned)
            shown, note = (cleaned, "") if len(cleaned) else (raw, " (raw: no point passed the cleaning)")
            save_preview(self.picture, shown, self.poses(), title=self.found.path.name + note)
            told = [str(report) for report in reports]
            edges = self._clean_edges(filters.outlier_step(), told)
            facts = {"raw": len(raw), "cleaned": len(cleaned), "filters": told}
            return StageResult([self.cleaned, self.picture, *edges], facts, cleaning_warnings(len(raw), len(cleaned)))

        return Stage("cleanup", "remove points that cannot be trusted", (self.product(".npz"),),
                     {"steps": filters.cleanup_steps(), "version": __version__}, (self.cleaned, self.picture), run)

    def _clean_edges(self, step: tuple[str, dict[str, Any]], reports: list[str]) -> list[Path]:
        """Edge clouds have no quality of their own, so only the outlier filter applies to them."""
        made = []
        for kind in _EDGE_CLOUDS:
            source, target = self.product(f"{kind}.ply"), self.product(f"{kind}_cleaned.ply")
            if str(self.product(f"{kind}.npy")) in self.meta()["files"]:
                cleaned, (report,) = clean_cloud(read_cloud(source), [step])
                write_cloud(target, cleaned)
                reports.append(f"{kind.removeprefix('_')}: {report}")
                made.append(target)
        return made

    def _view(self) -> Stage:
        def run() -> StageResult:
            from utils.plots.scene import Scene
            from utils.viewer.page import save_page

            scene = Scene.build(read_cloud(self.shown_cloud()), self.poses(), show_outside=True)
            save_page(self.page, scene, title=self.found.path.name, t_us=np.load(self.product("_tstamps.npy")))
            return StageResult([self.page])

        inputs = (self.cleaned, self.product(".npz"), self.product("_poses.npy"), self.product("_tstamps.npy"))
        return Stage("view", "write a page that shows cloud and trajectory in a browser", inputs,
                     {"version": __version__}, (self.page,), run)

    def shown_cloud(self) -> Path:
        """The cleaned cloud; the raw one if no point passed the cleaning."""
        return self.cleaned if len(read_cloud(self.cleaned)) else self.product(".npz")

    def meta(self) -> dict[str, Any]:
        """What the export says about itself."""
        content: dict[str, Any] = json.loads(self.product("_meta.json").read_text("utf-8"))
        return content

    def poses(self) -> np.ndarray:
        """`(T, 7)` camera to world."""
        poses: np.ndarray = np.load(self.product("_poses.npy"))
        return poses
