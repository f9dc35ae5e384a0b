"""`era amp conformance`: whether an amplifier fulfils the contract of protocol 4."""

import json
import shlex
import sys
from typing import TYPE_CHECKING, Annotated

import typer

from drivers.by_hand.cli import EXIT_STATUS, Json, Trace, Url, run
from drivers.errors import LinkError

if TYPE_CHECKING:
    from era_haptics.lab.conformance.contract import CheckResult


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
            help="Level at which channels are driven, relative to full level. Default: 0.2.",
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
            "full level. Other addresses of the line are only asked whether they reply; if one "
            "does, what is for all is left out. Continue?"
        )
    if write:
        more = judge(url, drives=True, level=level, on_result=show, before=report)
        try:
            report = run(more, trace)
        except (KeyboardInterrupt, LinkError):
            print(f"era: ended: {run(leave(url), None)}", file=sys.stderr)
            raise
    if json_:
        print(json.dumps(report.to_json()))
    else:
        print(report.summary)
        if report.left and report.overall != "failed":
            print(f"Next: era amp conformance {shlex.quote(url)} --write")
    if report.overall == "failed":
        raise typer.Exit(1)
    if write and report.overall == "incomplete":
        raise typer.Exit(EXIT_STATUS[LinkError])


def _show_result(result: "CheckResult") -> None:
    mark = result.result.value.replace("_", " ")
    print(f"{mark.upper() if mark == 'failed' else mark:<7}  It {result.check.requirement}.")
    if result.reason:
        print(f"         {result.reason} ({result.check.place})")
    for name in ("sent", "came"):
        if text := getattr(result.finding, name):
            print(f"         {name}: {text}")
