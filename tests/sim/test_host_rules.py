"""The rules for hosts: no violation in random days and scenarios, and each rule found broken."""

import asyncio
import contextlib
import math
import random
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping
from contextlib import asynccontextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest

from cases import shortly
from controller.sources.touch import Touch, TouchFrame
from drivers.host.amplifier import Amplifier
from drivers.protocol.definition import STATES
from drivers.protocol.records import Refusal
from drivers.protocol.sets import Command, Envelope, LayerSet, pack_layers
from drivers.wires.wire import OtherHost, Reply
from group_stops import RandomGroup
from kit.clock import in_virtual_time, run_virtual
from kit.courses import Acted, courses, follow
from kit.host_rules import RULES, ChannelLimits, HostRules
from kit.set_table import STROKE, SetTable, make_rig
from model.vibration import Excitation, Tone
from registry import threads
from registry.limits import GuardLimits
from sim.far_ends.wire_assignment import SimulatedWire

KINDS = {
    "can": SimulatedWire("slcan", 500_000),
    "serial": SimulatedWire("serial", 921_600, shared=True),
    "rtu": SimulatedWire("modbus-rtu", 460_800),  # a set is read back between two heartbeats
    "tcp": SimulatedWire("modbus-tcp"),
}
LINES = ("shared", "each its own")


def live(kind: str, lines: str, seed: int, *, lossy_steps: int = 0) -> None:
    """Drive two amplifiers through a random day on a kind of wire, and judge it."""
    rng = random.Random(seed)
    wire = KINDS[kind]
    alone = {name: replace(wire, line=name, shared=False) for name in ("a", "b")}
    wires = dict.fromkeys(("a", "b"), wire) if lines == "shared" else alone

    async def run() -> None:
        async with RandomGroup.of(wires, rng) as chain:
            await chain.live(40, lossy_steps=lossy_steps)
            await chain.close()
            chain.judge()
            assert chain.host_rules.requests > 100

    run_virtual(run(), rng=rng)


@pytest.mark.parametrize("seed", shortly(range(12), [1]))
@pytest.mark.parametrize("lines", shortly(LINES, ["shared"]))
@pytest.mark.parametrize("kind", shortly(KINDS, ["can", "rtu"]))
def test_rules_are_kept_in_random_days(kind: str, lines: str, seed: int) -> None:
    """Layers, stops, disarms, faults, and watchdogs that expire, heard at the amplifiers' end."""
    live(kind, lines, seed)


@pytest.mark.parametrize("seed", shortly(range(8), [1]))
@pytest.mark.parametrize("lines", shortly(LINES, ["shared"]))
@pytest.mark.parametrize("kind", shortly(KINDS, ["serial", "tcp"]))
def test_rules_are_kept_after_lost_and_doubled_frames(kind: str, lines: str, seed: int) -> None:
    """Host and amplifiers recover, and half a second later all rules hold again."""
    live(kind, lines, seed, lossy_steps=25)


# Over RTU an answer begins within 10 ms, and nothing may be sent before it: 25 ms are a fault, and
# the stop that follows a fault is still under way when the operator clears.
# A finger that comes again before a set was carried out changes nothing.
NOT_OVER_RTU = {"slow", "arc", "hung", "hasty"}


ALL_WIRES = ("serial", "modbus-tcp", "modbus-rtu", "socketcand", "slcan")
"""Every kind of wire."""
SCENARIOS = courses(Path(__file__).with_name("scenarios.yaml"))
ALONE: Excitation = {"SW": Tone(110.0, 20e-6, math.pi / 2), "NE": Tone(150.0, 40e-6, -math.pi)}
SHARED: Excitation = {"SW": Tone(90.0, 30e-6, 0.0)}
_LONGEST = 5.0  # s; a planted bug may cause a deadlock


