"""The description of a file format for recordings."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from sim.sensors.recording import Recording


@dataclass(frozen=True)
class Format:
    """A file format.

    read: raises InputError with file and line; start: the first bytes of a file; max_values: limit
    that bounds memory; cannot_hold: why recordings of these names at this sampling rate [Hz] do not
    fit, None where they do; sidecars: the files beside one.
    """

    write: Callable[[Path, Recording], None]
    read: Callable[[Path], Recording]
    start: bytes
    max_values: int
    cannot_hold: Callable[[Sequence[str], float], str | None] = lambda names, sample_rate: None
    sidecars: Callable[[Path], tuple[Path, ...]] = lambda path: ()


def rounded(value: float, digits: int) -> float:
    """A value that was written with so many significant digits."""
    return float(f"{value:.{digits}g}")
