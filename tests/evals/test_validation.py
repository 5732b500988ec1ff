"""The experiment with made-up results of the odometry: what is perfect passes, what is spoilt is named."""

from __future__ import annotations

import csv
import dataclasses
import io
import json
import re
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from devo.errors import InputError, TrackingError
from devo.poses import matrix_to_pose
from evals.validation import Validation, ValidationSettings, experiment, odometry, paper, validate, write_report
from evals.validation.agreement import compare, planarity
from evals.validation.experiment import CLEANED, EMVS_TRUE, TrialSummary
from evals.validation.figures import all_figures, draw_trajectory
from evals.validation.mapping import MapResult, align, mask_agreement, points_with_radius
from evals.validation.odometry import Trial
from evals.validation.report import save_figure
from evals.validation.source import Source, open_source
from evals.validation.tables import Table, make_tables
from evals.validation.verdict import criteria, findings, headline
from tests.evals.validation_samples import DEVO_T_METRIC, UNITS_PER_M, made_up_trial, quick_settings, write_board
from utils.clouds import PointCloud, read_cloud
from utils.trajectory_io import Trajectory


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_board(tmp_path_factory.mktemp("validation") / "board")


@pytest.fixture(scope="module")
def settings(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> ValidationSettings:
    return quick_settings(folder, tmp_path_factory.mktemp("report"))


@pytest.fixture(scope="module")
def source(settings: ValidationSettings) -> Source:
    return open_source(settings)


def _run(settings: ValidationSettings, trials: list[Trial],
         maps: tuple[list[MapResult], object] | None = None) -> Validation:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(experiment, "run_trials", lambda _: trials)
        if maps is not None:
            patch.setattr(experiment, "map_variants", lambda *_: maps)
        return validate(settings)


@pytest.fixture(scope="module")
def perfect(settings: ValidationSettings, source: Source) -> Validation:
    return _run(settings, [made_up_trial(source)])


@pytest.fixture(scope="module")
def spoilt(settings: ValidationSettings, source: Source, perfect: Validation) -> Validation:
    """The same trajectory, but every depth 12 % too large, and one trial that was lost."""
    lost = Trial(1, None, PointCloud(np.zeros((0, 3))), {"seconds": 0.5, "message": "lost"})
    return _run(settings, [made_up_trial(source, depth_factor=1.12), lost],
                (list(perfect.maps.values()), perfect.setup))


# --- figures of a run ---------------------------------------------------------------------------------------


def test_the_alignment_is_recovered(perfect: Validation) -> None:
    assert perfect.alignment.units_per_m == pytest.approx(UNITS_PER_M, rel=1e-6)
    assert perfect.alignment.ate_rmse_m < 1e-6
    assert perfect.alignment.rotation_residual_deg < 1e-3
    point = np.array([[0.3, 0.2, 1.0]])
    back = perfect.alignment.metric_T_devo.apply(DEVO_T_METRIC.apply(point))
    np.testing.assert_allclose(back, point, atol=1e-5)


def test_maps_of_the_board_are_right(perfect: Validation) -> None:
    assert set(perfect.maps) == {"gt", "gt_scaled", "devo", "devo_descaled", "gt_at_devo", "devo_spline",
                                 "gt_positions", "gt_rotations"}
    assert len(perfect.points[EMVS_TRUE]) > 500
    assert perfect.depth[EMVS_TRUE].median <= 0.01
    assert perfect.share_on_plane(EMVS_TRUE) >= 0.9
    assert perfect.plane_is_true and 0.7 < perfect.distance_m < 1.1
    for result in perfect.maps.values():  # made of the same events; poses of the odometry are exact here
        assert result.view.counts["events"] == perfect.maps["gt"].view.counts["events"]
        assert len(result.points) == pytest.approx(len(perfect.maps["gt"].points), rel=0.05)
    assert perfect.maps["gt"].poses_in_span > 10 * perfect.maps["devo"].poses_in_span


def test_scale_alone_changes_nothing_but_the_radius_does(perfect: Validation) -> None:
    for first, second in (("gt", "gt_scaled"), ("devo", "devo_descaled")):
        a, b = perfect.maps[first], perfect.maps[second]
        assert len(b.points) == pytest.approx(len(a.points), rel=0.01)
        equal = dict(mask_agreement(a, b))
        assert equal["equal mask"] > 0.999 and equal["same plane"] > 0.999
    scaled = perfect.maps["gt_scaled"]
    assert points_with_radius(scaled, 0.05 * UNITS_PER_M) == len(scaled.points)
    assert points_with_radius(scaled, 0.004 * UNITS_PER_M) < len(scaled.points)


def test_a_perfect_cloud_meets_everything(perfect: Validation) -> None:
    judged = criteria(perfect, 10.0)
    assert [one.name for one in judged if one.passed is not True] == []
    assert headline(judged) == f"{len(judged)} of {len(judged)} requirements are met."
    assert perfect.depth[CLEANED].median < 0.01
    agreement = perfect.agreement(EMVS_TRUE, CLEANED)
    assert agreement.score("before ICP", perfect.judged_m).precision > 0.95
    assert set(agreement.chamfer) == {"before ICP", "after ICP"}
    assert perfect.edges[EMVS_TRUE].mean_distance_px < 0.5 * perfect.edges[EMVS_TRUE].random_distance_px


def test_a_spoilt_cloud_is_told_apart(spoilt: Validation) -> None:
    judged = criteria(spoilt, 700.0)
    missed = {one.name: one for one in judged if one.passed is False}
    assert any(name.startswith("Read the other way") for name in missed)
    assert "Every trial of the odometry is usable" in missed
    assert "Duration" in missed
    why = next(one.why for name, one in missed.items() if name.startswith("Read the other way"))
    assert "too far" in why and "12.0%" in why
    assert headline(judged).startswith(f"{len(judged) - len(missed)} of {len(judged)} requirements are met; missed: ")
    assert spoilt.depth[CLEANED].bias == pytest.approx(0.12, abs=0.01)
    assert [trial.ok for trial in spoilt.trials] == [True, False]


def test_findings_follow_the_figures(perfect: Validation) -> None:
    gt, rate = len(perfect.maps["gt"].points), len(perfect.maps["gt_at_devo"].points)
    density = findings(perfect)[0]
    assert f" {gt} points" in density and f"{rate} (" in density
    fewer = {**perfect.maps, "devo": dataclasses.replace(perfect.maps["devo"], points=np.zeros((gt // 2, 3))),
             "gt_at_devo": dataclasses.replace(perfect.maps["gt_at_devo"], points=np.zeros((gt * 6 // 10, 3)))}
    assert "Density explains the difference: it accounts for 8" in findings(dataclasses.replace(perfect, maps=fewer))[0]
    fewer["gt_at_devo"] = dataclasses.replace(perfect.maps["gt_at_devo"], points=np.zeros((gt, 3)))
    assert "Density does not explain the difference" in findings(dataclasses.replace(perfect, maps=fewer))[0]


def test_reused_trials_do_not_count_as_fast(perfect: Validation) -> None:
    reused = dataclasses.replace(perfect, trials=[TrialSummary(0, True, reused=True)])
    duration = next(one for one in criteria(reused, 3.0) if one.name == "Duration")
    assert duration.passed is None and "1 of 1 trials reused" in duration.value


# --- report -------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def report(perfect: Validation) -> Path:
    written = write_report(perfect)
    assert written[0].name == "validation.html" and all(path.is_file() for path in written)
    return perfect.settings.out


def test_the_folder_is_complete(report: Path, perfect: Validation) -> None:
    tables = {path.stem for path in (report / "tables").iterdir()}
    assert {"verdict", "counts", "trials", "maps", "scale", "distances", "thresholds_metres", "thresholds_share",
            "thresholds_units", "planarity", "depth", "edges", "icp", "durations"} == tables
    figures = list((report / "figures").iterdir())
    assert len(figures) == 7 and all(path.read_bytes()[:8] == b"\x89PNG\r\n\x1a\n" for path in figures)
    cloud = read_cloud(report / "clouds" / "emvs_true_poses.ply")
    np.testing.assert_allclose(cloud.points, perfect.points[EMVS_TRUE], atol=1e-6)
    assert not list(report.rglob(".*"))  # no temporary file is left


def test_numbers_are_the_same_everywhere(report: Path, perfect: Validation) -> None:
    values = json.loads((report / "validation.json").read_text("utf-8"))
    rows = list(csv.DictReader(io.StringIO((report / "tables" / "thresholds_share.csv").read_text("utf-8"))))
    mine = next(row for row in rows if row["clouds"] == f"{EMVS_TRUE} -> {CLEANED}" and row["threshold"] == "5 %")
    score = perfect.agreement(EMVS_TRUE, CLEANED).score("before ICP", perfect.judged_m)
    assert float(mine["precision %"]) == pytest.approx(100 * score.precision, rel=1e-12)
    saved = values["agreement"][f"{EMVS_TRUE} -> {CLEANED}"]["before ICP"]["scores"]
    assert any(entry["f_score"] == pytest.approx(score.f_score, rel=1e-12) for entry in saved)
    assert all(entry["threshold_units"] == pytest.approx(UNITS_PER_M * entry["threshold"], rel=1e-5) for entry in saved)
    settings = yaml.safe_load((report / "config.yaml").read_text("utf-8"))
    assert settings["emvs"]["median_filter_size"] == 15 and settings["odometry"]["weights"]
    assert settings["emvs"]["every_nth_event"] == perfect.setup.event_stride


def test_the_paper_stands_beside_our_figures(report: Path) -> None:
    text = (report / "validation.md").read_text("utf-8")
    line = next(line for line in text.splitlines() if "0.05 units" in line and "paper" in line and "DEVO poses" in line)
    assert "98.4" in line and "31.7" in line and "0.479" in line
    assert "| 0.705 |" not in text and str(paper.COUNTS["DEVO poses"]) in text


def test_the_page_needs_nothing_else(report: Path) -> None:
    page = (report / "validation.html").read_text("utf-8")
    assert page.count("data:image/png;base64,") == 7
    assert not re.search(r"(src|href)=['\"](?!data:)", page)
    assert page.count("<table>") == page.count("</table>") >= 13


def test_same_figures_same_bytes(report: Path, perfect: Validation) -> None:
    judged = criteria(perfect, sum(perfect.seconds.values()))
    for table in make_tables(perfect, judged):
        assert (report / "tables" / f"{table.name}.csv").read_text("utf-8") == table.csv()
    again = io.BytesIO()
    save_figure(draw_trajectory(perfect), again)
    assert (report / "figures" / "trajectory.png").read_bytes() == again.getvalue()


@pytest.mark.parametrize("name", all_figures())
def test_nothing_of_a_figure_is_cut_off_or_overlaps(perfect: Validation, name: str) -> None:
    """As it is written, with point counts as those of a large sensor."""
    grown = {cloud: np.repeat(points, 1 + 30_000 // len(points), axis=0) for cloud, points in perfect.points.items()}
    projections = {cloud: dataclasses.replace(found, **{
        one.name: np.repeat(getattr(found, one.name), 1 + 30_000 // len(found.inside), axis=0)
        for one in dataclasses.fields(found)}) for cloud, found in perfect.projections.items()}
    figure = all_figures()[name][1](dataclasses.replace(perfect, points=grown, projections=projections))
    save_figure(figure, io.BytesIO())
    figure.dpi = 130  # as it is written, because the width of text depends on it
    renderer = figure.canvas.get_renderer()  # type: ignore[attr-defined]  # of the canvas of Agg
    box, page = figure.get_tightbbox(renderer), figure.get_size_inches()
    assert min(box.x0, box.y0, page[0] - box.x1, page[1] - box.y1) > -0.01, "inches"
    titles = sorted((axes._left_title.get_window_extent(renderer) for axes in figure.axes if axes.get_title("left")),
                    key=lambda extent: extent.x0)
    assert not any(first.overlaps(second) for first, second in zip(titles, titles[1:]))


def test_a_table_in_its_three_forms() -> None:
    table = Table("t", "A <title>", ("name", "share %", "x"),
                  [("a|b", 12.3456, 0.000123456), ("<i>", float("nan"), 7), ("paper", None, 1234567.0)], "note")
    assert table.csv().splitlines() == ["name,share %,x", "a|b,12.3456,0.000123456", "<i>,,7", "paper,,1234567.0"]
    assert "| a\\|b | 12.3 | 0.0001235 |" in table.markdown() and "| <i> | – | 7 |" in table.markdown()
    page = table.html()
    assert "&lt;i&gt;" in page and "<i>" not in page and "<tr class='paper'>" in page and "1.23e+06" in page


def test_lost_trials_stay_out_of_the_mean(spoilt: Validation) -> None:
    table = next(table for table in make_tables(spoilt, []) if table.name == "trials")
    assert [row[-1] for row in table.rows] == ["no", "lost"]  # one usable trial: no mean


# --- pictures -----------------------------------------------------------------------------------------------


def test_without_frames_the_events_are_the_picture(perfect: Validation, source: Source) -> None:
    assert perfect.picture.kind == "accumulated events" and perfect.picture.size == (160, 120)
    assert 0.01 < perfect.picture.edges.mean() < 0.5
    np.testing.assert_array_equal(perfect.picture.event_T_image, np.eye(4))
    assert source.sequence.images is None


def test_frames_of_another_camera_use_the_extrinsic_of_the_pose_files(folder: Path, source: Source,
                                                                      tmp_path: Path) -> None:
    copy = tmp_path / "framed"
    (copy / "images").mkdir(parents=True)
    for name in ("events.h5", "calib.yaml", "groundtruth.txt", "images_timestamps_us.txt"):
        (copy / name).symlink_to(folder / name)
    image = np.full((120, 160), 220, np.uint8)
    image[40:80, 50:110] = 30
    for number in range(37):
        cv2.imwrite(str(copy / "images" / f"{number:06d}.png"), image)
    framed = open_source(quick_settings(copy, tmp_path / "out"))
    picture = framed.picture(500_000)
    assert picture.kind == "intensity frame" and picture.t_us == pytest.approx(500_000, abs=17_000)
    np.testing.assert_array_equal(picture.event_T_image, np.eye(4))
    assert picture.edges.any() and not picture.edges[:30].any()
    offset = np.eye(4)
    offset[:3, :3], offset[:3, 3] = Rotation.from_rotvec([0.02, -0.1, 0.03]).as_matrix(), [0.05, -0.02, 0.01]
    poses = matrix_to_pose(source.truth.matrices() @ offset)
    lines = [" ".join(f"{value:.12g}" for value in (t_us, *pose)) for t_us, pose in zip(source.truth.t_us, poses)]
    (copy / "poses_gray_left.txt").write_text("\n".join(lines) + "\n", "utf-8")
    np.testing.assert_allclose(framed.picture(500_000).event_T_image, offset, atol=1e-6)


# --- input that cannot work ---------------------------------------------------------------------------------


def test_settings_out_of_range(folder: Path, tmp_path: Path) -> None:
    for name, value in (("trials", 0), ("processes", -1), ("max_frames", 0), ("emvs_events", 10), ("view_scale", 0.0)):
        with pytest.raises(InputError, match=name):
            ValidationSettings(folder, tmp_path, **{name: value})  # type: ignore[arg-type]


def test_poses_of_another_time(source: Source) -> None:
    late = Trajectory(source.truth.t_us + 10_000_000, source.truth.world_T_cam)
    with pytest.raises(InputError, match="0 of .* lie within the time of the ground truth"):
        align(source.truth, late)


@pytest.mark.parametrize("cloud", [np.zeros((0, 3)), np.zeros((2, 3))])
def test_clouds_with_too_few_points(cloud: np.ndarray) -> None:
    with pytest.raises(InputError, match=r"second cloud has \d points"):
        compare("pair", np.eye(3), cloud, [0.1], 0.1)


def test_clouds_that_are_no_plane_or_hold_nan() -> None:
    for cloud, message in ((np.ones((9, 3)), "determine no plane"), (np.full((9, 3), np.nan), "non-finite")):
        with pytest.raises(InputError, match=message):
            planarity("cloud", cloud, 1.0)
    with pytest.raises(InputError, match="non-finite"):
        compare("pair", np.full((4, 3), np.nan), np.eye(3), [0.1], 0.1)


def test_clouds_too_far_apart_for_icp() -> None:
    far = compare("pair", np.eye(3), np.eye(3) + 100.0, [0.1], 0.1)
    assert far.icp is None and set(far.scores) == {"before ICP"}
    assert far.scores["before ICP"][0].f_score == 0


def test_a_cloud_that_does_not_survive_the_cleaning(settings: ValidationSettings, source: Source) -> None:
    trial = made_up_trial(source)
    empty = dataclasses.replace(trial, raw=trial.raw.select(slice(2)))
    with pytest.raises(TrackingError, match="pass the cleaning"):
        _run(settings, [empty])


def test_a_recording_without_ground_truth(folder: Path, tmp_path: Path) -> None:
    copy = tmp_path / "blind"
    copy.mkdir()
    for name in ("events.h5", "calib.yaml"):
        (copy / name).symlink_to(folder / name)
    with pytest.raises(InputError, match="no ground truth"):
        open_source(quick_settings(copy, tmp_path / "out"))


def test_depth_maps_without_stamps_of_their_own(folder: Path, tmp_path: Path) -> None:
    copy = tmp_path / "odd"
    copy.mkdir()
    for name in ("events.h5", "calib.yaml", "groundtruth.txt", "depth"):
        (copy / name).symlink_to(folder / name)
    assert open_source(quick_settings(copy, tmp_path / "out")).depth is None
    lines = (folder / "images_timestamps_us.txt").read_text("utf-8").splitlines()
    (copy / "images_timestamps_us.txt").write_text("\n".join(lines[:-1]) + "\n", "utf-8")
    with pytest.raises(InputError, match=r"37 depth maps but 36 stamps"):
        open_source(quick_settings(copy, tmp_path / "out"))


# --- trials -------------------------------------------------------------------------------------------------


def test_trials_depend_on_what_they_depend_on(folder: Path, tmp_path: Path) -> None:
    base = quick_settings(folder, tmp_path)
    keys = odometry.trial_keys(base)
    assert keys == odometry.trial_keys(dataclasses.replace(base, out=tmp_path / "elsewhere", view_scale=1.0))
    assert len({*keys.values(), *odometry.trial_keys(dataclasses.replace(base, seed=1)).values(),
                *odometry.trial_keys(dataclasses.replace(base, max_frames=9)).values(),
                *odometry.trial_keys(dataclasses.replace(base, opts=("PATCHES_PER_FRAME", "32"))).values(),
                *odometry.trial_keys(dataclasses.replace(base, weights="random:0")).values()}) == 5


def test_a_run_too_short_to_start_is_an_error_and_remembered(folder: Path, tmp_path: Path) -> None:
    settings = quick_settings(folder, tmp_path, max_frames=3)
    for _ in range(2):
        with pytest.raises(TrackingError, match="not initialised"):
            odometry.run_trials(settings)
    facts = json.loads((tmp_path / "odometry" / "seed0.json").read_text("utf-8"))
    assert facts["usable"] is False and facts["frames"] == 3
    (tmp_path / "odometry" / "seed0.json").write_text("{", "utf-8")  # cut off: tracked again
    with pytest.raises(TrackingError, match="not initialised"):
        odometry.run_trials(settings)
    assert json.loads((tmp_path / "odometry" / "seed0.json").read_text("utf-8"))["status"] == facts["status"]


def test_missing_open3d_is_noticed_at_once(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setitem(sys.modules, "open3d", None)  # importing it raises
    monkeypatch.setattr(experiment, "run_trials", lambda _: pytest.fail("too late"))
    with pytest.raises(InputError, match="ICP needs it"):
        validate(ValidationSettings(sequence=tmp_path, out=tmp_path / "report"))