@dataclass
class Scene(Acted):
    """A chain whose source repeats its touches from the first on, until `holding` is cancelled."""

    holding: "asyncio.Task[None] | None" = None

    @property
    def amplifier(self) -> Amplifier:
        """The host of the first amplifier."""
        return next(iter(self.controller.amplifiers.values()))

    def fingers(self, *numbers: int, is_played: bool = True) -> None:
        """Replace the fingers on the plate; is_played: whether their pattern may be played.

        Patterns are by hand, of one finger or several: metres over 100 um, radians in degrees.
        """
        self.at = {number: (0.03 + 0.06 * number, 0.1) for number in numbers}
        first, second = {0: [(110.0, 0.2, 90.0)]}, {1: [(150.0, 0.4, 180.0)]}
        if len(numbers) > 1:
            first, second = {0: [(90.0, 0.3, 0.0)]}, {}
        parts = [first, second] if len(self.far.devices) > 1 else [first | second]
        expected = dict(zip(self.far.devices, parts, strict=True))
        self.must_be_felt = is_played
        self.host_rules.expected = expected if is_played else None
        self.report()
        if self.holding is None:
            self.holding = asyncio.create_task(self.hold(math.inf))

    def asks_for(self, frequency: float, level: float, phase: float | str = 0.0) -> None:
        """Touch where the table has this tone for one ERA, which may not be played."""
        self.table.excitation = {**ALONE, "NE": Tone(frequency, level * STROKE, float(phase))}
        self.fingers(1, is_played=False)

    def touches_beside(self) -> None:
        """Deliver a touch beside the plate."""
        self.deliver(TouchFrame("panel", threads.now(), (Touch(9, 1.3, 0.5),)))

    def trips(self) -> None:
        """Trip the first amplifier by an arc."""
        self.far.bench.advance(threads.now())
        self.far.amplifier.trip("ARC", threads.now())

    def injects(self, name: str, **values: Any) -> None:
        """Have another program send a request to the first amplifier."""
        with contextlib.suppress(Refusal):
            self.far.device.handle(name, values, threads.now())

    def another_is_silent(self) -> None:
        """Let another program send a set without levels."""
        self.injects("Set", **set_of(7, layer_of(ramp=200), now=True))

    def another_feeds(self) -> None:
        """Let another program send a heartbeat of its own session."""
        self.injects("Ping", session=self.amplifier.session % 65535 + 1, rate=0)


@asynccontextmanager
async def scene(*amplifiers: str, wire: str) -> AsyncIterator[Scene]:
    """A scene on a kind of wire, open; broken rules are reported before any other error."""
    rig = make_rig(amplifiers, GuardLimits(40.0, 500.0, 0.5))
    limits = ChannelLimits(channels=3, level=0.5, slew=100.0)
    async with Scene.on(
        SimulatedWire(wire),
        rig,
        SetTable(ALONE, rig.plate, SHARED),
        limits=limits,
        sensed_every=0.001,
    ) as chain:
        chain.is_felt = False
        chain.host_rules.set_contacts(())
        try:
            async with asyncio.timeout(_LONGEST):
                await chain.open()
                yield chain
                chain.holding.cancel()
                chain.host_rules.set_contacts(())
                await chain.close()
        finally:
            chain.judge()
        assert chain.host_rules.requests > 5


def _played() -> list[tuple[str, str, int]]:
    """Each scenario, a wire and the amplifiers: on two wires each, the day on every wire."""
    wires: dict[str, tuple[str, ...]] = {"stranger": ("serial",)}
    wires |= dict.fromkeys(NOT_OVER_RTU, ("serial", "modbus-tcp", "socketcand", "slcan"))
    played = [("day", wire, amplifiers) for wire in ALL_WIRES for amplifiers in (1, 2)]
    played += [("arc", wire, 1) for wire in wires["arc"]]
    for number, name in enumerate(SCENARIOS):
        possible = wires.get(name, ALL_WIRES)
        played += [(name, wire, 1) for wire in (possible[0], possible[number % len(possible)])]
    return [*dict.fromkeys(played)]


@pytest.mark.parametrize(("scenario", "wire", "amplifiers"), _played())
def test_rules_are_kept_in_scenario(scenario: str, wire: str, amplifiers: int) -> None:
    """Every scenario passes clean; amplifiers share a wire of a kind that can be shared."""
    course = {**SCENARIOS[scenario], "amplifiers": ("a", "b")[:amplifiers], "wire": wire}
    follow(course, scene, rng=random.Random(1))


QUIET = Command(0, 2000, 0, 0)


def tone(frequency: float = 100.0, level: float = 0.5, channel: int = 0) -> Command:
    """A command without envelopes, in Hz and full levels."""
    return Command(channel, round(frequency * 20), round(level * 10_000), 0)


def layer_of(*commands: Command, number: int = 0, ramp: int = 10) -> LayerSet:
    """A layer of a set; ramp [ms]."""
    return LayerSet(number, ramp, 0, commands)


def set_of(token: int, *layers: LayerSet, session: int = 9, now: bool = False) -> dict[str, Any]:
    """The values of a Set of one part."""
    head = {"session": session, "token": token, "index": 0, "parts": 1, "now": now}
    return {**head, "stream": pack_layers(layers)}


STATUS = {"state": STATES["OPERATION_ENABLED"], "latch": 0, "levels": [0, 0]}
STOPPED = {"state": STATES["QUICK_STOP_ACTIVE"], "latch": 1, "levels": [0, 0]}


