"""Stops by the thousand: is an amplifier silent whenever a stop says so?

    python tests/support/stops.py [--stops N] [--exceptions N] [--killed N] [--first SEED]

Over every wire, in virtual time. First frames are lost, late and doubled at random while all is
stopped, at any moment of what a host does. Then one exception is raised on the way of each stop, at
a line of the drivers or the controller that is drawn at random; at last `era amp stop` stops what a
killed host has left. Whatever happens, a stop ends in time, and what it reports of each amplifier
agrees with what its channels play.
"""

import argparse
import asyncio
import logging
import random
import sys
import types
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import controller
import drivers
import sim
from drivers import amp_actions
from drivers.errors import DriverError
from drivers.operation.silence import SilenceStatus, StopOutcome
from sim.faults.fault_window import FaultWindow
from stop_chain import LONGEST, MAX_DELAY, WIRES, StopChain, stop_chain
from virtual_loop import Stuck, run_virtual

PER_CHAIN = 12  # stops of one chain, with faults of frames
_WATCHED = tuple(str(Path(package.__path__[0])) for package in (drivers, controller))
_FAR = str(Path(sim.__path__[0]))
_MOST_LINES = 3000  # of a stop without faults; the place of an exception is drawn among them


@dataclass
class Tally:
    """Outcomes of stops by wire, and what was found wrong."""

    counts: Counter[tuple[str, str]] = field(default_factory=Counter)
    found: list[str] = field(default_factory=list)

    def add(self, wire: str, outcomes: Mapping[str, StopOutcome] | None) -> None:
        """Count a stop; None: it raised an exception."""
        self.counts[wire, "stops"] += 1
        if outcomes is None:
            self.counts[wire, "raised"] += 1
            return
        for outcome in outcomes.values():
            self.counts[wire, outcome.silence.value] += 1

    def total(self, what: str) -> int:
        """The sum over all wires."""
        return sum(count for (_, name), count in self.counts.items() if name == what)

    def table(self) -> str:
        """A row for each wire."""
        columns = ("stops", *(silence.value for silence in SilenceStatus), "raised")
        rows = [f"{'':<16}" + "".join(f"{name:>18}" for name in columns)]
        for wire in dict.fromkeys(wire for wire, _ in self.counts):
            cells = "".join(f"{self.counts[wire, name]:>18}" for name in columns)
            rows.append(f"{wire:<16}{cells}")
        return "\n".join(rows)


class Planted(Exception):
    """The exception that is raised on the way of a stop."""


# What a host does when it is stopped, by name.


async def _playing(chain: StopChain) -> None:
    await chain.play()


async def _touched(chain: StopChain) -> None:
    await chain.play()
    chain.touch()
    await asyncio.sleep(chain.rng.uniform(0.0, 0.01))


async def _arming(chain: StopChain) -> None:
    arming = asyncio.create_task(chain.controller.arm())
    arming.add_done_callback(lambda task: task.cancelled() or task.exception())
    await asyncio.sleep(chain.rng.uniform(0.0, 0.01))


async def _clearing(chain: StopChain) -> None:
    clearing = asyncio.create_task(chain.controller.clear())
    clearing.add_done_callback(lambda task: task.cancelled() or task.exception())
    await asyncio.sleep(chain.rng.uniform(0.0, 0.005))


async def _disarmed(chain: StopChain) -> None:
    await chain.play()
    with suppress(DriverError):
        await chain.controller.disarm()


async def _stopping(chain: StopChain) -> None:
    await chain.play()
    stopping = asyncio.create_task(chain.controller.stop())
    await asyncio.sleep(chain.rng.uniform(0.0, 0.01))
    if chain.rng.random() < 0.5:
        stopping.cancel()


SCENES: Mapping[str, Callable[[StopChain], Any]] = {
    "playing": _playing,
    "touched": _touched,
    "arming": _arming,
    "clearing": _clearing,
    "disarmed": _disarmed,
    "stopping": _stopping,
}


def _faults(rng: random.Random) -> tuple[FaultWindow, ...]:
    """Frames lost, late and doubled, in one direction or both; sometimes all are lost."""
    if rng.random() < 0.15:
        return (FaultWindow("drop", toward=rng.choice((None, "host", "amplifier"))),)
    return tuple(
        FaultWindow(
            kind,
            share=rng.choice((0.1, 0.3, 0.6)),
            toward=rng.choice((None, "host", "amplifier")),
            delay=rng.choice((0.005, 0.04, MAX_DELAY)),
        )
        for kind in ("drop", "delay", "duplicate")
        if rng.random() < 0.6
    )


async def _stop(chain: StopChain, wire: str, scene: str, tally: Tally) -> None:
    """Stop all, and judge the outcome."""
    stopping = asyncio.create_task(chain.controller.stop())
    await asyncio.wait([stopping], timeout=LONGEST)  # cancelled, it would still go on
    if not stopping.done():
        chain.found.append(f"{scene}: stop has not ended within {LONGEST:g} s")
        return
    if stopping.exception() is not None:  # no success
        tally.add(wire, None)
        return
    outcomes = stopping.result()
    tally.add(wire, outcomes)
    await chain.judge(outcomes, scene=scene)


