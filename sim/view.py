"""What a person sees of a running far end: amplifiers and fingers, in a table on the terminal."""

from rich.console import Group, RenderableType
from rich.table import Table

from sim.bench import Bench

_WINDOW = 0.2  # s; as long as a picture stays
_GRAVITY = 9.8  # m/s²


def draw(bench: Bench) -> RenderableType:
    """The present state of the bench."""
    amplifiers = Table("amplifier", "state", "fault", "set", "level of each channel")
    for name, amplifier in bench.amplifiers.items():
        status = amplifier.status(bench.time)
        levels = "  ".join(f"{level:4.0%}" for level in status.levels)
        amplifiers.add_row(name, status.state.name, status.fault.name, str(status.token), levels)
    fingers = Table("finger", "at", "peak acceleration")
    felt = bench.felt(bench.time - _WINDOW, bench.time)
    for name, (x, y) in bench.fingers.layout.positions.items():
        peak = f"{felt[name].peak.max() / _GRAVITY:.2f} g" if name in felt else ""
        fingers.add_row(name, f"{x * 1000:.0f}, {y * 1000:.0f} mm", peak)
    return Group(amplifiers, fingers)
