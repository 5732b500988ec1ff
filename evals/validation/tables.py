"""Tables of a validation: our figures, with those of the paper beside them where it has any."""

from __future__ import annotations

import csv
import html
import io
import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from evals.validation import paper
from evals.validation.agreement import plane_distances
from evals.validation.experiment import CLEANED, EMVS_DEVO, EMVS_TRUE, RAW, Validation, pair_name
from evals.validation.mapping import mask_agreement, points_with_radius
from evals.validation.settings import RADIUS_M, SHARES_OF_DISTANCE, THRESHOLDS_M
from evals.validation.verdict import Criterion

Cell = str | int | float | None
PAPER = "paper, BOARD SLOW"
STAGES = ("before ICP", "after ICP")


@dataclass(frozen=True)
class Table:
    """A table that can be written as CSV, Markdown and HTML.

    Attributes:
        name: beginning of the file name.
        title: headline.
        columns: headers, with units.
        rows: as many cells each; None = does not apply. Rows whose first cell begins with "paper" are references.
        note: one line below.
    """

    name: str
    title: str
    columns: tuple[str, ...]
    rows: list[tuple[Cell, ...]]
    note: str = ""

    def csv(self) -> str:
        """Comma-separated values with full precision, header first; NaN and None are empty."""
        stream = io.StringIO()
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(self.columns)
        writer.writerows([["" if _is_missing(cell) else cell for cell in row] for row in self.rows])
        return stream.getvalue()

    def markdown(self) -> str:
        """A Markdown table under a heading."""
        lines = [f"## {self.title}", "", "| " + " | ".join(self.columns) + " |", "|" + "---|" * len(self.columns)]
        lines += ["| " + " | ".join(text.replace("|", "\\|") for text in self._texts(row)) + " |" for row in self.rows]
        return "\n".join([*lines, "", *([self.note, ""] if self.note else [])])

    def html(self) -> str:
        """An HTML table under a heading."""
        parts = [f"<h2>{html.escape(self.title)}</h2><div class='scroll'><table><tr>"]
        parts += [f"<th>{html.escape(column)}</th>" for column in self.columns]
        for row in self.rows:
            kind = " class='paper'" if str(row[0]).startswith("paper") else ""
            cells = "".join(f"<td>{html.escape(text)}</td>" for text in self._texts(row))
            parts.append(f"</tr><tr{kind}>{cells}")
        return "".join([*parts, "</tr></table></div>", f"<p class='note'>{html.escape(self.note)}</p>"])

    def _texts(self, row: tuple[Cell, ...]) -> Iterator[str]:
        for column, cell in zip(self.columns, row, strict=True):
            if isinstance(cell, str):
                yield cell
            elif cell is None or _is_missing(cell):
                yield "–"
            elif isinstance(cell, int):
                yield str(cell)
            else:
                yield _percent(cell) if "%" in column else _significant(cell)


def _is_missing(cell: Cell) -> bool:
    return cell is None or (isinstance(cell, float) and math.isnan(cell))


def _percent(value: float) -> str:
    return f"{value:.1f}" if abs(value) >= 10 else f"{value:.2f}"


def _significant(value: float) -> str:
    """Four significant digits without an exponent where that is readable."""
    if value == 0 or 1e-4 <= abs(value) < 1e6:
        places = 3 if value == 0 else max(0, 3 - math.floor(math.log10(abs(value))))
        return f"{value:.{places}f}"
    return f"{value:.3g}"


def make_tables(found: Validation, judged: list[Criterion]) -> list[Table]:
    """All tables, in the order of the report."""
    return [_verdict(judged), _counts(found), _trials(found), _maps(found), _scale(found), _distances(found),
            *_thresholds(found), _planarity(found), *_depth(found), *_edges(found), _registration(found),
            _durations(found)]


def _verdict(judged: list[Criterion]) -> Table:
    rows: list[tuple[Cell, ...]] = [(one.word, one.name, one.value, one.limit, one.why) for one in judged]
    return Table("verdict", "Verdict", ("outcome", "requirement", "found", "expected", "if missed, why"), rows)