async def _disturbed_stops(wire: str, rng: random.Random, stops: int, tally: Tally) -> list[str]:
    """Stops of one chain while frames are lost, late and doubled."""
    async with stop_chain(wire, rng.choice((1, 2)), rng) as chain:
        for _ in range(stops):
            scene = rng.choice(tuple(SCENES))
            is_early = rng.random() < 0.5
            if is_early:
                chain.disturb(_faults(rng))
            await SCENES[scene](chain)
            if not is_early:
                chain.disturb(_faults(rng))
            await asyncio.sleep(rng.choice((0.0, 0.07, 0.12, 0.5)) * rng.random())
            await _stop(chain, wire, scene, tally)
            chain.recover()
            await asyncio.sleep(0.3)
            if not await _recovered(chain):
                break
    return [*chain.found, *chain.unhandled]


async def _recovered(chain: StopChain) -> bool:
    """Whether it can be armed again; a lost link can not, until it is opened again."""
    try:
        await chain.controller.clear()
    except DriverError:
        return False
    return True


async def _stop_with_exception(
    wire: str, rng: random.Random, tally: Tally, *, at: int
) -> list[str]:
    """One stop, on the way of which an exception is raised at the line of this number."""
    async with stop_chain(wire, rng.choice((1, 2)), rng) as chain:
        scene = rng.choice(("playing", "touched", "stopping"))
        await SCENES[scene](chain)
        if rng.random() < 0.5:
            chain.disturb(_faults(rng))
        with _exception_at(at) as planted:
            await _stop(chain, wire, f"{scene}, exception at line {at} {planted}", tally)
    return [f"{one} {planted}" for one in chain.found]


async def _stop_by_command(wire: str, rng: random.Random, tally: Tally) -> list[str]:
    """`era amp stop` for every amplifier of a host that was killed while it played."""
    async with stop_chain(wire, rng.choice((1, 2)), rng) as chain:
        await chain.play()
        await chain.abandon()
        chain.disturb(_faults(rng))
        outcomes: dict[str, StopOutcome] = {}
        for name, url in chain.urls.items():
            try:
                rows = await amp_actions.stop(url)
                outcomes[name] = StopOutcome(SilenceStatus(rows["silence"]))
            except DriverError as error:
                outcomes[name] = StopOutcome(SilenceStatus.MAY_PLAY, None, str(error))
        tally.add(wire, outcomes)
        await chain.judge(outcomes, scene="by command")
        return chain.found  # not what closing the killed host does


@contextmanager
def _exception_at(number: int) -> Iterator[list[str]]:
    """Raise `Planted` at the line of this number that drivers or controller run from here on.

    Yields the place, once it is reached. Lines on which a far end depends do not count.
    """
    left = number
    place: list[str] = []

    def watch(frame: types.FrameType, event: str, _: object) -> Any:
        nonlocal left
        if not frame.f_code.co_filename.startswith(_WATCHED) or _serves_far_end(frame):
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


def _serves_far_end(frame: types.FrameType | None) -> bool:
    while frame is not None:
        if frame.f_code.co_filename.startswith(_FAR):
            return True
        frame = frame.f_back
    return False


def disturbed_stops(seeds: Iterable[int], *, tally: Tally) -> None:
    """Chains over every wire in turn, with faults of frames."""
    wires = tuple(WIRES)
    for seed in seeds:
        wire = wires[seed % len(wires)]
        rng = random.Random(seed)
        _run(_disturbed_stops(wire, rng, PER_CHAIN, tally), rng, f"seed {seed} on {wire}", tally)


def stops_with_exceptions(seeds: Iterable[int], *, tally: Tally) -> None:
    """One stop with one exception for each seed, over every wire in turn."""
    wires = tuple(WIRES)
    for seed in seeds:
        wire = wires[seed % len(wires)]
        rng = random.Random(seed)
        at = rng.randint(1, rng.choice((100, 1000, _MOST_LINES)))
        _run(_stop_with_exception(wire, rng, tally, at=at), rng, f"seed {seed} on {wire}", tally)


def stops_by_command(seeds: Iterable[int], *, tally: Tally) -> None:
    """One killed host for each seed, over every wire in turn."""
    wires = tuple(WIRES)
    for seed in seeds:
        wire = wires[seed % len(wires)]
        rng = random.Random(seed)
        _run(_stop_by_command(wire, rng, tally), rng, f"seed {seed} on {wire}", tally)


def _run(main: Any, rng: random.Random, name: str, tally: Tally) -> None:
    try:
        found = run_virtual(main, rng=rng)
    except Stuck as problem:
        found = [str(problem)]
    tally.found += [f"{name}: {one}" for one in found]


def main() -> int:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--stops", type=int, default=10_000, help="with faults of frames")
    parser.add_argument("--exceptions", type=int, default=2_000, help="with an exception each")
    parser.add_argument("--killed", type=int, default=2_000, help="by command, of a killed host")
    parser.add_argument("--first", type=int, default=0, help="the first seed of each")
    options = parser.parse_args()
    logging.disable(logging.CRITICAL)
    failed = 0
    for name, play, seeds in (
        ("frames lost, late and doubled", disturbed_stops, range(options.stops)),
        ("one exception each", stops_with_exceptions, range(options.exceptions)),
        ("by era amp stop, of a killed host", stops_by_command, range(options.killed)),
    ):
        tally = Tally()
        limit = len(seeds)
        for seed in range(options.first, options.first + limit):
            if tally.total("stops") >= limit:
                break
            play((seed,), tally=tally)
        sys.stdout.write(f"{name}\n{tally.table()}\n")
        for one in tally.found:
            sys.stdout.write(f"{one}\n")
        sys.stdout.write(f"untrue or endless         {len(tally.found)}\n\n")
        sys.stdout.flush()
        failed += len(tally.found)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
