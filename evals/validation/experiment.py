"""The whole experiment: odometry, maps, comparisons; everything measured, nothing judged or drawn."""

from __future__ import annotations

import time
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from devo.errors import TrackingError
from evals.image_metrics import DepthErrors, EdgeAgreement, Projection, edge_agreement, project
from evals.pointcloud_metrics import ICP_REMEDY, PlaneFit, nearest_distances
from evals.validation.agreement import (
    Agreement,
    Planarity,
    compare,
    judge_depth,
    planarity,
    plane_distances,
    true_plane,
)
from evals.validation.mapping import (
    Alignment,
    MapResult,
    MapSetup,
    align,
    make_setup,
    make_variants,
    map_variants,
)
from evals.validation.odometry import Trial, run_trials
from evals.validation.settings import SHARES_OF_DISTANCE, THRESHOLDS_M, ValidationSettings
from evals.validation.source import Picture, Source, open_source
from utils.clouds.cloud import PointCloud
from utils.clouds.filters import FilterReport
from utils.clouds.open3d_import import import_open3d
from utils.emvs.geometry import FloatArray
from utils.emvs.views import PoseTrack

CLEANED, RAW = "DEVO cloud", "DEVO cloud, raw"
EMVS_TRUE, EMVS_DEVO = "EMVS, true poses", "EMVS, DEVO poses"
JUDGED_SHARE = 0.05
"""The threshold, relative to the distance of the scene, at which clouds have to agree."""
BOARD_SHARE = 0.02
"""How far, relative to the distance of the scene, a point may lie from the plane to count as on it."""


@dataclass(frozen=True, eq=False)
class TrialSummary:
    """What one trial of the odometry gave, against the map with true poses; lengths in metres.

    Attributes:
        seed: of the trial.
        ok: whether the run could be used; all figures are NaN otherwise.
        units_per_m, ate_rmse_m: scale and error of the trajectory.
        raw_points, points: of the exported cloud, before and after cleaning.
        emvs_to_devo, devo_to_emvs: shares within the judged threshold, in both directions.
        reachable: what `devo_to_emvs` would be if every point had its true depth: less than 1, because the map
            holds edges only and covers one view; NaN without true depth.
        chamfer_m: mean distance from the map to the exported cloud.
        plane_rmse_m: of the exported cloud.
        depth_error: median relative depth error of the exported cloud; NaN without true depth.
        seconds: of the odometry.
        reused: whether it was taken from an earlier run.
    """

    seed: int
    ok: bool
    units_per_m: float = float("nan")
    ate_rmse_m: float = float("nan")
    raw_points: float = float("nan")
    points: float = float("nan")
    emvs_to_devo: float = float("nan")
    devo_to_emvs: float = float("nan")
    reachable: float = float("nan")
    chamfer_m: float = float("nan")
    plane_rmse_m: float = float("nan")
    depth_error: float = float("nan")
    seconds: float = float("nan")
    reused: bool = False