def _counts(found: Validation) -> Table:
    units = found.alignment.units_per_m
    ours: dict[str, Cell] = {
        "DEVO poses": len(found.trial.trajectory or ()), "ground-truth poses": len(found.source.truth),
        "DEVO cloud points": len(found.points[CLEANED]), "EMVS points, DEVO poses": len(found.points[EMVS_DEVO]),
        "EMVS points, ground-truth poses": len(found.points[EMVS_TRUE]), "DEVO / ground-truth scale": units}
    rows: list[tuple[Cell, ...]] = [(name, value, paper.COUNTS[name]) for name, value in ours.items()]
    gt, devo = len(found.points[EMVS_TRUE]), len(found.points[EMVS_DEVO])
    rows += [
        ("EMVS points, ground truth / DEVO", gt / devo if devo else math.nan,
         paper.COUNTS["EMVS points, ground-truth poses"] / paper.COUNTS["EMVS points, DEVO poses"]),
        ("ground-truth poses / DEVO poses", found.maps["gt"].poses_in_span / found.maps["devo"].poses_in_span,
         paper.COUNTS["ground-truth poses"] / paper.COUNTS["DEVO poses"]),
        ("DEVO cloud points, raw", len(found.points[RAW]), None),
        ("distance of the scene [m]", found.distance_m, None),
        ("trajectory error, ATE RMSE after Sim3 [mm]", 1000 * found.alignment.ate_rmse_m, None),
        ("mean rotation residual [deg]", found.alignment.rotation_residual_deg, None),
        ("path [m]", found.alignment.path_length_m, None),
    ]
    return Table("counts", "Data and cloud sizes", ("quantity", "here", PAPER), rows, paper.SOURCE)


def _trials(found: Validation) -> Table:
    columns = ("seed", "DEVO / GT scale", "ATE [mm]", "raw points", "points", "EMVS near DEVO %", "DEVO near EMVS %",
               "of it reachable %", "Chamfer EMVS -> DEVO [mm]", "plane RMSE [mm]", "depth error %", "seconds",
               "reused")
    values = np.array([[trial.units_per_m, 1000 * trial.ate_rmse_m, trial.raw_points, trial.points,
                        100 * trial.emvs_to_devo, 100 * trial.devo_to_emvs, 100 * trial.reachable,
                        1000 * trial.chamfer_m, 1000 * trial.plane_rmse_m, 100 * trial.depth_error, trial.seconds]
                       for trial in found.trials])
    rows: list[tuple[Cell, ...]] = [
        (str(trial.seed), *row.tolist(), "yes" if trial.reused else "no" if trial.ok else "lost")
        for trial, row in zip(found.trials, values)]
    good = values[[trial.ok for trial in found.trials]]
    if len(good) > 1:
        rows += [("mean", *good.mean(axis=0).tolist(), None), ("std", *good.std(axis=0, ddof=1).tolist(), None)]
    return Table("trials", "Trials of the odometry", columns, rows,
                 f"Patches are drawn at random, so one run says little. EMVS = map with true poses; near = within "
                 f"{1000 * found.judged_m:.1f} mm, 5 % of the distance of the scene; reachable = the same points at "
                 "their true depth; std over n - 1.")


def _maps(found: Validation) -> Table:
    columns = ("poses", "poses used", "points", "before radius filter", "mean square of votes", "of true poses %",
               "min depth [own unit]", "max depth [own unit]", "radius [own unit]", "plane RMSE [mm]", "votes/s [M]")
    gt = found.maps["gt"]
    rows: list[tuple[Cell, ...]] = []
    for result in found.maps.values():
        counts, view = result.view.counts, result.view
        off = plane_distances(result.points, found.plane)
        rows.append((
            result.variant.label, result.poses_in_span, len(result.points), int(counts["points_before_radius_filter"]),
            result.sharpness, 100 * result.sharpness / gt.sharpness, view.planes.near, view.planes.far,
            RADIUS_M * result.variant.units_per_m, 1000 * float(np.sqrt(np.mean(off**2))) if len(off) else math.nan,
            counts["event_plane_votes"] / max(counts["read_and_vote_s"], 1e-3) / 1e6))
    which = "true plane of the scene" if found.plane_is_true else "robust plane of the map with true poses"
    return Table("maps", "EMVS maps by source of the poses", columns, rows,
                 f"Same events, span and reference time for all; plane RMSE against the {which}. Rows 1 to 4 isolate "
                 "the scale, rows 5 to 8 the density of poses, positions and rotations.")