class Host:
    """A host that sends what a test tells it, on a line with the amplifiers m and n."""

    def __init__(self, rules: HostRules) -> None:
        self.rules = rules

    def sends(self, name: str, *, address: int = 1, **values: Any) -> "Host":
        """Send a request."""
        self.rules.sent("/dev/line", address, name, values)
        return self

    def hears(self, **reply: Any) -> "Host":
        """Receive the reply to the last request."""
        self.rules.arrived("/dev/line", Reply(reply))
        return self

    def exchanges(self, name: str, *, address: int = 1, reply: Any = None, **values: Any) -> "Host":
        """Send a request, and receive its reply."""
        return self.sends(name, address=address, **values).hears(**(reply or STATUS))

    def identifies_and_arms(self) -> "Host":
        """Identify and arm both amplifiers, with session 9."""
        for address in (1, 2):
            self.exchanges("Hello", address=address)
            self.exchanges("GetCaps", address=address, reply={"layers": 4})
            self.exchanges("Arm", address=address, session=9, watchdog=250, clock=0)
        return self

    def plays(self, token: int, *layers: LayerSet, address: int = 1) -> "Host":
        """Stage a set, and commit it."""
        self.exchanges("Set", address=address, reply={"staged": 1}, **set_of(token, *layers))
        return self.exchanges("Commit", address=address, session=9, token=token, at=0)


async def _no_heartbeat(host: Host) -> None:
    await asyncio.sleep(0.1)


async def _fed_while_the_loop_stalls(host: Host) -> None:
    host.rules.set_stalled()
    await asyncio.sleep(0.01)
    host.exchanges("Ping", session=9, rate=0)


async def _vibration_without_a_finger(host: Host) -> None:
    host.rules.set_contacts([1], must_be_felt=False)
    host.rules.set_contacts([])
    await asyncio.sleep(0.05)
    host.plays(5, layer_of(tone()))


async def _plays_on_after_the_last_lift(host: Host) -> None:
    host.rules.set_contacts([1])
    host.plays(5, layer_of(tone()))
    await asyncio.sleep(0.01)
    host.rules.set_contacts([])
    await asyncio.sleep(0.05)


async def _ramp_of_100_ms_after_the_last_lift(host: Host) -> None:
    host.rules.set_contacts([1])
    host.plays(5, layer_of(tone()))
    await asyncio.sleep(0.01)
    host.rules.set_contacts([])
    host.exchanges("Silence", session=9, ramp=100)


async def _touch_without_a_pattern(host: Host) -> None:
    host.rules.set_contacts([1])
    for _ in range(3):
        await asyncio.sleep(0.05)
        for address in (1, 2):
            host.exchanges("Ping", address=address, session=9, rate=0)


async def _operator_stop_is_not_sent(host: Host) -> None:
    host.rules.commanded("stop")
    await asyncio.sleep(0.03)


async def _status_before_an_operator_stop(host: Host) -> None:
    host.rules.commanded("stop")
    await asyncio.sleep(0.007)
    for address in (1, 2):
        host.exchanges("Ping", address=address, session=9, rate=0)
        host.exchanges("Stop", address=address, reply=STOPPED, ramp=5)


async def _stop_neither_confirmed_nor_repeated(host: Host) -> None:
    host.exchanges("Stop", ramp=5, reply={**STOPPED, "levels": [5000, 0]})
    for _ in range(5):
        await asyncio.sleep(0.05)
        host.exchanges("Ping", address=2, session=9, rate=0)


async def _committed_on_one_of_two(host: Host) -> None:
    for address in (1, 2):
        reply = {"staged": 1}
        host.exchanges("Set", address=address, reply=reply, **set_of(5, layer_of(tone())))
    await asyncio.sleep(0.01)
    host.exchanges("Commit", session=9, token=5, at=0)
    await asyncio.sleep(0.03)


async def _armed_without_a_request(host: Host) -> None:
    host.rules.commanded("disarm")
    for address in (1, 2):
        host.exchanges("Disarm", address=address, ramp=5, reply={**STATUS, "state": 1})
    await asyncio.sleep(0.5)
    host.exchanges("Arm", session=10, watchdog=250, clock=0)


async def _heartbeat_beside_another_host(host: Host) -> None:
    host.rules.arrived("/dev/line", OtherHost(1))
    host.exchanges("Ping", session=9, rate=0)


async def _vibration_while_disarmed(host: Host) -> None:
    host.exchanges("GetStatus", reply={**STATUS, "state": STATES["FAULT"], "latch": 1})
    await asyncio.sleep(0.01)
    host.plays(5, layer_of(tone()))


def _at_once(act: Callable[[Host], object]) -> Callable[[Host], Awaitable[None]]:
    """Make a violation of what takes no time."""

    async def run(host: Host) -> None:
        act(host)

    return run