@dataclass(frozen=True, eq=False)
class Validation:
    """Everything that was measured; lengths are metres in the frame of the ground truth unless a name says `units`.

    Attributes:
        settings: what was asked for.
        source: the recording.
        trial: the trial that is shown, its alignment and its cleaned cloud (scalars of the odometry).
        alignment: of its trajectory.
        cloud, cleaning: its cleaned cloud in units of the odometry, and what the cleaning removed.
        trials: summaries of all trials.
        setup, maps: EMVS maps by key of their variant.
        distance_m: distance of the scene, the median depth of the map with true poses.
        points: clouds by name, `(N, 3)` metres.
        agreements: EMVS maps against exported clouds.
        planarities: by name of the cloud.
        plane: the true plane of the scene where true depth is known, else the robust plane of the map with true poses.
        plane_is_true: which of the two.
        depth: errors against true depth by name of the cloud; empty where it is unknown.
        picture: the image that points are projected into.
        projections, edges: by name of the cloud.
        seconds: by stage.
        notes: what could not be done.
    """

    settings: ValidationSettings
    source: Source
    trial: Trial
    alignment: Alignment
    cloud: PointCloud
    cleaning: list[FilterReport]
    trials: list[TrialSummary]
    setup: MapSetup
    maps: dict[str, MapResult]
    distance_m: float
    points: dict[str, FloatArray]
    agreements: list[Agreement]
    planarities: dict[str, Planarity]
    plane: PlaneFit
    plane_is_true: bool
    depth: dict[str, DepthErrors]
    picture: Picture
    projections: dict[str, Projection]
    edges: dict[str, EdgeAgreement]
    seconds: dict[str, float]
    notes: list[str] = field(default_factory=list)

    @property
    def judged_m(self) -> float:
        """The threshold at which clouds have to agree."""
        return JUDGED_SHARE * self.distance_m

    def agreement(self, source: str, target: str) -> Agreement:
        """The comparison of two clouds by their names."""
        return next(found for found in self.agreements if found.name == pair_name(source, target))

    def share_on_plane(self, name: str) -> float:
        """Share of the points of a cloud that lie on the plane of the scene, within 2 % of its distance."""
        return float((np.abs(plane_distances(self.points[name], self.plane)) <= BOARD_SHARE * self.distance_m).mean())


def pair_name(source: str, target: str) -> str:
    """What a comparison is called."""
    return f"{source} -> {target}"


def thresholds_m(distance_m: float, units_per_m: float) -> list[float]:
    """All thresholds in metres: the paper's as metres and as units of the odometry, and shares of the distance."""
    values = [*THRESHOLDS_M, *(value / units_per_m for value in THRESHOLDS_M),
              *(share * distance_m for share in SHARES_OF_DISTANCE)]
    return sorted(set(values))


def validate(settings: ValidationSettings) -> Validation:
    """Run the experiment.

    Raises:
        InputError: unusable settings or recording, no ground truth, or clouds with too few points to compare.
        TrackingError: the odometry gave nothing usable.
    """
    clock = _Clock()
    import_open3d(ICP_REMEDY)  # better missing now than after ten minutes
    settings = settings.resolved()
    source = open_source(settings)
    trials = run_trials(settings)
    clock.stop("odometry")
    trial = trials[0]
    assert trial.trajectory is not None, "run_trials raises otherwise"
    alignment = align(source.truth, trial.trajectory)
    cloud, cleaning = trial.cleaned()
    if len(cloud) < 3:
        raise TrackingError(f"{settings.sequence}: {len(cloud)} of {len(trial.raw)} points pass the cleaning, so there "
                            f"is no cloud to validate ({'; '.join(map(str, cleaning))}); try a longer recording")
    setup = make_setup(settings, source, trial.trajectory, alignment, cloud.points.astype(np.float64))
    results, setup = map_variants(settings, source, setup, make_variants(source.truth, trial.trajectory, alignment))
    maps = {result.variant.key: result for result in results}
    clock.stop("EMVS maps")
    raw = trial.raw.select(trial.raw.finite_mask())
    points = {EMVS_TRUE: maps["gt"].points, EMVS_DEVO: maps["devo"].points,
              CLEANED: alignment.metric_T_devo.apply(cloud.points), RAW: alignment.metric_T_devo.apply(raw.points)}
    distance = float(np.median(maps["gt"].view.cloud.points[:, 2])) if len(points[EMVS_TRUE]) else float("nan")
    agreements = _compare_all(points, distance, alignment)
    planes = {name: planarity(name, found, distance) for name, found in points.items()}
    track = PoseTrack(source.truth)
    plane = planes[EMVS_TRUE].robust if source.depth is None else true_plane(
        source.depth, track, setup.reference_us, 0.01 * distance)
    seen_us: dict[str, npt.ArrayLike] = {
        EMVS_TRUE: setup.reference_us, EMVS_DEVO: setup.reference_us, CLEANED: cloud.scalars["t_us"],
        RAW: raw.scalars["t_us"]}
    depth = {} if source.depth is None else {
        name: judge_depth(points[name], t_us, source.depth, track).summary for name, t_us in seen_us.items()}
    clock.stop("comparisons")
    summaries = [_summarise(other, source, points[EMVS_TRUE], distance, track) for other in trials]
    clock.stop("other trials")
    picture = source.picture(setup.reference_us)
    projections = {name: _project(name, points[name], picture, alignment, trial, track)
                   for name in (EMVS_TRUE, EMVS_DEVO, CLEANED)}
    edges = {name: edge_agreement(found.pixel_xy[found.inside], picture.edges)
             for name, found in projections.items() if found.inside.any() and picture.edges.any()}
    notes = [*source.notes, *(f"{name}: no point falls into the picture ({picture.kind}), so edges are not compared."
                              for name in projections if name not in edges)]
    clock.stop("image")
    return Validation(
        settings, source, trial, alignment, cloud, cleaning, summaries, setup, maps, distance, points, agreements,
        planes, plane, source.depth is not None, depth, picture, projections, edges, clock.seconds, notes)


