"""Rectification against published cameras, OpenCV's own projection and rendered images."""

from __future__ import annotations

from pathlib import Path

import cv2
import h5py
import numpy as np
import pytest

from devo.errors import InputError
from tests.tolerances import (
    RECTIFIED_INTRINSICS,
    RECTIFY_MAP_SAMPLES,
    RECTIFY_ROUND_TRIP_FISHEYE,
    RECTIFY_ROUND_TRIP_RADTAN,
)
from utils.calibration import Calibration
from utils.undistort import read_rectify_map, rectify_map, undistort_image, undistorted_intrinsics, write_rectify_map

CAMERAS = {
    "eds": Calibration(640, 480, 560.8520948927032, 560.6295819972383, 313.00733235019237, 217.32858679842997, "radtan",
                       (-0.09776467241921379, 0.2143738428636279, -0.004710710105172864, -0.004215916089401789)),
    "rpg": Calibration(240, 180, 196.63936292910697, 196.7329768429481, 105.06412666477927, 72.47170071387173, "radtan",
                       (-0.3367326394292646, 0.11178850939644308, -0.0014005281258491276, -0.00045959441440687044)),
    "hku": Calibration(346, 260, 249.69341447817564, 248.41625664694038, 176.74240257052816, 129.47631010746218,
                       "radtan",
                       (-0.3794794654640921, 0.15393049046270296, 0.0011400586965363895, -0.0019042695753031854)),
    "fpv": Calibration(346, 260, 173.07989681517137, 173.0734479068749, 163.31033691005516, 134.99889292308214,
                       "fisheye",
                       (-0.03252275347038443, 0.0010042799356776398, -0.0048537750326187136, 0.0014604134198771906)),
}
# (intrinsics of OpenCV < 4.8, intrinsics of OpenCV >= 4.8.1, samples of the map for the former: corners and centre)
PUBLISHED = {
    "eds": ((562.94122314, 563.57000732, 310.53467429, 215.59711647),
            (563.65523732, 564.69866054, 310.98424167, 216.02888940),
            ((-0.1564, -0.0005), (638.1347, 479.3723), (317.5623, 238.4072))),
    "rpg": ((166.34863281, 177.93533325, 99.31820520, 68.86377292),
            (167.38830677, 179.24263322, 99.94250301, 69.36924166),
            ((-6.2774, -8.8748), (251.3994, 198.5255), (112.0174, 84.7998))),
    "hku": ((200.00666809, 219.36967468, 176.22083232, 129.21104981),
            (200.82175742, 220.43605967, 176.94063180, 129.84157393),
            ((-7.2694, -19.9257), (353.1740, 278.4498), (173.2231, 129.6735))),
    "fpv": ((135.29828152, 135.29324034, 151.01137890, 137.39011467),
            (135.29799493, 135.29295377, 151.01224477, 137.39037438),
            ((-237.7574, -183.9818), (695.9282, 509.2896), (158.5969, 133.4768))),
}


def project(camera: Calibration, positions: np.ndarray, intrinsics: np.ndarray) -> np.ndarray:
    """Where OpenCV's lens model sees the rays through undistorted positions (N, 2)."""
    rays = np.column_stack([(positions - intrinsics[2:]) / intrinsics[:2], np.ones(len(positions))])
    K, D, zero = camera.camera_matrix, np.array(camera.coefficients), np.zeros(3)
    if camera.distortion_model == "fisheye":
        return cv2.fisheye.projectPoints(rays[:, None], zero, zero, K, D)[0].reshape(-1, 2)
    return cv2.projectPoints(rays, zero, zero, K, D if camera.coefficients else None)[0].reshape(-1, 2)


@pytest.mark.parametrize("name", CAMERAS)
def test_intrinsics_are_the_published_ones(name: str) -> None:
    assert np.abs(undistorted_intrinsics(CAMERAS[name]) - PUBLISHED[name][1]).max() < RECTIFIED_INTRINSICS