def _scale(found: Validation) -> Table:
    columns = ("pair", "points", "points, scaled", "change %", "equal mask %", "same plane %",
               "points, radius not scaled", "change %, radius not scaled")
    rows: list[tuple[Cell, ...]] = []
    for first, second in (("gt", "gt_scaled"), ("devo", "devo_descaled")):
        a, b = found.maps[first], found.maps[second]
        equal = dict(mask_agreement(a, b))
        fixed = points_with_radius(b, RADIUS_M * a.variant.units_per_m)
        base = max(len(a.points), 1)
        rows.append((f"{a.variant.label} | {b.variant.label}", len(a.points), len(b.points),
                     100 * (len(b.points) / base - 1), 100 * equal["equal mask"], 100 * equal["same plane"], fixed,
                     100 * (fixed / base - 1)))
    return Table("scale", "Scale isolation", columns, rows,
                 "Every step of EMVS but the outlier filter is homogeneous in the scale; an absolute radius that is "
                 "not scaled along changes the count all by itself.")


def _distances(found: Validation) -> Table:
    units = found.alignment.units_per_m
    columns = ("clouds", "stage", "Chamfer -> [mm]", "Chamfer -> [milli-units]", "Chamfer <- [mm]",
               "Chamfer <- [milli-units]", "symmetric [mm]", "median -> [mm]", "median <- [mm]")
    rows: list[tuple[Cell, ...]] = []
    for agreement in found.agreements:
        for stage, chamfer in agreement.chamfer.items():
            there, back = agreement.distances[stage]
            rows.append((
                agreement.name, stage, 1000 * chamfer.source_to_target, 1000 * chamfer.source_to_target * units,
                1000 * chamfer.target_to_source, 1000 * chamfer.target_to_source * units, 1000 * chamfer.symmetric,
                1000 * float(np.median(there)), 1000 * float(np.median(back))))
    for stage, value in paper.CHAMFER_UNITS.items():
        rows.append((f"{PAPER}: {pair_name(EMVS_DEVO, CLEANED)}", stage, 1000 * value / paper.UNITS_PER_M, 1000 * value,
                     None, None, None, None, None))
    return Table("distances", "Nearest-neighbour distances", columns, rows,
                 "-> mean over the first cloud, <- mean over the second; units are those of the odometry. Points that "
                 "the odometry knows little about make the means of the raw cloud.")


def _thresholds(found: Validation) -> Iterator[Table]:
    units = found.alignment.units_per_m
    columns = ("clouds", "threshold", "threshold [mm]", "precision %", "recall %", "F", "precision % after ICP",
               "recall % after ICP", "F after ICP")
    kinds = [("metres", "thresholds in metres", [(f"{100 * value:g} cm", value) for value in THRESHOLDS_M]),
             ("share", "thresholds relative to the distance of the scene",
              [(f"{100 * share:g} %", share * found.distance_m) for share in SHARES_OF_DISTANCE]),
             ("units", "thresholds in units of the odometry, as in the paper",
              [(f"{value:g} units", value / units) for value in THRESHOLDS_M])]
    for kind, title, limits in kinds:
        rows: list[tuple[Cell, ...]] = []
        for agreement in found.agreements:
            for text, limit in limits:
                cells: list[Cell] = []
                for stage in STAGES:
                    score = agreement.score(stage, limit) if stage in agreement.scores else None
                    cells += [None] * 3 if score is None else [100 * score.precision, 100 * score.recall, score.f_score]
                rows.append((agreement.name, text, 1000 * limit, *cells))
        if kind == "units":
            rows += _paper_rows()
        yield Table(f"thresholds_{kind}", f"Agreement at {title}", columns, rows,
                    "As in the paper, precision is the share of the first cloud near the second, recall the share of "
                    "the second near the first. Read as a judgement on the second cloud, recall is its accuracy and "
                    "precision its completeness.")


