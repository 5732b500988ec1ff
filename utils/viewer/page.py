"""One HTML file that shows cloud and trajectory in a browser, without network, server or libraries.

The file holds the points as base64 float32, one byte per point and colouring, the camera path, and a small viewer
(`viewer.js`) that draws with WebGL, or on a plain canvas where the browser has no WebGL.
"""

from __future__ import annotations

import base64
import html
import importlib.resources
import json
import os
from typing import Any

import numpy as np
import numpy.typing as npt

from devo.errors import InputError
from utils.atomic import atomic_path
from utils.plots.coloring import NO_COLOR, OWN_COLORS, color_cloud, colorings_of
from utils.plots.draw import color_map
from utils.plots.scene import FRUSTUM_EDGES, Scene

MOST_POINTS = 2_000_000
_MOST_FRUSTA = 24
_LEVELS = 254  # 255 marks a value that is not finite
_NOT_OFFERED = frozenset({"x", "y", "z", "pixel_x", "pixel_y", "clamped", NO_COLOR})


def save_page(path: str | os.PathLike[str], scene: Scene, *, title: str = "",
              t_us: npt.ArrayLike | None = None) -> None:
    """Write the page.

    Args:
        path: HTML file, written completely or not at all; the same input gives the same bytes.
        scene: cloud and path; its colouring is the one at the start, the page offers the others too.
        title: headline.
        t_us: `(T,)` microseconds of the scene's poses, for the time line; None numbers the frames.

    Raises:
        InputError: stamps and poses differ in number.
        OutputError: the file cannot be written.
    """
    data = _page_data(scene, title or "Trajectory and point cloud") | {"frames": _time_line(scene, t_us)}
    parts = {
        "TITLE": html.escape(data["title"]), "STYLE": _asset("page.css"),
        # "</script>" inside a string would end the script early
        "DATA": json.dumps(data, sort_keys=True, separators=(",", ":")).replace("<", "\\u003c"),
        "SCRIPT": "\n".join(_asset(name) for name in ("math.js", "renderers.js", "viewer.js")),
    }
    text = _asset("page.html")
    for name, part in parts.items():
        text = text.replace(f"/*{name}*/", part, 1)
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def _page_data(scene: Scene, title: str) -> dict[str, Any]:
    corners = scene.frusta(_MOST_FRUSTA)
    return {
        "title": title, "summary": scene.summary(), "notes": scene.describe(), "unit": scene.unit,
        "low": scene.low.tolist(), "high": scene.high.tolist(), "count": len(scene.cloud),
        "points": _base64(scene.cloud.points.astype("<f4")), "path": _base64(scene.poses[:, :3].astype("<f4")),
        "frusta": _base64(corners[:, list(FRUSTUM_EDGES)].astype("<f4")),
        "colorings": _colorings(scene), "start": scene.coloring.name,
        "palette": _base64((color_map()(np.arange(256))[:, :3] * 255).round().astype(np.uint8)),
        "colors": None if scene.cloud.colors is None else _base64(scene.cloud.colors),
    }


def _colorings(scene: Scene) -> list[dict[str, Any]]:
    """Per colouring its label, range, and one byte per point: 0..254 over the range, 255 = unknown."""
    offered = [name for name in colorings_of(scene.cloud) if name not in _NOT_OFFERED or name == scene.coloring.name]
    entries: list[dict[str, Any]] = []
    for name in offered:
        found = color_cloud(scene.cloud, name, scene.unit)
        entry: dict[str, Any] = {"name": name, "label": found.label or {OWN_COLORS: "colour of the points"}.get(
            name, "one colour"), "levels": None}
        if found.has_scale:
            low, high = found.limits
            share = np.clip((found.values - low) / (high - low), 0.0, 1.0)
            levels = np.where(np.isfinite(share), np.rint(np.nan_to_num(share) * _LEVELS), 255).astype(np.uint8)
            entry |= {"low": low, "high": high, "levels": _base64(levels)}
        entries.append(entry)
    return entries


def _time_line(scene: Scene, t_us: npt.ArrayLike | None) -> dict[str, Any]:
    """Camera corners of every frame and, where points know their time, the frame at which each point appears."""
    count = len(scene.poses)
    result: dict[str, Any] = {"count": count, "cameras": _base64(scene.frusta(count).astype("<f4"))}
    if t_us is None or not count:
        return result
    stamps = np.asarray(t_us, dtype=np.float64)
    if stamps.shape != (count,):
        raise InputError(f"{count} poses need {count} stamps, found an array of shape {stamps.shape}")
    result["seconds"] = _base64(((stamps - stamps[0]) * 1e-6).astype("<f4"))
    if "t_us" in scene.cloud.scalars:
        birth = np.searchsorted(stamps, scene.cloud.scalars["t_us"].astype(np.float64))
        result["birth"] = _base64(np.minimum(birth, count - 1).astype("<u4"))
    return result


def _base64(values: npt.NDArray[Any]) -> str:
    return base64.b64encode(np.ascontiguousarray(values).tobytes()).decode("ascii")


def _asset(name: str) -> str:
    return importlib.resources.files("utils.viewer").joinpath("assets", name).read_text(encoding="utf-8")
