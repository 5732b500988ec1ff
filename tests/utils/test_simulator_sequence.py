"""Simulated recordings: events where edges move, safe paths, and a folder that other readers understand."""

from __future__ import annotations

import dataclasses
import filecmp
import json
from pathlib import Path

import cv2
import h5py
import numpy as np
import pytest
import torch

from devo.errors import InputError, OutputError
from tests.tolerances import SIMULATOR_SURFACE
from utils.calibration import read_calibration
from utils.events.types import Events
from utils.simulator import dataset_folder
from utils.simulator.camera import camera_preset, camera_rays
from utils.simulator.dataset_folder import FolderOptions, image_stamps, write_recording
from utils.simulator.handheld import PRESETS, HandheldPath
from utils.simulator.sequence import SequenceSettings, SimulatedSequence
from utils.simulator.worlds import WORLDS, build_world
from utils.trajectory_io import read_tum

SMALL = SequenceSettings(scene="planes", seconds=0.2, seed=3, size=(64, 48), noise="none")


def all_events(sequence: SimulatedSequence) -> Events:
    return Events.concatenate([events for _, events in sequence.events()])


@pytest.fixture(scope="module")
def sequence() -> SimulatedSequence:
    return SimulatedSequence(SMALL)


@pytest.fixture(scope="module")
def events(sequence: SimulatedSequence) -> Events:
    return all_events(sequence)


def test_events_lie_on_moving_edges(sequence: SimulatedSequence, events: Events) -> None:
    """Where the picture is flat around a pixel all the time, hardly any event fires."""
    light = sequence.log_intensity(np.arange(0, 200_001, 10_000.0))
    padded = torch.nn.functional.pad(light[:, None], (1, 1, 1, 1), "replicate")
    steepest = (torch.nn.functional.max_pool2d(padded, 3, 1) + torch.nn.functional.max_pool2d(-padded, 3, 1)).amax(0)[0]
    edge = (steepest > 0.15).numpy()
    assert 0.1 < edge.mean() < 0.9
    on_edge = edge[events.y, events.x].mean()
    assert on_edge > 0.99
    still = 1.0 - np.bincount(events.y.astype(int) * 64 + events.x, minlength=64 * 48)[edge.ravel()].astype(bool).mean()
    assert still < 0.4, "most edges move, so they must show"


def test_events_are_sorted_whole_microseconds_inside_the_recording(events: Events) -> None:
    assert len(events) > 3000
    assert events.t_us[0] >= 0
    assert events.t_us[-1] <= 200_000
    assert (np.diff(events.t_us) >= 0).all()
    assert events.x.max() < 64
    assert events.y.max() < 48
    assert 0.3 < events.p.mean() < 0.7


def test_same_seed_same_events_other_seed_others(events: Events) -> None:
    again = all_events(SimulatedSequence(SMALL))
    for name in ("x", "y", "t_us", "p"):
        assert getattr(again, name).tobytes() == getattr(events, name).tobytes()
    other = all_events(SimulatedSequence(dataclasses.replace(SMALL, seed=4)))
    assert len(other) != len(events)


def test_events_do_not_depend_on_the_pieces_they_come_in(sequence: SimulatedSequence, events: Events) -> None:
    ends = [complete for complete, _ in sequence.events()]
    assert ends == sorted(ends)
    assert ends[-1] == 200_000
    starts = np.cumsum([0] + [len(piece) for _, piece in sequence.events()])
    assert starts[-1] == len(events)


def test_renderings_are_close_enough(sequence: SimulatedSequence) -> None:
    times = sequence.path.render_times(0.5)
    assert times[0] == 0
    assert times[-1] == 200_000
    assert (np.diff(times) > 0).all()
    poses = sequence.path.poses(times).float()
    moved = sequence.path._flow(poses[:-1], poses[1:]).flatten(1).amax(1)
    assert moved.max() < 0.55
    assert moved.median() > 0.1, "and not wastefully close"


