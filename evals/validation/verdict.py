"""Judgements and findings, computed from the figures of a run; no sentence here is true by itself."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from evals.validation.agreement import PLANE_SHARE
from evals.validation.experiment import BOARD_SHARE, CLEANED, EMVS_DEVO, EMVS_TRUE, JUDGED_SHARE, RAW, Validation
from evals.validation.mapping import mask_agreement

_PLANAR_SHARE = 0.8
LIMITS = {"depth": 0.01, "on_plane": 0.90, "scale": 0.01, "precision": 0.95, "plane_ratio": 3.0, "icp_m": 0.001,
          "seconds": 600.0}


@dataclass(frozen=True)
class Criterion:
    """One requirement.

    Attributes:
        name: what is required.
        value: what was found, in words and figures.
        limit: what was expected.
        passed: None where it cannot be judged; the reason is then in `value`.
        why: where it failed, what the other figures say about the cause; else empty.
    """

    name: str
    value: str
    limit: str
    passed: bool | None
    why: str = ""

    @property
    def word(self) -> str:
        """The outcome in one word."""
        return "not judged" if self.passed is None else "met" if self.passed else "missed"


def criteria(found: Validation, seconds: float) -> list[Criterion]:
    """All requirements of the experiment, judged.

    Args:
        found: the figures.
        seconds: what the run took up to the figures; not judged where odometry was reused.
    """
    return [*_map_criteria(found), *_scale_criteria(found), *_cloud_criteria(found), _plane_criterion(found),
            _duration(found, seconds)]


def headline(judged: list[Criterion]) -> str:
    """One sentence about all criteria."""
    met, missed = (sum(one.passed is value for one in judged) for value in (True, False))
    text = f"{met} of {met + missed} requirements are met"
    failed = [one.name for one in judged if one.passed is False]
    return text + (f"; missed: {'; '.join(failed)}." if failed else ".")


def is_planar(found: Validation) -> bool:
    """Whether the scene is a plane, judged by the map with true poses."""
    return found.planarities[EMVS_TRUE].robust.inlier_share >= _PLANAR_SHARE or (
        found.plane_is_true and found.plane.inlier_share >= _PLANAR_SHARE)


def _no_plane(found: Validation) -> str:
    """Why flatness is not judged: the scene may be round, or the map of a flat one too scattered to tell."""
    share = found.planarities[EMVS_TRUE].robust.inlier_share
    return (f"the scene is not known to be flat: {share:.1%} of the points of EMVS (true poses) lie within "
            f"{PLANE_SHARE:.0%} of the distance from one plane, at least {_PLANAR_SHARE:.0%} are needed to judge it")


def _map_criteria(found: Validation) -> Iterator[Criterion]:
    name = "EMVS with true poses: median depth error"
    limit = f"at most {LIMITS['depth']:.0%} of the distance"
    if EMVS_TRUE not in found.depth or not found.depth[EMVS_TRUE].judged:
        yield Criterion(name, "no true depth in this recording", limit, None)
    else:
        error = found.depth[EMVS_TRUE].median
        yield Criterion(name, f"{error:.2%}", limit, error <= LIMITS["depth"])
    name = f"EMVS with true poses: points within {BOARD_SHARE:.0%} of the plane"
    limit = f"at least {LIMITS['on_plane']:.0%}"
    if not is_planar(found):
        yield Criterion(name, _no_plane(found), limit, None)
        return
    share = found.share_on_plane(EMVS_TRUE)
    which = "true plane" if found.plane_is_true else "its own robust plane"
    yield Criterion(name, f"{share:.1%} ({which})", limit, share >= LIMITS["on_plane"])


def _scale_criteria(found: Validation) -> Iterator[Criterion]:
    for first, second in (("gt", "gt_scaled"), ("devo", "devo_descaled")):
        a, b = found.maps[first], found.maps[second]
        change = len(b.points) / len(a.points) - 1 if len(a.points) else math.nan
        equal = dict(mask_agreement(a, b))
        yield Criterion(
            f"Scale alone changes nothing: {a.variant.label} and {b.variant.label}",
            f"{len(a.points)} and {len(b.points)} points ({change:+.2%}), {equal['equal mask']:.3%} of the mask equal",
            f"count within {LIMITS['scale']:.0%}", abs(change) <= LIMITS["scale"])


def _mean(values: list[float]) -> tuple[float, float]:
    known = np.array([value for value in values if math.isfinite(value)])
    return (float(known.mean()), float(known.min())) if len(known) else (math.nan, math.nan)


def _cloud_criteria(found: Validation) -> Iterator[Criterion]:
    usable = [trial for trial in found.trials if trial.ok]
    near = f"within {JUDGED_SHARE:.0%} of the distance"
    of = f"(mean of {len(usable)} trial(s))"
    mean, worst = _mean([trial.emvs_to_devo for trial in usable])
    passed = mean >= LIMITS["precision"]
    yield Criterion(f"Precision as in the paper: EMVS (true poses) points {near} of a DEVO point",
                    f"{mean:.1%}, worst {worst:.1%}", f"at least {LIMITS['precision']:.0%} {of}", passed,
                    "" if passed else _why_incomplete(found))
    mean, worst = _mean([trial.devo_to_emvs for trial in usable])
    reachable, _ = _mean([trial.reachable for trial in usable])
    reachable = 1.0 if math.isnan(reachable) else reachable
    limit = LIMITS["precision"] * reachable
    passed = mean >= limit
    expected = f"at least {limit:.1%} {of}"
    if reachable < 1:
        expected += f": {LIMITS['precision']:.0%} of the {reachable:.1%} that the same points reach at their true depth"
    yield Criterion(f"Read the other way round: DEVO points {near} of an EMVS (true poses) point",
                    f"{mean:.1%}, worst {worst:.1%}", expected, passed, "" if passed else _why_inaccurate(found))
    lost = [trial.seed for trial in found.trials if not trial.ok]
    if lost:
        yield Criterion("Every trial of the odometry is usable", f"lost with seed {', '.join(map(str, lost))}",
                        "no lost trial", False)


def _why_incomplete(found: Validation) -> str:
    """How dense the exported cloud is compared with the threshold, and how far its points are off."""
    from utils.clouds.filters import median_neighbor_distance

    spacing = median_neighbor_distance(found.points[CLEANED].astype(np.float32)) or math.nan
    area = np.sort(np.ptp(found.points[CLEANED], axis=0))[1:].prod()
    per_disc = len(found.points[CLEANED]) / area * math.pi * found.judged_m**2
    at_ten = found.agreement(EMVS_TRUE, CLEANED).score("before ICP", 2 * found.judged_m).precision
    raw = found.agreement(EMVS_TRUE, RAW).score("before ICP", found.judged_m).precision
    flat = f"{found.share_on_plane(EMVS_TRUE):.1%} of the map's points lie on the plane. " if is_planar(found) else ""
    return (f"{_systematic(found)}{flat}The exported cloud has {len(found.points[CLEANED])} points, median spacing "
            f"{1000 * spacing:.0f} mm, about {per_disc:.1f} in a disc of the threshold's radius "
            f"({1000 * found.judged_m:.0f} mm); at twice the threshold the share is {at_ten:.1%}. The "
            f"raw cloud reaches {raw:.1%} at the threshold itself.")


def _why_inaccurate(found: Validation) -> str:
    """Whether points miss the map because they are wrong or because the map has nothing there."""
    off = found.planarities[CLEANED].least_squares.rmse
    text = f"{_systematic(found)}The points lie {1000 * off:.0f} mm (RMS) off their own plane"
    if CLEANED in found.depth and found.depth[CLEANED].judged:
        text += f" and {found.depth[CLEANED].median:.1%} (median) off the true depth"
    on_plane = found.share_on_plane(CLEANED) if is_planar(found) else math.nan
    if math.isfinite(on_plane):
        text += f"; {on_plane:.1%} of them are within {BOARD_SHARE:.0%} of the plane"
    at_ten = found.agreement(EMVS_TRUE, CLEANED).score("before ICP", 2 * found.judged_m).recall
    return text + f"; at twice the threshold the share is {at_ten:.1%}."


def _systematic(found: Validation) -> str:
    """A sentence about a shift of the whole cloud, where there is one."""
    agreement = found.agreement(EMVS_TRUE, CLEANED)
    text = ""
    error = found.depth.get(CLEANED)
    if error is not None and error.judged and abs(error.bias) > 0.5 * error.median:
        text = (f"The whole cloud lies {abs(error.bias):.1%} too {'far' if error.bias > 0 else 'near'} (median signed "
                "depth error): its depths do not fit the scale of its own trajectory. ")
        mapped = found.depth[EMVS_DEVO].bias
        if mapped * error.bias > 0 and abs(mapped) > 0.5 * abs(error.bias):
            text += (f"So does the map made with its poses ({mapped:+.1%}), which uses none of its depths: the poses "
                     "are at fault. ")
    if "after ICP" in agreement.scores:
        score = agreement.score("after ICP", found.judged_m)
        text += (f"After rigid ICP the shares are {score.precision:.1%} (map near the cloud) and {score.recall:.1%} "
                 "(cloud near the map). ")
    return text


def _plane_criterion(found: Validation) -> Criterion:
    name = f"Plane RMSE of the DEVO cloud below {LIMITS['plane_ratio']:g} x that of EMVS (true poses)"
    limit = f"ratio below {LIMITS['plane_ratio']:g}"
    if not is_planar(found):
        return Criterion(name, _no_plane(found), limit, None)
    emvs = found.planarities[EMVS_TRUE].least_squares.rmse
    own, _ = _mean([trial.plane_rmse_m for trial in found.trials])
    ratio = own / emvs if emvs > 0 else math.inf
    devo = found.planarities[EMVS_DEVO].least_squares.rmse
    value = f"{1000 * own:.1f} mm against {1000 * emvs:.1f} mm, ratio {ratio:.2f} ({own / devo:.2f} with DEVO poses)"
    passed = ratio < LIMITS["plane_ratio"]
    robust = found.planarities[CLEANED].robust
    why = "" if passed else (
        f"{robust.inlier_share:.1%} of the DEVO points lie within {PLANE_SHARE:.0%} of the distance of their robust "
        f"plane, with {1000 * robust.inlier_rmse:.1f} mm RMS; the rest makes the RMSE.")
    return Criterion(name, value, limit, passed, why)


def _duration(found: Validation, seconds: float) -> Criterion:
    reused = sum(trial.reused for trial in found.trials)
    note = f" ({reused} of {len(found.trials)} trials reused from an earlier run)" if reused else ""
    return Criterion("Duration", f"{seconds:.0f} s{note}", f"below {LIMITS['seconds']:.0f} s",
                     None if reused else seconds < LIMITS["seconds"])


def findings(found: Validation) -> list[str]:
    """What the experiment says about the claims of the paper, in sentences made of figures."""
    gt, devo, rate = found.maps["gt"], found.maps["devo"], found.maps["gt_at_devo"]
    before = found.agreement(EMVS_DEVO, CLEANED)
    sentences = [_density(len(gt.points), len(devo.points), len(rate.points), gt.poses_in_span, rate.poses_in_span)]
    counts = {key: len(found.maps[key].points) for key in ("gt_positions", "gt_rotations")}
    sharp = {key: result.sharpness / gt.sharpness for key, result in found.maps.items()}
    sentences.append(
        f"Sharpness of the votes relative to true poses: DEVO poses {sharp['devo']:.1%}, true positions with "
        f"DEVO rotations {sharp['gt_positions']:.1%} ({counts['gt_positions']} points), DEVO positions with true "
        f"rotations {sharp['gt_rotations']:.1%} ({counts['gt_rotations']} points).")
    if "after ICP" in before.chamfer:
        change = before.chamfer["after ICP"].source_to_target - before.chamfer["before ICP"].source_to_target
        same = abs(change) <= LIMITS["icp_m"]
        sentences.append(f"ICP changes the distance from the map with DEVO poses to the exported cloud by "
                         f"{1000 * change:+.2f} mm: the frames {'agree already' if same else 'do not agree fully'}.")
    for name, edge in found.edges.items():
        sentences.append(f"{name}: projected points are {edge.mean_distance_px:.1f} px from the nearest edge of the "
                         f"{found.picture.kind}, random pixels {edge.random_distance_px:.1f} px.")
    return sentences


def _density(true: int, estimated: int, thinned: int, dense: int, sparse: int) -> str:
    """Whether pose density explains the difference between the two maps."""
    lost, from_rate = true - estimated, true - thinned
    least = max(true, 1)
    text = (f"Pose density: {dense} true poses give {true} points, true poses at the {sparse} stamps of the odometry "
            f"{thinned} ({thinned / least:.1%}), DEVO poses {estimated} ({estimated / least:.1%}).")
    if lost <= 0:
        return text + " DEVO poses give no fewer points, so there is no difference to explain."
    share = from_rate / lost
    verdict = "explains" if share >= 0.5 else "does not explain"
    return text + f" Density {verdict} the difference: it accounts for {max(share, 0):.0%} of it."
