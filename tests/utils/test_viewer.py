"""The page: data survive, nothing is loaded from elsewhere, and a real browser draws it, with and without WebGL."""

from __future__ import annotations

import base64
import json
import re
import shutil
import subprocess
from collections.abc import Callable
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from devo.errors import InputError, OutputError
from utils.clouds.cloud import PointCloud
from utils.plots.scene import FRUSTUM_EDGES, Scene
from utils.viewer.page import save_page
from utils.viewer.window import geometries, has_display, point_colors

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "chrome")
WIDTH, HEIGHT = 1000, 640


def scene(count: int = 3000, **options: Any) -> Scene:
    rng = np.random.default_rng(1)
    points = np.c_[rng.uniform(-1, 1, (count, 2)), 3 + rng.normal(0, 0.05, count)].astype(np.float32)
    angle = np.linspace(0, 2 * np.pi, 40)
    poses = np.c_[0.4 * np.sin(angle), 0.2 * np.cos(angle), 0 * angle, np.tile([0, 0, 0, 1.0], (40, 1))]
    scalars = {"t_us": np.linspace(0, 39e4, count), "observations": np.arange(count) % 9,
               "weight": np.where(np.arange(count) % 5, 0.5, np.nan)}
    colors = rng.integers(0, 255, (count, 3)).astype(np.uint8)
    return Scene.build(PointCloud(points, colors, scalars), poses, show_outside=True, **options)


STAMPS = np.arange(40) * 1e4


def read_data(path: Path) -> dict[str, Any]:
    found = re.search(r"const DATA = (.*);</script>", path.read_text("utf-8"))
    assert found is not None
    return json.loads(found[1])


def decode(text: str, kind: str) -> np.ndarray:
    return np.frombuffer(base64.b64decode(text), kind)


# --- what is in the file --------------------------------------------------------------------------------------


def test_points_path_and_values_survive(tmp_path: Path) -> None:
    shown = scene()
    save_page(tmp_path / "v.html", shown, title="run", t_us=STAMPS)
    data = read_data(tmp_path / "v.html")
    np.testing.assert_array_equal(decode(data["points"], "<f4").reshape(-1, 3), shown.cloud.points)
    np.testing.assert_allclose(decode(data["path"], "<f4").reshape(-1, 3), shown.poses[:, :3], atol=1e-7)
    np.testing.assert_array_equal(decode(data["colors"], "u1").reshape(-1, 3), shown.cloud.colors)
    assert decode(data["frusta"], "<f4").size == 24 * len(FRUSTUM_EDGES) * 2 * 3
    entries = {entry["name"]: entry for entry in data["colorings"]}
    assert set(entries) == {"depth", "height", "time", "intensity", "rgb", "observations", "weight"}
    depth = entries["depth"]
    levels = decode(depth["levels"], "u1") / 254 * (depth["high"] - depth["low"]) + depth["low"]
    inside = (shown.points[:, 2] > depth["low"]) & (shown.points[:, 2] < depth["high"])
    np.testing.assert_allclose(levels[inside], shown.points[inside, 2], atol=(depth["high"] - depth["low"]) / 500)
    assert (decode(entries["weight"]["levels"], "u1")[::5] == 255).all()
    birth = decode(data["frames"]["birth"], "<u4")
    assert birth[0] == 0 and birth[-1] == 39 and (np.diff(birth.astype(int)) >= 0).all()
    np.testing.assert_allclose(decode(data["frames"]["seconds"], "<f4"), STAMPS * 1e-6, rtol=1e-6)
    assert "monocular: arbitrary scale" in data["notes"]


def test_same_input_same_bytes(tmp_path: Path) -> None:
    for name in "ab":
        save_page(tmp_path / f"{name}.html", scene(), t_us=STAMPS)
    assert (tmp_path / "a.html").read_bytes() == (tmp_path / "b.html").read_bytes()


class _Links(HTMLParser):
    def __init__(self) -> None:
        super().__init__()
        self.links: list[str] = []
        self.scripts = 0

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.scripts += tag == "script"
        self.links += [str(value) for name, value in attrs if name in ("src", "href", "data", "action")]


def test_the_page_needs_nothing_else_and_titles_cannot_break_out(tmp_path: Path) -> None:
    save_page(tmp_path / "v.html", scene(), title="</script><script>alert(1)</script> /*SCRIPT*/")
    text = (tmp_path / "v.html").read_text("utf-8")
    parser = _Links()
    parser.feed(text)
    assert parser.links == [] and parser.scripts == 2
    assert "alert(1)</script>" not in text
    assert not re.search(r"https?://|//cdn|fetch\(|XMLHttpRequest|import\(", text)
    assert "default-src 'none'" in text
    assert read_data(tmp_path / "v.html")["title"].startswith("</script>")


