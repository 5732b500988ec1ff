"""Figures of a validation, one function each, for the report and for notebooks."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from evals.validation import paper
from evals.validation.agreement import plane_distances
from evals.validation.experiment import CLEANED, EMVS_DEVO, EMVS_TRUE, RAW, Validation
from evals.validation.mapping import MapResult
from utils.emvs.geometry import FloatArray
from utils.emvs.views import PoseTrack

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLORS = {EMVS_TRUE: "#0072B2", EMVS_DEVO: "#D55E00", CLEANED: "#009E73", RAW: "#999999"}
_GREY, _CONTROL = "#555555", "#8f8f8f"
_STYLE: Any = {
    "font.size": 10, "axes.edgecolor": _GREY, "axes.titlesize": 11, "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.spines.top": False, "axes.spines.right": False, "axes.grid": True, "grid.color": "#e4e4e4",
    "grid.linewidth": 0.7, "axes.axisbelow": True, "legend.frameon": False, "figure.facecolor": "white"}


def all_figures() -> dict[str, tuple[str, Callable[[Validation], Figure]]]:
    """File name -> caption and the function that draws it, in the order of the report."""
    return {
        "image_overlay": ("Points of the three clouds, projected into the picture nearest to the reference view.",
                          draw_image_overlay),
        "overlay_3d": ("The exported cloud over the EMVS map with true poses, from the front and from above.",
                       draw_overlay),
        "emvs_pose_sources": ("EMVS with true poses and with DEVO poses: depth maps of the reference view, and the "
                              "points of both from the front.", draw_pose_sources),
        "scale_isolation": ("Scale isolation and controls: points and sharpness of the votes per source of the poses.",
                            draw_scale_isolation),
        "distances": ("Nearest-neighbour distances, and shares within a threshold (precision and recall as the paper "
                      "defines them) with the paper's figures.", draw_distances),
        "planarity": ("Signed distances of the points from the plane of the scene.", draw_planarity),
        "trajectory": ("Trajectory of the odometry after one similarity, over the ground truth.", draw_trajectory),
    }


def _new(width: float, height: float, rows: int, columns: int, **options: Any) -> tuple[Figure, Any]:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure, figure.subplots(rows, columns, **options)


def _styled(draw: Callable[[Validation], Figure]) -> Callable[[Validation], Figure]:
    """Draw with the style of the report, and leave that of the caller alone."""
    @functools.wraps(draw)
    def styled(found: Validation) -> Figure:
        import matplotlib

        with matplotlib.rc_context(_STYLE):
            figure = draw(found)
            figure.draw_without_rendering()  # the layout settles in its second pass where panels keep their aspect
        return figure

    return styled


def _plane_axes(found: Validation) -> FloatArray:
    """Rows: right and down as the reference view sees the scene's plane, and away from the camera."""
    view = found.maps["gt"].view.world_T_view[:3, :3]
    normal = found.plane.normal * np.sign(found.plane.normal @ view[:, 2] or 1.0)
    right = view[:, 0] - (view[:, 0] @ normal) * normal
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(normal, right), normal])


def _in_plane(found: Validation, points: FloatArray) -> FloatArray:
    """Coordinates `(N, 3)` right, down and behind the scene's plane, metres from the middle of the map."""
    middle = np.median(found.points[EMVS_TRUE], axis=0)
    middle = middle - plane_distances(middle[None], found.plane)[0] * found.plane.normal
    return np.asarray((points - middle) @ _plane_axes(found).T, np.float64)


def _front(axes: Axes, title: str) -> None:
    axes.set_aspect("equal")
    axes.invert_yaxis()
    axes.set_xlabel("right [m]")
    axes.set_ylabel("down [m]")
    axes.set_title(title)


def _legend(axes: Axes, **options: Any) -> None:
    legend = axes.legend(markerscale=4, **options)
    for handle in legend.legend_handles:
        if handle is not None:
            handle.set_alpha(1.0)


