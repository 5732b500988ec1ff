"""Pose helpers: inversion, relative poses, matrices and back, and refusal of what is no pose."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from devo.errors import InputError
from devo.lietorch import SE3
from devo.poses import (
    cam_T_world_from_world_T_cam,
    invert_poses_numpy,
    matrix_to_pose,
    normalize_poses_numpy,
    pose_to_matrix,
    relative_pose,
    world_T_cam_from_cam_T_world,
)


def random_poses(*shape: int) -> np.ndarray:
    return SE3.Random(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(0)).data.numpy()


@pytest.mark.parametrize("shape", [(), (1,), (5,), (2, 3), (0,)])
def test_numpy_and_torch_agree_with_matrix_inversion(shape: tuple[int, ...]) -> None:
    poses = random_poses(*shape)
    inverse = invert_poses_numpy(poses)
    np.testing.assert_allclose(pose_to_matrix(inverse), np.linalg.inv(pose_to_matrix(poses)), atol=1e-13)
    for convert in (world_T_cam_from_cam_T_world, cam_T_world_from_world_T_cam):
        np.testing.assert_allclose(convert(torch.from_numpy(poses)).numpy(), inverse, atol=1e-13)
    np.testing.assert_allclose(pose_to_matrix(poses), SE3(torch.from_numpy(poses)).matrix().numpy(), atol=1e-14)


def test_inputs_stay_as_they_are() -> None:
    poses = random_poses(4) * 1.7
    before = poses.copy()
    invert_poses_numpy(poses)
    normalize_poses_numpy(poses)
    assert np.array_equal(poses, before)


def test_inversion_passes_ordinary_gradients() -> None:
    """Numerical derivatives in the raw seven numbers, quaternion length included."""
    poses = (torch.from_numpy(random_poses(3)) * 1.1).requires_grad_()
    assert torch.autograd.gradcheck(lambda p: world_T_cam_from_cam_T_world(p), (poses,))


def test_relative_pose() -> None:
    a, b = torch.from_numpy(random_poses(2, 6)).unbind(0)
    expected = np.linalg.inv(pose_to_matrix(a)) @ pose_to_matrix(b)
    np.testing.assert_allclose(pose_to_matrix(relative_pose(a, b)), expected, atol=1e-13)
    # The pose of the second camera 2 m along x of the first, both turned by a quarter about z.
    turned = [0, 0, 0.5**0.5, 0.5**0.5]
    first, second = torch.tensor([1.0, 0, 0, *turned]), torch.tensor([1.0, 2, 0, *turned])
    torch.testing.assert_close(relative_pose(first, second), torch.tensor([2.0, 0, 0, 0, 0, 0, 1]))


def test_matrices_against_scipy() -> None:
    poses = random_poses(50)
    np.testing.assert_allclose(
        pose_to_matrix(poses)[:, :3, :3], Rotation.from_quat(poses[:, 3:]).as_matrix(), atol=1e-14
    )
    np.testing.assert_allclose(
        matrix_to_pose(pose_to_matrix(poses))[:, 3:],
        Rotation.from_matrix(pose_to_matrix(poses)[:, :3, :3]).as_quat(canonical=True),
        atol=1e-14,
    )


@pytest.mark.parametrize("offset", [0.0, 1e-15, 1e-9, 1e-4, -1e-9])
@pytest.mark.parametrize("axis", [(1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 1, 0), (1, -2, 3), (-1, 0, 1e-8)])
def test_half_turns_survive(axis: tuple[float, float, float], offset: float) -> None:
    direction = np.array(axis) / np.linalg.norm(axis)
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_rotvec((np.pi + offset) * direction).as_matrix()
    pose = matrix_to_pose(matrix)
    assert np.linalg.norm(pose[3:]) == pytest.approx(1, abs=1e-15)
    assert pose[6] >= 0
    np.testing.assert_allclose(pose_to_matrix(pose), matrix, atol=1e-14)


@settings(max_examples=100, deadline=None)
@given(st.lists(st.floats(-10, 10), min_size=7, max_size=7).filter(lambda v: np.linalg.norm(v[3:]) > 1e-3))
def test_property_matrix_round_trip_and_double_inversion(numbers: list[float]) -> None:
    pose = normalize_poses_numpy(numbers)
    back = matrix_to_pose(pose_to_matrix(numbers))
    sign = np.sign(np.dot(back[3:], pose[3:]))
    np.testing.assert_allclose(back[:3], pose[:3], atol=1e-12)
    np.testing.assert_allclose(sign * back[3:], pose[3:], atol=1e-12)
    np.testing.assert_allclose(invert_poses_numpy(invert_poses_numpy(numbers)), pose, atol=1e-12)


def test_float32_matrices_are_accepted() -> None:
    matrices = pose_to_matrix(random_poses(100)).astype(np.float32)
    np.testing.assert_allclose(pose_to_matrix(matrix_to_pose(matrices)), matrices, atol=1e-6)


NUMPY_FUNCTIONS = [normalize_poses_numpy, invert_poses_numpy, pose_to_matrix]


@pytest.mark.parametrize("function", NUMPY_FUNCTIONS)
@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_numbers_that_are_not_finite_are_refused(function: object, bad: float) -> None:
    poses = random_poses(4)
    poses[2, 1] = bad
    with pytest.raises(InputError, match="not finite in pose 2"):
        function(poses)


@pytest.mark.parametrize("function", NUMPY_FUNCTIONS)
def test_zero_quaternions_and_wrong_shapes_are_refused(function: object) -> None:
    poses = random_poses(4)
    poses[3, 3:] = 0
    with pytest.raises(InputError, match="length zero in pose 3"):
        function(poses)
    with pytest.raises(InputError, match=r"\(4, 6\)"):
        function(poses[:, :6])


@pytest.mark.parametrize("change", ["mirrored", "scaled", "sheared", "bottom", "zero"])
def test_matrices_that_are_no_rigid_motion_are_refused(change: str) -> None:
    matrices = pose_to_matrix(random_poses(3))
    spoiled = {
        "mirrored": lambda m: m @ np.diag([1.0, 1, -1, 1]),
        "scaled": lambda m: m * np.array([2.0, 2, 2, 1]),
        "sheared": lambda m: m + np.eye(4, k=1) * 0.1,
        "bottom": lambda m: m + np.diag([0, 0, 0, 1.0]),
        "zero": lambda m: m * 0,
    }
    matrices[1] = spoiled[change](matrices[1])
    with pytest.raises(InputError, match="matrix 1 that is no rigid motion"):
        matrix_to_pose(matrices)


def test_matrices_of_wrong_shape_or_not_finite_are_refused() -> None:
    with pytest.raises(InputError, match=r"\(3, 4\)"):
        matrix_to_pose(np.eye(4)[:3])
    matrices = np.stack([np.eye(4)] * 3)
    matrices[2, 0, 3] = np.nan
    with pytest.raises(InputError, match="not finite in matrix 2"):
        matrix_to_pose(matrices)


def test_torch_functions_refuse_wrong_sizes() -> None:
    with pytest.raises(InputError, match="expected float32 or float64"):
        world_T_cam_from_cam_T_world(torch.zeros(3, 6))
    with pytest.raises(InputError, match="batch shapes"):
        relative_pose(torch.zeros(3, 7), torch.zeros(2, 7))
