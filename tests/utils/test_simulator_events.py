"""The contrast-threshold pixel against a slow, literal re-telling of it, and its physical laws."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.tolerances import SIMULATOR_CROSSING, SIMULATOR_VOXEL
from utils.simulator.events import EventSettings, NoiseSource, PixelArray, expand, resting_pixels, threshold_maps
from utils.simulator.renderer import Renderer, pinhole_rays, render_in_chunks
from utils.simulator.sequence import list_events, sorted_events
from utils.simulator.textures import build_atlas
from utils.simulator.training import ClipSettings, clip_times, direct_voxels, plan_clip
from utils.simulator.voxels import scatter_events
from utils.voxel_grid import to_voxel_grid


def literal_pixel(levels: list[float], step_us: float, positive: float, negative: float, dead_us: float,
                  leak: float) -> list[tuple[float, int, float]]:
    """One pixel in float64, one crossing after the other: (time, polarity, slope) of what gets through."""
    events: list[tuple[float, int, float]] = []
    memory, last = levels[0], -math.inf
    for number, (start, stop) in enumerate(zip(levels[:-1], levels[1:])):
        memory_stop = memory - leak * step_us
        low, high = start - memory, stop - memory_stop
        while True:
            threshold = positive if high > 0 else -negative
            if abs(high) < abs(threshold):
                break
            fraction = (threshold - low) / (high - low)
            time = (number + fraction) * step_us
            if time - last >= dead_us * (1 - 1e-6):
                events.append((time, int(math.copysign(1, threshold)), abs(high - low) / step_us))
                last = time
            low, high, memory_stop = low - threshold, high - threshold, memory_stop + threshold
        memory = memory_stop
    return events


@settings(max_examples=60, deadline=None, derandomize=True)
@given(levels=st.lists(st.floats(-3, 3, width=16), min_size=2, max_size=12), positive=st.floats(0.15, 0.6),
       negative=st.floats(0.15, 0.6), dead_us=st.sampled_from([0.0, 37.0, 700.0]), leak=st.sampled_from([0.0, 3e-5]))
def test_pixel_agrees_with_the_literal_model(levels: list[float], positive: float, negative: float, dead_us: float,
                                             leak: float) -> None:
    step_us = 1000.0
    # thresholds that no sum of the coarse levels hits exactly, where rounding would decide
    positive, negative = positive + 1.2345e-4, negative + 2.3456e-4
    expected = literal_pixel(levels, step_us, positive, negative, dead_us, leak)
    array = PixelArray(torch.tensor([[positive]]), torch.tensor([[negative]]), dead_us, leak)
    found: list[tuple[float, int]] = []
    for number, change in enumerate(np.diff(levels)):
        crossings = array.step(torch.tensor([[float(change)]]), step_us)
        events = expand(crossings, number * step_us, step_us)
        order = torch.argsort(events.t_us)
        found += [(float(events.t_us[k]), int(events.sign[k])) for k in order]
    assert [sign for _, sign in found] == [sign for _, sign, _ in expected]
    for (time, _), (exact, _, slope) in zip(found, expected):
        assert abs(time - exact) * slope < SIMULATOR_CROSSING, "a time is as certain as the intensity is steep"


def test_signed_events_restore_the_log_intensity_within_one_threshold() -> None:
    generator = torch.Generator().manual_seed(0)
    positive, negative = threshold_maps((40, 50), EventSettings(mismatch=0.1, asymmetry=1.2), generator)
    array = PixelArray(positive, negative)
    levels = torch.randn(30, 40, 50, generator=generator).cumsum(0) * 0.3
    restored = torch.zeros(40, 50)
    for change in levels[1:] - levels[:-1]:
        crossings = array.step(change, 100.0)
        restored += crossings.count * torch.where(crossings.sign > 0, positive, -negative)
    difference = levels[-1] - levels[0] - restored
    assert (difference < positive + 1e-4).all()
    assert (difference > -negative - 1e-4).all()
    assert restored.abs().max() > 2.0, "the signal must fire many events for this to mean anything"


@pytest.fixture(scope="module")
def moving_view() -> tuple[torch.Tensor, list[int]]:
    """Log intensity of a noiseless random clip and its renderings per window."""
    generator = torch.Generator().manual_seed(7)
    settings_ = ClipSettings(scenes=(("planes", 1.0),), motions=(("translate", 1.0),), mean_flow_px=(4.0, 4.0),
                             tile=64, bank_size=8)
    plan = plan_clip(3, 48, 64, generator, settings_)
    renderer = Renderer(plan.planes, build_atlas(plan.tiles), pinhole_rays(plan.intrinsics, 48, 64))
    return render_in_chunks(renderer, plan.motion.spline.poses(clip_times(plan.steps))), plan.steps


def count_events(log_intensity: torch.Tensor, threshold: float) -> int:
    array = PixelArray(torch.full((48, 64), threshold), torch.full((48, 64), threshold))
    times = np.arange(len(log_intensity)) * 1000.0
    return sum(len(part.pixel) for part in list_events(log_intensity, times, array))


def test_event_count_scales_with_the_inverse_threshold(moving_view: tuple[torch.Tensor, list[int]]) -> None:
    view, _ = moving_view
    counts = {threshold: count_events(view, threshold) for threshold in (0.05, 0.1, 0.2)}
    assert counts[0.2] > 500
    # changes smaller than a threshold are lost, so halving it gives a little more than twice the events
    assert 1.95 < counts[0.05] / counts[0.1] < 2.3
    assert 1.9 < counts[0.1] / counts[0.2] < 2.6


def test_reversed_time_flips_polarity(moving_view: tuple[torch.Tensor, list[int]]) -> None:
    view, _ = moving_view

    def signed_sum(log_intensity: torch.Tensor) -> torch.Tensor:
        array = PixelArray(torch.full((48, 64), 0.1), torch.full((48, 64), 0.1))
        total = torch.zeros(48, 64)
        for change in log_intensity[1:] - log_intensity[:-1]:
            crossings = array.step(change, 1000.0)
            total += crossings.count * crossings.sign
        return total

    forward, backward = signed_sum(view), signed_sum(view.flip(0))
    assert forward.abs().max() > 5
    assert ((forward + backward).abs() <= 1.0 + 1e-6).all(), "each direction may lose less than one event per pixel"
    assert torch.corrcoef(torch.stack([forward.flatten(), backward.flatten()]))[0, 1] < -0.98


def test_constant_light_fires_nothing_and_leak_fires_positive_events() -> None:
    still = torch.rand(1, 20, 20).expand(11, -1, -1)
    times = np.arange(11) * 100_000.0
    generator = torch.Generator().manual_seed(1)
    quiet = resting_pixels((20, 20), EventSettings(), generator, "cpu")
    assert sum(len(part.pixel) for part in list_events(still, times, quiet)) == 0
    leaky = resting_pixels((20, 20), EventSettings(leak_hz=20.0), generator, "cpu")
    parts = list_events(still, times, leaky)
    assert all((part.sign > 0).all() for part in parts)
    assert sum(len(part.pixel) for part in parts) == pytest.approx(20.0 * 1.0 * 400, rel=0.05)


def test_dead_time_separates_the_events_of_a_pixel() -> None:
    array = PixelArray(torch.full((4, 4), 0.1), torch.full((4, 4), 0.1), refractory_us=300.0)
    ramp = torch.linspace(0, 5, 21)[:, None, None].expand(-1, 4, 4)
    events = sorted_events(list_events(ramp, np.arange(21) * 100.0, array), 4)
    stamps = events.t_us[(events.x == 2) & (events.y == 1)]
    assert len(stamps) >= 5
    assert np.diff(stamps).min() >= 299, "whole microseconds"


def test_noise_rates() -> None:
    generator = torch.Generator().manual_seed(3)
    source = NoiseSource(EventSettings(shot_hz=5.0, hot_fraction=0.01, hot_hz=300.0), 2000, generator)
    noise = source.draw(1_000_000.0, 2_000_000.0)
    assert noise.t_us.min() >= 1_000_000.0
    assert noise.t_us.max() <= 3_000_000.0
    per_pixel = torch.bincount(noise.pixel, minlength=2000)
    assert per_pixel[per_pixel < 40].float().mean() == pytest.approx(10.0, rel=0.1), "shot noise everywhere"
    hot = int((per_pixel >= 100).sum())
    assert 8 <= hot <= 32, "about one pixel in a hundred is hot"


def binned_by_borders(pixel: np.ndarray, time: np.ndarray, sign: np.ndarray, frames: int, area: int) -> np.ndarray:
    """Voxel grids of adjacent unit windows by the definition, in float64."""
    grids = np.zeros((frames, 5, area))
    window = np.minimum(np.floor(time).astype(int), frames - 1)
    for b in range(5):
        np.add.at(grids, (window, b, pixel), sign * np.maximum(0, 1 - np.abs(4 * (time - window) - b)))
    return grids


def test_direct_voxels_agree_with_listed_events(moving_view: tuple[torch.Tensor, list[int]]) -> None:
    view, steps = moving_view
    frame_us = 30_000.0

    def pixels() -> PixelArray:
        return resting_pixels((48, 64), EventSettings(refractory_us=400.0, leak_hz=0.3, mismatch=0.05),
                              torch.Generator().manual_seed(5), "cpu")

    direct = direct_voxels(view, steps, frame_us, pixels())
    parts = list_events(view, clip_times(steps).numpy() * frame_us, pixels())
    pixel, t_us, sign = (torch.cat([getattr(part, name) for part in parts]).numpy()
                         for name in ("pixel", "t_us", "sign"))
    expected = binned_by_borders(pixel, t_us / frame_us, sign, len(steps), 48 * 64)
    np.testing.assert_allclose(direct.numpy().reshape(expected.shape), expected, atol=SIMULATOR_VOXEL)
    events = sorted_events(parts, 64)
    for window in range(len(steps)):
        part = events.between(window * frame_us, (window + 1) * frame_us)
        listed = to_voxel_grid(part.x, part.y, part.t_us, part.p, 48, 64)
        # that grid counts time from its first to its last event, in whole microseconds: a few in 30 000
        assert (direct[window] - listed).abs().sum() < 0.01 * listed.abs().sum()


def test_scattered_events_follow_the_definition() -> None:
    rng = np.random.default_rng(0)
    pixel, time, sign = rng.integers(0, 30, 200), rng.uniform(0, 2, 200), rng.choice([-1.0, 1.0], 200)
    voxels = torch.zeros(2, 5, 5, 6)
    scatter_events(voxels, torch.from_numpy(pixel), torch.from_numpy(time).float(), torch.from_numpy(sign).float())
    expected = binned_by_borders(pixel, time, sign, 2, 30)
    np.testing.assert_allclose(voxels.numpy().reshape(expected.shape), expected, atol=SIMULATOR_VOXEL)
