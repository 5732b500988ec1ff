"""What `scripts/start_pipline.py` was asked for."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

BACKENDS = ("python", "ros")


@dataclass(frozen=True)
class CleanupOptions:
    """How the cloud is cleaned, after the quality filter of the odometry itself.

    Attributes:
        algorithm: `ror` (too few other points within a radius) or `sor` (neighbours unusually far away).
        output: file of the cleaned cloud; None = `<outname>_cleaned.ply` in the folder of results.
        nb_neighbors, std_ratio: of `sor`.
        radius, min_neighbors: of `ror`; None = derived from the cloud, whose scale is arbitrary.
    """

    algorithm: str = "ror"
    output: str | None = None
    nb_neighbors: int = 20
    std_ratio: float = 2.0
    radius: float | None = None
    min_neighbors: int | None = None


@dataclass(frozen=True)
class EmvsStageOptions:
    """Semi-dense mapping and the hand-over to its ROS implementation.

    Attributes:
        run: map with EMVS; `backend` python = the built-in mapper, ros = `rosrun mapper_emvs run_emvs`.
        export_bag: write bag and flag file for the ROS implementation.
        side: camera; None = that of the export.
        bag_name, conf_name: file names in the folder of results.
        event_topic, camera_info_topic, pose_topic: topics of the bag.
        min_depth, max_depth: depth range in trajectory units; None = from the cloud.
        dimZ: number of depth planes.
        t_margin_s: seconds of events before the first and after the last pose that go into the bag.
        overwrite: replace an existing bag.
    """

    run: bool = False
    backend: str = "python"
    export_bag: bool = False
    side: str | None = None
    bag_name: str = "emvs_input.bag"
    conf_name: str = "emvs_mono.conf"
    event_topic: str = "/dvs/events"
    camera_info_topic: str = "/dvs/camera_info"
    pose_topic: str = "/pose"
    min_depth: float | None = None
    max_depth: float | None = None
    dimZ: int = 100
    t_margin_s: float = 0.5
    overwrite: bool = False

    @property
    def needs_bag(self) -> bool:
        """Whether the stage that writes the bag runs."""
        return self.export_bag or (self.run and self.backend == "ros")


@dataclass(frozen=True)
class PipelineOptions:
    """One call of the pipeline.

    Attributes:
        indir: recording: folder, bag or event file.
        export: arguments of `scripts/export_pointcloud.py` by name; those that the pipeline decides are replaced.
        outdir: folder of results; None = `results/<name of indir>` in the working directory.
        dataset: name of the data set; "auto" = by its files.
        side: camera of a stereo recording.
        outname: file name of the cloud.
        frame_out: file name of the structure per frame.
        cleanup, emvs: the later stages.
        view: write the page that shows the cloud in a browser.
        overwrite_preprocessing: make everything anew that preprocessing makes.
        resume: leave stages alone whose inputs, settings and products are unchanged.
        dry_run: say what would be done, and do nothing.
        keep_going: go on after a failed stage with those that can still run.
        command: the command line, for the record.
    """

    indir: str
    export: dict[str, Any]
    outdir: str | None = None
    dataset: str = "auto"
    side: str = "left"
    outname: str = "pointcloud.npy"
    frame_out: str = "frames.npz"
    cleanup: CleanupOptions = field(default_factory=CleanupOptions)
    emvs: EmvsStageOptions = field(default_factory=EmvsStageOptions)
    view: bool = True
    overwrite_preprocessing: bool = False
    resume: bool = False
    dry_run: bool = False
    keep_going: bool = False
    command: tuple[str, ...] = ()

    def folder(self) -> Path:
        """Folder of results: as given, else named after the input."""
        if self.outdir is not None:
            return Path(self.outdir)
        source = Path(self.indir).absolute()
        return Path("results") / (source.name if source.is_dir() else source.name.split(".")[0])
