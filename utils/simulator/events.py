"""The contrast-threshold pixel: when does a changing log intensity fire events, and how many.

A pixel remembers the log intensity of its last event; `residual` is the present value minus that memory. It fires a
positive event each time the residual reaches the positive threshold, a negative one each time it falls to minus the
negative threshold, and then takes the threshold off the residual. Within one rendering step the intensity is linear, so
the crossing times of a pixel form an arithmetic series and no loop over events is needed (ESIM, Rebecq et al. 2018;
noise terms as in v2e, Hu et al. 2021).
"""

from __future__ import annotations

import dataclasses

import torch


@dataclasses.dataclass(frozen=True)
class EventSettings:
    """Parameters of the pixel array.

    Attributes:
        threshold: nominal contrast threshold in log intensity.
        mismatch: standard deviation of the pixel-to-pixel threshold variation, relative to the threshold.
        asymmetry: positive threshold over negative threshold.
        refractory_us: dead time after an event in microseconds; crossings inside it are lost.
        leak_hz: positive events per second that a pixel fires without any change.
        shot_hz: random events per second and pixel.
        hot_fraction: share of pixels that fire by themselves.
        hot_hz: mean rate of such a pixel in events per second.
    """

    threshold: float = 0.22
    mismatch: float = 0.04
    asymmetry: float = 1.0
    refractory_us: float = 0.0
    leak_hz: float = 0.0
    shot_hz: float = 0.0
    hot_fraction: float = 0.0
    hot_hz: float = 100.0

    def noiseless(self) -> EventSettings:
        """The same thresholds without any noise, dead time or leak."""
        return dataclasses.replace(self, refractory_us=0.0, leak_hz=0.0, shot_hz=0.0, hot_fraction=0.0)


@dataclasses.dataclass
class Crossings:
    """Events of one step as arithmetic series, one per pixel; every tensor has the shape of the pixel array.

    Event k = 0 .. count-1 of a pixel happens at the fraction `first + k * spacing` of the step.
    """

    sign: torch.Tensor
    count: torch.Tensor
    first: torch.Tensor
    spacing: torch.Tensor


class PixelArray:
    """The state of all pixels, advanced step by step.

    Args:
        positive: positive thresholds, any shape, float32.
        negative: negative thresholds (positive numbers), the same shape.
        refractory_us: dead time; a tensor that broadcasts to the pixels or a number.
        leak: upward drift of the residual per microsecond; a tensor that broadcasts to the pixels or a number.
    """

    def __init__(self, positive: torch.Tensor, negative: torch.Tensor, refractory_us: torch.Tensor | float = 0.0,
                 leak: torch.Tensor | float = 0.0) -> None:
        self.positive, self.negative, self.leak = positive, negative, leak
        self.refractory_us = refractory_us
        self.residual = torch.zeros_like(positive)
        self.fired: torch.Tensor | float = 0.0  # events so far
        self._since_us: torch.Tensor | None = None  # time since the last event
        if bool((torch.as_tensor(refractory_us) > 0).any()):
            self._since_us = torch.full_like(positive, 1e12)
        self._leaky = bool((torch.as_tensor(leak) != 0).any())

    def step(self, change: torch.Tensor, duration_us: torch.Tensor | float) -> Crossings:
        """Advance by one step in which the log intensity changes linearly by `change`.

        Args:
            change: log intensity at the end minus at the start of the step, shape of the pixels.
            duration_us: length of the step; a tensor that broadcasts to the pixels or a number.

        Returns:
            The crossings of the step.
        """
        before = self.residual
        after = before + change
        if self._leaky:
            after = after + self.leak * duration_us
        rising = torch.gt(after, 0.0, out=torch.empty_like(after))
        threshold = torch.lerp(self.negative, self.positive, rising)
        sign = rising.mul_(2.0).sub_(1.0)
        count = (after.abs() / threshold).floor_()
        span = (after - before).abs_().clamp_(min=1e-12)
        spacing = threshold / span
        first = (threshold - sign * before).div_(span)
        self.residual = torch.addcmul(after, sign * count, threshold, value=-1.0)
        crossings = Crossings(sign, count, first, spacing)
        if self._since_us is not None:
            crossings = self._apply_dead_time(crossings, duration_us)
        self.fired = crossings.count.sum() + self.fired
        return crossings

    def _apply_dead_time(self, crossings: Crossings, duration_us: torch.Tensor | float) -> Crossings:
        """Keep the crossings that are at least the dead time apart; they are an arithmetic series again."""
        assert self._since_us is not None
        count, spacing = crossings.count, crossings.spacing
        dead = self.refractory_us / torch.as_tensor(duration_us, device=count.device).clamp(min=1e-9)
        waiting = (dead - self._since_us / duration_us - crossings.first).clamp_(min=0)
        skipped = (waiting / spacing - 1e-5).ceil_().clamp_(min=0)
        stride = (dead / spacing - 1e-5).ceil_().clamp_(min=1)
        kept = ((count - skipped) / stride).ceil_().clamp_(min=0)
        first = torch.addcmul(crossings.first, skipped, spacing)
        spacing = spacing * stride
        last = torch.addcmul(first, kept - 1.0, spacing)
        fired = torch.gt(kept, 0.0, out=torch.empty_like(kept))
        since = self._since_us + duration_us
        fresh = (1.0 - last).nan_to_num_(0.0, 0.0, 0.0).clamp_(0.0, 1.0) * duration_us
        self._since_us = torch.lerp(since, fresh.expand_as(since), fired)
        return Crossings(crossings.sign, kept, first, spacing)