@_styled
def draw_image_overlay(found: Validation) -> Figure:
    """Points of each cloud on the picture."""
    figure, axes = _new(15, 4.6, 1, 3)
    for panel, (name, projection) in zip(axes, found.projections.items()):
        image = found.picture.image
        panel.imshow(image if image.ndim == 2 else image[..., ::-1], cmap="gray", vmin=0, vmax=255,
                     interpolation="nearest")
        pixel = projection.pixel_xy[projection.inside]
        panel.scatter(*pixel.T, s=5, color=COLORS[name], linewidths=0, alpha=0.9)
        edge = found.edges.get(name)
        text = f"{name}: {len(pixel)} points"  # two lines, because one does not fit over a panel for large images
        panel.set_title(text + (f"\n{edge.mean_distance_px:.1f} px from edges (random {edge.random_distance_px:.1f})"
                                if edge else ""), fontsize=9.5)
        panel.set_xlim(-0.5, image.shape[1] - 0.5)
        panel.set_ylim(image.shape[0] - 0.5, -0.5)
        panel.axis("off")
    figure.suptitle(f"Projected points over the {found.picture.kind} at {found.picture.t_us * 1e-6:.3f} s", x=0.01,
                    ha="left", fontsize=10, color=_GREY)
    return figure


@_styled
def draw_overlay(found: Validation) -> Figure:
    """Exported cloud over the map with true poses."""
    figure, (front, side) = _new(15, 6.2, 1, 2, width_ratios=(1.25, 1))
    shown = {name: _in_plane(found, found.points[name]) for name in (EMVS_TRUE, CLEANED)}
    for name, size in ((CLEANED, 5), (EMVS_TRUE, 2.5)):
        x, y, z = shown[name].T
        label = f"{name}: {len(x)} points"
        front.scatter(x, y, s=size, color=COLORS[name], linewidths=0, alpha=0.75, label=label)
        side.scatter(x, z, s=size, color=COLORS[name], linewidths=0, alpha=0.6)
    _front(front, "front view, as the reference camera sees it")
    _legend(front, loc="upper center", bbox_to_anchor=(0.5, -0.1), ncols=2)
    away = np.concatenate([cloud[:, 2] for cloud in shown.values()])
    reach = 1.1 * max(2.5 * found.judged_m, float(np.percentile(np.abs(away), 99)))
    side.axhspan(-found.judged_m, found.judged_m, color="#f0f0f0", zorder=0,
                 label=f"within {1000 * found.judged_m:.0f} mm of the plane (5 % of the distance)")
    side.axhline(0, color=_GREY, linewidth=0.8)
    side.set_ylim(-reach, reach)
    beyond = int((np.abs(away) > reach).sum())
    side.set_title("from above, depth exaggerated" + (f" ({beyond} points beyond)" if beyond else ""))
    side.set_xlabel("right [m]")
    side.set_ylabel("behind the plane [m]")
    side.legend(loc="upper center", bbox_to_anchor=(0.5, -0.1))
    return figure


@_styled
def draw_pose_sources(found: Validation) -> Figure:
    """Depth maps with true and with DEVO poses, and both clouds from the front."""
    figure, axes = _new(16, 5.2, 1, 3)
    limits = (found.setup.near_m, found.setup.far_m)
    depths = found.maps["gt"].view.depth_map
    if depths.mask.any():
        low, high = np.percentile(depths.depth[depths.mask], (2, 98))
        limits = (float(low) - 0.02 * found.distance_m, float(high) + 0.02 * found.distance_m)
    image = None
    for panel, key, name in zip(axes, ("gt", "devo"), (EMVS_TRUE, EMVS_DEVO)):
        image = _depth_map(panel, found.maps[key], limits)
        panel.set_title(f"{name}: {len(found.points[name])} points")
    if image is not None:
        figure.colorbar(image, ax=list(axes[:2]), orientation="horizontal", shrink=0.4, aspect=40, label="depth [m]")
    for name in (EMVS_TRUE, EMVS_DEVO):
        x, y, _ = _in_plane(found, found.points[name]).T
        axes[2].scatter(x, y, s=2.5, color=COLORS[name], linewidths=0, alpha=0.7, label=name)
    _front(axes[2], "both, from the front")
    _legend(axes[2], loc="upper center", bbox_to_anchor=(0.5, -0.12), ncols=2)
    return figure


def _depth_map(panel: Axes, result: MapResult, limits: tuple[float, float]) -> Any:
    """Depth over the confidence; returns what the colour bar needs."""
    found = result.view.depth_map
    top = float(np.percentile(found.confidence, 99.5)) or 1.0
    panel.imshow(1 - np.clip(found.confidence / top, 0, 1) * 0.35, cmap="gray", vmin=0, vmax=1)
    panel.set_xticks([])
    panel.set_yticks([])
    rows, columns = np.nonzero(found.mask)
    return panel.scatter(columns, rows, c=found.depth[rows, columns] / result.variant.units_per_m, s=3, cmap="turbo_r",
                         vmin=limits[0], vmax=limits[1], linewidths=0, marker="s")


