"""`era witness`: stand in the wires of amplifiers, or read a capture, and say what is wrong."""

import json
import math
import sys
from contextlib import ExitStack, closing
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TextIO

import typer

from model.counting import counted
from model.errors import InputError

if TYPE_CHECKING:
    from sim.witness.endpoint import WireEndpoint
    from sim.witness.violation import Violation
    from sim.witness.witness import Witness


def witness(
    urls: Annotated[
        list[str], typer.Argument(metavar="URL...", help="Amplifiers, as era sim prints them.")
    ],
    replay: Annotated[
        Path | None,
        typer.Option(metavar="CAPTURE", help="Read this capture instead of standing in wires."),
    ] = None,
    record: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Write a capture of all that passes.")
    ] = None,
    frequency: Annotated[
        str, typer.Option(metavar="LOW,HIGH", help="Frequencies that are allowed [Hz].")
    ] = "10,655.35",
    level: Annotated[
        float, typer.Option(metavar="LEVEL", help="The highest level that is allowed.")
    ] = 1.0,
    slew: Annotated[
        float | None, typer.Option(metavar="PER_S", help="How fast a level may rise.")
    ] = None,
    channels: Annotated[
        int, typer.Option(metavar="N", help="Channels that each amplifier has.", min=1, max=16)
    ] = 4,
    slack: Annotated[
        float, typer.Option(metavar="MS", help="What times may be wrong by on this machine.")
    ] = 20.0,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object and no text.")] = False,
) -> None:
    """Watch the wires of amplifiers by decoders of its own. Exit status 1 if a rule was broken.

    Prints a URL for each: use it in place of the amplifier's. Ends with Ctrl-C.
    """
    from sim.witness.endpoint import parse_endpoint
    from sim.witness.witness import Witness

    limits: dict[str, Any] = {
        "frequency_hz": _band(frequency),
        "level": _in_range("--level", level, most=1.0, unit="of full stroke"),
    }
    if slew is not None:
        limits["slew_per_s"] = _in_range("--slew", slew, unit="of full stroke a second")
    slack = _in_range("--slack", slack, unit="ms")
    if replay is not None and record is not None:
        raise InputError(
            "--record writes what passes a wire, and with --replay nothing passes one: leave out "
            "one of the two"
        )
    places = [parse_endpoint(url) for url in urls]
    _check_apart(places)
    wires = {place: f"wire{n}" for n, place in enumerate(dict.fromkeys(p.place for p in places), 1)}
    plan = {
        "wires": {wires[place.place]: place.kind for place in places},
        "amplifiers": {
            place.url: {
                "wire": wires[place.place],
                "address": place.address,
                "channels": dict.fromkeys(range(channels), limits),
            }
            for place in places
        },
        "times_s": {"slack": slack * 1e-3},
    }
    with ExitStack() as stack:
        capture = None if record is None else stack.enter_context(closing(_Capture(record)))
        seen = Witness(plan, record=None if capture is None else capture.write)
        if replay is not None:
            found = _replay(replay, seen)
        else:
            names = [wires[place.place] for place in places]
            found = _stand_in(places, names, seen, to=sys.stderr if as_json else sys.stdout)
    _tell(found, seen, as_json=as_json)
    if capture is not None:
        capture.check()
    if found:
        raise typer.Exit(1)


def _band(text: str) -> list[float]:
    try:
        low, high = (float(part) for part in text.split(","))
    except ValueError:
        low = high = math.nan
    if not 0 <= low <= high < math.inf:
        raise InputError(f"--frequency {text!r} is not LOW,HIGH in Hz, as in 40,500")
    return [low, high]


def _in_range(option: str, given: float, *, most: float = math.inf, unit: str) -> float:
    if not 0 <= given <= most or math.isinf(given):
        to = "or more" if math.isinf(most) else f"to {most:g}"
        raise InputError(f"{option} {given:g} is out of range; write 0 {to}, {unit}")
    return given


def _check_apart(places: list["WireEndpoint"]) -> None:
    """That no two URLs mean one amplifier, or one wire in two ways."""
    for number, place in enumerate(places):
        for other in places[:number]:
            if place.place != other.place:
                continue
            if place.kind != other.kind:
                raise InputError(
                    f"{other.url} and {place.url} are one wire in two ways, {other.kind} and "
                    f"{place.kind}; give the URL of the way that is spoken there"
                )
            if place.address == other.address:
                raise InputError(
                    f"{other.url} and {place.url} are one amplifier, number {place.address}; give "
                    "each once, and by the number that it has on the wire"
                )


class _Capture:
    """A capture that is being written. Wires do not wait for a disk: whatever befalls it is kept.

    Raises InputError where it cannot be begun.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._problem: OSError | None = None
        try:
            self._file = path.open("w", encoding="utf-8")
        except OSError as problem:
            raise InputError(f"--record {path} cannot be written: {problem.strerror}") from problem

    def write(self, line: str) -> None:
        """Add a line, unless one could not be written."""
        if self._problem is None:
            try:
                print(line, file=self._file)
            except OSError as problem:
                self._problem = problem

    def close(self) -> None:
        """Write what still waits."""
        try:
            self._file.close()
        except OSError as problem:
            self._problem = self._problem or problem

    def check(self) -> None:
        """Raise InputError if not all is in the file."""
        if self._problem is not None:
            raise InputError(
                f"--record {self._path}: the capture broke off ({self._problem.strerror}), and "
                "what came later is not in it; make room, or record elsewhere"
            ) from self._problem


def _replay(path: Path, seen: "Witness") -> list["Violation"]:
    from sim.witness.capture import read_capture

    end = None
    for piece in read_capture(path, wires=seen.wires):
        seen.bytes(piece.wire, piece.direction, piece.time, piece.data)
        end = piece.time
    if end is None:
        raise InputError(
            f"{path} holds no bytes at all; a capture has a line TIME WIRE > HEX for each piece of "
            "them, as --record writes it"
        )
    found = seen.finish(end)
    if not seen.frames:
        raise InputError(
            f"in the bytes of {path} is not one frame, so nothing was checked; give URLs of the "
            "kind of wire from which the capture is"
        )
    return found


def _stand_in(
    places: list["WireEndpoint"], names: list[str], seen: "Witness", *, to: TextIO
) -> list["Violation"]:
    import asyncio
    import signal
    import time

    from sim.witness_relay import relays

    async def run() -> None:
        ended = asyncio.Event()
        for number in (signal.SIGTERM, signal.SIGINT):
            asyncio.get_running_loop().add_signal_handler(number, ended.set)
        async with relays(places, names, seen) as ends:
            for place, end in zip(places, ends, strict=True):
                print(f"{place.url}: {end}", file=to, flush=True)
            await ended.wait()

    asyncio.run(run())
    return seen.finish(time.monotonic())


def _tell(found: list["Violation"], seen: "Witness", *, as_json: bool) -> None:
    if as_json:
        listed = [
            {
                "invariant": one.invariant,
                "wire": one.wire,
                "time_s": one.time,
                "sentence": one.sentence,
                "frames": list(one.frames),
            }
            for one in found
        ]
        print(json.dumps({"frames": seen.frames, "violations": listed}))
        return
    for one in found:
        print(one)
    said = f"{len(found)} broken" if found else "no rule was broken"
    print(f"{counted(seen.frames, 'frame')}: {said}")
