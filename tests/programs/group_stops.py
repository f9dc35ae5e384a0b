"""Stops of groups: is an amplifier silent whenever a stop says so? `make stop-test` has thousands.

Over every wire of protocol 4, in virtual time. First frames are lost, late and doubled at random
while all is stopped, at any moment of what a host does. Then one exception is raised on the way of
each stop, at a line of the drivers that is drawn at random. Last the host is killed, and one of its
amplifiers stopped by `era amp stop`. Whatever happens, a stop ends in time, and what it reports of
each amplifier agrees with what its channels play. Also random days of amplifiers on the chain:
layers, stops, faults, lost frames.
"""

import asyncio
import contextlib
import random
import sys
import types
from collections import Counter
from collections.abc import Awaitable, Callable, Iterable, Iterator, Mapping
from contextlib import AbstractAsyncContextManager, contextmanager, suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Self

import drivers
import sim
from drivers.by_hand import actions
from drivers.errors import CommandRefused, DriverError, LinkError, Preempted
from drivers.host.group import Group
from drivers.host.requests import Priority
from drivers.host.stops import StopOutcome
from drivers.host.watchdog import SILENCING_TIME
from drivers.playing import AmplifierLayer, AmplifierTone
from drivers.protocol.definition import BOOT_TIME, STATES
from drivers.protocol.sets import Envelope
from kit import host_rules, plate_judge
from kit import wires as real_wires
from kit.chain import Chain
from kit.clock import VirtualLoop, run_virtual
from kit.host_rules import ChannelLimits
from kit.set_table import SetTable, make_rig
from kit.wires import after_each
from registry import threads
from registry.limits import GuardLimits
from registry.virtual_time import Stuck
from sim.far_ends.wire_assignment import SimulatedWire
from sim.faults import FaultKind, FaultWindow, Toward

_CHANNELS, _LAYERS = 2, 4
_PASSING = 50e-6, 350e-6  # s; through driver and adapter, that sets may be read back at any time
_FAILURES = (CommandRefused, LinkError, Preempted)


