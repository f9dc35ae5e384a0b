"""`era amp conformance`: check an amplifier against protocol 4."""

import json
import shlex
import sys
import textwrap
from typing import TYPE_CHECKING, Annotated

import typer

from drivers.by_hand.cli import EXIT_STATUS, Json, Trace, Url, run
from drivers.errors import LinkError

if TYPE_CHECKING:
    from era_haptics.lab.conformance.contract import CheckResult

_INDENT = " " * 9
_WIDTH = 100


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
    trace: Trace = None,
    json_: Json = False,
) -> None:
    """Check that an amplifier conforms to the protocol. Reads only, unless --write is given."""
    from drivers.by_hand.actions import leave
    from era_haptics.lab.conformance.contract import DEFAULT_LEVEL, judge

    level = DEFAULT_LEVEL if level is None else level
    show = (lambda result: None) if json_ else _show_result
    report = run(judge(url, drives=False, level=level, on_result=show), trace)
    if not write and not json_ and sys.stdin.isatty():
        write = typer.confirm(
            f"{report.left} more checks arm the amplifier and drive its channels at {level:.0%} of "
            "full level. If another amplifier on the line replies, checks of broadcasts are "
            "skipped. Continue?"
        )
    if write:
        more = judge(url, drives=True, level=level, on_result=show, before=report)
        try:
            report = run(more, trace)
        except (KeyboardInterrupt, LinkError):
            print(f"era: run ended early: {run(leave(url), None)}", file=sys.stderr)
            raise
    if json_:
        print(json.dumps(report.to_json()))
    else:
        if report.fix_first:
            print(f"Fix first: {'; '.join(report.fix_first)}")
        print(report.summary)
        if report.left and report.overall != "failed":
            print(f"Next: era amp conformance {shlex.quote(url)} --write")
    if report.overall == "failed":
        raise typer.Exit(1)
    if write and report.overall == "incomplete":
        raise typer.Exit(EXIT_STATUS[LinkError])


def _show_result(result: "CheckResult") -> None:
    mark = result.result.value.replace("_", " ")
    is_failed = mark == "failed"
    print(f"{mark.upper() if is_failed else mark:<7}  {result.check.title}")
    if result.reason:
        print(f"{_INDENT}{result.reason}")
    if is_failed:
        place, remedy = result.advice
        text = f"remedy: {remedy}"
        print(f"{_INDENT}rule: docs/reference/{place} (check {result.check.name})")
        print(textwrap.fill(text, _WIDTH, initial_indent=_INDENT, subsequent_indent=_INDENT))
    if result.finding.sent:
        print(f"{_INDENT}last set sent: {result.finding.sent}")
    if result.finding.came:
        print(f"{_INDENT}last bytes received: {result.finding.came}")
