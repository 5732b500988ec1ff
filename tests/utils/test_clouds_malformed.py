"""Damaged cloud files give correct data or an `InputError` that names the file, never anything else."""

from __future__ import annotations

import io
import pickle
from pathlib import Path

import numpy as np
import pytest

from devo.errors import InputError
from utils.clouds import PointCloud, read_cloud, write_cloud

KINDS = [(".ply", False), (".ply", True), (".pcd", False), (".pcd", True), (".npy", False), (".npz", False)]
IDS = ["ply", "ply-text", "pcd", "pcd-text", "npy", "npz"]


def _cloud() -> PointCloud:
    rng = np.random.default_rng(5)
    return PointCloud(
        rng.normal(size=(20, 3)), rng.integers(0, 256, (20, 3), dtype=np.uint8),
        {"host_frame": np.arange(20, dtype=np.int32), "depth": rng.random(20)}, {"frame": "first camera"},
    )


def _written(folder: Path, suffix: str, text: bool) -> tuple[Path, bytes, PointCloud]:
    path = folder / f"cloud{suffix}"
    write_cloud(path, _cloud(), text=text)
    return path, path.read_bytes(), read_cloud(path)


@pytest.mark.parametrize(("suffix", "text"), KINDS, ids=IDS)
def test_truncated_at_every_11th_byte(tmp_path: Path, suffix: str, text: bool) -> None:
    path, content, whole = _written(tmp_path, suffix, text)
    for length in range(0, len(content), 11):
        path.write_bytes(content[:length])
        if text and length > content.rstrip().rfind(b" "):
            continue  # inside the very last number of a text file nothing shows that digits are missing
        with pytest.raises(InputError, match=f"cloud{suffix}"):
            read_cloud(path)
    assert len(whole) == 20


@pytest.mark.parametrize(("suffix", "text"), KINDS, ids=IDS)
@pytest.mark.parametrize("extra", [b"\0", b"1 2 3\n", b"\n\xff"])
def test_longer_than_the_header_says(tmp_path: Path, suffix: str, text: bool, extra: bytes) -> None:
    path, content, whole = _written(tmp_path, suffix, text)
    path.write_bytes(content + extra)
    if suffix == ".npz":  # the zip format allows a comment behind the archive's end; the content is intact
        np.testing.assert_array_equal(read_cloud(path).points, whole.points)
        return
    with pytest.raises(InputError, match=f"cloud{suffix}"):
        read_cloud(path)


@pytest.mark.parametrize(("suffix", "text"), KINDS, ids=IDS)
def test_flipped_bytes(tmp_path: Path, suffix: str, text: bool) -> None:
    """520 files with one to eight wrong bytes each; headers are hit more often than their share."""
    path, content, whole = _written(tmp_path, suffix, text)
    rng = np.random.default_rng(11)
    refused = 0
    for round_number in range(520):
        damaged = np.frombuffer(content, np.uint8).copy()
        reach = min(len(damaged), 400) if round_number % 2 else len(damaged)
        where = rng.integers(0, reach, rng.integers(1, 9))
        damaged[where] ^= rng.integers(1, 256, len(where), dtype=np.uint8)
        path.write_bytes(damaged.tobytes())
        try:
            found = read_cloud(path)
        except InputError as error:
            assert f"cloud{suffix}" in str(error)
            refused += 1
        else:
            assert found.points.shape == whole.points.shape  # other bytes, other values; never another count
    assert refused > 50


@pytest.mark.parametrize("suffix", [".ply", ".pcd", ".npy", ".npz"])
@pytest.mark.parametrize("content", [b"", b"\n", b"hello\n" * 9, b"\x93NUMPY", b"PK\x03\x04", b"ply\n", bytes(500)])
def test_garbage(tmp_path: Path, suffix: str, content: bytes) -> None:
    path = tmp_path / f"garbage{suffix}"
    path.write_bytes(content)
    with pytest.raises(InputError, match=f"garbage{suffix}"):
        read_cloud(path)