@dataclass
class RandomGroup(Chain):
    """A chain whose amplifiers play what is drawn: no finger touches, and its loop only beats."""

    rng: random.Random = field(init=False)
    _turned: asyncio.Event = field(default_factory=asyncio.Event)

    def __post_init__(self) -> None:
        """Draw as the wires do."""
        super().__post_init__()
        loop = asyncio.get_running_loop()
        assert isinstance(loop, VirtualLoop)
        self.rng = loop.rng

    @classmethod
    def of(
        cls, wires: Mapping[str, SimulatedWire], rng: random.Random, **options: Any
    ) -> AbstractAsyncContextManager[Self]:
        """A chain of amplifiers on wires, not open yet; options: as for `Chain.on`."""
        rig = make_rig([*wires], GuardLimits(20.0, 1000.0, 1.0))
        options |= {
            "passing": _PASSING,
            "capabilities": {"layers": _LAYERS},
            "watchdog": rng.choice((0.25, 0.5)),
        }
        limits = ChannelLimits(frequency=(20.0, 1000.0))
        table = SetTable({}, rig.plate)
        return cls.on(wires, rig, table, limits=limits, sensed_every=0.002, **options)

    async def _turn(self, step: Callable[[], Awaitable[None]]) -> None:
        try:
            await super()._turn(step)
        finally:
            self._turned.set()

    async def arm(self) -> None:
        """Arm, and await the turn of the loop that silences what it does not know."""
        await self.operate("arm")
        self._turned.clear()
        await self._turned.wait()

    @property
    def group(self) -> Group:
        """All amplifiers."""
        return self.controller.group

    def disturb(self, *windows: FaultWindow) -> None:
        """Have faults of frames on all wires from now on, until `recover`."""
        self.host_rules.disturb()
        for far_end in self.far_ends:
            for window in windows:
                far_end.device.inject_fault(window)

    def recover(self) -> None:
        """End the faults of frames."""
        for far_end in self.far_ends:
            far_end.recover()
        self.host_rules.disturb(-1)

    async def live(self, steps: int) -> None:
        """Open and arm the group, take so many steps, and disarm."""
        await self.open()
        for _ in range(steps):
            with contextlib.suppress(*_FAILURES):
                await self._step()
            await asyncio.sleep(self.rng.choice((0.0, 0.001, 0.01, 0.04, 0.2)))
        with contextlib.suppress(*_FAILURES):
            await self.operate("disarm")
        await asyncio.sleep(0.1)

    async def _step(self) -> None:
        if not self.group.is_open:
            await self.controller.release()
            await self.controller.open()
        if not self.group.is_armed and self.rng.random() < 0.8:
            await self.operate("clear")
            await self.arm()
            return
        chosen = self.rng.random()
        names = [*self.group.amplifiers]
        host = self.group.amplifiers[self.rng.choice(names)]
        if chosen < 0.6:
            await self.group.apply({name: self.layers() for name in names})
        elif chosen < 0.7:
            await host.request("GetAchieved", {"layer": self._number()}, Priority.OTHER)
        elif chosen < 0.75:
            await host.request("GetFaults", {}, Priority.OTHER)
        elif chosen < 0.8:
            await self.group.silence(self._ramp())
        elif chosen < 0.84:
            await self.operate("disarm")
        elif chosen < 0.9:
            await self.operate("stop")
        elif chosen < 0.93:
            self.turning.clear()
            await asyncio.sleep(0.6)
            self.turning.set()
        elif chosen < 0.96:
            self.far.bench.advance(threads.now())
            amplifier = self.rng.choice(self.far_ends).amplifier
            amplifier.trip(self.rng.choice(("ARC", "CHANNEL")), threads.now(), channel=1)
        else:
            status = await host.read_status()
            if self.group.is_armed and status["state"] != STATES["OPERATION_ENABLED"]:
                await self.operate("stop")

    def _number(self) -> int:
        return self.rng.randrange(_LAYERS)

    def _ramp(self) -> float:
        return self.rng.choice((0.0, 0.005, 0.01, 0.03))

    def layers(self) -> list[AmplifierLayer]:
        """Draw layers to play."""
        numbers = self.rng.sample(range(_LAYERS), self.rng.choice((1, 1, 1, 2)))
        return [self._layer(number) for number in numbers]

    def _layer(self, number: int) -> AmplifierLayer:
        kind = self.rng.random()
        valid_for = self.rng.choice((0.0, 0.0, 0.05, 0.3))
        if kind < 0.15:
            return AmplifierLayer(number, (), self._ramp())
        if kind < 0.25:
            return AmplifierLayer(number, (), self._ramp(), valid_for, renew=True)
        channels = self.rng.sample(range(_CHANNELS), self.rng.choice((1, 2)))
        tones = tuple(self._tone(channel, number) for channel in channels)
        return AmplifierLayer(
            number, tones, self._ramp(), valid_for, after=self.rng.random() < 0.15
        )

    def _tone(self, channel: int, number: int) -> AmplifierTone:
        rng = self.rng
        shapes = [self._shape() if rng.random() < 0.3 else None for _ in range(2)]
        return AmplifierTone(
            *(channel, rng.choice((100.0, 100.0, 150.0 + number)), rng.choice((0.0, 0.1, 0.2))),
            rng.uniform(-180, 179),
            keep_phase=rng.random() < 0.4,
            skip_ending=rng.random() < 0.3,
            onset=shapes[0],
            ending=shapes[1],
        )

    def _shape(self) -> Envelope:
        count = self.rng.choice((0, 1, 4))
        step = self.rng.choice((10, 40, 200))
        return Envelope(step, tuple((self.rng.randrange(2000), 0) for _ in range(count)))


