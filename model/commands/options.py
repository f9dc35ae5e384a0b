"""Options, parsing and reports that several commands share."""

import json
import math
import os
import re
import shlex
import shutil
import sys
import time
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path, PurePath
from typing import TYPE_CHECKING, Annotated, Any

import typer

from model.errors import InputError
from registry.streams import drawing_on

if TYPE_CHECKING:
    from model.arrays import FloatArray
    from model.processes import Progress

FAILED = 1
"""Exit status of a check whose object does not pass."""

RigArgument = Annotated[Path, typer.Argument(metavar="RIG", help="Rig file, e.g. RIG.yaml.")]
TableArgument = Annotated[Path, typer.Argument(metavar="TABLE", help="Table file, e.g. T.npz.")]
MeshOption = Annotated[
    str | None,
    typer.Option(
        metavar="NXxNY",
        help="Mesh, written like in a rig file: auto, 12x9 or '12x9 Q3'. Default: the rig's.",
    ),
]
FittedRigOption = Annotated[
    Path,
    typer.Option(
        "--output",
        "-o",
        metavar="RIG.fitted.yaml",
        help="Output file for the fitted rig, preferably in the folder of RIG.",
    ),
]
FolderOption = Annotated[
    Path, typer.Option("--output", "-o", metavar="DIR", help="Folder to write into.")
]
SizeOption = Annotated[
    str | None,
    typer.Option(
        "--size", metavar="WxH", help="Size of pictures, width and height in cm, such as 16x10."
    ),
]
JsonOption = Annotated[bool, typer.Option("--json", help="Print one JSON object.")]
QuietOption = Annotated[
    list[str] | None,
    typer.Option(metavar="X,Y", help="Position of a quiet finger in meters (repeatable)."),
]
ContactsOption = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE",
        help="File of contacts, or a surface layout. Default: fingers anywhere, with 1 to 3 quiet "
        "fingers.",
    ),
]
LowestOption = Annotated[
    float, typer.Option(min=1.0, help="Minimum rigid-body frequency of the plate in Hz.")
]
ClusterOption = Annotated[
    str | None,
    typer.Option(metavar="tcp://HOST:PORT", help="Address of a Dask scheduler to compute on."),
]
ExactOption = Annotated[
    bool, typer.Option("--exact", help="Simulate the nominal plate (no parameter errors).")
]
SeedOption = Annotated[
    int | None,
    typer.Option(
        metavar="N",
        help="Random seed for plate, ERAs, channels and fingers within the rig's tolerances.",
        min=0,
    ),
]

_LINE_INTERVAL = 2.0  # s
_MINUTES_FROM = 100.0  # s; longer times are given in minutes


class Stopwatch:
    """Measures the time that a `with` block takes."""

    elapsed = 0.0
    """Duration of the block [s], known after it."""

    def __enter__(self) -> "Stopwatch":
        self._started = time.perf_counter()
        return self

    def __exit__(self, *_: object) -> None:
        self.elapsed = time.perf_counter() - self._started


@contextmanager
def progress_bar(unit: str, *, is_transient: bool = False) -> "Iterator[Progress]":
    """Show a progress bar on standard error, or lines of text if that is not a terminal.

    Yields update(done, total). unit: plural of the things counted; is_transient: whether the bar
    disappears at the end.
    """
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, TimeElapsedColumn, TimeRemainingColumn
    from rich.progress import Progress as Bars

    console = Console(file=drawing_on(sys.stderr))
    if not console.is_terminal:
        yield _ProgressLines(unit).update
        return
    columns = (BarColumn(), MofNCompleteColumn(), unit, TimeElapsedColumn(), TimeRemainingColumn())
    with Bars(*columns, console=console, transient=is_transient) as bar:
        task = bar.add_task("", total=None)
        yield lambda done, total: bar.update(task, completed=done, total=total)


class _ProgressLines:
    """Progress as lines of text on standard error, at most one every two seconds.

    The remaining time covers the current stage, which starts when the total changes or the count
    restarts.
    """

    def __init__(self, unit: str) -> None:
        self._unit = unit
        self._done = self._total = 0
        self._updated = self._printed = self._started = time.monotonic()

    def update(self, done: int, total: int) -> None:
        """Print the progress if the last line is old enough."""
        now = time.monotonic()
        if total != self._total or done <= self._done:
            self._started = self._updated
        self._done = done
        self._total = total
        self._updated = now
        if now - self._printed < _LINE_INTERVAL:
            return
        self._printed = now
        sys.stderr.write(f"era: {done} of {total} {self._unit}{self._remaining(now)}\n")

    def _remaining(self, now: float) -> str:
        """Format the remaining time of the stage, if it can be estimated."""
        if not 0 < self._done < self._total:
            return ""
        seconds = (now - self._started) / self._done * (self._total - self._done)
        if seconds < _MINUTES_FROM:
            return f", about {seconds:.0f} s left"
        return f", about {seconds / 60:.0f} min left"


