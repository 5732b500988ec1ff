"""Bags without ROS: what rosbags reads back, the convention of poses, and the map that comes out of such a bag."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from devo.errors import InputError, OutputError
from tests.utils.bag_samples import typestore
from utils.calibration import Calibration
from utils.clouds import PointCloud, write_cloud
from utils.events import Events, make_events, open_events, write_events_h5
from utils.ros_output.camera_info import read_camera_info
from utils.ros_output.clouds import BagOptions, write_input_as_bag
from utils.ros_output.emvs_bag import EmvsBagOptions, prepare_emvs_bag
from utils.ros_output.messages import CAMERA_INFO, EVENT_ARRAY, EVENT_SCHEMAS, RosMessages, new_bag, stamps_ns
from utils.ros_output.recordings import open_recording
from utils.trajectory_io import Trajectory, inverted, write_npy, write_tum

pytest.importorskip("rosbags", reason="bags need the package rosbags")
SIZE = (64, 48)
CAMERA = Calibration(64, 48, 60.0, 61.0, 31.0, 23.0, "radtan", (-0.2, 0.05, 0.001, -0.002))


def read_bag(path: Path) -> dict[str, list[tuple[int, Any]]]:
    """Messages by topic, as the package rosbags understands the definitions in the bag itself."""
    from rosbags.rosbag1 import Reader
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    found: dict[str, list[tuple[int, Any]]] = {}
    with Reader(path) as bag:
        store = get_typestore(Stores.ROS1_NOETIC)
        for connection in bag.connections:
            if connection.msgtype == EVENT_ARRAY:
                store.register(get_types_from_msg(connection.msgdef.data, connection.msgtype))
        for connection, stamp, data in bag.messages():
            found.setdefault(connection.topic, []).append((stamp, store.deserialize_ros1(data, connection.msgtype)))
    return found


def pose_rows(messages: list[tuple[int, Any]]) -> np.ndarray:
    rows = [(m.pose.position, m.pose.orientation) for _, m in messages]
    return np.array([[p.x, p.y, p.z, q.x, q.y, q.z, q.w] for p, q in rows])


def stamp_ns(message: Any) -> int:
    return message.header.stamp.sec * 10**9 + message.header.stamp.nanosec


def events(count: int = 5000, start_us: int = 10_000_000) -> Events:
    rng = np.random.default_rng(0)
    return make_events(rng.integers(0, 64, count), rng.integers(0, 48, count),
                       start_us + np.sort(rng.integers(0, 1_000_000, count)), rng.integers(0, 2, count))


def trajectory(start_us: int = 10_100_000) -> Trajectory:
    share = np.linspace(0, 1, 21)
    quat = np.c_[0.1 * share, -0.2 * share, 0.05 * share, np.ones(21)]
    return Trajectory(start_us + (share * 800_000).astype(int), np.c_[share, 2 * share, -share, quat / np.linalg.norm(
        quat, axis=1, keepdims=True)])


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    folder = tmp_path / "walk"
    folder.mkdir()
    write_events_h5(folder / "events.h5", events(), sensor_size=SIZE)
    (folder / "calib.yaml").write_text(yaml.safe_dump(CAMERA.as_dict()))
    write_npy(folder / "run", trajectory())
    return folder


def options(folder: Path, **changes: Any) -> EmvsBagOptions:
    given = {"poses": str(folder / "run_poses.npy"), "out_bag": str(folder / "out.bag"), "datapath": str(folder)}
    return EmvsBagOptions(**given | changes)


# --- messages -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("schema", list(EVENT_SCHEMAS))
@pytest.mark.parametrize("count", [0, 1, 1000])
def test_packed_events_equal_the_librarys_own_serialisation(schema: str, count: int) -> None:
    messages, part = RosMessages(schema), events(count)
    store = messages.store
    assert store.generate_msgdef(EVENT_ARRAY)[1].startswith(schema)
    t_ns = part.t_us * 1000 + 7
    time, types = store.types["builtin_interfaces/msg/Time"], store.types
    rows = []
    for x, y, t, p in zip(part.x.tolist(), part.y.tolist(), t_ns.tolist(), part.p.tolist()):
        fields = {"x": x, "y": y, "ts": time(*divmod(t, 10**9)), "polarity": bool(p)}
        rows.append(types["dvs_msgs/msg/Event"](**fields))
    stamp = time(*divmod(int(t_ns[0]) if count else 0, 10**9))
    header = types["std_msgs/msg/Header"](3, stamp, "camera")
    whole = types[EVENT_ARRAY](header=header, height=48, width=64, events=rows)
    assert messages.event_array(part, t_ns, SIZE, "camera", 3) == bytes(store.serialize_ros1(whole, EVENT_ARRAY))


def test_stamps_begin_at_one_second_and_must_fit() -> None:
    assert stamps_ns([5.0, 6.5], 5.0).tolist() == [1_000_000_000, 1_000_001_500]
    for values in ([0.0, 5e15], [-2e6]):
        with pytest.raises(InputError, match="check their unit"):
            stamps_ns(values, 0.0)


def test_bags_are_replaced_only_on_request(tmp_path: Path) -> None:
    (tmp_path / "a.bag").write_text("precious")
    with pytest.raises(InputError, match="--overwrite"), new_bag(tmp_path / "a.bag", False):
        pass
    with pytest.raises(RuntimeError), new_bag(tmp_path / "a.bag", True):
        raise RuntimeError
    assert (tmp_path / "a.bag").read_text() == "precious" and len(list(tmp_path.iterdir())) == 1
    with pytest.raises(InputError, match="ends in .bag"), new_bag(tmp_path / "a.mcap", True):
        pass
    with pytest.raises(OutputError), new_bag("/proc/devo-test/a.bag", False):
        pass


# --- EMVS -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("schema", list(EVENT_SCHEMAS))
def test_everything_arrives(recording: Path, schema: str) -> None:
    summary = prepare_emvs_bag(options(recording, eventarray_schema=schema, max_events_per_msg=700))
    found = read_bag(recording / "out.bag")
    assert set(found) == {"/dvs/events", "/dvs/camera_info", "/pose"}
    written, shift = events(), 10**9 - 1000 * int(events().t_us[0])  # the first event comes before the first pose
    arrays = [message for _, message in found["/dvs/events"]]
    assert all(len(message.events) <= 700 and (message.width, message.height) == SIZE for message in arrays)
    assert all(stamp == stamp_ns(message) == message.events[0].ts.sec * 10**9 + message.events[0].ts.nanosec
               for stamp, message in found["/dvs/events"])
    rows = np.array([(e.x, e.y, e.ts.sec * 10**9 + e.ts.nanosec, e.polarity) for m in arrays for e in m.events])
    np.testing.assert_array_equal(rows, np.c_[written.x, written.y, written.t_us * 1000 + shift, written.p])
    assert [stamp for stamp, _ in found["/pose"]] == (trajectory().t_us * 1000 + shift).tolist()
    assert all(message.header.frame_id == "world" for _, message in found["/pose"])
    assert summary["events"] == 5000 and summary["poses"] == 21 and not summary["rectified"]
    info = found["/dvs/camera_info"][0][1]
    assert info.distortion_model == "plumb_bob" and (info.width, info.height) == SIZE
    np.testing.assert_allclose(info.D, [*CAMERA.coefficients, 0])
    np.testing.assert_allclose(info.K.reshape(3, 3), CAMERA.camera_matrix)
    np.testing.assert_array_equal(info.R.reshape(3, 3), np.eye(3))
    assert info.P[0] > 0 and info.P[10] == 1


def test_poses_go_out_camera_to_world_and_are_never_inverted_twice(recording: Path) -> None:
    """`_poses.npy` is camera to world, which EMVS needs; the published preparation inverted it once more."""
    poses = trajectory().world_T_cam
    prepare_emvs_bag(options(recording))
    np.testing.assert_allclose(pose_rows(read_bag(recording / "out.bag")["/pose"]), poses, atol=1e-6)
    assert np.abs(inverted(poses) - poses).max() > 0.5, "the test would not see an inversion"
    (recording / "run_meta.json").write_text('{"pose_convention": "T_world_cam"}')
    write_npy(recording / "turned", Trajectory(trajectory().t_us, inverted(poses)))
    (recording / "turned_meta.json").write_text('{"pose_convention": "T_cam_world"}')
    write_tum(recording / "truth.txt", trajectory())
    for changes in ({}, {"pose_convention": "T_wc"}, {"poses": str(recording / "turned_poses.npy")},
                    {"poses": str(recording / "turned_poses.npy"), "pose_convention": "T_cw"},
                    {"poses": str(recording / "truth.txt"), "time_unit": "s"}):
        prepare_emvs_bag(options(recording, overwrite=True, **changes))
        np.testing.assert_allclose(pose_rows(read_bag(recording / "out.bag")["/pose"]), poses, atol=1e-5)


def test_the_flag_file_covers_the_recording_and_single_bounds_are_honoured(recording: Path) -> None:
    depth = np.linspace(1.0, 2.0, 101).astype(np.float32)
    write_cloud(recording / "run.npz", PointCloud(np.zeros((101, 3)), scalars={"depth": depth}))
    cloud = str(recording / "run.npz")
    for changes, expected in (({}, (0.3, 5.0)), ({"max_depth": 9.0}, (0.3, 9.0)), ({"cloud": cloud}, (0.84, 2.34)),
                              ({"cloud": cloud, "min_depth": 0.5}, (0.5, 2.34)),
                              ({"cloud": cloud, "max_depth": 7.0}, (0.84, 7.0)),
                              ({"cloud": cloud, "min_depth": 0.1, "max_depth": 3.0}, (0.1, 3.0))):
        prepare_emvs_bag(options(recording, overwrite=True, **changes))
        lines = (recording / "out.conf").read_text().splitlines()
        flags = dict(line.removeprefix("--").split("=") for line in lines)
        assert (float(flags["min_depth"]), float(flags["max_depth"])) == pytest.approx(expected, rel=1e-4)
    assert flags["bag_filename"] == str(recording / "out.bag") and flags["dimZ"] == "100"
    last = max(events().t_us[-1], trajectory().t_us[-1])
    assert float(flags["stop_time_s"]) == pytest.approx((last - events().t_us[0]) * 1e-6)


def test_events_outside_the_margin_stay_out(recording: Path) -> None:
    found = prepare_emvs_bag(options(recording, t_margin_s=0.05))
    inside = (events().t_us >= 10_050_000) & (events().t_us <= 10_950_000)
    assert found["events"] == inside.sum() < 5000


def test_a_lens_known_by_its_map_only_gives_undistorted_events(recording: Path) -> None:
    """As for preprocessed data sets; the camera info then has no distortion (raw events would be a defect)."""
    from utils.undistort import rectify_map

    positions, intrinsics = rectify_map(CAMERA)
    raw = open_recording(recording)
    pinhole = Calibration(64, 48, *intrinsics.tolist())
    turned = type(raw)(raw.open_reader, pinhole, "walk", positions)
    with turned.open_reader() as reader:
        moved = Events.concatenate(list(turned.events(reader, -np.inf, 1e18, 1000)))
    expected = np.rint(positions[events().y, events().x])
    inside = ((expected >= 0) & (expected < SIZE)).all(axis=1)
    np.testing.assert_array_equal(np.c_[moved.x, moved.y], expected[inside])
    np.testing.assert_array_equal(moved.t_us, events().t_us[inside])
    assert raw.rectify_map is None and raw.camera == CAMERA


def test_our_mapper_finds_the_plane_in_such_a_bag_and_not_with_inverted_poses(tmp_path: Path) -> None:
    from utils.emvs.mapper import EventCamera, map_events
    from utils.emvs.settings import EmvsSettings
    from utils.emvs.views import PoseTrack
    from utils.undistort import rectify_map

    share = np.linspace(0, 1, 101)
    turn = np.c_[0.02 * share, -0.1 * share, 0.05 * share, np.ones(101)]
    path = Trajectory(share * 1e6, np.c_[0.5 * share - 0.25, 0.1 * share, 0 * share, turn / np.linalg.norm(
        turn, axis=1, keepdims=True)])
    x, y = (grid.ravel() for grid in np.meshgrid(np.linspace(-0.8, 0.8, 9), np.linspace(-0.6, 0.6, 80)))
    points, t_us = np.stack([x, y, np.full_like(x, 1.5)], axis=1), np.arange(0, 1_000_001, 5_000)
    world_T_cam = PoseTrack(path)(t_us)
    seen = np.einsum("tji,tnj->tni", world_T_cam[:, :3, :3], points[None] - world_T_cam[:, None, :3, 3])
    pixel = np.rint(seen[..., :2] / seen[..., 2:] * 60.0 + [32.0, 24.0]).astype(int)
    visible = (pixel >= 0).all(-1) & (pixel < SIZE).all(-1)
    recorded = make_events(*pixel[visible].T, t_us[np.nonzero(visible)[0]], np.ones(int(visible.sum())))
    write_events_h5(tmp_path / "events.h5", recorded, sensor_size=SIZE)
    (tmp_path / "calib.yaml").write_text(yaml.safe_dump(Calibration(64, 48, 60.0, 60.0, 32.0, 24.0).as_dict()))
    settings = EmvsSettings(dimZ=40, min_depth=0.7, max_depth=3.0, packet_size=256, radius_search=None)
    errors = {}
    for name, poses in (("right", path.world_T_cam), ("inverted", inverted(path.world_T_cam))):
        write_npy(tmp_path / name, Trajectory(path.t_us, poses))
        prepare_emvs_bag(options(tmp_path, poses=str(tmp_path / f"{name}_poses.npy"), overwrite=True))
        found = read_bag(tmp_path / "out.bag")["/pose"]
        stamps = np.array([stamp for stamp, _ in found]) / 1000
        camera = read_camera_info(tmp_path / "out.bag")
        with open_events(tmp_path / "out.bag", sensor_size=SIZE) as reader:
            track = Trajectory(stamps, pose_rows(found))
            result = map_events(reader, track, EventCamera(*rectify_map(camera)), settings)
        errors[name] = float(np.median(np.abs(result.cloud.points[:, 2] - 1.5)))
    assert errors["right"] < 0.05 and errors["inverted"] > 10 * errors["right"], errors


@pytest.mark.parametrize(("changes", "message"), [
    ({"poses": "nowhere_poses.npy"}, "cannot be read"), ({"min_depth": 6.0}, "is empty"), ({"dimZ": 300}, "2 to 256"),
    ({"max_events_per_msg": 0}, "max_events_per_msg"), ({"t_margin_s": -1.0}, "t_margin_s"),
    ({"datapath": None}, "name the recording"),
    ({"datapath": "nowhere"}, "nowhere"), ({"max_depth": float("nan")}, "is empty"),
    ({"eventarray_schema": "abc"}, "schema"), ({"out_bag": "out.mcap"}, "ends in .bag"),
    ({"cloud": "walk/run_poses.npy"}, "run_poses.npy")])
def test_wrong_arguments_of_the_emvs_bag(
    recording: Path, monkeypatch: pytest.MonkeyPatch, changes: dict, message: str
) -> None:
    monkeypatch.chdir(recording.parent)
    before = sorted(recording.parent.rglob("*"))
    with pytest.raises(InputError, match=message):
        prepare_emvs_bag(options(recording, **changes))
    assert sorted(recording.parent.rglob("*")) == before


def test_poses_of_another_clock_are_refused(recording: Path) -> None:
    write_npy(recording / "late", trajectory(10**12))
    with pytest.raises(InputError, match="do not overlap"):
        prepare_emvs_bag(options(recording, poses=str(recording / "late_poses.npy")))
    assert not (recording / "out.bag").exists()


# --- clouds and trajectories ----------------------------------------------------------------------------------


def xyz(message: Any) -> np.ndarray:
    assert [(f.name, f.offset, f.datatype) for f in message.fields] == [("x", 0, 7), ("y", 4, 7), ("z", 8, 7)]
    assert (message.height, message.point_step, message.row_step) == (1, 12, 12 * message.width) and message.is_dense
    return message.data.view("<f4").reshape(-1, 3)


def write(path: Path, **changes: Any) -> dict[str, list[tuple[int, Any]]]:
    target = path.with_name("out.bag")
    write_input_as_bag(BagOptions(str(path), str(target), overwrite=True, **changes))
    return read_bag(target)


@pytest.mark.parametrize("suffix", [".npy", ".ply", ".pcd", ".npz"])
def test_a_cloud(tmp_path: Path, suffix: str) -> None:
    points = np.random.default_rng(0).random((50, 3)).astype(np.float32)
    points[3, 1] = np.nan
    write_cloud(tmp_path / f"c{suffix}", PointCloud(points))
    found = write(tmp_path / f"c{suffix}", frame_id="map")
    ((stamp, message),) = found["/devo/pointcloud"]
    assert stamp == stamp_ns(message) == 10**9 and message.header.frame_id == "map"
    np.testing.assert_array_equal(xyz(message), np.delete(points, 3, axis=0))


@pytest.mark.parametrize(("stamps", "unit", "gap_ns"), [
    ([3.0, 3.5, 4.5], "auto", 500_000_000), ([3e6, 3.5e6, 4.5e6], "auto", 500_000_000),
    ([3.0, 3.5, 4.5], "us", 500), ([3e6, 4e6, 5e6], "s", 10**15)])
def test_clouds_per_frame_with_stamps(tmp_path: Path, stamps: list[float], unit: str, gap_ns: int) -> None:
    clouds = np.random.default_rng(0).random((3, 4, 3)).astype(np.float32)
    clouds[1] = np.nan
    np.save(tmp_path / "c.npy", clouds)
    np.save(tmp_path / "t.npy", np.array(stamps))
    found = write(tmp_path / "c.npy", timestamps_npy=str(tmp_path / "t.npy"), timestamp_unit=unit,
                  include_empty=True)["/devo/pointcloud"]
    assert [len(xyz(message)) for _, message in found] == [4, 0, 4]
    assert found[0][0] == 10**9 and found[1][0] - found[0][0] == gap_ns
    without = write(tmp_path / "c.npy", timestamps_npy=str(tmp_path / "t.npy"), timestamp_unit=unit)
    assert [len(xyz(message)) for _, message in without["/devo/pointcloud"]] == [4, 4]


def test_trajectories_have_a_topic_of_their_own(tmp_path: Path) -> None:
    """The published tool put poses on the topic of the clouds."""
    write_tum(tmp_path / "t.txt", trajectory())
    write_npy(tmp_path / "run", trajectory())
    for name in ("t.txt", "run_poses.npy"):
        found = write(tmp_path / name)
        assert set(found) == {"/devo/pose"}
        np.testing.assert_allclose(pose_rows(found["/devo/pose"]), trajectory().world_T_cam, atol=1e-6)
        stamps = [stamp for stamp, _ in found["/devo/pose"]]
        assert stamps == ((trajectory().t_us - trajectory().t_us[0]) * 1000 + 10**9).tolist()
    assert set(write(tmp_path / "t.txt", topic="/here")) == {"/here"}
    found = write(tmp_path / "t.txt", emvs_style=True)
    assert set(found) == {"/dvs/events", "/dvs/camera_info", "/pose"}
    assert len(found["/dvs/events"][0][1].events) == 0 and found["/dvs/camera_info"][0][1].width == 1


def test_wrong_inputs_of_clouds(tmp_path: Path) -> None:
    np.save(tmp_path / "empty.npy", np.empty((0, 3)))
    np.save(tmp_path / "c.npy", np.zeros((2, 3)))
    np.save(tmp_path / "many.npy", np.zeros((2, 3, 3)))
    np.save(tmp_path / "t.npy", np.zeros((2, 2)))
    np.save(tmp_path / "t3.npy", np.zeros(3))
    (tmp_path / "bad.txt").write_text("1 2 3\n")
    cases: list[tuple[str, dict[str, Any], str]] = [
        ("nowhere.npy", {}, "cannot be read"), ("empty.npy", {}, "include_empty"), ("bad.txt", {}, "8"),
        ("c.npy", {"emvs_style": True}, "needs a trajectory"), ("many.npy", {"timestamps_npy": "t3.npy"}, "3 stamps"),
        ("many.npy", {"timestamps_npy": "t.npy"}, "one row"), ("t3.npy", {}, "t3.npy")]
    for name, changes, message in cases:
        if "timestamps_npy" in changes:
            changes["timestamps_npy"] = str(tmp_path / changes["timestamps_npy"])
        with pytest.raises(InputError, match=message):
            write(tmp_path / name, **changes)
    assert not (tmp_path / "out.bag").exists()


# --- cameras of bags ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("camera", [
    CAMERA, Calibration(64, 48, 60.0, 61.0, 31.0, 23.0), Calibration(64, 48, 60.0, 61.0, 31.0, 23.0, "fisheye",
                                                                     (0.01, 0.002, -0.001, 0.0))])
def test_cameras_survive_a_bag(tmp_path: Path, camera: Calibration) -> None:
    messages = RosMessages()
    with new_bag(tmp_path / "c.bag", False) as bag:
        for topic, written in (("/left/camera_info", camera), ("/right/camera_info", Calibration(2, 2, 1, 1, 1, 1))):
            connection = bag.add_connection(topic, CAMERA_INFO, typestore=messages.store)
            bag.write(connection, 10**9, messages.camera_info(10**9, written, "cam"))
    found = read_camera_info(tmp_path / "c.bag", event_topic="/left/events")
    assert found.intrinsics.tolist() == camera.intrinsics.tolist() and found.distortion_model == camera.distortion_model
    np.testing.assert_allclose(found.coefficients[:4], camera.coefficients)
    assert read_camera_info(tmp_path / "c.bag", "right").width == 2
    with pytest.raises(InputError, match="/left/camera_info, /right/camera_info"):
        read_camera_info(tmp_path / "c.bag")


def test_bags_without_a_usable_camera(tmp_path: Path) -> None:
    messages = RosMessages()
    with new_bag(tmp_path / "none.bag", False) as bag:
        connection = bag.add_connection("/dvs/events", EVENT_ARRAY, typestore=typestore("dvs_msgs", 1))
        bag.write(connection, 10**9, messages.event_array(events(3), events(3).t_us * 1000, SIZE, "c", 0))
    with pytest.raises(InputError, match="no camera info"):
        read_camera_info(tmp_path / "none.bag")
    info = messages.store.types[CAMERA_INFO]
    for model, D, K, message in (("plumb_bob", [], np.zeros(9), "K is zero"), ("omni", [0.1], CAMERA.camera_matrix,
                                                                               "omni"),
                                 ("rational_polynomial", [0.1] * 8, CAMERA.camera_matrix, "only the first 5")):
        with new_bag(tmp_path / "bad.bag", True) as bag:
            connection = bag.add_connection("/camera_info", CAMERA_INFO, typestore=messages.store)
            region = messages.store.types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
            whole = info(messages._header(10**9, "c"), 48, 64, model, np.array(D, float), np.ravel(K).astype(float),
                         np.eye(3).ravel(), np.zeros(12), 0, 0, region)
            bag.write(connection, 10**9, bytes(messages.store.serialize_ros1(whole, CAMERA_INFO)))
        with pytest.raises(InputError, match=message):
            read_camera_info(tmp_path / "bad.bag")
