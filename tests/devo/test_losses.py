"""Losses against cases that can be computed by hand."""

from __future__ import annotations

import math

import pytest
import torch

from devo.lietorch import SE3
from devo.losses import (
    LEAST_SCORE,
    PEAK_SHARPNESS,
    alignment_scale,
    confidence_loss,
    direct_loss,
    fine_loss,
    flow_loss,
    masked_mean,
    peak_loss,
    pose_errors,
    pose_loss,
    score_loss,
    structure_loss,
)
from devo.selector import event_gradient


def random_poses(clips: int, frames: int, seed: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return SE3.exp(0.3 * torch.randn(clips, frames, 6, generator=generator, dtype=torch.float64)).data


def test_masked_mean_ignores_nan_and_gives_zero_without_entries() -> None:
    values = torch.tensor([1.0, math.nan, 3.0], requires_grad=True)
    mean = masked_mean(values, torch.tensor([True, False, True]))
    mean.backward()
    assert mean.item() == 2.0
    assert values.grad is not None
    assert values.grad.tolist() == [0.5, 0.0, 0.5]
    assert masked_mean(values, torch.zeros(3)).item() == 0.0


def test_flow_loss_takes_the_best_pixel_of_each_valid_patch() -> None:
    truth = torch.zeros(1, 2, 3, 3, 2)
    coords = torch.full((1, 2, 3, 3, 2), 30.0)
    coords[0, 0, 1, 2] = torch.tensor([3.0, 4.0])
    assert flow_loss(coords, truth, torch.tensor([[1.0, 0.0]])).item() == pytest.approx(5.0)
    assert flow_loss(coords, truth, torch.tensor([[1.0, 1.0]])).item() == pytest.approx((5.0 + 30 * 2**0.5) / 2)


def test_direct_loss_clamps_and_stops_the_gradient_of_hopeless_edges() -> None:
    predicted = torch.tensor([[[3.0, 4.0], [100.0, 0.0]]], requires_grad=True)
    loss = direct_loss(predicted, torch.zeros(1, 2, 2), torch.ones(1, 2, dtype=torch.bool))
    loss.backward()
    assert loss.item() == pytest.approx((5.0 + 20.0) / 2)
    assert predicted.grad is not None
    assert predicted.grad[0, 0].tolist() == pytest.approx([0.3, 0.4])
    assert predicted.grad[0, 1].abs().max() == 0


def test_scale_recovers_the_factor_between_similar_paths() -> None:
    generator = torch.Generator().manual_seed(1)
    centres = torch.randn(3, 7, 3, generator=generator, dtype=torch.float64)
    factors = torch.tensor([0.5, 2.0, 40.0], dtype=torch.float64)
    scale = alignment_scale(centres * factors[:, None, None], centres + 1.0)
    assert scale.tolist() == pytest.approx([0.5, 2.0, 10.0])


def test_scale_without_motion_is_finite() -> None:
    still, moving = torch.ones(1, 5, 3), torch.randn(1, 5, 3, generator=torch.Generator().manual_seed(2))
    assert alignment_scale(moving, still).item() == 10.0
    assert alignment_scale(still, moving).item() == 1.0
    assert alignment_scale(still, still).item() == 1.0


def test_pose_loss_does_not_see_scale_and_world_frame() -> None:
    truth = random_poses(2, 6, 3)
    # a similarity of the world: other origin, other unit
    move = SE3(random_poses(2, 1, 4))
    moved = (SE3(truth) * move).scale(torch.full((2, 1), 0.25, dtype=torch.float64)).data
    assert pose_loss(moved, truth)[0].item() < 1e-6


def test_pose_errors_of_a_known_rotation() -> None:
    truth = random_poses(1, 4, 5)
    turn = SE3.exp(torch.tensor([[[0, 0, 0, 0, 0.1, 0]]], dtype=torch.float64))
    wrong = truth.clone()
    wrong[:, 2:3] = (turn * SE3(truth[:, 2:3])).data  # frame 2 looks 0.1 rad aside, its centre stays
    translation, rotation = pose_errors(wrong, truth)
    assert rotation.shape == (1, 12)
    assert sorted(rotation[0].tolist()) == pytest.approx([0.0] * 6 + [0.1] * 6, abs=1e-7)
    assert translation[0, 0].item() < 1e-7  # pair (0, 1) is not affected


def test_pose_loss_gradient_is_a_left_tangent_gradient() -> None:
    truth, start = random_poses(1, 4, 6), random_poses(1, 4, 7)
    tangent = torch.zeros(1, 4, 6, dtype=torch.float64, requires_grad=True)
    rotation = pose_loss(SE3(start).retr(tangent).data, truth)[2]
    (gradient,) = torch.autograd.grad(rotation, tangent)
    step = torch.zeros(1, 4, 6, dtype=torch.float64)
    step[0, 2, 4] = 1e-6
    plus, minus = (pose_loss(SE3(start).retr(sign * step).data, truth)[2] for sign in (1, -1))
    assert gradient[0, 2, 4].item() == pytest.approx(((plus - minus) / 2e-6).item(), rel=1e-5)


def test_score_loss_by_hand_and_only_scores_learn() -> None:
    scores = torch.tensor([[0.5, 0.25]], requires_grad=True)
    errors = torch.tensor([[2.0, 1.0, 50.0]], requires_grad=True)
    weights = torch.tensor([[[1.0, 1.0], [math.exp(-2.0), math.exp(-2.0)], [1.0, 1.0]]], requires_grad=True)
    valid, kk = torch.tensor([[True, True, False]]), torch.tensor([0, 1, 0])
    loss = score_loss(scores, errors, weights, valid, kk)
    tracked = (1.0 * 0.5 * 2.0 + 2.0 * 0.25 * 1.0) / 2
    assert loss.item() == pytest.approx(tracked - (math.log(0.5) + math.log(0.25)) / 2)
    loss.backward()
    assert errors.grad is None
    assert weights.grad is None
    assert scores.grad is not None
    assert scores.grad[0].tolist() == pytest.approx([1.0 - 1.0, 1.0 - 2.0])


def test_confidence_loss_is_smallest_at_the_inverse_variance() -> None:
    error = torch.tensor([[[0.4, 0.8]]])
    weights = torch.tensor([[[0.25, 0.0625]]], requires_grad=True)  # 0.2^2 / error^2
    valid = torch.ones(1, 1, dtype=torch.bool)
    (gradient,) = torch.autograd.grad(confidence_loss(weights, error, torch.zeros(1, 1, 2), valid), weights)
    assert gradient.abs().max() < 1e-5
    hidden = confidence_loss(weights, error, error, ~valid)
    far = confidence_loss(weights, error + 99, error, valid)
    assert hidden.item() == far.item()


def test_fine_loss_weighs_relative_precision() -> None:
    errors = torch.tensor([[[0.2, 0.0], [0.0, 0.6]]], requires_grad=True)
    loss = fine_loss(errors, torch.zeros(1, 2, 2), torch.ones(1, 2, dtype=torch.bool))
    assert loss.item() == pytest.approx((math.log(2) + math.log(4)) / 2)
    (gradient,) = torch.autograd.grad(loss, errors)
    assert gradient.abs().sum(-1)[0].tolist() == pytest.approx([1.25, 0.625])


def test_peak_loss_is_smallest_where_the_correlation_peaks_at_the_truth() -> None:
    centre, truth = torch.tensor([[[10.0, 20.0]]]), torch.tensor([[[11.0, 18.0]]])  # shift (1, -2)
    valid = torch.ones(1, 1, dtype=torch.bool)
    losses = torch.empty(7, 7)
    for x in range(7):
        for y in range(7):
            correlation = torch.zeros(1, 1, 7, 7)
            correlation[0, 0, x, y] = 2.0
            losses[x, y] = peak_loss(correlation, centre, truth, valid)
    assert losses.argmin() == 4 * 7 + 1
    assert float(peak_loss(torch.zeros(1, 1, 7, 7), centre, truth, valid)) == pytest.approx(math.log(49))
    for outside in (truth + 3.5, truth - 3.5):
        assert float(peak_loss(torch.rand(1, 1, 7, 7), outside, truth, valid)) == 0.0


def test_peak_loss_shares_the_target_between_neighbours_and_passes_gradcheck() -> None:
    centre = torch.zeros(1, 1, 2, dtype=torch.float64)
    truth = torch.tensor([[[0.25, 0.0]]], dtype=torch.float64)
    valid = torch.ones(1, 1, dtype=torch.bool)
    correlation = torch.zeros(1, 1, 7, 7, dtype=torch.float64, requires_grad=True)
    (gradient,) = torch.autograd.grad(peak_loss(correlation, centre, truth, valid), correlation)
    target = 1 / 49 - gradient[0, 0] / PEAK_SHARPNESS  # softmax of zeros minus gradient
    assert float(target[3, 3]) == pytest.approx(0.75)
    assert float(target[4, 3]) == pytest.approx(0.25)
    assert torch.autograd.gradcheck(lambda c: peak_loss(c, centre, truth, valid), correlation)


def test_structure_loss_is_smallest_where_scores_follow_the_event_gradient() -> None:
    frames = torch.zeros(1, 5, 64, 80)
    frames[..., 20:44, 40:] = 1.0  # three edges of a bar that leaves the image
    gradient = event_gradient(frames)
    raw = torch.zeros(1, 14, 18, requires_grad=True)
    optimiser = torch.optim.Adam([raw], lr=0.3)
    for _ in range(300):
        optimiser.zero_grad()
        loss, correlation = structure_loss(raw, gradient)
        loss.backward()
        optimiser.step()
    score = torch.sigmoid(raw)[0].detach()
    assert float(correlation) > 0.999
    y, x = (score > 0.5).nonzero().T
    # the bar starts at quarter-resolution pixel (10, 5) and ends at row 11; cell s stands for pixel s+1
    assert set(y.tolist()) == set(range(3, 10)) and int(x.min()) == 8
    even = torch.cat([score[5:8, 10:].flatten(), score[:2].flatten()])
    torch.testing.assert_close(even, torch.full_like(even, LEAST_SCORE), atol=0.02, rtol=0)


def test_structure_loss_does_not_depend_on_the_event_rate() -> None:
    generator = torch.Generator().manual_seed(0)
    frames, logits = torch.randn(2, 5, 40, 48, generator=generator), torch.randn(2, 8, 10, generator=generator)
    loss, correlation = structure_loss(logits, event_gradient(frames))
    scaled, same = structure_loss(logits, event_gradient(7.0 * frames))
    assert float(loss) == pytest.approx(float(scaled)) and float(correlation) == pytest.approx(float(same))
