"""Cloud files: round trips, third-party readers and writers, sizes, failing disks."""

from __future__ import annotations

import contextlib
import resource
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import plyfile
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from devo.errors import InputError, OutputError
from utils.clouds import PointCloud, read_cloud, write_cloud
from utils.clouds.ply import read_ply

FORMATS = [(".ply", False), (".ply", True), (".pcd", False), (".pcd", True), (".npz", False)]
IDS = ["ply", "ply-text", "pcd", "pcd-text", "npz"]


def rich_cloud(count: int, seed: int = 0) -> PointCloud:
    """A cloud with colours, every kind of scalar and metadata."""
    rng = np.random.default_rng(seed)
    return PointCloud(
        rng.normal(scale=10, size=(count, 3)),
        rng.integers(0, 256, (count, 3), dtype=np.uint8),
        {
            "host_frame": rng.integers(0, 1000, count, dtype=np.int32),
            "t_us": 1_600_000_000_000_000 + rng.integers(0, 10**9, count, dtype=np.int64),
            "depth": rng.random(count, dtype=np.float32),
            "inv_depth_sigma": rng.random(count),
            "observations": rng.integers(0, 200, count, dtype=np.uint8),
            "clamped": rng.random(count) < 0.5,
        },
        {"frame": "world = first camera", "scale": "arbitrary", "command": "run --x 'a\tb' \u00fc\n" + "z" * 500},
    )


def assert_same(found: PointCloud, expected: PointCloud) -> None:
    np.testing.assert_array_equal(found.points, expected.points)
    assert (found.colors is None) == (expected.colors is None)
    if expected.colors is not None:
        np.testing.assert_array_equal(found.colors, expected.colors)
    assert list(found.scalars) == list(expected.scalars)
    for name, values in expected.scalars.items():
        np.testing.assert_array_equal(found.scalars[name], values, err_msg=name)
    assert found.metadata == expected.metadata


@pytest.mark.parametrize(("suffix", "text"), FORMATS, ids=IDS)
@pytest.mark.parametrize("count", [0, 1, 257])
def test_round_trip(tmp_path: Path, suffix: str, text: bool, count: int) -> None:
    cloud = rich_cloud(count)
    path = tmp_path / f"cloud{suffix}"
    assert write_cloud(path, cloud, text=text) == 0
    assert_same(read_cloud(path), cloud)
    assert [entry.name for entry in tmp_path.iterdir()] == [path.name]


_DTYPES = st.sampled_from(["?", "i1", "u1", "i2", "u2", "i4", "u4", "i8", "f2", "f4", "f8", ">f4", ">i2"])


@st.composite
def clouds(draw: st.DrawFn) -> PointCloud:
    count = draw(st.integers(0, 6))
    points = draw(hnp.arrays(np.float32, (count, 3)))
    colors = draw(st.none() | hnp.arrays(np.uint8, (count, 3)))
    scalars = {}
    for number in range(draw(st.integers(0, 3))):
        dtype = np.dtype(draw(_DTYPES))
        limits = {"elements": st.integers(-(2**53), 2**53)} if dtype == np.int64 else {}
        scalars[f"s{number}"] = draw(hnp.arrays(dtype, count, **limits))
    metadata = draw(st.dictionaries(st.sampled_from(["a", "b c", "d:e"]), st.text(max_size=20)))
    return PointCloud(points, colors, scalars, metadata)


@pytest.mark.parametrize(("suffix", "text"), FORMATS, ids=IDS)
@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(cloud=clouds())
def test_any_cloud_survives(tmp_path: Path, suffix: str, text: bool, cloud: PointCloud) -> None:
    path = tmp_path / f"cloud{suffix}"
    write_cloud(path, cloud, text=text)
    assert_same(read_cloud(path), cloud)
    first = path.read_bytes()
    write_cloud(path, read_cloud(path), text=text)
    assert len(path.read_bytes()) == len(first)


def test_same_cloud_same_bytes(tmp_path: Path) -> None:
    for suffix, text in FORMATS:
        paths = [tmp_path / f"{name}{suffix}" for name in "ab"]
        for path in paths:
            write_cloud(path, rich_cloud(50), text=text)
        assert paths[0].read_bytes() == paths[1].read_bytes()


