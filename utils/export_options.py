"""What `scripts/export_pointcloud.py` was asked for; the field names are those of its flags."""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, TypeVar

from devo.errors import InputError
from utils.datasets.registry import SequenceOptions
from utils.edge_clouds.settings import EdgeSettings, FocusSettings
from utils.export_products import cloud_file

MAX_RELATIVE_SIGMA = 0.1  # cleaned clouds keep depths that are known to ten per cent
KEEP_FRAME_CLOUDS = ("all", "last", "none")

Settings = TypeVar("Settings", bound=EdgeSettings)


def settings_from(kind: type[Settings], prefix: str, values: dict[str, Any]) -> Settings:
    """Edge settings of a kind from parsed flags `<prefix>_<field>`; fields without a flag keep their defaults.

    Raises:
        InputError: a value that makes no sense.
    """
    return kind(**{field.name: values[f"{prefix}_{field.name}"] for field in fields(kind)
                   if f"{prefix}_{field.name}" in values})


@dataclass
class ExportOptions:
    """One export. Lengths are in trajectory units, times in microseconds; see `--help` for each."""

    datapath: str
    dataset: str = "auto"
    config: str | None = None
    opts: list[str] | None = None
    weights: str | None = None
    out: str = "point_cloud.npy"
    rgb: bool = False
    stride: int = 1
    side: str = "left"
    stream: str | None = None
    start_us: float | None = None
    stop_us: float | None = None
    window_ms: float | None = None
    window_events: int | None = None
    calib: str | None = None
    image_size: list[int] | None = None
    intrinsics: list[float] | None = None
    workers: int = 1
    device: str = "auto"
    seed: int = 0
    viz: bool = False
    viz_flow: bool = False
    debug: bool = False
    save_per_frame_cloud: bool = False
    save_per_frame_cloud_path: str = "results/clouds"
    per_frame_keep: str = "all"
    voxel_size: float = 0.05
    export_frame_data: bool = False
    frame_data_out: str | None = None
    frame_mode: str = "final"
    save_dpviewer_cloud: bool = False
    save_observations: bool = False
    export_edge_cloud: bool = False
    edge_cloud_out: str | None = None
    edge: EdgeSettings = EdgeSettings()
    export_focus_edge_cloud: bool = False
    focus_edge_cloud_out: str | None = None
    focus: FocusSettings = FocusSettings()
    convert_ply: bool = False
    cleanup: bool = True
    cleanup_algo: str = "sor"
    sor_nb_neighbors: int = 20
    sor_std_ratio: float = 2.0
    ror_radius: float | None = None
    ror_min_neighbors: int | None = None

    @classmethod
    def from_flags(cls, flags: dict[str, Any]) -> ExportOptions:
        """Options from parsed flags by name; `--edge_*` and `--focus_*` go into `edge` and `focus`.

        Raises:
            InputError: a value of an edge cloud that makes no sense.
        """
        own = {field.name for field in fields(cls)}
        return cls(**{name: value for name, value in flags.items() if name in own},
                   edge=settings_from(EdgeSettings, "edge", flags), focus=settings_from(FocusSettings, "focus", flags))

    def check(self) -> None:
        """Refuse what cannot work before the long run begins.

        Raises:
            InputError: a value or a combination that makes no sense.
        """
        for product in ("edge_cloud", "focus_edge_cloud"):
            self.edge_cloud_file(product)
        if self.rgb and (self.export_edge_cloud or self.export_focus_edge_cloud):
            raise InputError("edge clouds are made of events; --rgb tracks image frames, so leave one of them out")
        if self.workers < 0:
            raise InputError(f"--workers is {self.workers}; expected 0 (no thread) or more")
        for name in ("voxel_size", "sor_std_ratio", "ror_radius"):
            value = getattr(self, name)
            if value is not None and not 0 < value < float("inf"):
                raise InputError(f"--{name} is {value}; expected a positive number")

    @property
    def wants_frames(self) -> bool:
        """Whether the structure per frame has to be recorded."""
        return self.export_frame_data or self.export_edge_cloud or self.export_focus_edge_cloud

    def edge_cloud_file(self, product: str) -> Path | None:
        """Where `edge_cloud` or `focus_edge_cloud` was asked to go; None = beside the other products."""
        name = getattr(self, f"{product}_out")
        return None if name is None else cloud_file(name, f"--{product}_out")

    def sequence_options(self) -> SequenceOptions:
        """The part that concerns the recording."""
        return SequenceOptions(
            side=self.side, stride=self.stride, start_us=self.start_us, stop_us=self.stop_us, window_ms=self.window_ms,
            window_events=self.window_events, calib=Path(self.calib) if self.calib else None,
            image_size=(self.image_size[0], self.image_size[1]) if self.image_size else None,
            intrinsics=tuple(self.intrinsics) if self.intrinsics else None, stream=self.stream)

    def outlier_step(self) -> tuple[str, dict[str, Any]]:
        """The chosen outlier filter for `utils.clouds.filters.clean_cloud`."""
        if self.cleanup_algo == "ror":
            return "ror", {"radius": self.ror_radius, "min_neighbors": self.ror_min_neighbors}
        return "sor", {"neighbors": self.sor_nb_neighbors, "std_ratio": self.sor_std_ratio}

    def cleanup_steps(self) -> list[str | tuple[str, dict[str, Any]]]:
        """Quality first, then the chosen outlier filter."""
        return [("quality", {"max_relative_sigma": MAX_RELATIVE_SIGMA}), self.outlier_step()]
