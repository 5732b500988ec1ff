"""The preview picture: it is drawn for any cloud, is not mirrored, and far points do not shrink the scene."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from devo.errors import InputError, OutputError
from utils.clouds.cloud import PointCloud
from utils.clouds.preview import save_preview
from utils.plots.draw import project, view_axes
from utils.plots.scene import Scene, place_pyramids


def _scene(outliers: int = 0) -> tuple[PointCloud, np.ndarray]:
    rng = np.random.default_rng(0)
    board = np.c_[rng.uniform(-1, 1, (3000, 2)), 2 + 0.02 * rng.normal(size=3000)]
    far = rng.normal(size=(outliers, 3)) * 1e4
    angle = np.linspace(0, 2 * np.pi, 50)
    poses = np.c_[0.3 * np.sin(angle), 0.1 * np.cos(angle), 0 * angle, np.tile([0, 0, 0, 1.0], (50, 1))]
    return PointCloud(np.vstack([board, far])), poses


def _pixels(path: Path) -> np.ndarray:
    from PIL import Image

    with Image.open(path) as image:
        assert image.format == "PNG"
        return np.asarray(image.convert("RGB"), dtype=np.int64)


def _inked(pixels: np.ndarray) -> int:
    """Pixels of saturated colour: points and path, not the gray axes and texts."""
    return int((pixels.max(axis=2) - pixels.min(axis=2) > 60).sum())


def test_a_picture_with_content(tmp_path: Path) -> None:
    cloud, poses = _scene()
    save_preview(tmp_path / "p.png", cloud, poses, title="$board_slow")
    pixels = _pixels(tmp_path / "p.png")
    assert pixels.shape == (1080, 1920, 3)
    save_preview(tmp_path / "e.png", PointCloud(np.empty((0, 3))), poses)
    assert _inked(pixels) > _inked(_pixels(tmp_path / "e.png")) + 5_000
    assert [entry.name for entry in sorted(tmp_path.iterdir())] == ["e.png", "p.png"]


def test_same_input_same_bytes(tmp_path: Path) -> None:
    for name in "ab":
        save_preview(tmp_path / f"{name}.png", *_scene())
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()


@pytest.mark.parametrize("outliers", [1, 30, 500])
def test_far_points_do_not_shrink_the_view(outliers: int) -> None:
    clean, spoilt = (Scene.build(*_scene(count)) for count in (0, outliers))
    assert (spoilt.high - spoilt.low).max() < 3.0 * (clean.high - clean.low).max()  # the far points reach 1e4
    assert spoilt.outside >= outliers


@pytest.mark.parametrize(
    ("points", "poses"),
    [
        (np.empty((0, 3)), np.empty((0, 7))),
        (np.ones((1, 3)), np.empty((0, 7))),
        (np.full((9, 3), np.nan), np.array([[0, 0, 0, 0, 0, 0, 1.0]])),
        (np.random.default_rng(0).random((50, 3)), np.array([[np.nan] * 7, [0, 0, 0, 0, 0, 0, 1.0]])),
        (np.random.default_rng(0).random((50, 3)) * [1, 1, 0], np.array([[0, 0, 0, 0, 0, 0, 0.0]] * 3)),
        (np.random.default_rng(0).random((50, 3)) * 1e-9, np.array([[0, 0, 0, 0, 0, 0, 1.0]])),
    ],
    ids=["nothing", "one-point", "nan-points", "nan-pose", "flat-zero-quaternion", "tiny"],
)
def test_degenerate_clouds(tmp_path: Path, points: np.ndarray, poses: np.ndarray) -> None:
    save_preview(tmp_path / "p.png", PointCloud(points), poses, color_by="height", unit="m")
    assert _pixels(tmp_path / "p.png").shape == (1080, 1920, 3)


def test_the_perspective_is_no_mirror_image() -> None:
    right, up, forward = view_axes()
    np.testing.assert_allclose(view_axes() @ view_axes().T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(np.cross(right, -up), forward, atol=1e-12)  # right x down = forward, as in the camera
    scene = Scene.build(*_scene())
    center = (scene.low + scene.high) / 2
    image, distance = project(center + np.array([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0], [0, 0, 0.1]]), scene)
    assert image[1, 0] > image[0, 0]  # x goes right
    assert image[2, 1] < image[0, 1]  # y goes down
    assert distance[3] > distance[0]  # z goes away


def test_frusta_use_camera_to_world() -> None:
    half = np.sqrt(0.5)
    quarter_turn_about_y = np.array([[5, 6, 7, 0, half, 0, half]])  # z of the camera becomes x of the world
    placed = place_pyramids(quarter_turn_about_y, np.array([[0, 0, 0], [0, 0, 2.0]]))
    np.testing.assert_allclose(placed, [[[5, 6, 7], [7, 6, 7]]], atol=1e-12)


def test_wrong_arguments(tmp_path: Path) -> None:
    cloud, poses = _scene()
    with pytest.raises(InputError, match=r"\(T, 7\)"):
        save_preview(tmp_path / "p.png", cloud, poses[:, :3])
    with pytest.raises(InputError, match="color_by"):
        save_preview(tmp_path / "p.png", cloud, poses, color_by="mood")
    with pytest.raises(OutputError):
        save_preview("/proc/devo-test/p.png", cloud, poses)
    assert not list(tmp_path.iterdir())


def test_pyplot_and_its_global_state_stay_away(repository: Path, tmp_path: Path) -> None:
    code = (
        "import sys, numpy as np\n"
        "from utils.clouds.preview import save_preview\n"
        "assert 'matplotlib' not in sys.modules\n"
        "from utils.clouds.cloud import PointCloud\n"
        f"save_preview({str(tmp_path / 'p.png')!r}, PointCloud(np.zeros((1, 3))), np.zeros((0, 7)))\n"
        "assert 'matplotlib.pyplot' not in sys.modules\n"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=repository, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