LOUD_KNOT = Command(0, 2000, 5000, 0, onset=Envelope(100, ((9000, 0),)))
BROKEN: Mapping[str, tuple[str, Callable[[Host], Awaitable[None]]]] = {
    "set of 520 Hz": ("limits", _at_once(lambda host: host.plays(5, layer_of(tone(520.0))))),
    "set above the level": (
        "limits",
        _at_once(lambda host: host.plays(5, layer_of(tone(level=0.81)))),
    ),
    "set for an unknown channel": (
        "limits",
        _at_once(lambda host: host.plays(5, layer_of(tone(channel=2)))),
    ),
    "set for an unknown layer": (
        "limits",
        _at_once(lambda host: host.plays(5, layer_of(tone(), number=4))),
    ),
    "onset above the level": ("limits", _at_once(lambda host: host.plays(5, layer_of(LOUD_KNOT)))),
    "rise too steep": ("limits", _at_once(lambda host: host.plays(5, layer_of(tone(), ramp=4)))),
    "layers above the level together": (
        "limits",
        _at_once(
            lambda host: host.plays(5, layer_of(tone())).plays(6, layer_of(tone(150.0), number=1))
        ),
    ),
    "level that really plays": (
        "limits",
        _at_once(lambda host: host.rules.check_level("m", [0.81, 0.0])),
    ),
    "set of another session": (
        "session",
        _at_once(lambda host: host.sends("Set", **set_of(5, layer_of(), session=8))),
    ),
    "heartbeat next to another host": ("session", _heartbeat_beside_another_host),
    "older set": (
        "token",
        _at_once(
            lambda host: host.plays(5, layer_of(tone())).sends("Set", **set_of(4, layer_of()))
        ),
    ),
    "same token with other contents": (
        "token",
        _at_once(
            lambda host: host.exchanges(
                "Set", reply={"staged": 1}, **set_of(5, layer_of(QUIET))
            ).exchanges("Set", reply={"staged": 1}, **set_of(5, layer_of(number=1)))
        ),
    ),
    "vibration while disarmed": ("enabled", _vibration_while_disarmed),
    "vibration without a finger": ("justified", _vibration_without_a_finger),
    "another pattern": (
        "pattern",
        _at_once(
            lambda host: (
                setattr(host.rules, "expected", {"m": {0: [(100.0, 0.4, 0.0)]}}),
                host.plays(5, layer_of(tone())),
            )
        ),
    ),
    "plays on after the last lift": ("lift", _plays_on_after_the_last_lift),
    "ramp of 100 ms after the last lift": ("lift", _ramp_of_100_ms_after_the_last_lift),
    "touch without a pattern": ("touch", _touch_without_a_pattern),
    "committed on one of two": ("commit", _committed_on_one_of_two),
    "stop that is not sent": ("stop", _operator_stop_is_not_sent),
    "heartbeat before an operator's stop": ("stop", _status_before_an_operator_stop),
    "stop neither confirmed nor repeated": ("stop", _stop_neither_confirmed_nor_repeated),
    "heartbeat after a stop": (
        "stop",
        _at_once(
            lambda host: host.exchanges("Stop", ramp=5, reply=STOPPED).sends(
                "Ping", session=9, rate=0
            )
        ),
    ),
    "no heartbeat": ("heartbeat", _no_heartbeat),
    "fed while the loop stalls": ("heartbeat", _fed_while_the_loop_stalls),
    "armed without a request": ("armed", _armed_without_a_request),
    "armed without identification": (
        "identified",
        _at_once(
            lambda host: (
                host.rules.opened(),
                host.exchanges("Arm", session=9, watchdog=250, clock=0),
            )
        ),
    ),
    "request before a reply": (
        "credit",
        _at_once(lambda host: host.sends("GetStatus").sends("GetStatus", address=2)),
    ),
}
"""What a host does wrong, and the only rule that it breaks."""


@pytest.mark.parametrize("name", BROKEN)
@in_virtual_time
async def test_broken_rule_is_found(name: str) -> None:
    """A host of two amplifiers that breaks one rule breaks no other."""
    rule, act = BROKEN[name]
    urls = {"m": "serial:///dev/line?address=1", "n": "serial:///dev/line?address=2"}
    limits = ChannelLimits(channels=2, level=0.8, slew=100.0)
    rules = HostRules(urls, limits=limits)
    host = Host(rules).identifies_and_arms()
    await act(host)
    violations = rules.finish()
    assert {violation.rule for violation in violations} == {rule}, [*map(str, violations)]


def test_every_rule_is_broken_once() -> None:
    """The table of violations leaves out no rule."""
    assert {rule for rule, _ in BROKEN.values()} == RULES.keys()
