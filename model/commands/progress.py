"""Progress bars for long work."""

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

_LINE_INTERVAL = 2.0  # s


@contextmanager
def progress_bar(unit: str) -> Iterator[Callable[[int, int], None]]:
    """Show a progress bar on standard error, or lines if that is no terminal.

    Yield its update(done, total). unit: plural of the things counted.
    """
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TimeRemainingColumn

    console = Console(stderr=True)
    if not console.is_terminal:
        yield _lines(unit)
        return
    columns = (BarColumn(), MofNCompleteColumn(), unit, TimeRemainingColumn())
    with Progress(*columns, console=console) as bar:
        task = bar.add_task("", total=None)
        yield lambda done, total: bar.update(task, completed=done, total=total)


def _lines(unit: str) -> Callable[[int, int], None]:
    """Print how far it is every two seconds."""
    printed = time.monotonic()

    def update(done: int, total: int) -> None:
        nonlocal printed
        if time.monotonic() - printed >= _LINE_INTERVAL:
            printed = time.monotonic()
            sys.stderr.write(f"{done} of {total} {unit}\n")

    return update
