"""The frame bundle: round trip, files of the published tool, malformed files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from devo.errors import InputError
from devo.poses import invert_poses_numpy
from utils.frame_bundle import FrameBundle, read_frame_bundle, write_frame_bundle


def random_bundle(seed: int, counts: list[int]) -> FrameBundle:
    generator = np.random.default_rng(seed)
    frames = []
    for i, count in enumerate(counts):
        quaternion = generator.normal(size=4)
        pose = np.concatenate([generator.normal(size=3), quaternion / np.linalg.norm(quaternion)])
        frames.append({"frame_id": 7 + 2 * i, "timestamp": 1e6 + 33_333.5 * i, "pose": pose.astype(np.float32),
                       "intrinsics": generator.uniform(20, 80, 4).astype(np.float32),
                       "points": generator.normal(size=(count, 3)).astype(np.float32),
                       "inv_depths": generator.uniform(0.1, 2, count).astype(np.float32),
                       "centers": generator.uniform(0, 60, (count, 2)).astype(np.float32)})
    return FrameBundle.from_frames(frames, np.array([7, 11]))


@given(st.integers(0, 2**31 - 1), st.lists(st.integers(0, 5), max_size=6))
@settings(max_examples=25, deadline=None)
def test_round_trip(tmp_path_factory: pytest.TempPathFactory, seed: int, counts: list[int]) -> None:
    bundle = random_bundle(seed, counts)
    path = write_frame_bundle(tmp_path_factory.mktemp("bundle") / "frames", bundle)
    assert path.name == "frames.npz"
    again = read_frame_bundle(path)
    for name in ("frame_ids", "t_us", "intrinsics", "offsets", "centers", "inv_depths", "points", "keyframe"):
        np.testing.assert_array_equal(getattr(again, name), getattr(bundle, name), err_msg=name)
    np.testing.assert_allclose(again.cam_T_world, bundle.cam_T_world, atol=1e-6)
    for i, count in enumerate(counts):
        centers, inv_depths = again.seeds(i)
        assert centers.shape == (count, 2) and inv_depths.shape == (count,)


def test_the_file_says_what_it_holds(tmp_path: Path) -> None:
    bundle = random_bundle(0, [3, 0, 5])
    with np.load(write_frame_bundle(tmp_path / "frames.npz", bundle)) as arrays:
        assert arrays["centers"].shape == (3, 5, 2) and np.isnan(arrays["centers"][0, 3:]).all()
        assert arrays["counts"].tolist() == [3, 0, 5] and arrays["offsets"].tolist() == [0, 3, 3]
        np.testing.assert_allclose(arrays["depths"], 1.0 / bundle.inv_depths, rtol=1e-6)
        assert arrays["keyframe"].tolist() == [True, False, True]


def test_files_of_the_published_tool_hold_inverse_depths(tmp_path: Path) -> None:
    bundle = random_bundle(1, [4, 2])
    arrays = bundle.arrays()
    arrays["depths"] = bundle.inv_depths
    for name in ("inv_depths", "keyframe", "pose_convention", "depths_convention"):
        del arrays[name]
    np.savez(tmp_path / "published.npz", **arrays)
    again = read_frame_bundle(tmp_path / "published.npz")
    np.testing.assert_array_equal(again.inv_depths, bundle.inv_depths)
    np.testing.assert_allclose(again.cam_T_world, bundle.cam_T_world, atol=1e-6)


def test_tags_decide(tmp_path: Path) -> None:
    bundle = random_bundle(2, [4, 2])
    arrays = bundle.arrays()
    arrays |= {"poses": invert_poses_numpy(bundle.cam_T_world), "pose_convention": np.array("T_world_cam")}
    del arrays["inv_depths"]
    np.savez(tmp_path / "tagged.npz", **arrays)
    again = read_frame_bundle(tmp_path / "tagged.npz")
    np.testing.assert_allclose(again.cam_T_world, bundle.cam_T_world, atol=1e-6)
    np.testing.assert_allclose(again.inv_depths, bundle.inv_depths, rtol=1e-6)


BROKEN = {
    "missing poses": (lambda a: a.pop("poses"), "poses missing"),
    "short poses": (lambda a: a.update(poses=a["poses"][:1]), "poses"),
    "flat poses": (lambda a: a.update(poses=a["poses"].ravel()), "poses"),
    "nan pose": (lambda a: a["poses"].__setitem__((0, 0), np.nan), "finite"),
    "zero quaternion": (lambda a: a["poses"].__setitem__((0, slice(3, 7)), 0), "quaternion"),
    "negative count": (lambda a: a.update(counts=np.array([-1, 6], np.int32)), "counts"),
    "large count": (lambda a: a.update(counts=np.array([900, 2], np.int32)), "counts"),
    "wrong counts": (lambda a: a.update(counts=np.array([3, 2], np.int32)), "patches"),
    "wrong offsets": (lambda a: a.update(offsets=np.array([0, 1])), "patches"),
    "flat centers": (lambda a: a.update(centers=a["centers"][:, :, 0]), "centers"),
    "short depths": (lambda a: a.update(depths=a["depths"][:3]), "inv_depths"),
    "times run back": (lambda a: a.update(timestamps=a["timestamps"][::-1].copy()), "increase"),
    "scalar times": (lambda a: a.update(timestamps=np.float64(3)), "timestamps"),
}


@pytest.mark.parametrize("case", BROKEN, ids=lambda name: name.replace(" ", "-"))
def test_malformed_bundles_are_named(case: str, tmp_path: Path) -> None:
    break_it, word = BROKEN[case]
    arrays = random_bundle(3, [4, 2]).arrays()
    break_it(arrays)
    np.savez(tmp_path / "broken.npz", **arrays)
    with pytest.raises(InputError, match=word) as caught:
        read_frame_bundle(tmp_path / "broken.npz")
    assert "broken.npz" in str(caught.value)


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04 no archive", np.random.default_rng(0).bytes(500)])
def test_files_that_are_no_archives_are_named(content: bytes, tmp_path: Path) -> None:
    path = tmp_path / "frames.npz"
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"frames\.npz"):
        read_frame_bundle(path)
    with pytest.raises(InputError, match=r"none\.npz"):
        read_frame_bundle(tmp_path / "none.npz")