@pytest.mark.parametrize("suffix", [".ply", ".pcd", ".npy", ".npz"])
def test_a_million_points(tmp_path: Path, suffix: str) -> None:
    rng = np.random.default_rng(1)
    cloud = PointCloud(rng.normal(size=(1_000_000, 3)), rng.integers(0, 256, (1_000_000, 3), dtype=np.uint8))
    path = tmp_path / f"cloud{suffix}"
    write_cloud(path, cloud)
    found = read_cloud(path)
    np.testing.assert_array_equal(found.points, cloud.points)
    if suffix != ".npy":
        np.testing.assert_array_equal(found.colors, cloud.colors)


def test_npy_keeps_the_points_alone(tmp_path: Path) -> None:
    cloud = rich_cloud(9)
    write_cloud(tmp_path / "c.npy", cloud)
    plain = np.load(tmp_path / "c.npy", allow_pickle=False)
    assert plain.dtype == np.float32
    np.testing.assert_array_equal(plain, cloud.points)
    assert_same(read_cloud(tmp_path / "c.npy"), PointCloud(cloud.points))


@pytest.mark.parametrize("array", [
    np.zeros((0, 3)), np.asfortranarray(np.arange(12.0).reshape(4, 3)), np.arange(6, dtype=">i2").reshape(2, 3)
])
def test_npy_of_other_programs(tmp_path: Path, array: np.ndarray) -> None:
    np.save(tmp_path / "c.npy", array)
    np.testing.assert_array_equal(read_cloud(tmp_path / "c.npy").points, array)


def test_npz_opens_with_numpy_without_pickle(tmp_path: Path) -> None:
    cloud = rich_cloud(5)
    write_cloud(tmp_path / "c.npz", cloud)
    with np.load(tmp_path / "c.npz", allow_pickle=False) as archive:
        assert set(archive.files) == {"points", "colors", "metadata_json", *cloud.scalars}
        assert archive["t_us"].dtype == np.int64
        assert archive["clamped"].dtype == bool


@pytest.mark.parametrize(("suffix", "text"), [*FORMATS, (".npy", False)], ids=[*IDS, "npy"])
def test_nonfinite_points_go_only_when_asked(tmp_path: Path, suffix: str, text: bool) -> None:
    points = np.arange(15, dtype=np.float32).reshape(5, 3)
    points[1, 1], points[3, 0], points[4, 2] = np.nan, np.inf, -np.inf
    cloud = PointCloud(points, scalars={} if suffix == ".npy" else {"row": np.arange(5)})
    path = tmp_path / f"c{suffix}"
    assert write_cloud(path, cloud, text=text) == 0
    assert_same(read_cloud(path), cloud)
    assert write_cloud(path, cloud, text=text, drop_nonfinite=True) == 3
    assert_same(read_cloud(path), cloud.select([0, 2]))


def test_integers_that_no_ply_type_holds_are_refused(tmp_path: Path) -> None:
    cloud = PointCloud(np.zeros((1, 3)), scalars={"big": np.array([2**60], np.int64)})
    for suffix in (".ply", ".pcd"):
        with pytest.raises(OutputError, match="npz"):
            write_cloud(tmp_path / f"c{suffix}", cloud)
    write_cloud(tmp_path / "c.npz", cloud)
    assert read_cloud(tmp_path / "c.npz").scalars["big"][0] == 2**60


def test_unknown_suffix_and_text_arrays(tmp_path: Path) -> None:
    cloud = rich_cloud(1)
    for call in (lambda: write_cloud(tmp_path / "c.xyz", cloud), lambda: read_cloud(tmp_path / "c.xyz")):
        with pytest.raises(InputError, match=r"c\.xyz: unknown kind.*\.ply"):
            call()
    with pytest.raises(InputError, match="no text form"):
        write_cloud(tmp_path / "c.npz", cloud, text=True)
    write_cloud(tmp_path / "C.PLY", cloud)
    assert len(read_cloud(tmp_path / "C.PLY")) == 1


