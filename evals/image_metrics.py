"""What a camera sees of a cloud: projected points, depth errors against a depth map, agreement with image edges.

Poses are camera to world, `(4, 4)`; intrinsics are `fx fy cx cy` in pixels, (0, 0) is the centre of the top left
pixel. Clouds and poses share frame and unit.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from devo.errors import InputError

FloatArray = npt.NDArray[np.float64]
_CANNY_LOW, _CANNY_HIGH = 60, 150  # of 255 grey levels per pixel


@dataclass(frozen=True, eq=False)
class Projection:
    """Where the points of a cloud appear in an image.

    Attributes:
        pixel_xy: `(N, 2)` float64 column and row; NaN for points that are not in front of the camera.
        depth: `(N,)` float64 z-depth in the cloud's unit; NaN likewise.
        inside: `(N,)` bool, in front of the camera and inside the image.
    """

    pixel_xy: FloatArray
    depth: FloatArray
    inside: npt.NDArray[np.bool_]


@dataclass(frozen=True)
class DepthErrors:
    """Relative error of z-depths, |measured - true| / true, over the points that the depth map can judge.

    Attributes:
        judged: number of points that fall on a pixel with a true depth.
        total: number of points.
        median: median relative error; NaN without judged points, like all figures here.
        within_2_percent: share of judged points whose error is at most 0.02.
        bias: median of the signed error, positive = too far.
    """

    judged: int
    total: int
    median: float
    within_2_percent: float
    bias: float


@dataclass(frozen=True)
class EdgeAgreement:
    """How well the projected points lie on the edges of an image.

    Attributes:
        points: number of points inside the image.
        edge_pixels: number of edge pixels.
        mean_distance_px: mean distance of a projected point to the nearest edge pixel.
        random_distance_px: the same for a pixel chosen at random, for comparison.
        on_edge: share of points within `radius_px` of an edge.
        coverage: share of edge pixels that have a point within `radius_px`.
        radius_px: that radius.
    """

    points: int
    edge_pixels: int
    mean_distance_px: float
    random_distance_px: float
    on_edge: float
    coverage: float
    radius_px: float


def project(points: npt.ArrayLike, world_T_cam: FloatArray, intrinsics: npt.ArrayLike,
            size: tuple[int, int]) -> Projection:
    """Project world points `(N, 3)` into a pinhole camera with an image of `(width, height)` pixels.

    Raises:
        InputError: points of another shape, or values that are not finite.
    """
    world = np.asarray(points, np.float64)
    if world.ndim != 2 or world.shape[1] != 3 or not np.isfinite(world).all():
        raise InputError(f"points to project must be finite and of shape (N, 3), found shape {world.shape} with "
                         f"{int((~np.isfinite(world)).sum())} values that are not finite")
    fx, fy, cx, cy = np.asarray(intrinsics, np.float64)
    seen = (world - world_T_cam[:3, 3]) @ world_T_cam[:3, :3]
    depth = np.where(seen[:, 2] > 0, seen[:, 2], np.nan)
    pixel = np.stack([fx * seen[:, 0] / depth + cx, fy * seen[:, 1] / depth + cy], axis=1)
    with np.errstate(invalid="ignore"):
        inside = (pixel > -0.5).all(axis=1) & (pixel < np.asarray(size, np.float64) - 0.5).all(axis=1)
    return Projection(pixel, depth, np.asarray(inside, np.bool_))


def relative_depth_errors(points: npt.ArrayLike, world_T_cam: FloatArray, intrinsics: npt.ArrayLike,
                          true_depth: npt.NDArray[np.floating]) -> FloatArray:
    """Signed relative depth error of each point at the pixel of a depth map that it falls on.

    Args:
        points: `(N, 3)` world.
        world_T_cam: `(4, 4)` camera of the depth map.
        intrinsics: `fx fy cx cy` of the depth map.
        true_depth: `(H, W)` z-depth in the unit of the points; 0, negative or not finite = unknown.

    Returns:
        `(N,)` float64, (depth - true) / true; NaN outside the image and where the true depth is unknown.
    """
    height, width = true_depth.shape
    found = project(points, world_T_cam, intrinsics, (width, height))
    error = np.full(len(found.depth), np.nan)
    column, row = np.rint(found.pixel_xy[found.inside]).astype(np.int64).T
    truth = true_depth[row, column].astype(np.float64)
    truth = np.where(np.isfinite(truth) & (truth > 0), truth, np.nan)
    error[found.inside] = found.depth[found.inside] / truth - 1.0
    return error


def summarise_depth_errors(errors: FloatArray) -> DepthErrors:
    """Figures of the signed relative errors of `relative_depth_errors`, NaN = not judged."""
    known = errors[np.isfinite(errors)]
    if not len(known):
        return DepthErrors(0, len(errors), float("nan"), float("nan"), float("nan"))
    return DepthErrors(len(known), len(errors), float(np.median(np.abs(known))),
                       float((np.abs(known) <= 0.02).mean()), float(np.median(known)))


def canny_edges(image: npt.NDArray[np.uint8]) -> npt.NDArray[np.bool_]:
    """Edge pixels of a grey or BGR image `(H, W)` or `(H, W, 3)`, by Canny's detector after a slight blur."""
    grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    return np.asarray(cv2.Canny(cv2.GaussianBlur(grey, (3, 3), 0), _CANNY_LOW, _CANNY_HIGH)) > 0


def edge_agreement(pixel_xy: npt.ArrayLike, edges: npt.NDArray[np.bool_], radius_px: float = 2.0) -> EdgeAgreement:
    """Compare projected points with the edges of an image.

    Args:
        pixel_xy: `(N, 2)` column and row of points inside the image.
        edges: `(H, W)` bool.
        radius_px: how near counts as on the edge.

    Raises:
        InputError: no edge pixel, no point, or points outside the image.
    """
    pixel = np.rint(np.asarray(pixel_xy, np.float64)).astype(np.int64)
    if not edges.any() or not len(pixel):
        raise InputError(f"cannot compare {len(pixel)} projected points with {int(edges.sum())} edge pixels: at least "
                         "one of each is needed; check the pose of the image and the calibration")
    height, width = edges.shape
    column, row = pixel.T
    if column.min() < 0 or row.min() < 0 or column.max() >= width or row.max() >= height:
        raise InputError(f"some projected points lie outside the image of {width}x{height} pixels; pass only those "
                         "that `project` found inside")
    occupied = np.zeros(edges.shape, bool)
    occupied[row, column] = True
    to_edge, to_point = _distance_to(edges), _distance_to(occupied)
    return EdgeAgreement(
        points=len(pixel), edge_pixels=int(edges.sum()), mean_distance_px=float(to_edge[row, column].mean()),
        random_distance_px=float(to_edge.mean()), on_edge=float((to_edge[row, column] <= radius_px).mean()),
        coverage=float((to_point[edges] <= radius_px).mean()), radius_px=radius_px)


def _distance_to(pixels: npt.NDArray[np.bool_]) -> npt.NDArray[np.float32]:
    """`(H, W)` Euclidean distance of every pixel to the nearest True one."""
    return np.asarray(cv2.distanceTransform((~pixels).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE))