@pytest.mark.parametrize("scene", list(WORLDS))
def test_paths_are_safe_smooth_and_of_the_promised_speed(scene: str) -> None:
    camera = camera_preset(48, 36)
    rays = camera_rays(camera)
    speeds = {}
    for seed, preset in ((0, "slow"), (1, "normal"), (2, "fast")):
        world = build_world(scene, camera.fx, seed)
        path = HandheldPath(world, rays, 12e6, PRESETS[preset], np.random.default_rng(seed))
        times = np.arange(0, 12e6, 10_000.0)
        poses = path.poses(times)
        assert world.planes.distance_to_surface(poses[None, :, :3].float()).min() > 0.2
        torch.testing.assert_close(poses[:, 3:].norm(dim=-1), torch.ones(len(times), dtype=torch.float64))
        speed = (poses[1:, :3] - poses[:-1, :3]).norm(dim=-1) / 0.01
        assert speed.max() < 30
        speeds[preset] = path.mean_flow_px_s() * 240 / 48
    for preset, wanted in PRESETS.items():
        assert 0.5 * wanted.speed_px_s < speeds[preset] < 1.6 * wanted.speed_px_s, speeds


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("simulated") / "deep" / "room"
    settings = SequenceSettings(scene="room", seconds=0.1, seed=1, size=(64, 48), distorted=True)
    summary = write_recording(folder, settings, FolderOptions(fps=50, frames=True))
    assert summary.folder == folder
    assert summary.frames == 6
    return folder


def test_event_file_has_the_dsec_layout(recording: Path) -> None:
    import hdf5plugin  # noqa: F401 - registers the filter, as any third-party reader would

    with h5py.File(recording / "events.h5") as file:
        t = file["events/t"][:].astype(np.int64)
        assert file["events/x"].dtype == np.uint16
        assert set(np.unique(file["events/p"][:])) == {0, 1}
        index = file["ms_to_idx"][:]
        assert len(t) == json.loads((recording / "scene.json").read_text())["events"]
    for millisecond in (0, 1, 37, len(index) - 1):
        assert index[millisecond] == np.searchsorted(t, millisecond * 1000)


def test_folder_geometry_is_consistent_through_its_files_alone(recording: Path) -> None:
    """Depth pixels, undistorted by OpenCV with the written calibration and by the written pose, lie on the planes."""
    calibration = read_calibration(recording / "calib.yaml")
    assert (calibration.width, calibration.height) == (64, 48)
    assert calibration.is_distorted
    stamps = np.loadtxt(recording / "images_timestamps_us.txt")
    np.testing.assert_array_equal(stamps, [0, 20_000, 40_000, 60_000, 80_000, 100_000])
    trajectory = read_tum(recording / "groundtruth.txt")
    planes = json.loads((recording / "scene.json").read_text())["planes"]
    columns, rows = np.meshgrid(np.arange(64.0), np.arange(48.0))
    pixels = np.stack([columns, rows], -1).reshape(-1, 1, 2)
    ideal = cv2.undistortPoints(pixels, calibration.camera_matrix, np.array(calibration.coefficients),
                                criteria=(cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 200, 1e-12))[:, 0]
    for number in (0, 3, 5):
        depth = np.load(recording / "depth" / f"{number:06d}.npy")
        assert depth.dtype == np.float32
        assert depth.shape == (48, 64)
        assert depth.min() > 0.2
        row = int(np.searchsorted(trajectory.t_us, stamps[number]))
        assert trajectory.t_us[row] == stamps[number]
        pose = trajectory.matrices()[row]
        points = np.column_stack([ideal, np.ones(len(ideal))]) * depth.reshape(-1, 1)
        world = points @ pose[:3, :3].T + pose[:3, 3]
        distance = np.min([np.abs(world @ plane["normal"] + plane["offset"]) for plane in planes], axis=0)
        assert distance.max() < 10 * SIMULATOR_SURFACE
        image = cv2.imread(str(recording / "images" / f"{number:06d}.png"), cv2.IMREAD_UNCHANGED)
        assert image.shape == (48, 64)
        assert image.std() > 10


