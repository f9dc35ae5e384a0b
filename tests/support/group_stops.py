"""Stops of groups by the thousand: is an amplifier silent whenever a stop says so?

    python tests/support/group_stops.py [--stops N] [--exceptions N] [--killed N] [--first SEED]

Over every wire of protocol 3, in virtual time. First frames are lost, late and doubled at random
while all is stopped, at any moment of what a host does. Then one exception is raised on the way of
each stop, at a line of the drivers that is drawn at random. Last the host is killed, and one of its
amplifiers stopped by `era amp stop`. Whatever happens, a stop ends in time, and what it reports of
each amplifier agrees with what its channels play.
"""

import argparse
import asyncio
import logging
import random
import sys
import types
from collections import Counter
from collections.abc import AsyncIterator, Awaitable, Callable, Iterable, Iterator, Mapping
from contextlib import asynccontextmanager, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

import drivers
import sim
from drivers.by_hand import actions
from drivers.errors import DriverError
from drivers.host.amplifier import WATCHDOG
from drivers.host.amplifier import Amplifier as Host
from drivers.host.dialogue import SILENCING
from drivers.host.stop import Stopped
from drivers.protocol.records import Values
from random_group import RandomGroup
from virtual_loop import Stuck, run_virtual
from words_line import Alter, MemoryLine, unaltered

LINES: Mapping[str, tuple[str, tuple[tuple[str, ...], ...]]] = {
    "serial": ("serial", (("a",),)),
    "serial, two lines": ("serial", (("a",), ("b",))),
    "serial, shared": ("serial", (("a", "b"),)),
    "modbus-rtu, shared": ("rtu", (("a", "b"),)),
    "modbus-tcp": ("tcp", (("a",),)),
    "can, shared": ("can", (("a", "b"),)),
}
"""Kinds of wires, and the amplifiers on each line."""

PER_CHAIN = 12  # stops of one chain, with faults of frames
LONGEST = 5.0  # s; a stop that takes longer hangs
_MAX_DELAY = 0.2  # s; of a late frame
_LATE = 2 * _MAX_DELAY + 0.05  # s; until every late frame and its late copy have arrived
_HEARTBEAT = 0.05  # s
_MOMENTS = 20  # at which what plays is looked at
_MOST_LINES = 1500  # of a stop without faults; the place of an exception is drawn among them
_WATCHED, _FAR = (str(Path(package.__path__[0])) for package in (drivers, sim))
_GRANTING = ("Arm", "Set", "Commit")


class Planted(Exception):
    """The exception that is raised on the way of a stop."""


@dataclass
class Tally:
    """Outcomes of stops by wire, and what was found wrong."""

    counts: Counter[tuple[str, str]] = field(default_factory=Counter)
    found: list[str] = field(default_factory=list)

    def total(self, what: str) -> int:
        """The sum over all wires."""
        return sum(count for (_, name), count in self.counts.items() if name == what)

    def table(self) -> str:
        """A row for each wire."""
        columns = ("stops", "confirmed", "may play", "raised")
        rows = [f"{'':<20}" + "".join(f"{name:>12}" for name in columns)]
        for wire in dict.fromkeys(wire for wire, _ in self.counts):
            cells = "".join(f"{self.counts[wire, name]:>12}" for name in columns)
            rows.append(f"{wire:<20}{cells}")
        return "\n".join(rows)


class Chain(RandomGroup):
    """A group on its lines, beaten as by a control loop; found: what was wrong."""

    def __init__(self, wire: str, rng: random.Random) -> None:
        kind, lines = LINES[wire]
        super().__init__([MemoryLine(kind, *names) for names in lines], rng)
        self.found: list[str] = []
        self._granted: list[str] = []
        for end in self.lines:
            for name, far in end.far.items():
                far.handle = self._noting(name, far.handle)  # type: ignore[method-assign]
        self._background = asyncio.create_task(self.keep_beating())

    def _noting(
        self, name: str, handle: Callable[[str, Values, float], Values]
    ) -> Callable[[str, Values, float], Values]:
        def noting(request: str, values: Values, now: float) -> Values:
            reply = handle(request, values, now)
            if request in _GRANTING:
                self._granted.append(f"{name} took {request}")
            return reply

        return noting

    def disturb(self, *, is_on: bool = True) -> None:
        """Lose, delay and double frames from now on, in one direction or both, or no longer."""
        for end in self.lines:
            end.inward, end.outward = (
                _faulty(self.rng) if is_on else unaltered for _ in ("inward", "outward")
            )

    async def apply(self) -> None:
        """Play some layers on all amplifiers."""
        with suppress(DriverError):
            await self.group.apply(dict.fromkeys(self.group.amplifiers, self.layers()))

    async def play(self) -> None:
        """Clear and arm if need be, and play; gives up after a DriverError."""
        with suppress(DriverError):
            await self.group.clear()
        with suppress(DriverError):
            await self.group.arm()
        await self.apply()
        await asyncio.sleep(self.rng.uniform(0.0, 0.08))

    def _loud(self, name: str) -> str:
        """Describe what an amplifier plays, or will without a request; empty if nothing."""
        now = asyncio.get_running_loop().time()
        far = next(end.far[name] for end in self.lines if name in end.far)
        far.tick(now)
        channels = range(far.playback.channels)
        level = max(
            far.playback.level(channel, now + LONGEST * number / _MOMENTS)
            for number in range(_MOMENTS)
            for channel in channels
        )
        if level > 1e-3 or far.state == "OPERATION_ENABLED":
            return f"{name} in {far.state} plays {level:.4f}"
        return ""

    def _check(self, names: Iterable[str], what: str) -> None:
        self.found += [f"{what} {loud}" for name in names if (loud := self._loud(name))]

    async def judge(self, outcomes: Mapping[str, Stopped], scene: str) -> None:
        """Compare the outcomes of a stop with the amplifiers, now and until all is silent."""
        certain = [name for name, outcome in outcomes.items() if outcome.is_confirmed]
        self._check(certain, f"{scene}: confirmed silent, but")
        self._granted.clear()
        await asyncio.sleep(_LATE)
        self._check(certain, f"{scene}: confirmed silent, but afterwards")
        self.found += [
            f"{scene}: confirmed silent, then {each}"
            for each in self._granted
            if each.split()[0] in certain
        ]
        for name, outcome in outcomes.items():
            if not outcome.is_confirmed:
                left = outcome.may_play_until + _MAX_DELAY - asyncio.get_running_loop().time()
                await asyncio.sleep(min(max(0.0, left), 3 * LONGEST))
                self._check([name], f"{scene}: {outcome}, but afterwards")

    def close(self) -> None:
        """End the heartbeats."""
        self._background.cancel()


