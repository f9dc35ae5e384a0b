"""`era amp conformance`: check an amplifier against protocol 4."""

import json
import shlex
import sys
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from drivers.by_hand.cli import EXIT_STATUS, Json, Trace, Url, run
from drivers.errors import CommandError, LinkError

if TYPE_CHECKING:
    from era_haptics.lab.conformance.conformance_report import CheckResult, ConformanceReport

_INDENT = " " * 9


def conformance(
    url: Url,
    write: Annotated[
        bool, typer.Option("--write", help="Drive the outputs too, without confirmation.")
    ] = False,
    level: Annotated[
        float | None,
        typer.Option(
            metavar="LEVEL",
            min=0.1,  # below it fractions are too close together for measured levels
            max=1.0,
            show_default=False,
            help="Drive level of the channels, relative to full level. Default: 0.2.",
        ),
    ] = None,
    keyword: Annotated[
        str,
        typer.Option(
            "-k",
            metavar="EXPRESSION",
            show_default=False,
            help="Run only checks whose names match, such as 'watchdog or stop'.",
        ),
    ] = "",
    junit_xml: Annotated[
        Path | None,
        typer.Option(
            "--junitxml",
            metavar="FILE",
            dir_okay=False,
            show_default=False,
            help="Write a JUnit report to FILE.",
        ),
    ] = None,
    trace: Trace = None,
    json_: Json = False,
) -> None:
    """Check that an amplifier conforms to the protocol. Reads only, unless --write is given."""
    from drivers.by_hand.actions import leave
    from drivers.trace import tracing
    from era_haptics.lab.conformance.session import DEFAULT_LEVEL, judge

    level = DEFAULT_LEVEL if level is None else level
    if junit_xml is not None:
        _require_writable(junit_xml)
    is_driven = False

    def may_drive(count: int) -> bool:
        nonlocal is_driven
        is_interactive = not json_ and sys.stdin.isatty()
        is_driven = write or (is_interactive and _confirms(count, level))
        return is_driven

    with nullcontext() if trace is None else tracing(trace):
        try:
            report = judge(
                url,
                level=level,
                may_drive=may_drive,
                on_result=(lambda result: None) if json_ else _show_result,
                keyword=keyword,
                junit_xml=junit_xml,
            )
        except (KeyboardInterrupt, LinkError):
            if is_driven:
                print(f"era: run ended early: {run(leave(url), None)}", file=sys.stderr)
            raise
    if json_:
        print(json.dumps(report.to_json()))
    else:
        _show_summary(report)
    if report.overall == "failed":
        raise typer.Exit(1)
    if is_driven and report.overall == "incomplete":
        raise typer.Exit(EXIT_STATUS[LinkError])


def _require_writable(path: Path) -> None:
    """Raise CommandError if a file cannot be written."""
    try:
        path.touch()
    except OSError as error:
        raise CommandError(f"JUnit report {path} cannot be written: {error.strerror}") from error


def _confirms(count: int, level: float) -> bool:
    """Ask the user whether checks may drive the channels."""
    return typer.confirm(
        f"{count} more checks arm the amplifier and drive its channels at {level:.0%} of "
        "full level. If another amplifier on the line replies, checks of broadcasts are "
        "skipped. Continue?"
    )


def _show_result(result: "CheckResult") -> None:
    mark = result.result.value.replace("_", " ")
    if mark == "failed":
        mark = mark.upper()
    print(f"{mark:<7}  {result.check.title}")
    for line in result.details:
        print(f"{_INDENT}{line}")


def _show_summary(report: "ConformanceReport") -> None:
    if report.fix_first:
        print(f"Fix first: {'; '.join(report.fix_first)}")
    print(report.summary)
    if report.remaining and report.overall != "failed":
        print(f"Next: era amp conformance {shlex.quote(report.url)} --write")
