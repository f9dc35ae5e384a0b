"""What there is to know of a kind of file that holds recordings."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from sim.sensors.recording import Recording


@dataclass(frozen=True)
class Format:
    """A kind of file.

    write, read: read raises InputError, with file and line, for what write does not write; start:
    what it begins with; values_max: how many values it takes, so that memory stays bounded;
    cannot_hold: why not recordings of these names at this sampling rate [Hz], None where it can;
    beside: files that stand beside one.
    """

    write: Callable[[Path, Recording], None]
    read: Callable[[Path], Recording]
    start: bytes
    values_max: int
    cannot_hold: Callable[[Sequence[str], float], str | None] = lambda names, sample_rate: None
    beside: Callable[[Path], tuple[Path, ...]] = lambda path: ()


def rounded(value: float, digits: int) -> float:
    """A value of which a file kept so many digits."""
    return float(f"{value:.{digits}g}")
