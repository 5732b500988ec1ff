"""The unrolled training pass: schedule, truth, joined clips, correlation volume, gradients."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor, nn

from devo import projective_ops as pops
from devo.altcorr import patchify
from devo.enet import eVONet
from devo.errors import InputError
from devo.lietorch import SE3
from devo.losses import direct_loss, flow_loss, pose_loss
from devo.unroll import UnrollResult, unroll, unroll_clips
from devo.unroll_state import JoinedClips, UnrollSettings
from tests.tolerances import JOINED_CLIPS

PATCHES = 6


class FixedPatches(nn.Module):
    """A network without randomness: patches on a fixed lattice, revisions a linear function of the correlation."""

    RES = 4.0

    def __init__(self) -> None:
        super().__init__()
        generator = torch.Generator().manual_seed(0)
        self.features = nn.Conv2d(5, 8, 4, stride=4)
        self.head = nn.Linear(882, 4)
        for parameter in self.parameters():
            parameter.data = 0.05 * torch.randn(parameter.shape, generator=generator)

    def patchify(self, images: Tensor, patches_per_image: int, disps: Tensor) -> tuple[Tensor | None, ...]:
        fmap = self.features(images.flatten(0, 1))
        frames, _, height, width = fmap.shape
        number = torch.arange(patches_per_image, dtype=torch.float32)
        x = 1 + (3 * number) % (width - 2)
        y = 1 + (5 * number) % (height - 2)
        coords = torch.stack([x, y], -1).expand(frames, -1, -1).contiguous()
        grid = torch.stack(torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")[::-1]).float()
        grid = torch.cat([grid.expand(frames, -1, -1, -1), disps.reshape(frames, 1, height, width)], 1)
        return (
            fmap[None],
            patchify(fmap, coords, 1).flatten(0, 1)[None],
            torch.zeros(1, frames * patches_per_image, 4, 1, 1),
            patchify(grid, coords, 1).flatten(0, 1)[None],
            None,
            None,
        )

    def update(
        self,
        net: Tensor,
        inp: Tensor,
        corr: Tensor,
        flow: None,
        ii: Tensor,
        jj: Tensor,
        kk: Tensor,
        groups: object = None,
    ) -> tuple[Tensor, tuple[Tensor, Tensor, None]]:
        out = self.head(corr)
        return net + 1, (out[..., :2], torch.sigmoid(out[..., 2:]), None)


def random_clips(
    clips: int, frames: int, seed: int, height: int = 64, width: int = 80
) -> tuple[Tensor, SE3, Tensor, Tensor]:
    generator = torch.Generator().manual_seed(seed)
    images = torch.randn(clips, frames, 5, height, width, generator=generator)
    poses = SE3.exp(0.03 * torch.randn(clips, frames, 6, generator=generator))
    disps = 0.3 + torch.rand(clips, frames, height, width, generator=generator)
    intrinsics = torch.tensor([70.0, 70.0, (width - 1) / 2, (height - 1) / 2]).expand(clips, frames, 4)
    return images, poses, disps, intrinsics


def run(clips: int, frames: int, seed: int = 0, fraction: Tensor | None = None, **settings: object) -> UnrollResult:
    torch.manual_seed(seed)
    chosen = {"steps": 3, "patches_per_image": PATCHES, "initial_frames": 3, "drop_probability": 0.0, **settings}
    return unroll_clips(FixedPatches(), *random_clips(clips, frames, seed), UnrollSettings(**chosen), fraction)  # type: ignore[arg-type]


def test_graph_is_dense_first_and_then_grows_by_one_frame_per_update() -> None:
    result = run(2, 6, steps=8, initial_frames=3)
    frames = [3, 3, 3, 4, 5, 6, 6, 6]
    assert [step.predicted.shape[1] for step in result.steps] == [2 * PATCHES * n * n for n in frames]
    assert [step.poses.shape for step in result.steps if step.poses is not None] == [(2, n) for n in frames]
    # edges of neighbouring frames: |i-j| in {1, 2}
    assert [step.valid.shape[1] for step in result.steps] == [2 * PATCHES * 2 * (2 * n - 3) for n in frames]
    assert [step.scores for step in result.steps] == [None] * 8


def test_dropping_removes_all_edges_of_the_frame_four_back() -> None:
    result = run(1, 6, steps=5, initial_frames=4, drop_probability=1.0)
    # frame 4 arrives and takes frame 0 away: 5 - 1 = 4 connected frames
    assert result.steps[4].predicted.shape[1] == PATCHES * 16


def test_published_call_returns_one_tuple_per_update() -> None:
    torch.manual_seed(0)
    network = eVONet(dim_inet=16, dim_fnet=8, dim=8, norm="std")
    outputs = unroll(network, *random_clips(1, 3, 1), STEPS=2, patches_per_image=4)
    assert len(outputs) == 2
    valid, coords, coords_gt, poses, patches, kl, scores, *_ = outputs[-1]
    assert coords.shape == coords_gt.shape == (1, valid.shape[1], 3, 3, 2)
    assert poses.shape == (1, 3)
    assert patches.shape == (1, 12, 3, 3, 3)
    assert kl == 0
    assert scores is not None
    assert scores.shape == (3, 4)
    assert outputs[0][6] is None


def test_with_the_truth_as_start_nothing_is_left_to_correct() -> None:
    torch.manual_seed(3)
    settings = UnrollSettings(steps=1, patches_per_image=PATCHES, initial_frames=4, structure_only=True)
    from devo.unroll_state import GrowingGraph, JoinedClips

    clips = JoinedClips(FixedPatches(), *random_clips(2, 4, 3), settings)  # type: ignore[arg-type]
    graph = GrowingGraph(clips)
    coords = pops.transform(clips.poses_gt, clips.patches_gt, clips.intrinsics, *graph.edges)
    torch.testing.assert_close(coords, graph.coords_gt.reshape(coords.shape), rtol=0, atol=1e-4)
    # the first frame of each clip is its world frame
    identity = SE3.Identity(1, 1).data.expand(2, 1, 7)
    torch.testing.assert_close(clips.poses_gt.data.view(2, 4, 7)[:, :1], identity, rtol=0, atol=1e-6)


def test_visibility_excludes_points_outside_the_image_and_behind_others() -> None:
    images, _, disps, intrinsics = random_clips(1, 2, 5)
    disps = torch.ones_like(disps)
    disps[0, 1, :, 40:] = 3.0  # in frame 1 something near covers the right half
    sideways = torch.tensor(
        [[[0, 0, 0, 0, 0, 0, 1.0], [0.4, 0, 0, 0, 0, 0, 1.0]]]
    )  # 28 px = 7 feature pixels to the right
    settings = UnrollSettings(steps=1, patches_per_image=40, initial_frames=2)
    torch.manual_seed(0)
    step = unroll_clips(FixedPatches(), images, SE3(sideways), disps, intrinsics, settings).steps[0]  # type: ignore[arg-type]
    x = step.predicted_gt[0, :, 0].view(2, 40, 2)[0, :, 1]  # patches of frame 0 seen in frame 1
    visible = step.predicted_valid.view(2, 40, 2)[0, :, 1]
    assert bool(visible[x < 9].all())
    assert not bool(visible[x > 12].any())
    assert bool((x > 12).any())
    assert bool((x < 9).any())


@pytest.mark.parametrize("fraction", [None, 0.5])
def test_joined_clips_give_what_each_clip_gives_alone(fraction: float | None) -> None:
    torch.manual_seed(11)
    network = FixedPatches()
    images, poses, disps, intrinsics = random_clips(2, 5, 7)
    settings = UnrollSettings(steps=4, patches_per_image=PATCHES, initial_frames=4, drop_probability=0.0)
    start = None if fraction is None else torch.tensor([fraction, 0.2])
    torch.manual_seed(1)
    both = unroll_clips(network, images, poses, disps, intrinsics, settings, start).steps  # type: ignore[arg-type]
    torch.manual_seed(1)  # initial depths are drawn clip by clip: the first clip gets the same ones
    alone = unroll_clips(
        network,
        images[:1],
        SE3(poses.data[:1]),
        disps[:1],
        intrinsics[:1],
        settings,  # type: ignore[arg-type]
        None if start is None else start[:1],
    ).steps
    for joined, single in zip(both, alone):
        half = single.predicted.shape[1]
        torch.testing.assert_close(joined.predicted[:, :half], single.predicted, rtol=0, atol=JOINED_CLIPS)
        assert joined.poses is not None
        assert single.poses is not None
        torch.testing.assert_close(joined.poses.data[:1], single.poses.data, rtol=0, atol=JOINED_CLIPS)


def test_start_between_identity_and_truth() -> None:
    result = run(3, 4, fraction=torch.tensor([0.0, 0.5, 1.0]), steps=1, initial_frames=4)
    errors = result.steps[0].start_error.view(3, -1)
    own = torch.arange(4)
    edges = torch.ones(4, PATCHES, 4, dtype=torch.bool)
    edges[own, :, own] = False
    assert errors[2].median() < errors[0].median()  # depth is wrong everywhere, poses only in the first
    assert result.poses_gt.shape == (3, 4)


def test_every_parameter_gets_a_finite_gradient() -> None:
    torch.manual_seed(0)
    network = eVONet(dim_inet=16, dim_fnet=8, dim=8, norm="std")
    images, poses, disps, intrinsics = random_clips(2, 4, 2)
    settings = UnrollSettings(steps=3, patches_per_image=8, initial_frames=4, probe=True)
    result = unroll_clips(network, network.normalize(images), poses, disps, intrinsics, settings)
    loss = torch.zeros(())
    for step in result.steps:
        assert step.coords is not None
        assert step.poses is not None
        loss = (
            loss
            + flow_loss(step.coords, step.coords_gt, step.valid)
            + pose_loss(step.poses.data, result.poses_gt.data)[0]
        )
        loss = loss + direct_loss(step.predicted, step.predicted_gt, step.predicted_valid)
    assert result.steps[-1].scores is not None
    (loss + result.steps[-1].scores.log().mean()).backward()
    for name, parameter in network.named_parameters():
        assert parameter.grad is not None, name
        assert bool(torch.isfinite(parameter.grad).all()), name
        assert float(parameter.grad.abs().max()) > 0, name


def test_matched_edges_start_off_the_truth_each_in_its_own_way() -> None:
    result = run(2, 4, steps=0, match_updates=2, probe=True)
    assert result.steps == [] and result.probe is not None
    first, second = result.matches
    offset = (first.centre - first.predicted_gt).view(2, -1, PATCHES, 2)  # frame pair, patch
    own = offset - offset.mean(dim=2, keepdim=True)
    assert float(own.norm(dim=-1).median()) > 0.1
    assert float(offset.mean(dim=2).norm(dim=-1).median()) > 0.1
    torch.testing.assert_close(second.centre, first.predicted)
    torch.testing.assert_close(second.predicted_gt, first.predicted_gt)


def test_disturbed_depths_are_some_of_them_and_positive() -> None:
    torch.manual_seed(0)
    images, poses, disps, intrinsics = random_clips(1, 4, 0)
    settings = UnrollSettings(patches_per_image=64, flat_depth=1.0)
    clips = JoinedClips(FixedPatches(), images, poses, disps, intrinsics, settings)  # type: ignore[arg-type]
    before = clips.patches.clone()
    clips.disturb_depths()
    ratio = (clips.patches / before)[0, :, 2, 1, 1]
    assert 0.35 < float((ratio != 1).float().mean()) < 0.65
    assert 0.3 < float(ratio[ratio != 1].log().std()) < 0.5
    assert torch.equal(clips.patches[:, :, :2], before[:, :, :2])


def test_shapes_that_do_not_fit_are_refused() -> None:
    images, poses, disps, intrinsics = random_clips(1, 3, 0)
    with pytest.raises(InputError, match="multiples of 4"):
        unroll_clips(FixedPatches(), images[..., :-1], poses, disps, intrinsics)  # type: ignore[arg-type]
    with pytest.raises(InputError, match="disps has shape"):
        unroll_clips(FixedPatches(), images, poses, disps[:, :2], intrinsics)  # type: ignore[arg-type]