def _faulty(rng: random.Random) -> Alter:
    """Return what loses, delays and doubles; sometimes nothing passes, or all does."""
    drawn = rng.random()
    if drawn < 0.1:
        return lambda name, data: []
    if drawn < 0.25:
        return unaltered
    lost, late, doubled = (rng.choice((0.0, 0.1, 0.3, 0.6)) for _ in range(3))
    delay = rng.choice((0.005, 0.04, _MAX_DELAY))

    def alter(name: str, data: bytes) -> list[tuple[float, bytes]]:
        copies = 0 if rng.random() < lost else 2 if rng.random() < doubled else 1
        return [(delay if rng.random() < late else 0.0002, data) for _ in range(copies)]

    return alter


async def _playing(chain: Chain) -> None:
    await chain.play()


async def _applying(chain: Chain) -> None:
    await chain.play()
    await _begun(chain, chain.apply(), longest=0.01)


async def _arming(chain: Chain) -> None:
    await _begun(chain, chain.group.arm(), longest=0.03)


async def _clearing(chain: Chain) -> None:
    await _begun(chain, chain.group.clear(), longest=0.005)


async def _disarmed(chain: Chain) -> None:
    await chain.play()
    with suppress(DriverError):
        await chain.group.disarm()


async def _stopping(chain: Chain) -> None:
    await chain.play()
    stopping = await _begun(chain, chain.group.stop(), longest=0.01)
    if chain.rng.random() < 0.5:
        stopping.cancel()


async def _begun(
    chain: Chain, work: Awaitable[object], *, longest: float
) -> "asyncio.Future[object]":
    """Begin what goes on while all is stopped."""
    task = asyncio.ensure_future(work)
    task.add_done_callback(lambda done: done.cancelled() or done.exception())
    await asyncio.sleep(chain.rng.uniform(0.0, longest))
    return task


SCENES: Mapping[str, Callable[[Chain], Awaitable[None]]] = {
    "playing": _playing,
    "applying": _applying,
    "arming": _arming,
    "clearing": _clearing,
    "disarmed": _disarmed,
    "stopping": _stopping,
}


async def _stop(chain: Chain, wire: str, scene: str, tally: Tally) -> None:
    """Stop all, and judge the outcome."""
    tally.counts[wire, "stops"] += 1
    try:
        stopping = asyncio.ensure_future(chain.group.stop())
    except Planted:  # no success
        tally.counts[wire, "raised"] += 1
        return
    await asyncio.wait([stopping], timeout=LONGEST)  # cancelled, it would still go on
    if not stopping.done():
        chain.found.append(f"{scene}: stop has not ended within {LONGEST:g} s")
    elif stopping.exception() is not None:  # no success
        tally.counts[wire, "raised"] += 1
    else:
        outcomes = stopping.result()
        if outcomes.keys() != chain.group.amplifiers.keys():
            chain.found.append(f"{scene}: outcomes of {sorted(outcomes)} only")
        for outcome in outcomes.values():
            tally.counts[wire, "confirmed" if outcome.is_confirmed else "may play"] += 1
        await chain.judge(outcomes, scene)


async def _disturbed_stops(chain: Chain, wire: str, tally: Tally, seed: int) -> None:
    """Stops of one chain while frames are lost, late and doubled."""
    rng = chain.rng
    for _ in range(PER_CHAIN):
        scene = rng.choice(tuple(SCENES))
        is_early = rng.random() < 0.5
        if is_early:
            chain.disturb()
        await SCENES[scene](chain)
        if not is_early:
            chain.disturb()
        await asyncio.sleep(rng.choice((0.0, 0.07, 0.12, 0.5)) * rng.random())
        await _stop(chain, wire, scene, tally)
        chain.disturb(is_on=False)
        await asyncio.sleep(0.3)