@pytest.mark.parametrize("suffix", [".ply", ".pcd", ".npy", ".npz"])
def test_missing_file_and_folder(tmp_path: Path, suffix: str) -> None:
    with pytest.raises(InputError, match=f"nowhere{suffix}: cannot be read"):
        read_cloud(tmp_path / f"nowhere{suffix}")
    (tmp_path / f"folder{suffix}").mkdir()
    with pytest.raises(InputError, match=f"folder{suffix}: cannot be read"):
        read_cloud(tmp_path / f"folder{suffix}")


_ASCII = "ply\nformat ascii 1.0\n"
_XYZ = "property float x\nproperty float y\nproperty float z\n"


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (_ASCII + "element vertex 1\n" + _XYZ + "1 2 3\n", "no end_header"),
        ("ply\nelement vertex 1\n" + _XYZ + "end_header\n1 2 3\n", "no format line"),
        ("ply\nformat ascii 2.0\nelement vertex 0\n" + _XYZ + "end_header\n", "'format ascii 2.0' cannot be"),
        (_ASCII + "element face 0\nproperty int a\nend_header\n", "no vertex element"),
        (_ASCII + "element vertex -1\n" + _XYZ + "end_header\n", "'element vertex -1'"),
        (_ASCII + "element vertex 0\nelement vertex 0\nend_header\n", "vertex occurs twice"),
        (_ASCII + "element vertex 0\nproperty quad x\nend_header\n", "names no type"),
        (_ASCII + "element vertex 0\n" + _XYZ + "property float x\nend_header\n", "'property float x'"),
        (_ASCII + "property float x\nend_header\n", "'property float x' cannot be understood"),
        (_ASCII + "element vertex 1\nproperty float x\nproperty float y\nend_header\n1 2\n", "need x, y and"),
        (_ASCII + "element vertex 0\n" + _XYZ + "property list uchar int n\nend_header\n", "lists .n. are not"),
        (_ASCII + "element vertex 2\n" + _XYZ + "end_header\n1 2 3\n", "promises 2 lines of data, found 1"),
        (_ASCII + "element vertex 1\n" + _XYZ + "end_header\n1 2\n", "1 lines of 3 values, found 1 of 2"),
        (_ASCII + "element vertex 2\n" + _XYZ + "end_header\n1 2 3\n4 5\n", "damaged"),
        (_ASCII + "element vertex 1\n" + _XYZ + "end_header\n1 two 3\n", "two"),
        (_ASCII + "element vertex 1\n" + _XYZ + "property uchar k\nend_header\n1 2 3 256\n", "k holds 256"),
        (_ASCII + "element vertex 1\n" + _XYZ + "property int k\nend_header\n1 2 3 nan\n", "k holds nan"),
        ("ply\nformat binary_little_endian 1.0\nelement vertex 99999999999\n" + _XYZ + "end_header\n", "truncated"),
        ("ply\nformat binary_little_endian 1.0\nelement face 2\nproperty list int int n\nelement vertex 0\n" + _XYZ
         + "end_header\n\xff\xff\xff\x7f", "claims"),
    ],
)
def test_ply_headers(tmp_path: Path, content: str, message: str) -> None:
    path = tmp_path / "bad.ply"
    path.write_bytes(content.encode("latin-1"))
    with pytest.raises(InputError, match=f"bad.ply: .*{message}"):
        read_cloud(path)


