"""Geometry of the reference view: virtual camera, depth planes, and how rays of events cross them.

Rebecq et al. 2018, section 5. Frames: `rv` reference view, `ev` camera at the time of an event packet.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from devo.errors import InputError
from utils.emvs.settings import DepthSpacing, EmvsSettings

FloatArray = npt.NDArray[np.float64]
_FAR_OUTSIDE = 1e4  # half image widths; small enough that positions on other planes still fit whole numbers
_LEAST_PLANE_DISTANCE = 1e-6  # of the canonical depth; a camera in the canonical plane sees it as a line


@dataclass(frozen=True)
class VirtualCamera:
    """Pinhole camera of the reference view.

    Attributes:
        width, height: pixels.
        focal: focal length of both axes in pixels.
        cx, cy: principal point in pixels; (0, 0) is the centre of the top left pixel.
    """

    width: int
    height: int
    focal: float
    cx: float
    cy: float

    @staticmethod
    def of(settings: EmvsSettings, sensor_size: tuple[int, int], intrinsics: npt.ArrayLike) -> VirtualCamera:
        """The reference camera for a sensor `(width, height)` with undistorted intrinsics `fx fy cx cy`."""
        width, height = settings.dimX or sensor_size[0], settings.dimY or sensor_size[1]
        focal = float(np.asarray(intrinsics, np.float64)[0])
        if settings.fov_deg >= 10:
            focal = 0.5 * width / math.tan(math.radians(settings.fov_deg) / 2)
        return VirtualCamera(width, height, focal, width / 2, height / 2)

    def points(self, columns: FloatArray, rows: FloatArray, depth: FloatArray) -> FloatArray:
        """`(N, 3)` float64 points in the camera frame of pixels and their z-depths, all `(N,)`."""
        x, y = (columns - self.cx) / self.focal, (rows - self.cy) / self.focal
        return np.stack([x * depth, y * depth, depth], axis=1)


@dataclass(frozen=True)
class DepthPlanes:
    """Depths of the planes.

    In inverse depth plane 0 is the farthest, in depth it is the nearest; the other end of the range is not reached.

    Attributes:
        near, far: depth range in the unit of the poses.
        count: number of planes.
        spacing: equidistant in inverse depth or in depth.

    Raises:
        InputError: not `0 < near < far`.
    """

    near: float
    far: float
    count: int
    spacing: DepthSpacing = "inverse"

    def __post_init__(self) -> None:
        if not 0 < self.near < self.far < math.inf:
            raise InputError(f"the depth range is {self.near:g} to {self.far:g}, expected 0 < min_depth < max_depth")

    def at(self, index: npt.ArrayLike) -> FloatArray:
        """Depth at plane numbers, which may lie between planes; float64 of the same shape."""
        share = np.asarray(index, np.float64) / self.count
        if self.spacing == "linear":
            return self.near + share * (self.far - self.near)
        return 1.0 / (1.0 / self.far + share * (1.0 / self.near - 1.0 / self.far))

    @property
    def depths(self) -> FloatArray:
        """`(count,)` float64 depths."""
        return self.at(np.arange(self.count))


@dataclass(frozen=True, eq=False)
class PacketRays:
    """Where the rays of K packets of S events cross the canonical plane, and how to carry them to other planes.

    Image positions are normalised: -1 and 1 are the centres of the first and last pixel of the reference view.

    Attributes:
        u, v: `(K, S)` float32 normalised position on the canonical plane.
        side: `(K, S)` float32, 1 where that point lies in front of the event's camera, -1 behind it, 0 for no event.
        gain: `(P, K)` float32; normalised position on plane i = gain * position + offset.
        offset_u, offset_v: `(P, K)` float32.
        ahead: `(P, K)` float32, 1 where plane i and the canonical plane lie on the same side of the camera, else -1.
    """

    u: Tensor
    v: Tensor
    side: Tensor
    gain: Tensor
    offset_u: Tensor
    offset_v: Tensor
    ahead: Tensor

    @property
    def all_in_front(self) -> bool:
        """Whether every ray meets every plane in front of its camera, so that nothing has to be masked for that."""
        return bool((self.side > 0).all()) and bool((self.ahead > 0).all())


def usable_packets(rv_T_ev: FloatArray, canonical_depth: float) -> npt.NDArray[np.bool_]:
    """`(K,)` True for packets whose camera does not lie in the canonical plane; `rv_T_ev` is (K, 4, 4)."""
    return np.abs(canonical_depth - rv_T_ev[:, 2, 3]) > _LEAST_PLANE_DISTANCE * canonical_depth


def packet_rays(pixels: Tensor, valid: Tensor, rv_T_ev: FloatArray, intrinsics: npt.ArrayLike, camera: VirtualCamera,
                depths: FloatArray) -> PacketRays:
    """Carry the events of K packets to the canonical plane, and find the affine maps to all planes.

    With ev_T_rv = (R, t): a point of plane Z_0 at normalised reference coordinates n is (Z_0 R + t e3^T) n in the
    event's camera, a homography whose inverse carries pixels to the reference view. From there plane Z_i is reached
    with the camera centre C in the reference frame:
    x_i = [Z_0 (Z_i - C_z) x_0 + (Z_0 - Z_i)(C_x f + C_z c_x)] / [Z_i (Z_0 - C_z)].

    Args:
        pixels: `(K, S, 2)` undistorted pixels; any float type and device.
        valid: `(K, S)` bool, False for padding.
        rv_T_ev: `(K, 4, 4)` pose of the event camera in the reference view; see `usable_packets`.
        intrinsics: `fx fy cx cy` of the undistorted event camera.
        camera: reference view.
        depths: `(P,)`, canonical plane first.
    """
    device = pixels.device
    fx, fy, cx, cy = np.asarray(intrinsics, np.float64)
    ev_T_rv = np.linalg.inv(rv_T_ev)
    induced = depths[0] * ev_T_rv[:, :3, :3]
    induced[:, :, 2] += ev_T_rv[:, :3, 3]
    to_pixels = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
    to_rays = np.array([[1 / camera.focal, 0, -camera.cx / camera.focal],
                        [0, 1 / camera.focal, -camera.cy / camera.focal], [0, 0, 1.0]])
    homography = torch.from_numpy(np.linalg.inv(to_pixels @ induced @ to_rays)).to(device)
    scale = torch.tensor([2.0 / (camera.width - 1), 2.0 / (camera.height - 1)], dtype=torch.float64, device=device)
    mapped = pixels.double() @ homography[:, :, :2].mT + homography[:, None, :, 2]
    position = mapped[..., :2] / mapped[..., 2:] * scale - 1.0
    side = torch.sign(mapped[..., 2]) * valid
    # coordinates that are no numbers would poison the votes even at weight 0, so they leave the image instead
    position = torch.where(torch.isfinite(position), position, _FAR_OUTSIDE).clamp(-_FAR_OUTSIDE, _FAR_OUTSIDE).float()

    center, planes = rv_T_ev[None, :, :3, 3], depths[:, None]
    denominator = planes * (depths[0] - center[..., 2])
    gain = depths[0] * (planes - center[..., 2]) / denominator
    shift = (depths[0] - planes) / denominator
    offset_x = shift * (center[..., 0] * camera.focal + center[..., 2] * camera.cx)
    offset_y = shift * (center[..., 1] * camera.focal + center[..., 2] * camera.cy)
    ahead = np.sign((planes - center[..., 2]) / (depths[0] - center[..., 2]))

    def upload(values: FloatArray) -> Tensor:
        return torch.from_numpy(values.astype(np.float32)).to(device)

    return PacketRays(
        u=position[..., 0].contiguous(), v=position[..., 1].contiguous(), side=side.float(), gain=upload(gain),
        offset_u=upload(gain - 1.0 + 2.0 * offset_x / (camera.width - 1)),
        offset_v=upload(gain - 1.0 + 2.0 * offset_y / (camera.height - 1)), ahead=upload(ahead))
