"""`era witness`: check the traffic of amplifiers, from a capture or live by a relay in the wire.

A relay forwards bytes before they are checked, to add as little latency as possible.
"""

import json
import math
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict
from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TextIO

import typer

from model.errors import InputError
from model.quantities import counted
from registry.files import regular_file

if TYPE_CHECKING:
    from era_haptics.lab.witness.relay import WireEndpoint
    from era_haptics.lab.witness.witness import Witness


def witness(
    urls: Annotated[list[str], typer.Argument(metavar="URL...", help="URLs of the amplifiers.")],
    replay: Annotated[
        Path | None,
        typer.Option(metavar="CAPTURE", help="Check a capture instead of live wires."),
    ] = None,
    record: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Write a capture of all traffic.")
    ] = None,
    frequency: Annotated[
        str, typer.Option(metavar="LOW,HIGH", help="Allowed frequencies [Hz].")
    ] = "10,3276.75",
    level: Annotated[
        float, typer.Option(metavar="LEVEL", help="Highest allowed level, 0..1.")
    ] = 1.0,
    slew: Annotated[
        float | None, typer.Option(metavar="PER_S", help="Highest allowed rise of a level [1/s].")
    ] = None,
    channels: Annotated[
        int, typer.Option(metavar="N", help="Channels of each amplifier.", min=1, max=16)
    ] = 4,
    slack: Annotated[
        float, typer.Option(metavar="MS", help="Tolerance of times on this machine [ms].")
    ] = 20.0,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """Check the traffic of amplifiers against the protocol.

    Print a relay URL for each amplifier, to be used in its place, and check until Ctrl-C. Exit
    status 1 on violations.
    """
    from era_haptics.lab.witness.capture import (
        AmplifierConfig,
        ChannelLimits,
        TimeLimits,
        WitnessConfig,
    )
    from era_haptics.lab.witness.witness import Witness

    limits = ChannelLimits(
        _band(frequency),
        _in_range("--level", level, maximum=1.0, unit="of full stroke"),
        math.inf if slew is None else _in_range("--slew", slew, unit="of full stroke a second"),
    )
    slack = _in_range("--slack", slack, unit="ms")
    if replay is not None and record is not None:
        raise InputError("--record and --replay exclude each other: give one of them")
    from era_haptics.lab.witness.relay import parse_endpoint

    endpoints = [parse_endpoint(url) for url in urls]
    _check_apart(endpoints)
    locations = dict.fromkeys(each.location for each in endpoints)
    wires = {location: f"wire{number}" for number, location in enumerate(locations, 1)}
    of_all = dict.fromkeys(range(channels), limits)
    config = WitnessConfig(
        {wires[each.location]: each.kind for each in endpoints},
        {
            each.url: AmplifierConfig(wires[each.location], each.address, of_all)
            for each in endpoints
        },
        TimeLimits(slack=slack * 1e-3),
    )
    with _capture(record) as write:
        checker = Witness(config, record=write)
        if replay is not None:
            end = _replay(replay, checker)
        else:
            to = sys.stderr if as_json else sys.stdout
            end = _relay(endpoints, [wires[each.location] for each in endpoints], checker, to=to)
        found = checker.finish(end)
        if as_json:
            listed = {"frames": checker.frames, "violations": [asdict(each) for each in found]}
            print(json.dumps(listed))
        else:
            counts = f"{counted(checker.frames, 'frame')}, {counted(len(found), 'violation')}"
            print(*found, counts, sep="\n")
    if found:
        raise typer.Exit(1)


def _band(text: str) -> tuple[float, float]:
    try:
        low, high = (float(part) for part in text.split(","))
    except ValueError:
        low = high = math.nan
    if not 0 <= low <= high < math.inf:
        raise InputError(f"--frequency must be LOW,HIGH in Hz, as in 40,500, got {text!r}")
    return low, high


def _in_range(option: str, given: float, *, maximum: float = math.inf, unit: str) -> float:
    if not 0 <= given <= maximum or math.isinf(given):
        to = "or more" if math.isinf(maximum) else f"to {maximum:g}"
        raise InputError(f"{option} must be 0 {to} {unit}, got {given:g}")
    return given


def _check_apart(endpoints: list["WireEndpoint"]) -> None:
    """Refuse two URLs for one amplifier, or for one wire in two ways."""
    for other, endpoint in combinations(endpoints, 2):
        is_same_wire = endpoint.location == other.location
        if is_same_wire and endpoint.kind != other.kind:
            raise InputError(
                f"{other.url} and {endpoint.url}: one wire cannot be {other.kind} and "
                f"{endpoint.kind}; give the URL of its actual protocol"
            )
        if is_same_wire and endpoint.address == other.address:
            raise InputError(
                f"{other.url} and {endpoint.url}: both are amplifier {endpoint.address} of one "
                "wire; give each amplifier once, by its address"
            )


@contextmanager
def _capture(path: Path | None) -> Iterator[Callable[[str], None]]:
    """Yield what appends a line to a capture file, if there is one; its end tells what was lost.

    Relaying goes on where writing fails. Raises InputError where it cannot be opened, or is
    incomplete.
    """
    problems: list[OSError] = []
    try:
        opened = path and open(path, "w", encoding="utf-8", opener=regular_file)  # noqa: SIM115
    except OSError as problem:
        raise InputError(f"--record {path}: cannot be written: {problem.strerror}") from problem

    def write(line: str) -> None:
        if opened and not problems:
            try:
                print(line, file=opened)
            except OSError as problem:
                problems.append(problem)

    try:
        yield write
    finally:
        try:
            if opened:
                opened.close()
        except OSError as problem:
            problems.append(problem)
        if problems:
            raise InputError(
                f"--record {path}: capture incomplete: {problems[0].strerror}; free disk space, or "
                "record elsewhere"
            ) from problems[0]


def _replay(path: Path, checker: "Witness") -> float:
    """Check a capture; returns its end [s]."""
    from era_haptics.lab.witness.capture import read_wire_capture

    end = None
    for end, wire, direction, data in read_wire_capture(path, wires=checker.wires):
        checker.record_bytes(wire, direction, end, data)
    if end is None or not checker.frames:
        raise InputError(
            f"{path}: no frame decoded, nothing was checked; write lines TIME WIRE > HEX, and give "
            "URLs of the captured kind of wire"
        )
    return end


def _relay(
    endpoints: list["WireEndpoint"], names: list[str], checker: "Witness", *, to: TextIO
) -> float:
    """Relay until a signal comes; returns when that was [s]."""
    import asyncio
    import signal
    import time

    async def run() -> None:
        ended = asyncio.Event()
        for number in (signal.SIGTERM, signal.SIGINT):
            asyncio.get_running_loop().add_signal_handler(number, ended.set)
        from era_haptics.lab.witness.relay import relays

        async with relays(endpoints, names, checker) as ends:
            for endpoint, end in zip(endpoints, ends, strict=True):
                print(endpoint.url, end, sep="  ", file=to, flush=True)
            print(
                "checking what passes the right URL, to be used in place of the left; a server is "
                "connected to when a host is; Ctrl-C ends",
                file=sys.stderr,
            )
            await ended.wait()

    asyncio.run(run())
    if not checker.frames:
        raise InputError(
            "no frame passed, nothing was checked; use the relay URLs in place of the amplifiers'"
        )
    return time.monotonic()