def print_report(rows: Iterable[str | None], answer: Mapping[str, Any], *, as_json: bool) -> None:
    """Print a command's report: rows of text (None is skipped), or JSON."""
    text = json.dumps(answer) if as_json else "\n".join(row for row in rows if row is not None)
    sys.stdout.write(f"{text}\n")


def next_line(*words: str | Path) -> str:
    """Format the next command for the shell, with quotes if needed.

    If `era` is not on the PATH, the command starts with its path.
    """
    arguments = [str(word) for word in words]
    running = sys.argv[0]
    if arguments[0] == PurePath(running).stem and shutil.which(arguments[0]) is None:
        arguments[0] = running
    if os.name == "nt":
        from subprocess import list2cmdline

        return f"Next: {list2cmdline(arguments)}"
    return f"Next: {shlex.join(arguments)}"


def seed_of_plate(*, exact: bool, seed: int | None) -> int | None:
    """Return the seed of a simulated plate, 0 by default, or None for the nominal plate.

    Raises InputError if both options are given.
    """
    if exact and seed is not None:
        raise InputError("--exact and --seed exclude each other; give one")
    return None if exact else seed or 0


def figure_size(text: str | None) -> tuple[float, float] | None:
    """Parse `WxH` in centimeters to the width and height of pictures [in]; None stays None.

    Raises InputError for other text, and for sides outside 2 to 200 cm.
    """
    if text is None:
        return None
    try:
        width, height = (float(part) for part in text.replace("×", "x").split("x"))
    except ValueError:
        width = height = 0.0
    if not (2 <= width <= 200 and 2 <= height <= 200):  # False for NaN
        raise InputError(f"--size must be WxH in cm, 2 to 200 each, such as 16x10, got {text!r}")
    return width / 2.54, height / 2.54


# Values of options

_MAX_FREQUENCIES = 2000  # more is a typing error


def parse_point(text: str, *, what: str) -> tuple[float, float]:
    """Parse `X,Y` to a position [m]; what: the option, for the error."""
    parts = text.split(",")
    try:
        x, y = (float(part) for part in parts)
    except ValueError:
        raise InputError(
            f"{what} must be X,Y in meters without a unit, such as {what} 0.10,0.08, got {text!r}"
        ) from None
    if not (math.isfinite(x) and math.isfinite(y)):
        raise InputError(f"{what}: both coordinates must be finite, got {text!r}")
    return x, y


def parse_pair(text: str, *, what: str) -> tuple[int, int]:
    """Parse `12x9` to two counts."""
    match = re.fullmatch(r"\s*(\d{1,6})\s*[x×]\s*(\d{1,6})\s*", text)
    if match is None:
        raise InputError(f"{what} must be two numbers such as 12x9, got {text!r}")
    return int(match[1]), int(match[2])


def parse_frequencies(text: str) -> "FloatArray":
    """Parse `LO:HI:STEP`, both ends included, or a list `60,110,250`, to frequencies (f,) [Hz].

    Raises InputError for other text, and for a list that does not ascend.
    """
    import numpy as np  # which other commands do without

    try:
        if ":" in text:
            low, high, step = (float(part) for part in text.split(":"))
            count = int((high - low) / step + 1e-9) + 1
            if not (0 < low <= high and step > 0 and count <= _MAX_FREQUENCIES):
                raise ValueError
            return np.asarray(low + step * np.arange(count))
        values = np.array([float(part) for part in text.split(",")])
        if not (len(values) <= _MAX_FREQUENCIES and np.isfinite(values).all() and min(values) > 0):
            raise ValueError
    except (ValueError, OverflowError, ZeroDivisionError):
        raise InputError(
            "--frequencies must be LO:HI:STEP in Hz with LO above zero and at most HI, such as "
            f"60:320:10, or a list above zero, such as 60,110, and at most "
            f"{_MAX_FREQUENCIES} frequencies, got {text[:40]!r}"
        ) from None
    distinct, counts = np.unique(values, return_counts=True)
    if len(distinct) < len(values):
        raise InputError(
            f"--frequencies must be distinct, got {distinct[counts.argmax()]:g} Hz twice in "
            f"{text[:40]!r}"
        )
    if (np.diff(values) < 0).any():
        raise InputError(f"--frequencies must ascend, got {text[:40]!r}; sort them")
    return values
