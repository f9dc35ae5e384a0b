"""Picture of checked content: level over time, expected and felt, and what plays."""

import numpy as np
from matplotlib.figure import Figure

from controller.check.content_check import RANGE_DB, TOLERANCE_DB, CheckedContent
from controller.content.pattern import Pattern, along, hertz_of

_REQUESTED, _FELT = "#888888", "#0b5cad"


def content_figure(pattern: Pattern, checked: CheckedContent) -> Figure:
    """Draw level and frequency over time: of the file in grey, what is felt of it in blue."""
    figure = Figure(figsize=(8.0, 4.6), layout="constrained")
    levels, tones = figure.subplots(2, 1, sharex=True, height_ratios=(3, 2))
    times = np.asarray(checked.step * np.arange(len(checked.expected)), dtype=float)
    top = float(checked.expected.max())
    low, high = checked.expected - TOLERANCE_DB, checked.expected + TOLERANCE_DB
    counts = checked.expected > top - RANGE_DB
    levels.fill_between(times, low, high, where=counts, color=_REQUESTED, alpha=0.3, lw=0)
    levels.plot(times, checked.expected, color=_REQUESTED, lw=1, label="asked, within 3 dB")
    levels.plot(times - checked.delay, checked.given, color=_FELT, lw=1.2, label="felt")
    levels.set_ylim(top - RANGE_DB, top + 2 * TOLERANCE_DB)
    levels.set_ylabel("level / dB SL")
    levels.set_title(
        f"{100 * checked.kept_share:.0f} % kept, felt {1000 * checked.delay:.0f} ms later",
        fontsize=10,
    )
    tones.plot(times, hertz_of(along(pattern.sharpness, times)), color=_REQUESTED, lw=1)
    sharpness = np.array([each.sharpness for each in pattern.transients])
    starts = [each.time for each in pattern.transients]
    tones.plot(starts, hertz_of(sharpness), "x", color=_REQUESTED)
    for part in checked.parts:
        if part.frequency is not None:
            until = part.start + (part.stimulus.duration or 0.0)
            tones.plot([part.start, until], [part.frequency] * 2, color=_FELT, lw=2)
    tones.set_xlim(0, checked.duration)
    tones.set_xlabel("time / s")
    tones.set_ylabel("frequency / Hz")
    levels.legend(loc="lower right", fontsize=8)
    return figure
