"""Pictures of checked content: level and frequency over time."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from controller.content.pattern import Pattern, curve_at, hertz_of
from era_haptics.lab.checks.content_check import RANGE_DB, TOLERANCE_DB, CheckedContent
from model.arrays import FloatArray

_REQUESTED_COLOR = "#888888"
_FELT_COLOR = "#0b5cad"
_FAINT = 0.1  # fraction of the highest amplitude; weaker frequencies are not drawn


def content_figure(pattern: Pattern, checked: CheckedContent) -> Figure:
    """Draw level and frequency over time: the file in dashed gray, felt vibration in blue."""
    figure = Figure(figsize=(6.9, 4.0), layout="constrained")
    levels, tones = figure.subplots(2, 1, sharex=True, height_ratios=(3, 2))
    _draw_content(levels, tones, pattern, checked)
    _set_scale(levels, tones, [checked])
    levels.set_title(f"{checked.headline}, {_delay(checked)}", fontsize=10)
    levels.legend(loc="best", fontsize=9)
    tones.legend(loc="best", fontsize=8)
    return figure


def comparison_figure(contents: Mapping[str, tuple[Pattern, CheckedContent]]) -> Figure:
    """Draw several contents by file, one column each, on the same scales."""
    count = len(contents)
    figure = Figure(figsize=(max(6.9, 3.4 * count), 4.4), layout="constrained")
    axes = figure.subplots(2, count, sharex=True, sharey="row", height_ratios=(3, 2), squeeze=False)
    for (name, (pattern, checked)), (levels, tones) in zip(contents.items(), axes.T, strict=True):
        _draw_content(levels, tones, pattern, checked)
        headline = checked.headline.replace(", ", "\n")
        levels.set_title(
            f"{Path(name).name}\n{headline}\n{_delay(checked)}", fontsize=9, loc="left"
        )
        levels.label_outer()
        tones.label_outer()
    _set_scale(axes[0, 0], axes[1, 0], [checked for _, checked in contents.values()])
    axes[0, 0].legend(loc="best", fontsize=8)
    return figure


def _delay(checked: CheckedContent) -> str:
    return f"felt {1000 * checked.delay:.0f} ms later"


def _set_scale(levels: Axes, tones: Axes, contents: Sequence[CheckedContent]) -> None:
    """Set the limits of axes to fit all contents."""
    top = max([float(checked.expected.max()) for checked in contents])
    levels.set_ylim(top - RANGE_DB, top + 2 * TOLERANCE_DB)
    tones.margins(y=0.15)  # room for the legend between the curves
    tones.set_xlim(0, max([checked.duration for checked in contents]))


def _draw_content(levels: Axes, tones: Axes, pattern: Pattern, checked: CheckedContent) -> None:
    """Draw level and frequency of a content over time."""
    times = np.asarray(checked.step * np.arange(len(checked.expected)), dtype=float)
    low, high = checked.expected - TOLERANCE_DB, checked.expected + TOLERANCE_DB
    levels.fill_between(
        times, low, high, where=checked.is_counted, color=_REQUESTED_COLOR, alpha=0.3, lw=0
    )
    levels.plot(
        times,
        checked.expected,
        color=_REQUESTED_COLOR,
        lw=1.2,
        ls="--",
        label="requested (band: ±3 dB)",
    )
    levels.plot(times - checked.delay, checked.felt, color=_FELT_COLOR, lw=1.5, label="felt")
    levels.set_ylabel("level / dB SL")
    _draw_frequencies(tones, pattern, checked, times)
    tones.set_xlabel("time / s")
    tones.set_ylabel("frequency / Hz")


def _draw_frequencies(
    axes: Axes, pattern: Pattern, checked: CheckedContent, times: FloatArray
) -> None:
    """Draw the frequencies of the file and of the felt vibration at times (n,) [s]."""
    if pattern.intensity:
        hertz = hertz_of(curve_at(pattern.sharpness, times))
        is_silent = curve_at(pattern.intensity, times, beyond=0.0) <= 0
        requested = np.where(is_silent, np.nan, hertz)
        axes.plot(times, requested, color=_REQUESTED_COLOR, lw=1.2, ls="--", label="requested")
    if pattern.transients:
        starts = [tap.time for tap in pattern.transients]
        sharpness = np.array([tap.sharpness for tap in pattern.transients])
        axes.plot(starts, hertz_of(sharpness), "x", color=_REQUESTED_COLOR, label="requested tap")
    label = "felt"
    for part in checked.parts:
        if part.frequency is None:
            continue
        course = part.stimulus.course
        if course is None:
            end = part.start + (part.stimulus.duration or 0.0)
            axes.plot([part.start, end], [part.frequency] * 2, color=_FELT_COLOR, lw=2, label=label)
        else:
            is_faint = course.at(times - part.start) < _FAINT
            hertz = np.where(is_faint, np.nan, part.frequency)
            axes.plot(times, hertz, color=_FELT_COLOR, lw=2, label=label)
        label = "_nolegend_"  # one entry for all parts
