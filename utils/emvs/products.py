"""Files and pictures of an EMVS map."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from devo.errors import OutputError
from utils.atomic import atomic_path
from utils.clouds.cloud import PointCloud
from utils.clouds.io import write_cloud
from utils.emvs.depth_map import DepthMap, to_bytes
from utils.emvs.mapper import EmvsMap, View

CLOUD_SUFFIXES = (".ply", ".npy", ".npz", ".pcd")


def base_path(out: str | os.PathLike[str]) -> Path:
    """The common beginning of all names: `out` without the ending of a cloud file, if it has one."""
    path = Path(out)
    return path.with_suffix("") if path.suffix.lower() in CLOUD_SUFFIXES else path


def write_products(base: Path, result: EmvsMap, meta: dict[str, Any], *, pictures: bool = True,
                   dsi: bool = False) -> list[Path]:
    """Write everything that belongs to a map; names begin with `base`.

    `.ply` and `.npy`: world cloud; `_camera.ply` and `_camera.pcd`: the same in the frame of the reference view (one
    view only; the PCD is ASCII `x y z intensity`, intensity = 1 / depth, as other EMVS programs write it);
    `_depth.npy`, `_confidence.npy`, `_mask.npy`; with pictures `_depth.png` (colour, white = no depth),
    `_depth_gray.png`, `_confidence.png`, `_mask.png` and `_overview.png`; `_dsi.npy` on request; `_meta.json`. With
    several views the files of view k are called `_view000_...`.

    Returns:
        What was written.

    Raises:
        OutputError: a file cannot be written.
    """
    written = [_write_cloud(Path(f"{base}.ply"), result.cloud), _write_cloud(Path(f"{base}.npy"), result.cloud)]
    for number, view in enumerate(result.views):
        stem = str(base) if len(result.views) == 1 else f"{base}_view{number:03d}"
        written += _write_view(stem, view, pictures, dsi)
    if len(result.views) == 1:
        written += _write_camera_clouds(base, result.views[0].cloud)
    target = Path(f"{base}_meta.json")
    meta = {**meta, "files": [path.name for path in written]}
    with atomic_path(target) as temporary:
        temporary.write_text(json.dumps(meta, indent=1) + "\n", "utf-8")
    return [*written, target]


def _write_cloud(path: Path, cloud: PointCloud, text: bool = False) -> Path:
    write_cloud(path, cloud, text=text)
    return path


def _write_camera_clouds(base: Path, cloud: PointCloud) -> list[Path]:
    plain = PointCloud(cloud.points, scalars={"intensity": cloud.scalars["intensity"]})
    return [_write_cloud(Path(f"{base}_camera.ply"), cloud),
            _write_cloud(Path(f"{base}_camera.pcd"), plain, text=True)]


def _write_view(stem: str, view: View, pictures: bool, dsi: bool) -> list[Path]:
    found = view.depth_map
    arrays: dict[str, np.ndarray] = {"depth": found.depth, "confidence": found.confidence, "mask": found.mask}
    if dsi and view.dsi is not None:
        arrays["dsi"] = view.dsi.numpy()
    written = []
    for name, array in arrays.items():
        written.append(Path(f"{stem}_{name}.npy"))
        with atomic_path(written[-1]) as temporary, temporary.open("wb") as file:
            np.lib.format.write_array(file, np.ascontiguousarray(array), allow_pickle=False)
    if not pictures:
        return written
    for name, image in (("depth", depth_picture(found)), ("depth_gray", _gray(found.depth)),
                        ("confidence", to_bytes(found.confidence)), ("mask", found.mask.astype(np.uint8) * 255)):
        written.append(Path(f"{stem}_{name}.png"))
        _write_png(written[-1], image)
    written.append(Path(f"{stem}_overview.png"))
    write_overview(written[-1], view)
    return written


def depth_picture(found: DepthMap) -> npt.NDArray[np.uint8]:
    """`(H, W, 3)` uint8 BGR: rainbow from red (near) to violet (far), white where no depth is believed."""
    colored = cv2.applyColorMap(_gray(found.depth, found.mask), cv2.COLORMAP_RAINBOW)
    colored[~found.mask] = 255
    return colored.astype(np.uint8)


def _gray(depth: npt.NDArray[np.float32], mask: npt.NDArray[np.bool_] | None = None) -> npt.NDArray[np.uint8]:
    """Depth from the least to the largest one (of the mask, if there is any) as 0..255."""
    values = depth[mask] if mask is not None and mask.any() else depth
    return to_bytes(np.clip(depth, values.min(), values.max()))


def _write_png(path: Path, image: npt.NDArray[np.uint8]) -> None:
    done, data = cv2.imencode(".png", image)
    if not done:
        raise OutputError(f"cannot encode {path} as PNG")
    with atomic_path(path) as temporary:
        temporary.write_bytes(data.tobytes())


def write_overview(path: Path, view: View) -> None:
    """Draw confidence, depth map with its scale, and the cloud from above in one PNG.

    Raises:
        OutputError: the file cannot be written.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    found, points = view.depth_map, view.cloud.points
    figure = Figure(figsize=(16, 5.2), dpi=100, layout="constrained")
    FigureCanvasAgg(figure)
    left, middle, right = figure.subplots(1, 3, width_ratios=(1.1, 1.25, 1))
    left.imshow(found.confidence, cmap="gray", vmax=float(np.percentile(found.confidence, 99.5)) or 1.0)
    left.set_title("confidence: most votes along the ray")
    shown = np.where(found.mask, found.depth, np.nan)
    limits = (view.planes.near, view.planes.far)
    if found.mask.any():
        limits = tuple(np.percentile(found.depth[found.mask], (2, 98)))
    image = middle.imshow(shown, cmap="turbo_r", vmin=limits[0], vmax=limits[1])
    middle.set_title(f"depth: {int(found.mask.sum())} pixels, unit of the poses")
    figure.colorbar(image, ax=middle, shrink=0.85)
    right.scatter(points[:, 0], points[:, 2], s=2, c=points[:, 2], cmap="turbo_r", vmin=limits[0], vmax=limits[1])
    right.plot(0, 0, "k^", markersize=8)
    right.set_title(f"{len(points)} points from above")
    right.set_xlabel("x")
    right.set_ylabel("z")
    right.set_aspect("equal", adjustable="datalim")
    right.grid(alpha=0.3)
    with atomic_path(path) as temporary:
        figure.savefig(temporary, format="png")