async def _stop_with_exception(chain: Chain, wire: str, tally: Tally, seed: int) -> None:
    """One stop, on the way of which an exception is raised at a line whose number is drawn."""
    at = random.Random(-seed).randint(1, random.Random(seed).choice((100, 500, _MOST_LINES)))
    scene = chain.rng.choice(("playing", "applying", "stopping"))
    await SCENES[scene](chain)
    if chain.rng.random() < 0.5:
        chain.disturb()
    with _exception_at(at) as planted:
        await _stop(chain, wire, f"{scene}, exception at line {at} {planted}", tally)
    chain.found = [f"{one} {planted}" for one in chain.found]


async def _stop_by_command(chain: Chain, wire: str, tally: Tally, seed: int) -> None:
    """Stop one amplifier of a killed host by `era amp stop`."""
    rng = chain.rng
    scene = rng.choice(tuple(SCENES))
    await SCENES[scene](chain)
    if is_early := rng.random() < 0.5:
        chain.disturb()
    await asyncio.sleep(rng.uniform(0.0, 0.02))
    chain.close()
    for end in chain.lines:
        end.kill_host()
    silent_from = asyncio.get_running_loop().time() + WATCHDOG + SILENCING
    if not is_early:
        chain.disturb()
    end = rng.choice(chain.lines)
    name = rng.choice(tuple(end.hosts))

    @asynccontextmanager
    async def reached(url: str) -> AsyncIterator[Host]:
        yield end.hosts[url]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(actions, "reached", reached)
        async with asyncio.timeout(LONGEST):
            rows = await actions.stop(name)
    is_confirmed = rows["silence"] == "confirmed_silent"
    tally.counts[wire, "stops"] += 1
    tally.counts[wire, "confirmed" if is_confirmed else "may play"] += 1
    await chain.judge({name: Stopped(is_confirmed, silent_from)}, f"{scene}, killed")


@contextmanager
def _exception_at(number: int) -> Iterator[list[str]]:
    """Raise `Planted` at the line of this number that the drivers run from here on.

    Yields the place, once it is reached. Lines on which a far end depends do not count.
    """
    left = number
    place: list[str] = []

    def watch(frame: types.FrameType, event: str, _: object) -> Any:
        nonlocal left
        if not frame.f_code.co_filename.startswith(_WATCHED) or _is_of_far_end(frame):
            return None
        if event == "line":
            left -= 1
            if left <= 0:
                sys.settrace(before)
                code = frame.f_code
                place.append(f"{Path(code.co_filename).name}:{frame.f_lineno} {code.co_name}")
                raise Planted
        return watch

    before = sys.gettrace()
    sys.settrace(watch)
    try:
        yield place
    finally:
        sys.settrace(before)


def _is_of_far_end(frame: types.FrameType | None) -> bool:
    while frame is not None:
        if frame.f_code.co_filename.startswith(_FAR) or frame.f_code is Chain._loud.__code__:
            return True
        frame = frame.f_back
    return False


PROGRAMMES: Mapping[str, Callable[[Chain, str, Tally, int], Awaitable[None]]] = {
    "frames lost, late and doubled": _disturbed_stops,
    "one exception each": _stop_with_exception,
    "by era amp stop, of a killed host": _stop_by_command,
}


def play(programme: str, seed: int, tally: Tally) -> None:
    """Stop a chain once, or some times, and judge it; seeds go over all wires in turn."""
    wire, rng = tuple(LINES)[seed % len(LINES)], random.Random(seed)

    async def run() -> list[str]:
        chain = Chain(wire, rng)
        await chain.group.open()
        await PROGRAMMES[programme](chain, wire, tally, seed)
        chain.close()
        return chain.found

    try:
        found = run_virtual(run(), rng=rng)
    except Stuck as problem:
        found = [str(problem)]
    tally.found += [f"seed {seed} on {wire}: {one}" for one in found]


def main() -> int:
    """The command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--stops", type=int, default=10_000, help="with faults of frames")
    parser.add_argument("--exceptions", type=int, default=2_000, help="with an exception each")
    parser.add_argument("--killed", type=int, default=2_000, help="by command, of a killed host")
    parser.add_argument("--first", type=int, default=0, help="the first seed of each")
    options = parser.parse_args()
    logging.disable(logging.CRITICAL)
    failed = 0
    limits = (options.stops, options.exceptions, options.killed)
    for name, limit in zip(PROGRAMMES, limits, strict=True):
        tally = Tally()
        seed = options.first
        while tally.total("stops") < limit:
            play(name, seed, tally)
            seed += 1
        lines = (name, tally.table(), *tally.found, f"untrue or endless: {len(tally.found)}")
        sys.stdout.write("\n".join(lines) + "\n\n")
        sys.stdout.flush()
        failed += len(tally.found)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