def _pcd(**changes: str | None) -> str:
    entries: dict[str, str | None] = {
        "VERSION": "0.7", "FIELDS": "x y z", "SIZE": "4 4 4", "TYPE": "F F F", "COUNT": "1 1 1", "WIDTH": "1",
        "HEIGHT": "1", "POINTS": "1", "DATA": "ascii"}
    entries.update(changes)
    return "".join(f"{key} {value}\n" for key, value in entries.items() if value is not None) + "1 2 3\n"


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"DATA": None}, "no DATA line|cannot be understood"),
        ({"FIELDS": None}, "no FIELDS line"),
        ({"POINTS": None}, "no POINTS line"),
        ({"POINTS": "2"}, "is not POINTS 2"),
        ({"POINTS": "2", "WIDTH": "2"}, "POINTS is 2, found 1 lines"),
        ({"WIDTH": "-1"}, "WIDTH must be one whole number"),
        ({"SIZE": "4 4"}, "3, 2, 3 and 3 entries"),
        ({"SIZE": "4 4 3"}, "size 3"),
        ({"TYPE": "F F Q"}, "type Q"),
        ({"COUNT": "1 1 0"}, "count 0"),
        ({"FIELDS": "x y y"}, "repeat a name"),
        ({"FIELDS": "x y w"}, "need x, y and z"),
        ({"DATA": "zip"}, "DATA zip is not supported"),
        ({"DATA": "binary"}, "1 points need 12 bytes, found 6"),
        ({"FIELDS": "x y z rgb", "SIZE": "4 4 4 8", "TYPE": "F F F U", "COUNT": "1 1 1 1", "DATA": "ascii\n1 2 3 4",
          "POINTS": "2", "WIDTH": "2"}, "values|damaged"),
        ({"LABEL": "1"}, "LABEL"),
    ],
)
def test_pcd_headers(tmp_path: Path, changes: dict[str, str | None], message: str) -> None:
    path = tmp_path / "bad.pcd"
    if "LABEL" in changes:
        changes = {**changes, "DATA": "ascii"}
        path.write_text("LABEL 1\n" + _pcd())
    else:
        path.write_text(_pcd(**changes))
    with pytest.raises(InputError, match=f"bad.pcd: .*({message})"):
        read_cloud(path)


def test_pcd_template_itself_is_fine(tmp_path: Path) -> None:
    (tmp_path / "good.pcd").write_text(_pcd())
    np.testing.assert_array_equal(read_cloud(tmp_path / "good.pcd").points, [[1, 2, 3]])


class _Attack:
    def __reduce__(self) -> tuple:
        return (exec, ("raise SystemExit('code of the file was run')",))


def test_pickles_are_never_loaded(tmp_path: Path) -> None:
    objects = np.empty((1, 3), object)
    objects[0, 0] = _Attack()
    np.save(tmp_path / "a.npy", objects, allow_pickle=True)
    np.savez(tmp_path / "a.npz", points=objects)
    (tmp_path / "b.npy").write_bytes(pickle.dumps(_Attack()))
    for name in ("a.npy", "a.npz", "b.npy"):
        with pytest.raises(InputError, match="pickled|no NPY array"):
            read_cloud(tmp_path / name)


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"cloud": np.zeros((1, 3))}, "no array named points, found cloud"),
        ({"points": np.zeros((2, 3)), "depth": np.zeros(3)}, "depth must be"),
        ({"points": np.zeros((2, 3)), "x": np.zeros(2)}, "'x' is no name"),
        ({"points": np.zeros((2, 3)), "metadata_json": np.array("[1]")}, "no JSON object"),
        ({"points": np.zeros((2, 3)), "metadata_json": np.array("{")}, "no JSON object"),
        ({"points": np.zeros((2, 3)), "metadata_json": np.array('{"seed": 1}')}, "text to text"),
    ],
)
def test_archives_whose_arrays_do_not_fit(tmp_path: Path, arrays: dict[str, np.ndarray], message: str) -> None:
    np.savez(tmp_path / "bad.npz", **arrays)
    with pytest.raises(InputError, match=f"bad.npz: .*{message}"):
        read_cloud(tmp_path / "bad.npz")


@pytest.mark.parametrize("shape", ["(1000000000000, 3)", "(-1, 3)", "(4, 2)", "(6,)", "'x'"])
def test_npy_with_a_lying_shape(tmp_path: Path, shape: str) -> None:
    stream = io.BytesIO()
    header = f"{{'descr': '<f4', 'fortran_order': False, 'shape': {shape}, }}".ljust(117) + "\n"
    stream.write(b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header.encode())
    (tmp_path / "bad.npy").write_bytes(stream.getvalue() + bytes(24))
    with pytest.raises(InputError, match="bad.npy"):
        read_cloud(tmp_path / "bad.npy")
