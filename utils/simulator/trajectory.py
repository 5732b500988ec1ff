"""Smooth rigid motion: uniform cubic B-splines over translation and rotation vector around a reference pose."""

from __future__ import annotations

import dataclasses

import torch


def quaternion_to_matrix(quat_xyzw: torch.Tensor) -> torch.Tensor:
    """Rotation matrices `(..., 3, 3)` of unit quaternions `(..., 4)`, scalar last."""
    x, y, z, w = quat_xyzw.unbind(-1)
    rows = [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
            2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
            2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]
    return torch.stack(rows, -1).view(*quat_xyzw.shape[:-1], 3, 3)


def quaternion_multiply(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    """Hamilton product of quaternions `(..., 4)`, scalar last."""
    av, aw, bv, bw = a[..., :3], a[..., 3:], b[..., :3], b[..., 3:]
    av, bv = torch.broadcast_tensors(av, bv)
    vector = aw * bv + bw * av + torch.linalg.cross(av, bv)
    return torch.cat([vector, aw * bw - (av * bv).sum(-1, keepdim=True)], -1)


def quaternion_conjugate(quat_xyzw: torch.Tensor) -> torch.Tensor:
    """Inverse of unit quaternions `(..., 4)`, scalar last."""
    return torch.cat([-quat_xyzw[..., :3], quat_xyzw[..., 3:]], -1)


def rotate(quat_xyzw: torch.Tensor, vectors: torch.Tensor) -> torch.Tensor:
    """Rotate vectors `(..., 3)` by unit quaternions `(..., 4)`."""
    return (quaternion_to_matrix(quat_xyzw) @ vectors[..., None])[..., 0]


def rotation_vector_to_quaternion(vector: torch.Tensor) -> torch.Tensor:
    """SO(3) exponential: rotation vectors `(..., 3)` in radians to quaternions `(..., 4)`, scalar last."""
    angle = vector.norm(dim=-1, keepdim=True)
    return torch.cat([0.5 * torch.sinc(angle / (2 * torch.pi)) * vector, torch.cos(0.5 * angle)], -1)


def compose(a_T_b: torch.Tensor, b_T_c: torch.Tensor) -> torch.Tensor:
    """Product of 7-vector poses `tx ty tz qx qy qz qw`, broadcasting over leading dimensions."""
    quaternion = quaternion_multiply(a_T_b[..., 3:], b_T_c[..., 3:])
    translation = a_T_b[..., :3] + rotate(a_T_b[..., 3:], b_T_c[..., :3])
    return torch.cat([translation, quaternion / quaternion.norm(dim=-1, keepdim=True)], -1)


def invert(a_T_b: torch.Tensor) -> torch.Tensor:
    """Inverse of 7-vector poses."""
    inverse = quaternion_conjugate(a_T_b[..., 3:])
    return torch.cat([-rotate(inverse, a_T_b[..., :3]), inverse], -1)


def spline_weights(times: torch.Tensor, count: int) -> torch.Tensor:
    """Uniform cubic B-spline weights `(N, count)`; knot k peaks at time `k - 1`, valid times are `0 .. count - 3`."""
    distance = (times[:, None] - (torch.arange(count, device=times.device, dtype=times.dtype) - 1.0)).abs()
    near = 2.0 / 3.0 - distance.square() + 0.5 * distance**3
    far = (2.0 - distance).clamp(min=0) ** 3 / 6.0
    return torch.where(distance < 1.0, near, far)


@dataclasses.dataclass(frozen=True)
class Spline:
    """A pose curve `world_T_cam(t) = anchor * [exp(rotation(t)), translation(t)]`.

    Attributes:
        anchor: `(7,)` pose around which the curve moves, camera to world.
        knots: `(K, 6)` float32 control values: translation in the anchor frame (scene units), rotation vector (rad).
        spacing: time between knots; the unit is the caller's (frames in training, microseconds in sequences).
    """

    anchor: torch.Tensor
    knots: torch.Tensor
    spacing: float

    @property
    def duration(self) -> float:
        """Largest valid time."""
        return (self.knots.shape[0] - 3) * self.spacing

    def poses(self, times: torch.Tensor) -> torch.Tensor:
        """Camera-to-world poses `(N, 7)` float32 at `times` `(N,)`, each within `0 .. duration`."""
        scaled = (times.double() / self.spacing).clamp(0, self.knots.shape[0] - 3)
        # only four knots matter at a time; a dense weight matrix would be quadratic in the length of a recording
        first = scaled.floor().clamp(max=self.knots.shape[0] - 4).long()
        weights = spline_weights(scaled - first, 4)
        values = torch.stack([self.knots[first + k] for k in range(4)], 1).double()
        six = (weights[:, :, None] * values).sum(1)
        local = torch.cat([six[:, :3], rotation_vector_to_quaternion(six[:, 3:])], -1)
        return compose(self.anchor.double().expand(len(times), 7), local).float()

    def scaled(self, translation: float, rotation: float) -> Spline:
        """The same curve with its excursions from the anchor multiplied."""
        factors = self.knots.new_tensor([translation] * 3 + [rotation] * 3)
        return dataclasses.replace(self, knots=self.knots * factors)


def induced_flow(inverse_depth: torch.Tensor, x: torch.Tensor, y: torch.Tensor, from_world_T_cam: torch.Tensor,
                 to_world_T_cam: torch.Tensor, focal: float) -> torch.Tensor:
    """Length in pixels of the image motion of the points seen in one pose, when viewed from another.

    Args:
        inverse_depth: `(M, H, W)` in the first camera; 0 counts as infinitely far.
        x: ray x coordinates, broadcastable to `(H, W)`.
        y: ray y coordinates, broadcastable to `(H, W)`.
        from_world_T_cam: `(M, 7)`.
        to_world_T_cam: `(M, 7)`.
        focal: focal length in pixels.

    Returns:
        `(M, H, W)` float32 pixels; points that end up behind the second camera get the image diagonal.
    """
    relative = compose(invert(to_world_T_cam), from_world_T_cam)
    rotation = quaternion_to_matrix(relative[:, 3:])
    x, y = torch.broadcast_tensors(x, y)
    rays = torch.stack([x, y, torch.ones_like(x)], -1)
    moved = torch.einsum("mij,hwj->mhwi", rotation, rays) + inverse_depth[..., None] * relative[:, None, None, :3]
    depth = moved[..., 2]
    flow = (moved[..., :2] / depth.clamp(min=0.05)[..., None] - rays[..., :2]).norm(dim=-1) * focal
    limit = focal * 2.0
    return torch.where(depth > 0.05, flow, torch.full_like(flow, limit)).clamp(max=limit)
