"""Calibration files: every accepted spelling gives one camera, every implausible one is refused by name."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import yaml

from devo.errors import InputError
from utils.calibration import Calibration, read_calibration

CAMERA = Calibration(240, 180, 200.0, 201.5, 120.25, 89.0, "radtan", (-0.3, 0.1, 0.001, -0.002))
PLAIN = {"width": 240, "height": 180, "fx": 200.0, "fy": 201.5, "cx": 120.25, "cy": 89.0, "distortion_model": "radtan",
         "distortion_coefficients": [-0.3, 0.1, 0.001, -0.002]}
K_ROWS = [[200.0, 0, 120.25], [0, 201.5, 89.0], [0, 0, 1]]
K_FLAT = [value for row in K_ROWS for value in row]


def variant(drop: str = "", **changes: object) -> dict[str, object]:
    return {**{key: value for key, value in PLAIN.items() if key not in drop.split()}, **changes}


@pytest.mark.parametrize("suffix", [".yaml", ".yml", ".json"])
@pytest.mark.parametrize("fields", [
    PLAIN,
    variant("fx fy cx cy", intrinsics=[200.0, 201.5, 120.25, 89.0]),
    variant("fx fy cx cy", camera_matrix=K_ROWS),
    variant("fx fy cx cy", camera_matrix=K_FLAT),
    variant("fx fy cx cy", camera_matrix=[200.0, 201.5, 120.25, 89.0]),
    variant("width height", resolution=[240, 180]),
    variant("distortion_model", distortion_model="plumb_bob"),
    variant("width height fx fy cx cy distortion_coefficients", image_width=240, image_height=180,  # ROS camera_info
            camera_matrix={"rows": 3, "cols": 3, "data": K_FLAT}, distortion_model="plumb_bob",
            distortion_coefficients={"rows": 1, "cols": 4, "data": [-0.3, 0.1, 0.001, -0.002]}),
    {"cam0": {"camera_model": "pinhole", "intrinsics": [200.0, 201.5, 120.25, 89.0], "distortion_model": "radtan",
              "distortion_coeffs": [-0.3, 0.1, 0.001, -0.002], "resolution": [240, 180]},  # Kalibr camchain
     "cam1": {"intrinsics": [1, 1, 1, 1]}},
])
def test_spellings_of_one_camera(fields: dict[str, object], suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"calib{suffix}"
    path.write_text(json.dumps(fields) if suffix == ".json" else yaml.safe_dump(fields))
    assert read_calibration(path) == CAMERA


def test_own_spelling_round_trips(tmp_path: Path) -> None:
    fisheye = Calibration(346, 260, 173.0, 173.5, 163.3, 135.0, "fisheye", (-0.03, 0.001, -0.005, 0.001))
    for camera in (CAMERA, fisheye, Calibration(10, 10, 5, 5, 4, 4)):
        (tmp_path / "calib.yaml").write_text(yaml.safe_dump(camera.as_dict()))
        assert read_calibration(tmp_path / "calib.yaml") == camera


def test_opencv_yaml_is_read(tmp_path: Path) -> None:
    (tmp_path / "calib.yaml").write_text(
        "%YAML:1.0\n---\nimage_width: 240\nimage_height: 180\n"
        "camera_matrix: !!opencv-matrix\n   rows: 3\n   cols: 3\n   dt: d\n"
        "   data: [ 200., 0., 120.25, 0., 201.5, 89., 0., 0., 1. ]\n"
        "distortion_model: radtan\n"
        "distortion_coefficients: !!opencv-matrix\n   rows: 1\n   cols: 4\n   dt: d\n"
        "   data: [ -0.3, 0.1, 0.001, -0.002 ]\n")
    assert read_calibration(tmp_path / "calib.yaml") == CAMERA


@pytest.mark.parametrize(("line", "model", "coefficients"), [
    ("200 201.5 120.25 89", "none", ()),
    ("200 201.5 120.25 89 -0.3 0.1 0.001 -0.002\n", "radtan", (-0.3, 0.1, 0.001, -0.002)),
    ("# a camera\n200 201.5 120.25 89 -0.3 0.1 0.001 -0.002 0.5 # k3 too\n", "radtan", (-0.3, 0.1, 0.001, -0.002, 0.5)),
])
def test_one_line_of_text(line: str, model: str, coefficients: tuple[float, ...], tmp_path: Path) -> None:
    (tmp_path / "calib.txt").write_text(line)
    camera = read_calibration(tmp_path / "calib.txt", (240, 180))
    assert camera.intrinsics.tolist() == [200, 201.5, 120.25, 89]
    assert (camera.distortion_model, camera.coefficients) == (model, coefficients)


def test_where_the_size_comes_from(tmp_path: Path) -> None:
    (tmp_path / "calib.txt").write_text("200 201.5 120.25 89")
    (tmp_path / "calib.json").write_text(json.dumps(PLAIN))
    assert read_calibration(tmp_path / "calib.txt", None, (240, 180)).width == 240
    assert read_calibration(tmp_path / "calib.txt", (300, 200), (240, 180)).width == 300
    assert read_calibration(tmp_path / "calib.json", None, (300, 200)).width == 240
    with pytest.raises(InputError, match="made for 240x180 pixels, but the image size was given as 300x200"):
        read_calibration(tmp_path / "calib.json", (300, 200))
    with pytest.raises(InputError, match=r"calib.txt: .*sensor size is not in the file; pass the image size"):
        read_calibration(tmp_path / "calib.txt")


@pytest.mark.parametrize(("fields", "message"), [
    (variant(fx=0.0), "focal length is fx=0"), (variant(fy=-3.0), "expected positive pixels"),
    (variant(fx=float("nan")), "fx is nan"), (variant(cy=float("inf")), "cy is inf"),
    (variant(cx=240.0), r"principal point \(240, 89\) lies outside the image of 240x180"),
    (variant(cy=-1.0), "principal point"), (variant(width=0), "width is 0"), (variant(height=-5), "height is -5"),
    (variant(width=240.5), "expected whole numbers"), (variant("height"), "image size"),
    (variant("fx"), "no intrinsics, found the keys cx, cy, dist"),
    (variant("fx fy cx cy", intrinsics=[1, 2, 3]), "3 intrinsics"),
    (variant("fx fy cx cy", camera_matrix=[1, 2, 3, 4, 5, 6, 7, 8, 9]), "not of the form"),
    (variant("fx fy cx cy", intrinsics="many"), "expected numbers"),
    (variant("distortion_model"), "coefficients without distortion_model"),
    (variant(distortion_model="rational"), "distortion model is 'rational'"),
    (variant(distortion_coefficients=[1, 2, 3]), "3 coefficients for the model radtan, expected 4 or 5"),
    (variant(distortion_model="fisheye", distortion_coefficients=[0] * 5), "5 coefficients for the model fisheye"),
    (variant(distortion_model="none"), "4 coefficients for the model none"),
    (variant(distortion_coefficients=[0.1, 0.1, float("nan"), 0]), "expected finite numbers"),
])
def test_cameras_that_cannot_be(fields: dict[str, object], message: str, tmp_path: Path) -> None:
    path = tmp_path / "calib.yaml"
    path.write_text(yaml.safe_dump(fields))
    with pytest.raises(InputError, match=message) as caught:
        read_calibration(path)
    assert str(caught.value).startswith(str(path))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(("name", "content", "message"), [
    ("calib.txt", b"", "0 numbers, expected 4, 8 or 9"), ("calib.txt", b"1 2 3 4 5", "5 numbers"),
    ("calib.txt", b"fx 200", "expected numbers"), ("calib.txt", b"\xff\xfe\x00", "expected numbers"),
    ("calib.yaml", b"", "found NoneType"), ("calib.yaml", b"- 1\n- 2\n", "found list"),
    ("calib.yaml", b"a: [1, 2", "not valid yaml"), ("calib.yaml", b"\xff\xfe\x80", "not a text file"),
    ("calib.yaml", b"!!python/object/apply:os.system ['true']", "not valid yaml"),
    ("calib.json", b"{", "not valid json"), ("calib.json", b"5", "found int"),
])
def test_files_that_are_no_calibration(name: str, content: bytes, message: str, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match=message) as caught:
        read_calibration(tmp_path / name, (240, 180))
    assert "\n" not in str(caught.value)


def test_missing_file(tmp_path: Path) -> None:
    for name in ("calib.yaml", "calib.txt"):
        with pytest.raises(InputError, match="cannot read calibration"):
            read_calibration(tmp_path / name)


def test_matrix_and_flags() -> None:
    assert CAMERA.camera_matrix.tolist() == K_ROWS
    assert CAMERA.is_distorted
    assert not Calibration(10, 10, 5, 5, 4, 4, "radtan", (0, 0, 0, 0)).is_distorted
    assert Calibration(10, 10, 5, 5, 4, 4, "fisheye", (0, 0, 0, 0)).is_distorted
    with pytest.raises(InputError, match="width is 240.0"):
        Calibration(240.0, 180, 1, 1, 1, 1)  # type: ignore[arg-type]
    with pytest.raises(InputError, match="distortion model is 'kb8'"):
        Calibration(240, 180, 1, 1, 1, 1, "kb8")  # type: ignore[arg-type]