@pytest.mark.parametrize("name", CAMERAS)
def test_map_samples_are_the_published_ones(name: str) -> None:
    positions, used = rectify_map(CAMERAS[name], intrinsics=PUBLISHED[name][0])
    height, width = positions.shape[:2]
    found = [positions[0, 0], positions[height - 1, width - 1], positions[height // 2, width // 2]]
    assert positions.dtype == np.float32
    assert used.tolist() == list(PUBLISHED[name][0])
    assert np.abs(np.array(found) - PUBLISHED[name][2]).max() < RECTIFY_MAP_SAMPLES


@pytest.mark.parametrize(("name", "options"), [*((name, {}) for name in CAMERAS), ("rpg", {"alpha": 1.0}),
                                               ("fpv", {"balance": 0.5}), ("fpv", {"balance": 1.0})])
def test_projecting_the_map_gives_the_raw_pixels_back(name: str, options: dict[str, float]) -> None:
    camera = CAMERAS[name]
    positions, intrinsics = rectify_map(camera, **options)
    rows, columns = np.mgrid[:camera.height, :camera.width]
    raw = np.stack([columns, rows], axis=-1).reshape(-1, 2)
    error = np.abs(project(camera, positions.reshape(-1, 2).astype(np.float64), intrinsics) - raw).max()
    limit = RECTIFY_ROUND_TRIP_FISHEYE if camera.distortion_model == "fisheye" else RECTIFY_ROUND_TRIP_RADTAN
    assert error < limit


@pytest.mark.parametrize("model", ["none", "radtan"])
def test_camera_without_distortion_is_left_alone(model: str) -> None:
    camera = Calibration(20, 10, 15.0, 16.0, 9.0, 4.5, model, (0.0,) * 4 if model == "radtan" else ())  # type: ignore[arg-type]
    positions, intrinsics = rectify_map(camera)
    rows, columns = np.mgrid[:10, :20]
    assert np.array_equal(intrinsics, camera.intrinsics)
    assert np.abs(positions - np.stack([columns, rows], axis=-1)).max() < 1e-5
    moved, _ = rectify_map(camera, intrinsics=camera.intrinsics * 2)
    assert np.abs(moved - 2 * positions).max() < 1e-5


@pytest.mark.parametrize("name", ["rpg", "fpv"])
def test_images_and_events_are_rectified_alike(name: str) -> None:
    """A bright blob at a raw pixel appears in the undistorted image where the map sends events of that pixel."""
    camera = CAMERAS[name]
    positions, intrinsics = rectify_map(camera)
    rows, columns = np.mgrid[:camera.height, :camera.width]
    for x, y in ((100, 60), (150, 110), (60, 120)):
        blob = 250 * np.exp(-((columns - x) ** 2 + (rows - y) ** 2) / 18)
        image = undistort_image(blob.astype(np.uint8), camera, intrinsics).astype(float)
        peak = np.array([(image * columns).sum(), (image * rows).sum()]) / image.sum()
        assert np.abs(peak - positions[y, x]).max() < 0.5


def test_image_of_another_size_is_refused() -> None:
    with pytest.raises(InputError, match="image of 30x20 pixels, but the calibration is for 240x180"):
        undistort_image(np.zeros((20, 30), np.uint8), CAMERAS["rpg"], CAMERAS["rpg"].intrinsics)


@pytest.mark.parametrize(("model", "coefficients", "message"), [
    ("radtan", (-2.0, 0.0, 0.0, 0.0), r"cannot be undone for \d+% of the pixels"),
    ("radtan", (0.0, 0.0, 0.5, 0.5), "cannot be undone"),
    ("fisheye", (-1.0, 0.5, -3.0, 2.0), "cannot be undone"),
])
def test_distortion_that_cannot_be_undone(model: str, coefficients: tuple[float, ...], message: str) -> None:
    with pytest.raises(InputError, match=message):
        rectify_map(Calibration(240, 180, 200, 200, 120, 90, model, coefficients))  # type: ignore[arg-type]


def test_map_files(tmp_path: Path) -> None:
    positions = np.random.default_rng(0).normal(size=(6, 8, 2)).astype(np.float32)
    write_rectify_map(tmp_path / "rectify_map.h5", positions)
    with h5py.File(tmp_path / "rectify_map.h5") as stream:
        assert list(stream) == ["rectify_map"]
        assert (stream["rectify_map"].dtype.str, stream["rectify_map"].compression) == ("<f4", None)
        assert np.array_equal(stream["rectify_map"][:], positions)
    assert np.array_equal(read_rectify_map(tmp_path / "rectify_map.h5", (8, 6)), positions)
    with pytest.raises(InputError, match="map is for 8x6 pixels, the sensor has 6x8"):
        read_rectify_map(tmp_path / "rectify_map.h5", (6, 8))
    with pytest.raises(InputError, match=r"expected \(H, W, 2\)"):
        write_rectify_map(tmp_path / "other.h5", positions[0])


def test_damaged_map_files(tmp_path: Path) -> None:
    write_rectify_map(tmp_path / "map.h5", np.zeros((6, 8, 2)))
    whole = (tmp_path / "map.h5").read_bytes()
    for length in range(0, len(whole) - 1, 64):
        (tmp_path / "cut.h5").write_bytes(whole[:length])
        with pytest.raises(InputError, match="cut.h5"):
            read_rectify_map(tmp_path / "cut.h5")
    with h5py.File(tmp_path / "other.h5", "w") as stream:
        stream["map"] = np.zeros(3)
    with pytest.raises(InputError, match="dataset rectify_map missing, found map"):
        read_rectify_map(tmp_path / "other.h5")
    with h5py.File(tmp_path / "shape.h5", "w") as stream:
        stream["rectify_map"] = np.zeros((3, 2))
    with pytest.raises(InputError, match=r"expected float \(H, W, 2\)"):
        read_rectify_map(tmp_path / "shape.h5")