_SHARED = ("a", "b")
LINES: Mapping[str, Mapping[str, SimulatedWire]] = {
    "serial": {"a": SimulatedWire("serial", 921_600)},
    "serial, two lines": {name: SimulatedWire("serial", 921_600, line=name) for name in _SHARED},
    "serial, shared": dict.fromkeys(_SHARED, SimulatedWire("serial", 921_600, shared=True)),
    "modbus-rtu, shared": dict.fromkeys(_SHARED, SimulatedWire("modbus-rtu", 115_200)),
    "modbus-tcp": {"a": SimulatedWire("modbus-tcp")},
    "can, shared": dict.fromkeys(_SHARED, SimulatedWire("slcan", 500_000)),
}
"""Wires of the amplifiers."""

PER_CHAIN = 12  # stops of one chain, with faults of frames
LONGEST = 5.0  # s; a stop that takes longer hangs
_MAX_DELAY = 0.2  # s; of a late frame
_LATE = 2 * _MAX_DELAY + 0.05  # s; until every late frame and its late copy have arrived
_MOMENTS = 20  # at which what plays is looked at
_MOST_LINES = 1500  # of a stop without faults; the place of an exception is drawn among them
_WATCHED, _SIMULATED = (str(Path(package.__path__[0])) for package in (drivers, sim))
_FAR = (_SIMULATED, str(host_rules.__file__), str(plate_judge.__file__), str(real_wires.__file__))
_GRANTING = ("Arm", "Set", "Commit")
_FRAME_FAULTS: tuple[FaultKind, ...] = ("drop", "duplicate", "delay")


class Planted(Exception):
    """The exception that is raised on the way of a stop."""


@dataclass
class Tally:
    """Outcomes of stops by wire, and what was found wrong."""

    counts: Counter[tuple[str, str]] = field(default_factory=Counter)
    problems: list[str] = field(default_factory=list)

    def total(self, what: str) -> int:
        """The sum over all wires."""
        return sum(count for (_, name), count in self.counts.items() if name == what)


@dataclass
class Stopping(RandomGroup):
    """A chain whose group is stopped; problems: what was wrong."""

    problems: list[str] = field(default_factory=list)
    _granted: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        """Note what lets an amplifier play."""
        super().__post_init__()
        for name, device in self.far.devices.items():
            after_each(device, partial(self._note, name))

    def _note(self, name: str, request: str, *_: object) -> None:
        if request in _GRANTING:
            self._granted.append(f"{name} took {request}")

    def lose_some(self) -> None:
        """Lose, delay and double frames from now on, in one direction or both."""
        self.disturb(*_drawn(self.rng, "amplifier"), *_drawn(self.rng, "host"))

    async def apply(self) -> None:
        """Play some layers on all amplifiers."""
        with suppress(DriverError):
            await self.group.apply(dict.fromkeys(self.group.amplifiers, self.layers()))

    async def play(self) -> None:
        """Clear and arm if need be, and play; gives up after a DriverError."""
        with suppress(DriverError):
            await self.operate("clear")
        with suppress(DriverError):
            await self.arm()
        await self.apply()
        await asyncio.sleep(self.rng.uniform(0.0, 0.08))

    async def begin(self, scene: str) -> None:
        """Do what a scene says; what it begins may go on while all is stopped."""
        if scene not in ("arming", "clearing"):
            await self.play()
        if scene == "disarmed":
            with suppress(DriverError):
                await self.operate("disarm")
        begun: Mapping[str, tuple[Callable[[], Awaitable[object]], float]] = {
            "applying": (self.apply, 0.01),
            "arming": (partial(self.operate, "arm"), 0.03),
            "clearing": (partial(self.operate, "clear"), 0.005),
            "stopping": (partial(self.operate, "stop"), 0.01),
        }
        if scene in begun:
            work, longest = begun[scene]
            task = asyncio.ensure_future(work())
            task.add_done_callback(lambda done: done.cancelled() or done.exception())
            await asyncio.sleep(self.rng.uniform(0.0, longest))
            if scene == "stopping" and self.rng.random() < 0.5:
                task.cancel()

    def _loud(self, name: str) -> str:
        """Describe what an amplifier plays, or will without a request; empty if nothing."""
        level = self.plate_judge.loudest(name, LONGEST, _MOMENTS)
        state = self.far.summary(name).state
        if level > 1e-3 or state == "OPERATION_ENABLED":
            return f"{name} in {state} plays {level:.4f}"
        return ""

    def _check(self, names: Iterable[str], what: str) -> None:
        for name in names:
            loud = self._loud(name)
            if loud:
                self.problems.append(f"{what} {loud}")

    async def compare(self, outcomes: Mapping[str, StopOutcome], scene: str) -> None:
        """Compare the outcomes of a stop with the amplifiers, now and until all is silent."""
        certain = [name for name, outcome in outcomes.items() if outcome.is_confirmed]
        self._check(certain, f"{scene}: confirmed silent, but")
        self._granted.clear()
        await asyncio.sleep(_LATE)
        self._check(certain, f"{scene}: confirmed silent, but afterwards")
        for grant in self._granted:
            name, *_ = grant.split()
            if name in certain:
                self.problems.append(f"{scene}: confirmed silent, then {grant}")
        for name, outcome in outcomes.items():
            if not outcome.is_confirmed:
                now = asyncio.get_running_loop().time()
                remaining = outcome.may_play_until + _MAX_DELAY - now
                await asyncio.sleep(min(max(0.0, remaining), 3 * LONGEST))
                self._check([name], f"{scene}: {outcome}, but afterwards")

    def end(self) -> None:
        """End the control loop."""
        self.running.cancel()


