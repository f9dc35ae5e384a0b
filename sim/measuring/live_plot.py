"""Responses in plain text while they are measured: a line for each sensor, one screen in all."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Protocol

import numpy as np

from model.arrays import FloatArray
from sim.measuring.multisine import Multisine
from sim.sensors.sensor_file import WiredSensor

STEPS = "▁▂▃▄▅▆▇█"
_RANGE = 60.0  # dB from the highest step to the lowest
_BESIDE = 40  # columns of names and numbers
_LINES = 6  # of a screen that are not of sensors


class Show(Protocol):
    """Takes what was recorded so far: whole periods of each run, (n, inputs)."""

    def __call__(self, recorded: Sequence[FloatArray]) -> None:
        """Show it."""


def levels(multisine: Multisine, recorded: Sequence[FloatArray], columns: list[int]) -> FloatArray:
    """Root mean square over the runs of response to all sources together, (sensors, f) [dB].

    Relative to a sample by a sample. With all runs it is that over the sources, since the turns of
    their phases are orthogonal.
    """
    count = len(recorded[0])
    lines = multisine.lines * (count // multisine.samples)
    power = np.zeros((len(columns), len(lines)))
    for each in recorded:
        spectrum = np.fft.rfft(each[:, columns], axis=0)[lines] * 2 / count
        power += np.abs(spectrum.T) ** 2
    size = np.abs(multisine.played(0)[:, 0])
    return np.asarray(10 * np.log10(np.maximum(power / len(recorded) / size**2, 1e-30)))


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
    found = levels(multisine, recorded, columns)
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
def live_plot(
    multisine: Multisine, sensors: Sequence[WiredSensor]
) -> Iterator[tuple[Callable[[int, int], None], Show]]:
    """Draw anew after each run, on standard error if that is a terminal.

    Yields an update(done, total) of a bar below, in milliseconds, and what shows the runs.
    """
    from rich.console import Console, Group
    from rich.live import Live
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TimeRemainingColumn
    from rich.text import Text

    console = Console(stderr=True)
    if not console.is_terminal:
        yield lambda done, total: None, lambda recorded: None
        return
    bar = Progress(BarColumn(), MofNCompleteColumn(), "ms", TimeRemainingColumn())
    task = bar.add_task("", total=None)
    with Live(bar, console=console) as live:

        def show(recorded: Sequence[FloatArray]) -> None:
            width, height = console.size
            text = plot(multisine, recorded, sensors, width=width, height=height)
            live.update(Group(Text(text, no_wrap=True, overflow="crop"), bar), refresh=True)

        yield lambda done, total: bar.update(task, completed=done, total=total), show