@_styled
def draw_scale_isolation(found: Validation) -> Figure:
    """Points and sharpness per variant."""
    figure, (left, right) = _new(14, 4.8, 1, 2, sharey=True)
    results = list(found.maps.values())
    place = np.arange(len(results))
    colors = [COLORS[EMVS_DEVO] if "devo" in result.variant.key and result.variant.isolates == "scale"
              else COLORS[EMVS_TRUE] if result.variant.isolates == "scale" else _CONTROL for result in results]
    counts = np.array([len(result.points) for result in results])
    sharp = np.array([result.sharpness for result in results]) / found.maps["gt"].sharpness
    for axes, values, text, title in ((left, counts, "{:.0f}", "points of the map"),
                                      (right, sharp, "{:.3f}", "mean square of the votes, true poses = 1")):
        bars = axes.barh(place, values, color=colors, height=0.68)
        axes.bar_label(bars, [text.format(value) for value in values], padding=4, fontsize=9)
        axes.set_title(title)
        axes.set_xlim(0, 1.14 * float(values.max()))
        axes.grid(axis="y", visible=False)
        axes.axhline(3.5, color=_GREY, linewidth=0.8, linestyle=":")
    labels = [f"{result.variant.label}\n({result.poses_in_span} poses)" for result in results]
    left.set_yticks(place, labels, fontsize=9)
    left.invert_yaxis()
    from matplotlib.patches import Patch

    names = ("true poses", "DEVO poses", "controls: density, positions, rotations")
    shown = [Patch(color=color, label=name) for color, name in zip(
        (COLORS[EMVS_TRUE], COLORS[EMVS_DEVO], _CONTROL), names)]
    figure.legend(handles=shown, loc="outside lower center", ncols=3)
    return figure


@_styled
def draw_distances(found: Validation) -> Figure:
    """Histograms of nearest-neighbour distances, and precision and recall over the threshold."""
    figure, axes = _new(15, 9.0, 2, 2)
    top = 1000 * float(max(2.2 * found.judged_m, 0.1))
    bins = np.linspace(0, top, 61)
    for column, first in enumerate((EMVS_DEVO, EMVS_TRUE)):
        agreement = found.agreement(first, CLEANED)
        panel, curve = axes[0, column], axes[1, column]
        there, back = (1000 * values for values in agreement.distances["before ICP"])
        for values, color, label in ((there, COLORS[first], f"{first} to {CLEANED}"),
                                     (back, COLORS[CLEANED], f"{CLEANED} to {first}")):
            panel.hist(np.minimum(values, top), bins, weights=np.full(len(values), 100 / len(values)), color=color,
                       alpha=0.55, label=f"{label}: mean {values.mean():.1f} mm, median {np.median(values):.1f} mm")
        panel.set_title(f"{first} and {CLEANED}, before ICP")
        panel.set_xlabel(f"distance to the nearest point [mm] (last bin: and beyond {top:.0f})")
        panel.set_ylabel("share of points [%]")
        _curves(curve, found, first)
        for one in (panel, curve):
            one.axvline(1000 * found.judged_m, color=_GREY, linewidth=0.9, linestyle="--")
            one.set_xlim(0, top)
        panel.set_ylim(top=1.25 * panel.get_ylim()[1])
        panel.legend(loc="upper right", fontsize=9)
    return figure


def _curves(axes: Axes, found: Validation, first: str) -> None:
    """Precision and recall over the threshold for both stages, with the paper's points."""
    agreement = found.agreement(first, CLEANED)
    for stage, style in (("before ICP", "-"), ("after ICP", ":")):
        if stage not in agreement.distances:
            continue
        for values, color, name in zip(agreement.distances[stage], (COLORS[first], COLORS[CLEANED]),
                                       ("precision", "recall")):
            axes.plot(1000 * np.sort(values), 100 * np.arange(1, len(values) + 1) / len(values), style, color=color,
                      label=f"{name}, {stage}")
    published = paper.AGREEMENT_GROUND_TRUTH if first == EMVS_TRUE else {
        0.05: (paper.PRECISION_AT_5_CM, paper.RECALL_AT_5_CM, 0.0)}
    for index, marker, name in ((0, "^", "precision"), (1, "v", "recall")):
        axes.plot([1000 * limit / paper.UNITS_PER_M for limit in published],
                  [100 * figures[index] for figures in published.values()], marker, color="black", markersize=6,
                  markerfacecolor="none", label=f"{name}, paper (BOARD SLOW)")
    axes.set_ylim(0, 103)
    axes.set_xlabel("threshold [mm]; dashed: 5 % of the distance of the scene")
    axes.set_ylabel("share within the threshold [%]")
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.13), fontsize=9, ncols=3)