def test_folder_is_reproducible_and_readable_as_a_recording(recording: Path, tmp_path: Path) -> None:
    from utils.events.hdf5 import Hdf5EventReader

    settings = SequenceSettings(scene="room", seconds=0.1, seed=1, size=(64, 48), distorted=True)
    write_recording(tmp_path / "again", settings, FolderOptions(fps=50, frames=True))
    with h5py.File(recording / "events.h5") as first, h5py.File(tmp_path / "again" / "events.h5") as second:
        for name in ("events/x", "events/y", "events/t", "events/p", "ms_to_idx", "t_offset"):
            assert np.asarray(first[name]).tobytes() == np.asarray(second[name]).tobytes()
    names = ["calib.yaml", "groundtruth.txt", "images_timestamps_us.txt", "scene.json",
             "images/000002.png", "depth/000004.npy"]
    assert filecmp.cmpfiles(recording, tmp_path / "again", names, shallow=False) == (names, [], [])
    reader = Hdf5EventReader(recording / "events.h5")
    assert reader.sensor_size == (64, 48)
    assert reader.rows > 1000
    reader.close()
    assert sorted(path.name for path in recording.parent.iterdir()) == ["room"], "no temporary folder stays"


def test_nothing_is_replaced_by_accident(tmp_path: Path) -> None:
    tiny = SequenceSettings(scene="planes", seconds=0.06, size=(32, 24))
    options = FolderOptions(depth=False)
    target = tmp_path / "recording"
    write_recording(target, tiny, options)
    before = (target / "events.h5").stat().st_mtime_ns
    with pytest.raises(InputError, match="--overwrite"):
        write_recording(target, tiny, options)
    assert (target / "events.h5").stat().st_mtime_ns == before
    write_recording(target, dataclasses.replace(tiny, seed=5), dataclasses.replace(options, overwrite=True))
    assert json.loads((target / "scene.json").read_text())["settings"]["seed"] == 5
    precious = tmp_path / "thesis"
    precious.mkdir()
    (precious / "chapter1.tex").write_text("irreplaceable")
    with pytest.raises(InputError, match="not overwritten|so it is not"):
        write_recording(precious, tiny, dataclasses.replace(options, overwrite=True))
    assert (precious / "chapter1.tex").read_text() == "irreplaceable"
    assert len(list(tmp_path.iterdir())) == 2


@pytest.mark.parametrize("error", [KeyboardInterrupt, OSError(28, "No space left on device")])
def test_an_interrupted_run_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
                                           error: BaseException) -> None:
    def fail(*_: object) -> None:
        raise error

    monkeypatch.setattr(dataset_folder, "_write_images", fail)
    expected = KeyboardInterrupt if error is KeyboardInterrupt else OutputError
    with pytest.raises(expected):
        write_recording(tmp_path / "new", SequenceSettings(scene="planes", seconds=0.06, size=(32, 24)))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("change", [{"scene": "moon"}, {"preset": "warp"}, {"noise": "loud"}, {"seconds": -1.0},
                                    {"seconds": float("nan")}, {"threshold": 0.0}, {"seed": -1}, {"step_px": 0.0}])
def test_unusable_settings_are_refused(change: dict[str, object]) -> None:
    with pytest.raises(InputError, match="expected"):
        SequenceSettings(**change)  # type: ignore[arg-type]


def test_image_stamps_cover_the_recording() -> None:
    stamps = image_stamps(1_000_000, 30.0)
    assert stamps[0] == 0
    assert stamps[-1] == 1_000_000
    assert len(stamps) == 31
    with pytest.raises(InputError, match="images per second"):
        FolderOptions(fps=0.0)