def _drawn(rng: random.Random, toward: Toward) -> list[FaultWindow]:
    """Return what loses, delays and doubles; sometimes nothing passes, or all does."""
    drawn = rng.random()
    if drawn < 0.1:
        return [FaultWindow(fault="drop", toward=toward)]
    if drawn < 0.25:
        return []
    delay = rng.choice((0.005, 0.04, _MAX_DELAY))
    shares = {fault: rng.choice((0.0, 0.1, 0.3, 0.6)) for fault in _FRAME_FAULTS}
    return [
        FaultWindow(fault=fault, share=share, toward=toward, delay=delay)
        for fault, share in shares.items()
        if share
    ]


SCENES = ("playing", "applying", "arming", "clearing", "disarmed", "stopping")
"""What a host does while all is stopped, or has done before."""


async def _stop(chain: Stopping, wire: str, scene: str, tally: Tally) -> None:
    """Stop all, and judge the outcome."""
    tally.counts[wire, "stops"] += 1
    try:
        stopping = asyncio.ensure_future(chain.controller.stop())
    except Planted:  # no success
        tally.counts[wire, "raised"] += 1
        return
    await asyncio.wait([stopping], timeout=LONGEST)  # cancelled, it would still go on
    if not stopping.done():
        chain.problems.append(f"{scene}: stop has not ended within {LONGEST:g} s")
    elif stopping.exception() is not None:  # no success
        tally.counts[wire, "raised"] += 1
    else:
        outcomes = stopping.result()
        if outcomes.keys() != chain.group.amplifiers.keys():
            chain.problems.append(f"{scene}: outcomes of {sorted(outcomes)} only")
        for outcome in outcomes.values():
            tally.counts[wire, "confirmed" if outcome.is_confirmed else "may play"] += 1
        await chain.compare(outcomes, scene)


async def _disturbed_stops(chain: Stopping, wire: str, tally: Tally, seed: int) -> None:
    """Stops of one chain while frames are lost, late and doubled."""
    rng = chain.rng
    for _ in range(PER_CHAIN):
        scene = rng.choice(SCENES)
        is_early = rng.random() < 0.5
        if is_early:
            chain.lose_some()
        await chain.begin(scene)
        if not is_early:
            chain.lose_some()
        await asyncio.sleep(rng.choice((0.0, 0.07, 0.12, 0.5)) * rng.random())
        await _stop(chain, wire, scene, tally)
        chain.recover()
        await asyncio.sleep(0.3)


