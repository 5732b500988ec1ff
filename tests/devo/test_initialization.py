"""The first structure: reliefs reshaped, and the choice between the solutions."""

from __future__ import annotations

import math

import pytest
import torch

from devo import initialization
from devo import projective_ops as pops
from devo.initialization import reshaped_relief, unexplained_share
from devo.lietorch import SE3
from tests.devo.test_tracker import make_tracker, trajectory_scale
from tests.oracle import OracleScene, OracleTracker

FOCAL = 60.0


def small_motion(size: float) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Poses (4,7), inverse depths (4,20) around 0.5 and pixels (4,20,2); everything that moves is of order `size`."""
    generator = torch.Generator().manual_seed(3)
    tangent = size * torch.randn(4, 6, generator=generator, dtype=torch.float64)
    tangent[:, 2] = 0.0
    tangent[0] = 0.0
    inv_depths = 0.5 + 0.1 * torch.randn(4, 20, generator=generator, dtype=torch.float64)
    inv_depths -= torch.quantile(inv_depths, 0.5) - 0.5
    pixels = 20.0 * torch.rand(4, 20, 2, generator=generator, dtype=torch.float64) - 10.0
    return SE3.exp(tangent).data, inv_depths, pixels


def image_motion(poses: torch.Tensor, inv_depths: torch.Tensor, pixels: torch.Tensor) -> torch.Tensor:
    """Where the points of frame 0 are seen in the others, minus where they are in frame 0: (3,20,2) pixels."""
    patches = torch.cat([pixels, inv_depths[..., None]], dim=-1).view(1, -1, 3, 1, 1)
    intrinsics = torch.tensor([FOCAL, FOCAL, 0.0, 0.0], dtype=torch.float64).expand(1, 4, 4)
    kk = torch.arange(20).repeat(3)
    jj = torch.arange(1, 4).repeat_interleave(20)
    seen = pops.transform(SE3(poses[None]), patches, intrinsics, torch.zeros_like(jj), jj, kk)
    return seen.view(3, 20, 2) - pixels[:1]


@pytest.mark.parametrize("factor", [-1.0, 0.5, 1.25])
@pytest.mark.parametrize("size", [1e-3, 1e-2])
def test_a_reshaped_relief_causes_nearly_the_same_image_motion(size: float, factor: float) -> None:
    poses, inv_depths, pixels = small_motion(size)
    other_poses, other_depths = reshaped_relief(poses, inv_depths, factor)
    motion, other = image_motion(poses, inv_depths, pixels), image_motion(other_poses, other_depths, pixels)
    assert (motion - other).abs().max() < 0.12 * motion.abs().max(), "first order in motion, small field of view"
    torch.testing.assert_close(other_depths - 0.5, factor * (inv_depths - 0.5))
    unchanged = image_motion(poses, other_depths, pixels)
    assert (motion - unchanged).abs().max() > 2.0 * (motion - other).abs().max(), "the poses have to change as well"


@pytest.mark.parametrize("factor", [-1.0, 0.5, 1.25])
def test_reshaping_back_gives_the_first_structure_again(factor: float) -> None:
    poses, inv_depths, _ = small_motion(1e-3)
    again, depths = reshaped_relief(*reshaped_relief(poses, inv_depths, factor), 1.0 / factor)
    torch.testing.assert_close(depths, inv_depths)
    torch.testing.assert_close(again, poses, atol=1e-5, rtol=0)


@pytest.mark.parametrize("factor", [-1.0, 6.0])
def test_reshaped_depths_stay_positive(factor: float) -> None:
    inv_depths = torch.tensor([[0.1, 0.5], [0.5, 9.0]])
    _, depths = reshaped_relief(SE3.exp(torch.zeros(2, 6)).data, inv_depths, factor)
    assert depths.min() >= 0.3 * 0.5 and depths.max() <= 3.0 * 0.5


def run_until_initialised(**changes: object) -> tuple[OracleTracker, OracleScene]:
    tracker, scene = make_tracker(frames=24, **changes)
    torch.manual_seed(0)
    for voxel, intrinsics, t_us in scene.frames():
        tracker(t_us, voxel, intrinsics)
        if tracker.is_initialized:
            return tracker, scene
    raise AssertionError("24 frames with motion are enough")


@pytest.mark.parametrize(("rounds", "mirror", "starts"), [(0, True, 2), (2, True, 5), (2, False, 4)])
def test_a_first_structure_that_is_right_stays_as_it_is(rounds: int, mirror: bool, starts: int) -> None:
    once, _ = run_until_initialised(MIRROR_TEST=False)
    several, _ = run_until_initialised(MIRROR_TEST=mirror, START_ROUNDS=rounds)
    assert several.counters["reversed_start"] == several.counters["better_starts"] == 0
    for name in ("poses_", "patches_", "net", "target_", "weight_"):
        assert torch.equal(getattr(once, name), getattr(several, name)), name
    assert several.counters["updates"] == starts * once.counters["updates"]


@pytest.mark.parametrize(("factor", "rounds", "mirror"), [(-1.0, 0, True), (-1.0, 2, True), (0.4, 1, False),
                                                          (2.5, 1, False)])
def test_a_first_structure_that_is_wrong_is_replaced(monkeypatch: pytest.MonkeyPatch, factor: float, rounds: int,
                                                     mirror: bool) -> None:
    solve, calls = initialization._solve, []

    def solve_wrongly_at_first(tracker: OracleTracker) -> None:
        solve(tracker)
        calls.append(tracker.n)
        if len(calls) == 1:  # a solver that ended in the wrong place
            state = reshaped_relief(tracker.poses_[:tracker.n], tracker.patches_[:tracker.n, :, 2], factor)
            tracker.poses_[:tracker.n], tracker.patches_[:tracker.n, :, 2] = state

    monkeypatch.setattr(initialization, "_solve", solve_wrongly_at_first)
    tracker, scene = run_until_initialised(START_ROUNDS=rounds, MIRROR_TEST=mirror)
    assert tracker.counters["better_starts"] >= 1
    assert factor > 0 or rounds > 0 or (len(calls) == 2 and tracker.counters["reversed_start"] == 1)
    scale = trajectory_scale(tracker, scene)
    keyframes = tracker.tstamps_[:tracker.n]
    error = scale * tracker.result().poses[keyframes, :3] - scene.world_T_cam.data[keyframes, :3].numpy()
    assert abs(error).max() < 0.01
    assert unexplained_share(tracker) < 1e-4


def test_nothing_measured_explains_nothing() -> None:
    tracker, _ = run_until_initialised()
    tracker.weight_ = torch.zeros_like(tracker.weight_)
    assert unexplained_share(tracker) == math.inf


def test_fewer_updates_can_be_asked_for() -> None:
    tracker, _ = run_until_initialised(INITIAL_UPDATES=3, MIRROR_TEST=False)
    assert tracker.counters["updates"] == 3


def test_a_lower_motion_threshold_starts_earlier() -> None:
    """Short recordings hold too few frames of 2 px each; with half of that, half of the way is enough."""
    usual, _ = run_until_initialised()
    early, _ = run_until_initialised(PROBE_FLOW=1.0)
    assert early.counters["frames_without_motion"] < usual.counters["frames_without_motion"]
    assert early.counter < usual.counter
    published, _ = run_until_initialised(PROBE_FLOW=2.0)
    assert torch.equal(published.poses_, usual.poses_)
