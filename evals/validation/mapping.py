"""EMVS maps of one recording with poses of different source, scale and density.

All maps use the same events, the same time span and the same reference time, so that only the poses differ. Depth
range and filter radius are fixed in metres and scaled with the poses.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from tqdm import tqdm

from devo.errors import InputError
from devo.poses import matrix_to_pose
from evals.alignment import Similarity, umeyama_sim3
from evals.validation.settings import RADIUS_M, ValidationSettings
from evals.validation.source import Source
from utils.emvs import EmvsSettings, View, map_events
from utils.emvs.geometry import FloatArray, VirtualCamera
from utils.emvs.mapper import filter_cloud
from utils.emvs.views import PoseTrack, depth_range_from_points
from utils.trajectory_io import Trajectory, quaternions

IDENTITY = Similarity(1.0, np.eye(3), np.zeros(3))
_LEAST_POSES = 8


@dataclass(frozen=True, eq=False)
class Alignment:
    """How the world of the odometry lies in that of the ground truth.

    Attributes:
        metric_T_devo: similarity from units of the odometry to metres in the frame of the ground truth.
        ate_rmse_m: root mean square distance of aligned camera centres.
        rotation_residual_deg: mean angle between aligned and true camera axes.
        poses: number of poses that were matched (true poses interpolated at the stamps of the odometry).
        path_length_m: true path between the first and last of them.
    """

    metric_T_devo: Similarity
    ate_rmse_m: float
    rotation_residual_deg: float
    poses: int
    path_length_m: float

    @property
    def units_per_m(self) -> float:
        """DEVO / ground-truth scale: units of the odometry in one metre."""
        return 1.0 / self.metric_T_devo.scale


@dataclass(frozen=True, eq=False)
class Variant:
    """Poses to map with.

    Attributes:
        key: short name.
        label: for tables and figures.
        trajectory: camera to world.
        units_per_m: length of a metre in the unit of the trajectory.
        metric_T_world: brings the cloud to metres in the frame of the ground truth.
        isolates: `scale` for the four variants of the paper, `poses` for the controls.
    """

    key: str
    label: str
    trajectory: Trajectory
    units_per_m: float
    metric_T_world: Similarity
    isolates: str


@dataclass(frozen=True, eq=False)
class MapResult:
    """An EMVS map of one variant.

    Attributes:
        variant: what it was made with.
        view: reference view, depth map, counts.
        points: `(N, 3)` float64, metres in the frame of the ground truth.
        poses_in_span: number of poses that the map rests on.
    """

    variant: Variant
    view: View
    points: FloatArray
    poses_in_span: int

    @property
    def sharpness(self) -> float:
        """Mean square of the votes."""
        return self.view.counts["dsi_mean_square"]


@dataclass(frozen=True, eq=False)
class MapSetup:
    """What all maps share.

    Attributes:
        start_us, stop_us: span with events, true poses and poses of the odometry.
        near_m, far_m: depth range in metres.
        event_stride: every n-th event votes.
        emvs: settings; lengths are those of metric poses.
    """

    start_us: float
    stop_us: float
    near_m: float
    far_m: float
    event_stride: int
    emvs: EmvsSettings

    @property
    def reference_us(self) -> float:
        """Time of the reference view."""
        return (self.start_us + self.stop_us) / 2


def align(truth: Trajectory, estimate: Trajectory) -> Alignment:
    """Fit one similarity to the camera centres, with true poses interpolated at the stamps of the odometry.

    Raises:
        InputError: fewer than eight stamps lie within the ground truth, or the centres determine no similarity.
    """
    inside = (estimate.t_us >= truth.t_us[0]) & (estimate.t_us <= truth.t_us[-1])
    if inside.sum() < _LEAST_POSES:
        raise InputError(f"{int(inside.sum())} of {len(estimate)} poses of the odometry lie within the time of the "
                         f"ground truth ({truth.t_us[0]:.0f} us to {truth.t_us[-1]:.0f} us), at least {_LEAST_POSES} "
                         "are needed; check the clocks of events and ground truth")
    true_poses = PoseTrack(truth)(estimate.t_us[inside])
    found = Trajectory(estimate.t_us[inside], estimate.world_T_cam[inside]).matrices()
    centers = true_poses[:, :3, 3]
    fit = umeyama_sim3(found[:, :3, 3], centers)
    residual = np.linalg.norm(fit.apply(found[:, :3, 3]) - centers, axis=1)
    turned = fit.rotation @ found[:, :3, :3]
    cosine = (np.einsum("nij,nij->n", turned, true_poses[:, :3, :3]) - 1) / 2
    angle = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    return Alignment(fit, float(np.sqrt((residual**2).mean())), float(angle.mean()), int(inside.sum()),
                     float(np.linalg.norm(np.diff(centers, axis=0), axis=1).sum()))


def make_variants(truth: Trajectory, estimate: Trajectory, alignment: Alignment) -> list[Variant]:
    """The four variants of the paper and the controls.

    The controls say what the difference between true and estimated poses is made of: their density (true poses at the
    stamps of the odometry; estimated poses on a spline at the density of the true ones), their positions or their
    rotations (one from each source).
    """
    fit, units = alignment.metric_T_devo, alignment.units_per_m
    inside = (estimate.t_us >= truth.t_us[0]) & (estimate.t_us <= truth.t_us[-1])
    stamps = estimate.t_us[inside]
    true_at = PoseTrack(truth)(stamps)
    estimated = Trajectory(stamps, estimate.world_T_cam[inside]).matrices()
    aligned = estimated.copy()
    aligned[:, :3, :3] = fit.rotation @ estimated[:, :3, :3]
    aligned[:, :3, 3] = fit.apply(estimated[:, :3, 3])
    true_positions, true_rotations = aligned.copy(), aligned.copy()
    true_positions[:, :3, 3] = true_at[:, :3, 3]
    true_rotations[:, :3, :3] = true_at[:, :3, :3]
    return [
        Variant("gt", "ground truth", truth, 1.0, IDENTITY, "scale"),
        Variant("gt_scaled", f"ground truth x {units:.3f}", _scaled(truth, units), units,
                Similarity(1 / units, np.eye(3), np.zeros(3)), "scale"),
        Variant("devo", "DEVO", estimate, units, fit, "scale"),
        Variant("devo_descaled", f"DEVO / {units:.3f}", _scaled(estimate, 1 / units), 1.0,
                Similarity(1.0, fit.rotation, fit.translation), "scale"),
        Variant("gt_at_devo", "ground truth at DEVO's rate", _trajectory(stamps, true_at), 1.0, IDENTITY, "poses"),
        Variant("devo_spline", "DEVO on a spline", _splined(estimate, truth), units, fit, "poses"),
        Variant("gt_positions", "true positions, DEVO rotations", _trajectory(stamps, true_positions), 1.0, IDENTITY,
                "poses"),
        Variant("gt_rotations", "DEVO positions, true rotations", _trajectory(stamps, true_rotations), 1.0, IDENTITY,
                "poses"),
    ]


def make_setup(settings: ValidationSettings, source: Source, estimate: Trajectory, alignment: Alignment,
               sparse_points: FloatArray) -> MapSetup:
    """Common span, depth range from the cloud of the odometry as the reference view sees it, EMVS settings.

    The span begins and ends with a pose of the odometry inside the ground truth, so that it holds for every variant.

    Raises:
        InputError: events, true poses and odometry share no time.
    """
    with source.sequence.open_events() as reader:
        first, last = reader.time_range_us()
    known = estimate.t_us[(estimate.t_us >= source.truth.t_us[0]) & (estimate.t_us <= source.truth.t_us[-1])]
    start, stop = max(float(first), float(known[0])), min(float(last), float(known[-1]))
    if not start < stop:
        raise InputError(f"events ({first} us to {last} us), ground truth ({source.truth.t_us[0]:.0f} us to "
                         f"{source.truth.t_us[-1]:.0f} us) and odometry ({estimate.t_us[0]:.0f} us to "
                         f"{estimate.t_us[-1]:.0f} us) share no time; check the clocks")
    width, height = source.camera.size
    emvs = dataclasses.replace(settings.emvs, dimX=round(settings.view_scale * width),
                               dimY=round(settings.view_scale * height))
    camera = VirtualCamera.of(emvs, source.camera.size, source.camera.intrinsics)
    near, far = settings.emvs.min_depth, settings.emvs.max_depth
    if near is None or far is None:
        view = PoseTrack(estimate)((start + stop) / 2)[0]
        seen = depth_range_from_points(sparse_points, view, camera.focal, (camera.width, camera.height))
        near = seen[0] / alignment.units_per_m if near is None else near
        far = seen[1] / alignment.units_per_m if far is None else far
    return MapSetup(start, stop, near, far, 1, emvs)


def map_variants(settings: ValidationSettings, source: Source, setup: MapSetup,
                 variants: list[Variant]) -> tuple[list[MapResult], MapSetup]:
    """Map the same events once per variant; progress goes to stderr."""
    reader, stride = source.thinned_events(setup.start_us, setup.stop_us + 1, settings.emvs_events)
    setup = dataclasses.replace(setup, event_stride=stride)
    device = torch.device(settings.device)
    results = []
    for variant in tqdm(variants, desc="EMVS maps", unit="map"):
        scale = variant.units_per_m
        emvs = dataclasses.replace(setup.emvs, min_depth=setup.near_m * scale, max_depth=setup.far_m * scale,
                                   radius_search=RADIUS_M * scale)
        view = map_events(reader, variant.trajectory, source.camera, emvs, start_us=setup.start_us,
                          stop_us=setup.stop_us + 1, device=device).views[0]
        stamps = variant.trajectory.t_us
        count = int(((stamps >= setup.start_us) & (stamps <= setup.stop_us)).sum())
        points = variant.metric_T_world.apply(view.world_cloud().points)
        results.append(MapResult(variant, view, points, count))
    return results, setup


def points_with_radius(result: MapResult, radius: float) -> int:
    """Number of points of a map that the outlier filter leaves at another radius, in the unit of its poses."""
    from utils.emvs.mapper import depth_cloud

    raw = depth_cloud(result.view.depth_map, result.view.camera)
    return len(filter_cloud(raw, EmvsSettings(radius_search=radius)))


def _scaled(trajectory: Trajectory, factor: float) -> Trajectory:
    return Trajectory(trajectory.t_us, trajectory.world_T_cam * np.array([factor] * 3 + [1.0] * 4))


def _trajectory(t_us: FloatArray, matrices: FloatArray) -> Trajectory:
    return Trajectory(t_us, matrix_to_pose(matrices))


def _splined(estimate: Trajectory, truth: Trajectory) -> Trajectory:
    """The estimate on cubic splines (positions; rotations relative to their neighbours) at the stamps of the truth."""
    from scipy.interpolate import CubicSpline
    from scipy.spatial.transform import Rotation, RotationSpline

    seconds = (estimate.t_us - estimate.t_us[0]) * 1e-6
    stamps = truth.t_us[(truth.t_us > estimate.t_us[0]) & (truth.t_us < estimate.t_us[-1])].astype(np.float64)
    stamps = np.unique(np.concatenate([[estimate.t_us[0]], stamps, [estimate.t_us[-1]]]))
    wanted = (stamps - estimate.t_us[0]) * 1e-6
    position = CubicSpline(seconds, estimate.world_T_cam[:, :3])(wanted)
    rotation = RotationSpline(seconds, Rotation.from_quat(estimate.world_T_cam[:, 3:]))(wanted).as_matrix()
    return Trajectory(stamps, np.concatenate([position, quaternions(rotation)], axis=1))


def mask_agreement(first: MapResult, second: MapResult) -> Iterator[tuple[str, float]]:
    """Shares of pixels with equal mask, and of common pixels with the same depth plane."""
    a, b = first.view.depth_map, second.view.depth_map
    yield "equal mask", float((a.mask == b.mask).mean())
    both = a.mask & b.mask
    yield "same plane", float((a.plane[both] == b.plane[both]).mean()) if both.any() else float("nan")