async def _stop_with_exception(chain: Stopping, wire: str, tally: Tally, seed: int) -> None:
    """One stop, on the way of which an exception is raised at a line whose number is drawn."""
    at = random.Random(-seed).randint(1, random.Random(seed).choice((100, 500, _MOST_LINES)))
    scene = chain.rng.choice(("playing", "applying", "stopping"))
    await chain.begin(scene)
    if chain.rng.random() < 0.5:
        chain.lose_some()
    with _exception_at(at) as planted:
        await _stop(chain, wire, f"{scene}, exception at line {at} {planted}", tally)
    chain.problems = [f"{problem} {planted}" for problem in chain.problems]


async def _stop_by_command(chain: Stopping, wire: str, tally: Tally, seed: int) -> None:
    """Stop one amplifier of a killed host by `era amp stop`."""
    rng = chain.rng
    scene = rng.choice(SCENES)
    await chain.begin(scene)
    if is_early := rng.random() < 0.5:
        chain.lose_some()
    await asyncio.sleep(rng.uniform(0.0, 0.02))
    chain.end()
    chain.operation.kill_host()
    loop = asyncio.get_running_loop()
    assert isinstance(loop, VirtualLoop)
    loop.kill_hosts()
    silent_from = loop.time() + chain.controller.watchdog + SILENCING_TIME
    if not is_early:
        chain.lose_some()
    name = rng.choice([*chain.far.urls])
    async with asyncio.timeout(BOOT_TIME + LONGEST):
        rows = await actions.stop(chain.far.urls[name])
    is_confirmed = rows["silence"] == "confirmed_silent"
    tally.counts[wire, "stops"] += 1
    tally.counts[wire, "confirmed" if is_confirmed else "may play"] += 1
    await chain.compare({name: StopOutcome(is_confirmed, silent_from)}, f"{scene}, killed")


@contextmanager
def _exception_at(number: int) -> Iterator[list[str]]:
    """Raise `Planted` at the line of this number that the drivers run from here on.

    Yields the place, once it is reached. Lines on which a far end depends do not count.
    """
    lines_left = number
    place: list[str] = []

    def watch(frame: types.FrameType, event: str, _: object) -> Any:
        nonlocal lines_left
        if not frame.f_code.co_filename.startswith(_WATCHED) or _is_of_far_end(frame):
            return None
        if event == "line":
            lines_left -= 1
            if lines_left <= 0:
                sys.settrace(former_trace)
                code = frame.f_code
                place.append(f"{Path(code.co_filename).name}:{frame.f_lineno} {code.co_name}")
                raise Planted
        return watch

    former_trace = sys.gettrace()
    sys.settrace(watch)
    try:
        yield place
    finally:
        sys.settrace(former_trace)


def _is_of_far_end(frame: types.FrameType | None) -> bool:
    while frame is not None:
        if frame.f_code.co_filename.startswith(_FAR):
            return True
        frame = frame.f_back
    return False


PROGRAMMES: Mapping[str, Callable[[Stopping, str, Tally, int], Awaitable[None]]] = {
    "frames lost, late and doubled": _disturbed_stops,
    "one exception each": _stop_with_exception,
    "by era amp stop, of a killed host": _stop_by_command,
}


def play(programme: str, seed: int, tally: Tally) -> None:
    """Stop a chain once, or some times, and judge it; seeds go over all wires in turn."""
    wire, rng = tuple(LINES)[seed % len(LINES)], random.Random(seed)

    async def run() -> list[str]:
        async with Stopping.of(LINES[wire], rng) as chain:
            await chain.open()
            await PROGRAMMES[programme](chain, wire, tally, seed)
            chain.end()
        return chain.problems

    try:
        problems = run_virtual(run(), rng=rng)
    except Stuck as problem:
        problems = [str(problem)]
    tally.problems += [f"seed {seed} on {wire}: {problem}" for problem in problems]
