"""Say and draw what a recording is like."""

from __future__ import annotations

import os
from typing import Any

import numpy as np

from utils.atomic import atomic_path
from utils.events.statistics import EventStatistics, Rate
from utils.events.types import Events

_BACKGROUND, _PANEL, _GRID, _TEXT, _FAINT = "#0e1116", "#151a21", "#2a313c", "#e6e9ee", "#97a1b0"
_BRIGHTER, _DARKER, _HOT = (0.36, 0.68, 1.0), (1.0, 0.40, 0.36), "#ffd166"


def describe(statistics: EventStatistics, *, format_name: str, size_is_known: bool, losses: dict[str, int],
             hot_pixels_shown: int = 5) -> list[tuple[str, str]]:
    """Return the report as pairs (heading, sentence).

    Args:
        format_name: what the file turned out to be.
        size_is_known: the file or the caller gave the sensor size; otherwise it is the largest coordinate seen.
        losses: what the reader had to leave out.
        hot_pixels_shown: how many hot pixels are listed one by one.
    """
    width, height = statistics.size
    seconds = statistics.duration_us * 1e-6
    active = np.count_nonzero(statistics.pixel_counts) / max(statistics.pixel_counts.size, 1)
    said = "" if size_is_known else " (not said by the file; from the largest coordinates)"
    mean = statistics.events / seconds if seconds else 0.0
    return [
        ("format", format_name),
        ("sensor", f"{width} x {height} pixels{said}, {active:.1%} of them with events"),
        ("events", f"{statistics.events:,}"),
        ("duration", f"{seconds:.6f} s, from {statistics.first_us * 1e-6:.6f} s to {statistics.last_us * 1e-6:.6f} s"),
        ("rate", f"{_per_second(mean)} on average, {_per_second(_peak(statistics.rate))} at the peak "
                 f"({statistics.rate.bin_us / 1000:g} ms bins)"),
        ("polarity", f"{statistics.brighter / max(statistics.events, 1):.1%} brighter, "
                     f"{1 - statistics.brighter / max(statistics.events, 1):.1%} darker"),
        ("order", _order(statistics)),
        ("gaps", _gaps(statistics)),
        ("hot pixels", _hot(statistics, hot_pixels_shown)),
        ("losses", ", ".join(f"{count:,} {reason}" for reason, count in losses.items()) or "none"),
    ]


