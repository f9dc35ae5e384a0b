"""What commands that fit a rig to a measurement have in common: the file they write, their end."""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from model.commands.options import next_line, print_report
from model.errors import InputError
from model.files.replacing import check_ending, check_place, check_replaceable

if TYPE_CHECKING:
    from model.config.document import Document
    from model.rig.rig import Rig

NO_FIT = 1
"""Exit status where a fit does not explain the measurement."""

_HEADING = re.compile(rb"# .* by `era (calibrate|outputs|rig identify)`:\s*$|\Z")
"""First line of a rig that was fitted, or of an empty file."""


def check_rig_output(output: Path, *taken: Path) -> None:
    """Raise InputError unless a rig can be written to a place other than the files taken.

    There may be a fitted rig already, but no file that somebody wrote.
    """
    check_place(output, example="rig2.yaml")
    check_ending(output, ".yaml", ".yml", what="a rig file")
    for file in taken:
        if output.resolve() == file.resolve():
            raise InputError(f"--output must differ from {file}; choose another name")
    if output.is_file():
        with output.open("rb") as stream:
            is_fitted = _HEADING.match(stream.readline()) is not None
        check_replaceable(output, is_own=is_fitted, what="rig that `era` fitted")


def write_fitted_rig(
    output: Path,
    document: "Document",
    rigs: "tuple[Rig, Rig]",
    comment: Sequence[str],
    *,
    mesh: str | None = None,
) -> list[str]:
    """Write the document of a rig with the values of its fit, and return the files written.

    rigs: before and after; comment: a heading as in _HEADING, and lines of the report.
    """
    from model.files.array_file import whole_or_nothing
    from model.rig.rewritten import rewritten_text

    text = rewritten_text(document, *rigs, comment="\n  ".join(comment), mesh=mesh)
    with whole_or_nothing(output) as stream:
        stream.write(text.encode())
    return [str(output)]


def finish(
    rows: Sequence[str],
    report: dict[str, Any] | None,
    *,
    files: Sequence[str],
    elapsed: float,
    refusal: str | None,
) -> None:
    """Print a report as text, or as JSON if there is one, and what was written.

    refusal: why the first of the files, the rig, was not; the exit status is then NO_FIT.
    elapsed: time of the fit [s].
    """
    answer = (report or {}) | {"solve_time_s": elapsed, "files": list(files)}
    print_report(rows, answer, as_json=report is not None)
    if refusal is not None:
        typer.echo(f"era: {refusal}", err=True)
        raise typer.Exit(NO_FIT)
    if report is None:
        print(f"\nwrote {', '.join(files)}; fitted in {elapsed:.1f} s")
        table = Path(files[0]).with_suffix(".npz")
        print(next_line("era", "table", "build", files[0], "-o", table))