# --- other programs -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("text", [False, True])
def test_plyfile_reads_what_we_write(tmp_path: Path, text: bool) -> None:
    cloud = rich_cloud(100)
    write_cloud(tmp_path / "c.ply", cloud, text=text)
    data = plyfile.PlyData.read(tmp_path / "c.ply")
    vertex = data["vertex"]
    assert [prop.name for prop in vertex.properties] == ["x", "y", "z", "red", "green", "blue", *cloud.scalars]
    types = ["f4", "f4", "f4", "u1", "u1", "u1", "i4", "f8", "f4", "f8", "u1", "u1"]
    assert [prop.val_dtype for prop in vertex.properties] == types
    np.testing.assert_array_equal(np.stack([vertex[axis] for axis in "xyz"], 1), cloud.points)
    for name, values in cloud.scalars.items():
        np.testing.assert_array_equal(vertex[name], values)
    assert "frame: world = first camera" in data.comments


@pytest.mark.parametrize("suffix", [".ply", ".pcd"])
@pytest.mark.parametrize("text", [False, True])
def test_open3d_reads_what_we_write(tmp_path: Path, suffix: str, text: bool) -> None:
    open3d = pytest.importorskip("open3d", exc_type=ImportError)
    for count in (0, 1, 100):
        cloud = rich_cloud(count)
        write_cloud(tmp_path / f"c{suffix}", cloud, text=text)
        found = open3d.io.read_point_cloud(str(tmp_path / f"c{suffix}"))
        assert len(found.points) == count
        if count:
            np.testing.assert_array_equal(np.asarray(found.points, np.float32), cloud.points)
            np.testing.assert_array_equal(np.rint(np.asarray(found.colors) * 255), cloud.colors)


@pytest.mark.parametrize("suffix", [".ply", ".pcd"])
@pytest.mark.parametrize("text", [False, True])
def test_we_read_what_open3d_writes(tmp_path: Path, suffix: str, text: bool) -> None:
    open3d = pytest.importorskip("open3d", exc_type=ImportError)
    cloud = rich_cloud(40)
    theirs = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(cloud.points.astype(np.float64)))
    theirs.colors = open3d.utility.Vector3dVector(cloud.colors / 255.0)
    path = tmp_path / f"c{suffix}"
    assert open3d.io.write_point_cloud(str(path), theirs, write_ascii=text)
    found = read_cloud(path)
    # Open3D writes text PLY with 6 significant digits: half a unit of the last one
    np.testing.assert_allclose(found.points, cloud.points, rtol=5e-6 if text and suffix == ".ply" else 1e-7)
    np.testing.assert_array_equal(found.colors, cloud.colors)


def test_compressed_pcd_is_refused_with_advice(tmp_path: Path) -> None:
    open3d = pytest.importorskip("open3d", exc_type=ImportError)
    theirs = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(np.random.default_rng(0).random((50, 3))))
    assert open3d.io.write_point_cloud(str(tmp_path / "c.pcd"), theirs, compressed=True)
    with pytest.raises(InputError, match="binary_compressed is not supported.*convert"):
        read_cloud(tmp_path / "c.pcd")


@pytest.mark.parametrize("order", ["<", ">", ""], ids=["little", "big", "ascii"])
@pytest.mark.parametrize("faces", ["none", "triangles", "mixed"])
def test_we_read_what_plyfile_writes(tmp_path: Path, order: str, faces: str) -> None:
    """Doubles, extra elements before and after the vertices, lists of equal and of different length."""
    rng = np.random.default_rng(3)
    columns = [("x", "f8"), ("y", "f8"), ("z", "f8"), ("nx", "f4"), ("label", "i2"), ("scalar_I#1", "u4")]
    vertices = np.zeros(30, columns)
    for name in vertices.dtype.names:
        vertices[name] = rng.integers(0, 3000, 30)
    cameras = np.array([(1.5, 2)], [("view", "f4"), ("id", "i4")])
    lengths = {"none": [], "triangles": [3] * 20, "mixed": [3, 4, 0, 5, 3]}[faces]
    polygons = np.empty(len(lengths), [("vertex_indices", object), ("flag", "u1")])
    for row, length in enumerate(lengths):
        polygons[row] = (np.arange(length, dtype=np.int32), row)
    face_element = plyfile.PlyElement.describe(
        polygons, "face", val_types={"vertex_indices": "i4"}, len_types={"vertex_indices": "u1"}
    )
    elements = [plyfile.PlyElement.describe(cameras, "camera"), face_element,
                plyfile.PlyElement.describe(vertices, "vertex"),
                plyfile.PlyElement.describe(cameras.copy(), "tail")]
    plyfile.PlyData(elements, text=order == "", byte_order=order or "=", comments=["made by a test"],
                    obj_info=["info"]).write(tmp_path / "c.ply")
    found = read_ply(tmp_path / "c.ply")
    np.testing.assert_array_equal(found.points, np.stack([vertices[axis] for axis in "xyz"], 1))
    np.testing.assert_array_equal(found.scalars["label"], vertices["label"])
    np.testing.assert_array_equal(found.scalars["scalar_I_1"], vertices["scalar_I#1"])
    assert found.scalars["label"].dtype == np.int16
    assert found.scalars["label"].dtype.isnative
    assert found.metadata == {"comment": "made by a test\ninfo"}


