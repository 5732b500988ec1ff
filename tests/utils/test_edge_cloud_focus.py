"""The focus score peaks at the true depth; refinement on images whose geometry is known."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
import torch
from torch import Tensor

from devo.errors import InputError
from devo.lietorch import SE3
from tests.oracle import HEIGHT, INTRINSICS, WIDTH, OracleScene
from tests.utils.dotted_scene import FRAME_US, project, wall_points
from utils.edge_clouds.focus import Slice, focus_peaks, focus_scores, refine_edges
from utils.edge_clouds.images import pooled_to_qres
from utils.edge_clouds.settings import FocusSettings
from utils.frame_bundle import FrameBundle

FRAMES, MIDDLE = 9, 4
STEP = 0.25  # a twelfth of the depth per frame
QUARTER = INTRINSICS / 4


def blobs(pixels: Tensor, chosen: FocusSettings, width: float = 1.2) -> Tensor:
    """A pooled image `(h,w)` with a Gaussian of `width` pooled px at each full-resolution pixel."""
    s = chosen.downsample
    place = (pixels.float() - (s - 1) / 2) / s
    rows, columns = torch.arange(HEIGHT // s).float(), torch.arange(WIDTH // s).float()
    far = (columns - place[:, :1])[:, None, :] ** 2 + (rows - place[:, 1:])[:, :, None] ** 2
    return torch.exp(-0.5 * far / width**2).nansum(dim=0)


def known_world(chosen: FocusSettings, count: int = 12) -> tuple[OracleScene, Tensor, list[Slice], Tensor, Tensor]:
    """Scene, dots, images of all frames but the middle one, and the dots in the middle one: qres px, inverse depth."""
    scene = OracleScene(FRAMES, STEP)
    points = wall_points(scene, count, seed=3, margin=0.25)
    slices = [Slice(blobs(project(scene, points, i), chosen), scene.cam_T_world.data[i], i)
              for i in range(FRAMES) if i != MIDDLE]
    pose = scene.cam_T_world.data[MIDDLE]
    depth = SE3(pose.expand(count, 7).clone()).act(points)[:, 2]
    return scene, points, slices, project(scene, points, MIDDLE).float() / 4, (1.0 / depth).float()


@pytest.mark.parametrize(("downsample", "accuracy"), [(1, 0.005), (2, 0.01), (4, 0.02)])
def test_the_score_peaks_at_the_true_inverse_depth(downsample: int, accuracy: float) -> None:
    chosen = FocusSettings(downsample=downsample, patch_radius=0)
    scene, _, slices, xy, truth = known_world(chosen, count=1)
    tried = truth[:, None] * torch.linspace(0.6, 1.4, 161)
    scores = focus_scores(xy, tried, QUARTER, scene.cam_T_world.data[MIDDLE], slices, chosen)
    peak = tried[0, int(scores[0].argmax())]
    assert float(peak) == pytest.approx(float(truth[0]), rel=accuracy)
    # eight images whose blob is hit in its middle: about eight times the height of one, but for the interpolation
    assert float(scores.max()) > 0.75 * len(slices)
    assert float(scores[0, 0]) < 0.6 * float(scores.max())


@pytest.mark.parametrize("error", [0.88, 1.0, 1.12])
def test_priors_that_are_wrong_are_corrected(error: float) -> None:
    chosen = FocusSettings(downsample=2, patch_radius=0, rho_samples=31)
    scene, _, slices, xy, truth = known_world(chosen)
    tried = (truth * error)[:, None] * torch.linspace(0.7, 1.3, chosen.rho_samples)
    peak = focus_peaks(xy, tried, QUARTER, scene.cam_T_world.data[MIDDLE], slices, chosen)
    wrong = (peak.inv_depth / truth - 1).abs()[peak.accepted]
    assert len(wrong) >= 8 and float(wrong.median()) < 0.005 and float(wrong.max()) < 0.05


def test_inverted_poses_do_not_focus() -> None:
    """The convention matters: camera-to-world poses in place of world-to-camera ones give no common peak."""
    chosen = FocusSettings(downsample=2, patch_radius=0)
    scene, _, slices, xy, truth = known_world(chosen)

    def best(turned: list[Slice], pose: Tensor) -> float:
        tried = truth[:, None] * torch.linspace(0.8, 1.2, 25)
        return float(focus_scores(xy, tried, QUARTER, pose, turned, chosen).amax(dim=1).median())

    pose = scene.cam_T_world.data[MIDDLE]
    inverted = [Slice(item.image, SE3(item.cam_T_world).inv().data, item.frame) for item in slices]
    assert best(inverted, SE3(pose).inv().data) < 0.5 * best(slices, pose)


def test_the_largest_value_in_the_neighbourhood_counts() -> None:
    """Against direct bilinear samples at every offset."""
    chosen = FocusSettings(patch_radius=1)
    identity = torch.tensor([0.0, 0, 0, 0, 0, 0, 1], dtype=torch.float64)
    image = torch.rand(HEIGHT // 4, WIDTH // 4, generator=torch.Generator().manual_seed(0))
    pixels = torch.tensor([[0, 0], [5, 7], [WIDTH // 4 - 1, HEIGHT // 4 - 1], [20, 3]])
    scores = focus_scores(pooled_to_qres(pixels, chosen), torch.ones(4, 3), QUARTER, identity,
                          [Slice(image, identity, 0)], chosen)
    padded = torch.nn.functional.pad(image, (1, 1, 1, 1))
    expected = [float(padded[y:y + 3, x:x + 3].max()) for x, y in pixels.tolist()]
    np.testing.assert_allclose(scores.numpy(), np.repeat(np.array(expected)[:, None], 3, axis=1), rtol=1e-4)


def test_points_behind_a_camera_or_outside_add_nothing() -> None:
    chosen = FocusSettings()
    identity = torch.tensor([0.0, 0, 0, 0, 0, 0, 1], dtype=torch.float64)
    far_ahead = torch.tensor([0.0, 0, -50.0, 0, 0, 0, 1], dtype=torch.float64)
    far_right = torch.tensor([50.0, 0, 0, 0, 0, 0, 1], dtype=torch.float64)
    image = torch.ones(HEIGHT // 4, WIDTH // 4)
    scores = focus_scores(torch.tensor([[20.0, 15.0]]), torch.ones(1, 3), QUARTER, identity,
                          [Slice(image, far_ahead, 0), Slice(image, far_right, 1)], chosen)
    assert torch.equal(scores, torch.zeros(1, 3))


def peaks_of(curve: list[float], **values: float) -> tuple[float, float, bool]:
    from utils.edge_clouds.focus import _find_peaks

    chosen = FocusSettings(rho_samples=len(curve), min_peak_ratio=1.2, **values)  # type: ignore[arg-type]
    peak = _find_peaks(torch.arange(len(curve)).float()[None] + 1, torch.tensor([curve]), chosen)
    return float(peak.inv_depth) - 1, float(peak.confidence), bool(peak.accepted)


def test_peaks_rivals_and_plateaus() -> None:
    place, confidence, accepted = peaks_of([0, 0, 0, 1, 4, 3, 1, 0, 2, 0])  # parabola through 1, 4, 3
    assert place == pytest.approx(4.25) and confidence == pytest.approx(2.0) and accepted  # rival 2, not neighbour 3
    assert peaks_of([0, 0, 1, 4, 1, 0, 0, 3.9, 0, 0])[2] is False  # a rival as high
    assert peaks_of([9, 4, 1, 0, 0, 0, 0, 0])[2] is False  # at the end of the band
    assert peaks_of([0, 0, 1, 5, 5, 5, 1, 0, 0, 0])[0] == pytest.approx(4.0)  # middle of a plateau
    assert peaks_of([0, 0, 1, 5, 1, 0, 0, 5, 1, 0])[2] is False  # two equal peaks
    assert peaks_of([0.0] * 8)[2] is False
    assert peaks_of([0, 0, 1, 4, 1, 0, 0, 0], min_score=5.0)[2] is False


def stream(scene: OracleScene, points: Tensor) -> Iterator[tuple[Tensor, Tensor, float]]:
    for i in range(len(scene.cam_T_world.data)):
        voxel = torch.zeros(5, HEIGHT, WIDTH)
        pixel = project(scene, points, i).round()
        inside = (pixel >= 0).all(dim=1) & (pixel[:, 0] < WIDTH) & (pixel[:, 1] < HEIGHT)
        voxel[2, pixel[inside, 1].long(), pixel[inside, 0].long()] = 1.0
        yield voxel, INTRINSICS.double(), float(FRAME_US * i)


def bundle_of(scene: OracleScene, points: Tensor, wrong: float) -> FrameBundle:
    """Frames with the true poses and, at the dots, depths that are wrong by a factor."""
    frames = []
    for i, pose in enumerate(scene.cam_T_world.data):
        pixel = project(scene, points, i)
        depth = SE3(pose.expand(len(points), 7).clone()).act(points)[:, 2]
        seen = (depth > 0) & (pixel >= 0).all(dim=1) & (pixel[:, 0] < WIDTH) & (pixel[:, 1] < HEIGHT)
        frames.append({"frame_id": i, "timestamp": float(FRAME_US * i), "pose": pose.numpy(),
                       "intrinsics": QUARTER.numpy(), "points": points[seen].numpy(),
                       "inv_depths": (wrong / depth[seen]).numpy(), "centers": (pixel[seen] / 4).numpy()})
    return FrameBundle.from_frames(frames)


def test_a_streamed_recording_is_refined_towards_the_scene() -> None:
    scene = OracleScene(FRAMES, STEP)
    points = wall_points(scene, 60, seed=5, margin=0.1)
    chosen = FocusSettings(downsample=2, patch_radius=0, knn=1, max_dist=3.0, topk=400)
    clouds = list(refine_edges(stream(scene, points), bundle_of(scene, points, 1.1), chosen))
    assert len(clouds) == FRAMES
    cloud = clouds[MIDDLE]
    depth, prior = cloud.scalars["depth"], 1.0 / cloud.scalars["prior_inv_depth"]
    camera = scene.world_T_cam.data[MIDDLE, :3]
    refined = torch.from_numpy(cloud.points).double()
    unrefined = camera + (refined - camera) * torch.from_numpy(prior / depth)[:, None]
    before, after = (float(scene.distance(points).median()) for points in (unrefined, refined))
    assert len(cloud) > 50 and before > 0.15, "the first guesses are wrong by a tenth"
    assert after < 0.5 * before
    assert set(cloud.scalars) == {"host_frame", "t_us", "pixel_x", "pixel_y", "depth", "inv_depth", "prior_inv_depth",
                                  "score", "confidence"}
    assert float(cloud.metadata["band_travel_px"]) > 3.0
    assert (cloud.scalars["confidence"] >= 1.2).all() and (cloud.scalars["host_frame"] == MIDDLE).all()


def test_which_frames_are_refined() -> None:
    scene = OracleScene(FRAMES, STEP)
    points = wall_points(scene, 40, seed=5)
    bundle = bundle_of(scene, points, 1.0)
    chosen = FocusSettings(downsample=2, keyframe_stride=3, max_keyframes=2, min_peak_ratio=0.0, knn=1)
    clouds = list(refine_edges(stream(scene, points), bundle, chosen))
    assert [sorted(set(cloud.scalars["host_frame"].tolist())) for cloud in clouds] == [[0], [3]]
    alone = FocusSettings(min_baseline=99.0, knn=1)
    assert sum(map(len, refine_edges(stream(scene, points), bundle, alone))) == 0


def test_a_recording_of_another_time_is_refused() -> None:
    scene = OracleScene(FRAMES, STEP)
    points = wall_points(scene, 5)
    late = ((voxel, camera, t_us + 1e9) for voxel, camera, t_us in stream(scene, points))
    with pytest.raises(InputError, match="80000 us"):
        list(refine_edges(late, bundle_of(scene, points, 1.0), FocusSettings()))