def threshold_maps(shape: tuple[int, ...], settings: EventSettings, generator: torch.Generator,
                   device: torch.device | str = "cpu") -> tuple[torch.Tensor, torch.Tensor]:
    """Positive and negative thresholds of every pixel, log-normal around the nominal value; never below 0.01."""
    ratio = settings.asymmetry**0.5
    noise = torch.randn((2, *shape), generator=generator) * settings.mismatch
    positive = settings.threshold * ratio * noise[0].exp()
    negative = settings.threshold / ratio * noise[1].exp()
    return positive.clamp(min=0.01).to(device), negative.clamp(min=0.01).to(device)


def resting_pixels(shape: tuple[int, int], settings: EventSettings, generator: torch.Generator,
                   device: torch.device | str) -> PixelArray:
    """Pixels in the middle of their life: the distance to the next event is random."""
    positive, negative = threshold_maps(shape, settings, generator, device)
    leak = settings.leak_hz * 1e-6 * positive if settings.leak_hz > 0 else 0.0
    array = PixelArray(positive, negative, settings.refractory_us, leak)
    phase = torch.rand(shape, generator=generator).to(device)
    array.residual = phase * (positive + negative) * 0.999 - negative * 0.999
    return array


@dataclasses.dataclass(frozen=True)
class TimedEvents:
    """Single events: flat pixel index `(N,)` int64, time `(N,)` float64 microseconds, sign `(N,)` float32 -1 or +1."""

    pixel: torch.Tensor
    t_us: torch.Tensor
    sign: torch.Tensor


def expand(crossings: Crossings, start_us: float, duration_us: float) -> TimedEvents:
    """Write out the arithmetic series of one step as single events, pixel by pixel, not sorted by time."""
    count = crossings.count.reshape(-1)
    firing = torch.nonzero(count).flatten()
    repeats = count[firing].long()
    pixel = firing.repeat_interleave(repeats)
    number = torch.arange(len(pixel), device=count.device) - (repeats.cumsum(0) - repeats).repeat_interleave(repeats)
    fraction = crossings.first.reshape(-1)[pixel] + number * crossings.spacing.reshape(-1)[pixel]
    t_us = start_us + fraction.clamp(0.0, 1.0).double() * duration_us
    return TimedEvents(pixel, t_us, crossings.sign.reshape(-1)[pixel])


class NoiseSource:
    """Random events that have nothing to do with the scene: shot noise everywhere, and hot pixels.

    Args:
        settings: rates.
        area: number of pixels.
        generator: CPU generator; chooses the hot pixels now and the events later.
    """

    def __init__(self, settings: EventSettings, area: int, generator: torch.Generator) -> None:
        self._area, self._generator = area, generator
        self._shots_per_us = settings.shot_hz * 1e-6 * area
        hot = int(torch.poisson(torch.tensor(settings.hot_fraction * area), generator=generator))
        self._hot = torch.randint(area, (hot,), generator=generator)
        self._hot_per_us = settings.hot_hz * 2e-6 * torch.rand(hot, generator=generator)
        self._hot_sign = torch.randint(2, (hot,), generator=generator) * 2.0 - 1.0

    def draw(self, start_us: float, duration_us: float) -> TimedEvents:
        """Noise events of an interval, not sorted by time."""
        shots = int(torch.poisson(torch.tensor(self._shots_per_us * duration_us), generator=self._generator))
        pixel = torch.randint(self._area, (shots,), generator=self._generator)
        sign = torch.randint(2, (shots,), generator=self._generator) * 2.0 - 1.0
        if len(self._hot):
            counts = torch.poisson(self._hot_per_us * duration_us, generator=self._generator).long()
            pixel = torch.cat([pixel, self._hot.repeat_interleave(counts)])
            sign = torch.cat([sign, self._hot_sign.repeat_interleave(counts)])
        t_us = start_us + torch.rand(len(pixel), generator=self._generator, dtype=torch.float64) * duration_us
        return TimedEvents(pixel, t_us, sign)