def test_float_colours_are_taken_as_shares(tmp_path: Path) -> None:
    path = tmp_path / "c.ply"
    head = "ply\nformat ascii 1.0\nelement vertex 1\n" + "".join(
        f"property float {name}\n" for name in ("x", "y", "z", "red", "green", "blue"))
    path.write_text(head + "end_header\n1 2 3 0 0.5 1\n")
    np.testing.assert_array_equal(read_cloud(path).colors, [[0, 128, 255]])
    path.write_text(head + "end_header\n1 2 3 0 127 255\n")
    with pytest.raises(InputError, match="green must be uchar"):
        read_cloud(path)


def test_pcd_of_emvs_and_with_vectors(tmp_path: Path) -> None:
    path = tmp_path / "c.pcd"
    path.write_text("VERSION .7\nFIELDS x y z _ hist\nSIZE 4 4 4 1 2\nTYPE F F F U I\nCOUNT 1 1 1 2 2\n"
                    "WIDTH 1\nHEIGHT 2\nPOINTS 2\nDATA ascii\n1 2 3 0 0 -7 8\n4 5 6 0 0 9 10\n")
    found = read_cloud(path)
    np.testing.assert_array_equal(found.points, [[1, 2, 3], [4, 5, 6]])
    assert {name: values.tolist() for name, values in found.scalars.items()} == {"hist_0": [-7, 9], "hist_1": [8, 10]}


# --- disks that fail ----------------------------------------------------------------------------------------


@contextlib.contextmanager
def _largest_file(size: int) -> Iterator[None]:
    """The kernel refuses writes beyond `size` bytes, as a full disk would."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@pytest.mark.parametrize(("suffix", "text"), [*FORMATS, (".npy", False)], ids=[*IDS, "npy"])
def test_a_write_that_fails_leaves_the_old_file_alone(tmp_path: Path, suffix: str, text: bool) -> None:
    path = tmp_path / f"c{suffix}"
    write_cloud(path, rich_cloud(3), text=text)
    before = path.read_bytes()
    with _largest_file(16_384), pytest.raises(OutputError, match=rf"cannot write .*c\{suffix}"):
        write_cloud(path, rich_cloud(20_000), text=text)
    assert path.read_bytes() == before
    assert [entry.name for entry in tmp_path.iterdir()] == [path.name]


@pytest.mark.parametrize("suffix", [".ply", ".pcd", ".npy", ".npz"])
def test_a_folder_that_cannot_be_written(tmp_path: Path, suffix: str, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(OutputError, match="cannot write /proc/"):
        write_cloud(f"/proc/devo-test/c{suffix}", rich_cloud(1))
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="cannot write"):
        write_cloud(tmp_path / "file" / f"c{suffix}", rich_cloud(1))

    def refuse(*_: object, **__: object) -> None:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr("utils.atomic.tempfile.mkstemp", refuse)
    with pytest.raises(OutputError, match="Permission denied"):
        write_cloud(tmp_path / f"c{suffix}", rich_cloud(1))
    assert not (tmp_path / f"c{suffix}").exists()