def _compare_all(points: dict[str, FloatArray], distance_m: float, alignment: Alignment) -> list[Agreement]:
    """The maps against the exported cloud, and against each other."""
    limits = thresholds_m(distance_m, alignment.units_per_m)
    pairs = ((EMVS_DEVO, CLEANED), (EMVS_TRUE, CLEANED), (EMVS_TRUE, RAW), (EMVS_TRUE, EMVS_DEVO))
    return [compare(pair_name(first, second), points[first], points[second], limits, JUDGED_SHARE * distance_m)
            for first, second in pairs]


def _summarise(trial: Trial, source: Source, reference: FloatArray, distance_m: float,
               track: PoseTrack) -> TrialSummary:
    """One trial against the map with true poses, aligned by its own trajectory."""
    seconds = float(trial.facts["seconds"])
    cloud, _ = trial.cleaned()
    if trial.trajectory is None or len(cloud) < 3:
        return TrialSummary(trial.seed, False, seconds=seconds, reused=trial.reused)
    alignment = align(source.truth, trial.trajectory)
    points = alignment.metric_T_devo.apply(cloud.points)
    found = compare("trial", reference, points, [JUDGED_SHARE * distance_m], JUDGED_SHARE * distance_m)
    score = found.scores["before ICP"][0]
    error = reachable = float("nan")
    if source.depth is not None:
        judged = judge_depth(points, cloud.scalars["t_us"], source.depth, track)
        error = judged.summary.median
        if len(judged.corrected):
            reachable = float((nearest_distances(judged.corrected, reference) < JUDGED_SHARE * distance_m).mean())
    return TrialSummary(
        trial.seed, True, alignment.units_per_m, alignment.ate_rmse_m, len(trial.raw), len(points), score.precision,
        score.recall, reachable, found.chamfer["before ICP"].source_to_target,
        planarity("trial", points, distance_m).least_squares.rmse, error, seconds, trial.reused)


def _project(name: str, points: FloatArray, picture: Picture, alignment: Alignment, trial: Trial,
             track: PoseTrack) -> Projection:
    """Points in the picture: clouds of the odometry with its own pose at that time, others with the true one."""
    assert trial.trajectory is not None
    if name == EMVS_TRUE:
        time_us = float(np.clip(picture.t_us, track.t_us[0], track.t_us[-1]))
        world_T_event = track(time_us)[0]
    else:
        own = PoseTrack(trial.trajectory)
        world_T_event = own(float(np.clip(picture.t_us, own.t_us[0], own.t_us[-1])))[0]
        fit = alignment.metric_T_devo
        world_T_event[:3, 3] = fit.apply(world_T_event[:3, 3])
        world_T_event[:3, :3] = fit.rotation @ world_T_event[:3, :3]
    return project(points, world_T_event @ picture.event_T_image, picture.intrinsics, picture.size)


class _Clock:
    """Seconds per stage."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._last = time.perf_counter()

    def stop(self, stage: str) -> None:
        now = time.perf_counter()
        self.seconds[stage] = round(now - self._last, 2)
        self._last = now
