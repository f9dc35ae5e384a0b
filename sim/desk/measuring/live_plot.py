"""Responses in plain text while they are measured: a line for each sensor, one screen in all."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

import numpy as np

from model.arrays import FloatArray
from model.calibration.responses import WiredSensor
from sim.desk.measuring.multisine import Multisine

Show = Callable[[Sequence[FloatArray]], None]
"""Takes what was recorded so far: whole periods of each run, (n, inputs)."""

STEPS = "▁▂▃▄▅▆▇█"
_RANGE = 60.0  # dB from the highest step to the lowest
_BESIDE = 40  # columns of names and numbers
_LINES = 5  # of a screen that are not of sensors


def plot(
    multisine: Multisine,
    recorded: Sequence[FloatArray],
    sensors: Sequence[WiredSensor],
    *,
    width: int,
    height: int,
) -> str:
    """Lines of text, at most so many of so many columns.

    Each sensor with its response over frequency, the highest of all sensors the full step, and its
    largest sample, 100 % is full scale.
    """
    shown = sensors[: max(1, height - _LINES)]
    columns = [sensor.input - 1 for sensor in shown]
    heard = np.array([multisine.found(each[:, columns]).T for each in recorded])
    # To all sources together, a sample by a sample: the turns of their phases are orthogonal.
    power = (np.abs(heard) ** 2).mean(axis=0) / np.abs(multisine.played(0)[:, 0]) ** 2
    found = 10 * np.log10(np.maximum(power, 1e-30))  # (sensors, f) [dB]
    groups = np.array_split(np.arange(found.shape[1]), min(found.shape[1], max(8, width - _BESIDE)))
    drawn = np.array([found[:, group].max(axis=1) for group in groups]).T  # (sensors, columns)
    top = drawn.max()
    step = np.clip((drawn - top) / _RANGE * len(STEPS) + len(STEPS), 0, len(STEPS) - 1)
    peaks = np.max([np.abs(each[:, columns]).max(axis=0) for each in recorded], axis=0)
    low, high = (f"{multisine.frequencies[end]:g} Hz" for end in (0, -1))
    rows = [
        f"{sensor.name[:10]:10s} {''.join(STEPS[int(each)] for each in one)} "
        f"{float(loudest) - top:6.1f} dB, input {100 * float(peak):5.1f} %"
        for sensor, one, loudest, peak in zip(shown, step, drawn.max(axis=1), peaks, strict=True)
    ]
    rows.append(f"{'':10s} {low}{high.rjust(len(groups) - len(low))}")
    hidden = len(sensors) - len(shown)
    rows.append(
        f"{len(recorded)} of {multisine.sources} runs; a step is {_RANGE / len(STEPS):g} dB"
        + (f"; {hidden} more sensors" if hidden else "")
    )
    return "\n".join(rows)


@contextmanager
def live_plot(multisine: Multisine, sensors: Sequence[WiredSensor]) -> Iterator[Show]:
    """Yield what draws the runs anew after each, on standard error if that is a terminal."""
    from rich.console import Console
    from rich.live import Live
    from rich.text import Text

    console = Console(stderr=True)
    if not console.is_terminal:
        yield lambda recorded: None
        return
    with Live(console=console) as live:

        def show(recorded: Sequence[FloatArray]) -> None:
            width, height = console.size
            text = plot(multisine, recorded, sensors, width=width, height=height)
            live.update(Text(text, no_wrap=True, overflow="crop"), refresh=True)

        yield show