@pytest.mark.parametrize(("points", "poses"), [
    (np.empty((0, 3)), np.empty((0, 7))), (np.ones((1, 3)), np.empty((0, 7))),
    (np.full((4, 3), np.nan), np.array([[0, 0, 0, 0, 0, 0, 1.0]]))], ids=["nothing", "one-point", "nan"])
def test_degenerate_scenes(tmp_path: Path, points: np.ndarray, poses: np.ndarray) -> None:
    save_page(tmp_path / "v.html", Scene.build(PointCloud(points), poses, show_outside=True))
    text = (tmp_path / "v.html").read_text("utf-8")
    assert read_data(tmp_path / "v.html")["count"] == np.isfinite(points).all(axis=1).sum()
    assert "NaN" not in text.split("const DATA = ")[1].split(";</script>")[0]


def test_what_cannot_be_written(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="40 poses need 40 stamps"):
        save_page(tmp_path / "v.html", scene(), t_us=STAMPS[:5])
    with pytest.raises(OutputError):
        save_page("/proc/devo-test/v.html", scene())
    assert not list(tmp_path.iterdir())


# --- in a browser ---------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def browser() -> str:
    found = next((path for name in BROWSERS if (path := shutil.which(name))), None)
    if found is None:
        pytest.skip(f"no browser found, looked for {', '.join(BROWSERS)} (apt-get install chromium)")
    return found


def screenshot(browser: str, page: Path, target: Path, suffix: str = "") -> tuple[np.ndarray, str]:
    """Pixels of the page as drawn, and the page's own word on what drew it."""
    from PIL import Image

    common = [browser, "--headless=new", "--no-sandbox", "--hide-scrollbars", "--enable-unsafe-swiftshader",
              "--disable-extensions", "--no-first-run", f"--user-data-dir={target.parent / 'profile'}",
              f"--window-size={WIDTH},{HEIGHT}", "--virtual-time-budget=3000"]
    address = page.resolve().as_uri() + suffix
    done = subprocess.run([*common, f"--screenshot={target}", address], capture_output=True, text=True, timeout=180)
    assert target.is_file(), done.stderr[-2000:]
    with Image.open(target) as image:
        return np.asarray(image.convert("RGB"), dtype=np.int64), done.stderr


def colored(pixels: np.ndarray) -> int:
    """Pixels of the palette of the points (blue to yellow), not those of path, panel and texts."""
    red, green, blue = np.moveaxis(pixels, 2, 0)
    return int(((green > red + 25) & (green > 90) | ((blue > red + 30) & (blue > 90))).sum())


@pytest.mark.parametrize("renderer", ["webgl", "canvas"])
def test_a_browser_draws_the_points(
    browser: str, tmp_path: Path, renderer: str, record_property: Callable[[str, object], None]
) -> None:
    suffix = "#canvas" if renderer == "canvas" else ""
    save_page(tmp_path / "full.html", scene(), title="board", t_us=STAMPS)
    full, errors = screenshot(browser, tmp_path / "full.html", tmp_path / f"{renderer}.png", suffix)
    record_property("screenshot", str(tmp_path / f"{renderer}.png"))
    assert "Uncaught" not in errors, errors[-2000:]
    assert full.shape == (HEIGHT, WIDTH, 3)
    middle = full[120:520, 200:750]  # no panel, legend or axes here
    assert colored(middle) > 3000, "the points are missing"
    assert len(np.unique((middle // 16).reshape(-1, 3), axis=0)) > 60, "the points have too few colours"
    red = (full[..., 0] > 150) & (full[..., 1] < 140) & (full[..., 2] < 130)
    assert red[120:560, 100:780].sum() > 150, "the camera path is missing"


# --- in a window ----------------------------------------------------------------------------------------------


def test_shapes_of_the_window() -> None:
    pytest.importorskip("open3d", reason="the window needs Open3D")
    shown = scene()
    cloud, path, cameras, first = geometries(shown)
    np.testing.assert_allclose(np.asarray(cloud.points), shown.points)
    np.testing.assert_allclose(np.asarray(cloud.colors), point_colors(shown))
    assert len(np.asarray(path.lines)) == 39 and len(np.asarray(cameras.points)) == 14 * 5
    np.testing.assert_allclose(np.asarray(first.points), shown.frusta(1)[0])
    np.testing.assert_allclose(point_colors(scene(color_by="rgb")), shown.cloud.colors / 255)
    assert (point_colors(scene(color_by="none")) == point_colors(scene(color_by="none"))[0]).all()


def test_displays_are_found_by_the_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.platform", "linux")
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    assert not has_display()
    monkeypatch.setenv("DISPLAY", ":0")
    assert has_display()