@_styled
def draw_planarity(found: Validation) -> Figure:
    """Distances from the plane of the scene: distribution per cloud, and where on the plane they are."""
    figure, (left, right) = _new(15, 5.0, 1, 2, width_ratios=(1, 1.1))
    reach = 1000 * 1.5 * found.judged_m
    bins = np.linspace(-reach, reach, 61)
    for name in (EMVS_TRUE, EMVS_DEVO, CLEANED):
        away = 1000 * plane_distances(found.points[name], found.plane) * np.sign(
            found.plane.normal @ _plane_axes(found)[2])
        left.hist(np.clip(away, -reach, reach), bins, weights=np.full(len(away), 100 / len(away)), histtype="step",
                  linewidth=1.8, color=COLORS[name],
                  label=f"{name}: own-plane RMSE {1000 * found.planarities[name].least_squares.rmse:.1f} mm")
    left.set_xlabel(f"behind the plane [mm] (outer bins: and beyond {reach:.0f})")
    left.set_ylabel("share of points [%]")
    left.set_title("distance from the " + ("true plane" if found.plane_is_true else "plane of the map with true poses"))
    left.set_ylim(top=1.35 * left.get_ylim()[1])
    left.legend(loc="upper left", fontsize=9)
    x, y, z = _in_plane(found, found.points[CLEANED]).T
    order = np.argsort(np.abs(z))
    limit = 1000 * 0.6 * found.judged_m
    image = right.scatter(x[order], y[order], c=1000 * z[order], s=7, cmap="RdBu_r", vmin=-limit, vmax=limit,
                          linewidths=0)
    _front(right, f"{CLEANED}: where its points are off")
    figure.colorbar(image, ax=right, label="behind the plane [mm]", extend="both", shrink=0.9)
    return figure


@_styled
def draw_trajectory(found: Validation) -> Figure:
    """Aligned trajectory from above and from the side, and its error over time."""
    figure, (above, side, over_time) = _new(16, 4.8, 1, 3)
    assert found.trial.trajectory is not None
    truth, estimate = found.source.truth, found.trial.trajectory
    inside = (estimate.t_us >= truth.t_us[0]) & (estimate.t_us <= truth.t_us[-1])
    stamps = estimate.t_us[inside]
    true_centers = PoseTrack(truth)(stamps)[:, :3, 3]
    centers = found.alignment.metric_T_devo.apply(estimate.world_T_cam[inside][:, :3])
    for axes, (a, b), title in ((above, (0, 2), "from above"), (side, (2, 1), "from the side")):
        axes.plot(true_centers[:, a], true_centers[:, b], color=_GREY, linewidth=1.4, label="ground truth")
        axes.plot(centers[:, a], centers[:, b], color=COLORS[EMVS_DEVO], linewidth=1.4, label="DEVO after Sim3")
        axes.set_aspect("equal", adjustable="datalim")
        axes.set_xlabel(f"{'xyz'[a]} [m]")
        axes.set_ylabel(f"{'xyz'[b]} [m]")
        axes.set_title(title)
    side.invert_yaxis()
    above.legend(loc="upper center", bbox_to_anchor=(0.5, -0.14), ncols=2)
    error = 1000 * np.linalg.norm(centers - true_centers, axis=1)
    over_time.plot((stamps - stamps[0]) * 1e-6, error, color=COLORS[EMVS_DEVO], linewidth=1.3)
    over_time.axhline(1000 * found.alignment.ate_rmse_m, color=_GREY, linestyle="--", linewidth=0.9)
    over_time.set_ylim(bottom=0)
    over_time.set_xlabel("time [s]")
    over_time.set_ylabel("distance from the true centre [mm]")
    over_time.set_title(f"ATE {1000 * found.alignment.ate_rmse_m:.1f} mm on {found.alignment.path_length_m:.2f} m")
    return figure
