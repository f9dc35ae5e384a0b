"""The live view of a simulation on the terminal: amplifiers, peak accelerations, fingers."""

import numpy as np
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from model.arrays import FloatArray, lattice
from model.vibration import G
from sim.bench.bench import Bench
from sim.control import SimulationContext

WINDOW = 0.2  # s; of the peaks shown for fingers
_SHADES = " ·-+*#@"
_FULL = 5.0  # g; the last shade
_THRESHOLD = 0.002  # of _FULL; smaller values are not drawn
_COLUMNS, _ROWS = 28, 10
_DECAY = 0.5  # of the peaks per picture


class PlateView:
    """Peak accelerations over a lattice of the plate (rows, columns) [m/s²], fading with time."""

    def __init__(self, bench: Bench) -> None:
        plate = bench.rig.plate
        x = (np.arange(_COLUMNS) + 0.5) / _COLUMNS * plate.length
        y = (np.arange(_ROWS) + 0.5) / _ROWS * plate.width
        self.begun = bench.time  # s
        self._bench = bench
        self._points = lattice(x, y)
        self._peaks = np.zeros(len(self._points))

    @property
    def shapes(self) -> FloatArray:
        """Shapes at its points, in the present coordinates of the plate."""
        return self._bench.shapes_at(self._points)

    def record(self, times: FloatArray, accelerations: FloatArray) -> None:
        """Keep the peaks of accelerations (n, p) [m/s²]."""
        np.maximum(self._peaks, np.abs(accelerations).max(axis=0), out=self._peaks)

    def take(self) -> FloatArray:
        """Return the peaks and fade them."""
        peaks = self._peaks.copy()
        self._peaks *= _DECAY
        return peaks.reshape(_ROWS, _COLUMNS)


def draw(context: SimulationContext, plate: PlateView) -> RenderableType:
    """Render the present state; without fingers it fits on 24 lines of 80 columns."""
    bench = context.bench
    amplifiers = Table("amplifier", "state", "fault", "set", "level of each channel")
    for name, amplifier in bench.amplifiers.items():
        summary = amplifier.summary(bench.time)
        levels = "  ".join(f"{level:4.0%}" for level in summary.levels)
        amplifiers.add_row(name, summary.state, summary.fault, str(summary.token), levels)
    fingers = Table("finger", "at", "peak acceleration")
    felt = bench.felt(bench.time - WINDOW, bench.time)
    for name, (x, y) in bench.positions.items():
        peak = f"{felt[name].peak.max() / G:.2f} g" if name in felt else ""
        fingers.add_row(name, f"{x * 1000:.0f}, {y * 1000:.0f} mm", peak)
    footer = [f"{bench.time - plate.begun:.1f} s"]
    if context.recorder is not None:
        full = ", full" if context.recorder.is_full else ""
        footer.append(f"recording {context.recorder.path}: {context.recorder.seconds:.1f} s{full}")
    touched = [fingers] if fingers.row_count else []
    return Group(amplifiers, _picture(bench, plate.take()), *touched, Text("   ".join(footer)))


def _picture(bench: Bench, peaks: FloatArray) -> Text:
    """The plate with y upwards; O are fingers, E are ERAs."""
    share = np.maximum(peaks / (_FULL * G) - _THRESHOLD, 0)
    shade = np.ceil(share * (len(_SHADES) - 1)).astype(int)
    rows = [[_SHADES[min(cell, len(_SHADES) - 1)] for cell in row] for row in shade]
    size = bench.rig.plate.length, bench.rig.plate.width
    places = [((era.x, era.y), "E") for era in bench.rig.eras]
    places += [(at, "O") for at in bench.positions.values()]
    for (x, y), mark in places:
        column = min(int(x / size[0] * _COLUMNS), _COLUMNS - 1)
        rows[min(int(y / size[1] * _ROWS), _ROWS - 1)][column] = mark
    bar = "+" + "-" * _COLUMNS + "+"
    lines = [bar, *(f"|{''.join(row)}|" for row in reversed(rows)), bar]
    legend = f"peak acceleration: {_SHADES[1]} to {_SHADES[-1]} up to {_FULL:g} g; E ERA, O finger"
    return Text("\n".join([*lines, legend]))