def _paper_rows() -> list[tuple[Cell, ...]]:
    rows: list[tuple[Cell, ...]] = [
        (f"{PAPER}: {pair_name(EMVS_DEVO, CLEANED)}", "0.05 units", 50 / paper.UNITS_PER_M,
         100 * paper.PRECISION_AT_5_CM, 100 * paper.RECALL_AT_5_CM, paper.F_AT_5_CM["before ICP"], None, None,
         paper.F_AT_5_CM["after ICP"])]
    rows += [(f"{PAPER}: {pair_name(EMVS_TRUE, CLEANED)}", f"{limit:g} units", 1000 * limit / paper.UNITS_PER_M,
              100 * precision, 100 * recall, f_score, None, None, None)
             for limit, (precision, recall, f_score) in paper.AGREEMENT_GROUND_TRUTH.items()]
    return rows


def _planarity(found: Validation) -> Table:
    units = found.alignment.units_per_m
    columns = ("cloud", "points", "RMSE [mm]", "RMSE [milli-units]", "median distance [mm]", "robust: inliers %",
               "robust: inlier RMSE [mm]", "angle to the scene's plane [deg]")
    rows: list[tuple[Cell, ...]] = []
    for name, flat in found.planarities.items():
        cosine = min(1.0, abs(float(flat.robust.normal @ found.plane.normal)))
        rows.append((
            name, len(found.points[name]), 1000 * flat.least_squares.rmse, 1000 * flat.least_squares.rmse * units,
            1000 * flat.least_squares.median_distance, 100 * flat.robust.inlier_share, 1000 * flat.robust.inlier_rmse,
            math.degrees(math.acos(cosine))))
    for name, label in (("EMVS, DEVO poses", EMVS_DEVO), ("DEVO cloud", CLEANED)):
        value = paper.PLANE_RMSE_UNITS[name]
        rows.append((f"{PAPER}: {label}", None, 1000 * value / paper.UNITS_PER_M, 1000 * value, None, None, None, None))
    return Table("planarity", "Planarity", columns, rows,
                 "Means something for flat scenes only. RMSE: least-squares plane through all points. Robust: RANSAC, "
                 f"within {1000 * found.planarities[CLEANED].threshold_m:.1f} mm (1 % of the distance).")


def _depth(found: Validation) -> Iterator[Table]:
    if found.depth:
        yield Table("depth", "Depth against ground truth",
                    ("cloud", "points", "judged", "median error %", "within 2 %: share %", "median signed error %"),
                    [(name, error.total, error.judged, 100 * error.median, 100 * error.within_2_percent,
                      100 * error.bias) for name, error in found.depth.items()],
                    "Relative z-depth error against the true depth map nearest in time to the view of each point.")


def _edges(found: Validation) -> Iterator[Table]:
    if found.edges:
        yield Table("edges", f"Points projected into the {found.picture.kind}",
                    ("cloud", "points in view", "mean distance to edge [px]", "random pixel [px]", "on an edge %",
                     "edge coverage %"),
                    [(name, edge.points, edge.mean_distance_px, edge.random_distance_px, 100 * edge.on_edge,
                      100 * edge.coverage) for name, edge in found.edges.items()],
                    f"On an edge, covered: within {next(iter(found.edges.values())).radius_px:g} px. Image at "
                    f"{found.picture.t_us * 1e-6:.3f} s, {found.picture.size[0]}x{found.picture.size[1]} px.")


def _registration(found: Validation) -> Table:
    rows: list[tuple[Cell, ...]] = [
        (agreement.name, 100 * agreement.icp.fitness, 1000 * agreement.icp.inlier_rmse, agreement.icp.rotation_deg,
         1000 * agreement.icp.translation_norm) for agreement in found.agreements if agreement.icp is not None]
    return Table("icp", "ICP", ("clouds", "fitness %", "inlier RMSE [mm]", "rotation [deg]", "translation [mm]"), rows,
                 f"Point to point, rigid, from the identity, correspondences within {1000 * found.judged_m:.1f} mm, 50 "
                 "iterations at most. Rotation and translation are about the origin of the ground truth.")


def _durations(found: Validation) -> Table:
    rows: list[tuple[Cell, ...]] = [(stage, seconds) for stage, seconds in found.seconds.items()]
    return Table("durations", "Durations", ("stage", "wall clock [s]"), rows)