def save_picture(path: str | os.PathLike[str], statistics: EventStatistics, sample: Events, title: str) -> None:
    """Draw a slice of events, the events per pixel with hot pixels marked, and rate and polarity over time.

    Args:
        path: PNG file, written completely or not at all.
        sample: the events of the slice.
        title: headline.

    Raises:
        OutputError: the file cannot be written.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(15, 9), dpi=100, facecolor=_BACKGROUND, layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.add_gridspec(3, 2, height_ratios=(3.2, 1, 0.8))
    figure.suptitle(title, color=_TEXT, fontsize=13)
    _draw_slice(_panel(figure.add_subplot(grid[0, 0])), statistics, sample)
    _draw_counts(figure, _panel(figure.add_subplot(grid[0, 1])), statistics)
    rate = _panel(figure.add_subplot(grid[1, :]))
    _draw_rate(rate, _panel(figure.add_subplot(grid[2, :], sharex=rate)), statistics.rate)
    with atomic_path(path) as temporary:
        figure.savefig(temporary, format="png", facecolor=_BACKGROUND)


def _panel(axes: Any) -> Any:
    axes.set_facecolor(_PANEL)
    axes.tick_params(colors=_FAINT, labelsize=9)
    for spine in axes.spines.values():
        spine.set_color(_GRID)
    return axes


def _label(axes: Any, title: str, x: str, y: str) -> None:
    axes.set_title(title, color=_TEXT, fontsize=11, loc="left")
    axes.set_xlabel(x, color=_FAINT, fontsize=9)
    axes.set_ylabel(y, color=_FAINT, fontsize=9)


def _draw_slice(axes: Any, statistics: EventStatistics, sample: Events) -> None:
    width, height = statistics.size
    picture = np.zeros((2, height, width))
    np.add.at(picture, (sample.p.astype(np.intp), sample.y.astype(np.intp), sample.x.astype(np.intp)), 1.0)
    total = picture.sum(axis=0)
    share = (picture[1] / np.maximum(total, 1))[..., None]
    color = share * np.array(_BRIGHTER) + (1 - share) * np.array(_DARKER)
    strength = 1 - np.exp(-total)[..., None]
    axes.imshow(np.clip(color * strength + 0.06, 0, 1), interpolation="nearest", aspect="equal")
    span = (int(sample.t_us[-1]) - int(sample.t_us[0])) * 1e-3 if len(sample) else 0.0
    since = (int(sample.t_us[0]) - statistics.first_us) * 1e-6 if len(sample) else 0.0
    _label(axes, f"{len(sample):,} events in {span:.2f} ms, {since:.3f} s after the start (blue brighter, red darker)",
           "x [px]", "y [px]")


def _draw_counts(figure: Any, axes: Any, statistics: EventStatistics) -> None:
    from matplotlib.colors import LogNorm

    counts = statistics.pixel_counts
    shown = np.ma.masked_less(counts, 1)
    image = axes.imshow(shown, norm=LogNorm(1, max(int(counts.max()), 2)), cmap="viridis", interpolation="nearest",
                        aspect="equal")
    bar = figure.colorbar(image, ax=axes, fraction=0.035, pad=0.02)
    bar.ax.tick_params(colors=_FAINT, labelsize=9)
    hot = statistics.hot_pixels()
    if hot:
        axes.plot([pixel.x for pixel in hot[:200]], [pixel.y for pixel in hot[:200]], "o", markersize=10,
                  markerfacecolor="none", markeredgecolor=_HOT, markeredgewidth=1.2)
    noun = "hot pixel" if len(hot) == 1 else "hot pixels"
    _label(axes, f"events per pixel, {len(hot) or 'no'} {noun}" + (" (circles)" if hot else ""), "x [px]", "y [px]")


def _draw_rate(axes: Any, below: Any, rate: Rate) -> None:
    edges = np.arange(len(rate.events) + 1) * rate.bin_us * 1e-6
    axes.stairs(rate.events / (rate.bin_us * 1e-6) / 1e6, edges, fill=True, color="#5b8def", alpha=0.85)
    axes.tick_params(labelbottom=False)
    _label(axes, f"rate ({rate.bin_us / 1000:g} ms bins)", "", "million events/s")
    share = np.where(rate.events > 0, rate.brighter / np.maximum(rate.events, 1), np.nan)
    below.stairs(share * 100, edges, baseline=None, color=_HOT)
    below.axhline(50, color=_FAINT, linewidth=0.8, linestyle=":")
    below.set_ylim(0, 100)
    below.set_xlim(0, edges[-1])
    _label(below, "brighter events", "time since the start [s]", "%")
    for panel in (axes, below):
        panel.grid(color=_GRID, linewidth=0.6)
        panel.set_axisbelow(True)


def _per_second(rate: float) -> str:
    for limit, divisor, unit in ((1e6, 1e6, "million "), (1e4, 1e3, "thousand ")):
        if rate >= limit:
            return f"{rate / divisor:.2f} {unit}events/s"
    return f"{rate:.0f} events/s"


def _peak(rate: Rate) -> float:
    return float(rate.events.max(initial=0)) / (rate.bin_us * 1e-6)


def _order(statistics: EventStatistics) -> str:
    if not statistics.backward_steps:
        return "sorted by time"
    return (f"NOT sorted: {statistics.backward_steps:,} stamps run backwards, by at most "
            f"{statistics.largest_backward_us:,} us; read with --sort or on_unsorted=\"sort\"")


def _gaps(statistics: EventStatistics) -> str:
    if not statistics.longest_gaps:
        return "none, all stamps are equal"
    longest = statistics.longest_gaps[0]
    since = (longest.start_us - statistics.first_us) * 1e-6
    return (f"{statistics.gap_count:,} of {statistics.gap_us / 1000:g} ms or more; the longest lasts "
            f"{longest.length_us / 1000:.3f} ms, {since:.3f} s after the start")


def _hot(statistics: EventStatistics, shown: int) -> str:
    hot = statistics.hot_pixels()
    if not hot:
        return "none"
    listing = ", ".join(f"({pixel.x}, {pixel.y}) {pixel.events:,}" for pixel in hot[:shown])
    share = sum(pixel.events for pixel in hot) / max(statistics.events, 1)
    return f"{len(hot):,} with {share:.1%} of the events: {listing}" + (", ..." if len(hot) > shown else "")
