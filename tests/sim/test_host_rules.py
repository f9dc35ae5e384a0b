"""The witness: days of sound amplifiers, its decoders, and each of its rules.

It finds nothing in days that are random and in scenarios, on every kind of wire; the decoders read
bytes that were written by hand; each violation is found, correct traffic and own delays are none.
"""

import asyncio
import math
import random
import struct
from collections.abc import AsyncIterator, Callable, Mapping, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest

from cases import read_yaml, shortly
from controller.sources.touch import Touch, TouchFrame
from drivers.host.amplifier import Amplifier
from drivers.wires.modbus_frames import framed
from group_stops import RandomGroup
from kit import conversation as hand
from kit.clock import run_virtual
from kit.conversation import HALF, Talk
from kit.courses import Acted, courses, follow
from kit.set_table import STROKE, SetTable, make_rig
from kit.witness import RULES
from model.vibration import Excitation, Tone
from registry import threads
from registry.limits import GuardLimits
from sim.far_ends.wire_assignment import SimulatedWire
from witness.capture import (
    TransferDirection,
    WitnessedMessage,
    WitnessedReply,
    WitnessedRequest,
)
from witness.witness import DECODERS

KINDS = {
    "can": SimulatedWire("slcan", 500_000),
    "serial": SimulatedWire("serial", 921_600, shared=True),
    "rtu": SimulatedWire("modbus-rtu", 460_800),  # a set is read back between two heartbeats
    "tcp": SimulatedWire("modbus-tcp"),
}
LINES = ("shared", "each its own")


def live(kind: str, lines: str, seed: int, *, lossy_steps: int = 0) -> None:
    """Have two amplifiers live a random day on a kind of wire, and ask the witness."""
    rng = random.Random(seed)
    wire = KINDS[kind]
    alone = {name: replace(wire, line=name, shared=False) for name in ("a", "b")}
    wires = dict.fromkeys(("a", "b"), wire) if lines == "shared" else alone

    async def run() -> None:
        async with RandomGroup.of(wires, rng) as chain:
            await chain.live(40, lossy_steps=lossy_steps)
            await chain.close()
            chain.judge()
            assert chain.witness.frames > 200

    run_virtual(run(), rng=rng)


@pytest.mark.parametrize("seed", shortly(range(12), [1]))
@pytest.mark.parametrize("lines", shortly(LINES, ["shared"]))
@pytest.mark.parametrize("kind", shortly(KINDS, ["can", "rtu"]))
def test_witness_finds_nothing_in_random_days(kind: str, lines: str, seed: int) -> None:
    """Layers, stops, disarms, faults, and watchdogs that expire, heard at the amplifiers' end."""
    live(kind, lines, seed)


@pytest.mark.parametrize("seed", shortly(range(8), [1]))
@pytest.mark.parametrize("lines", shortly(LINES, ["shared"]))
@pytest.mark.parametrize("kind", shortly(KINDS, ["serial", "tcp"]))
def test_witness_excuses_lost_and_doubled_frames(kind: str, lines: str, seed: int) -> None:
    """Host and amplifiers recover, and half a second later all rules hold again."""
    live(kind, lines, seed, lossy_steps=25)


ROOT = Path(__file__).parents[2]
# Over RTU an answer begins within 10 ms, and nothing may be sent before it: 25 ms are a fault, and
# the stop that follows a fault is still under way when the operator clears.
# A finger that comes again before a set was carried out changes nothing.
NOT_OVER_RTU = {"slow", "arc", "hung", "hasty"}


WITNESSED = ("serial", "modbus-tcp", "modbus-rtu", "socketcand", "slcan")
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
        self.witness.expect(expected if is_played else None)
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

    def injects(self, kind: int, words: Sequence[int]) -> None:
        """Inject a request of another program toward the amplifier on the first wire."""
        link, data = self.witness.wires[0], hand.frame(kind, words, sequence=999)
        self.operation.deliver(link, "amplifier", data, self.operation._terminals[link].inward)

    def another_is_silent(self) -> None:
        """Let another program send a set without levels."""
        self.injects(hand.SET, hand.part(7, hand.layer(0), now=True))

    def another_feeds(self) -> None:
        """Let another program send a heartbeat of its own session."""
        self.injects(hand.PING, (self.amplifier.session % 65535 + 1, 0))


@asynccontextmanager
async def scene(*amplifiers: str, wire: str) -> AsyncIterator[Scene]:
    """A scene on a kind of wire, open; what the witness found is said before any other error."""
    rig = make_rig(amplifiers, GuardLimits(40.0, 500.0, 0.5))
    judged = {"channels": 3, "level": 0.5, "slew": 100}
    async with Scene.on(
        SimulatedWire(wire),
        rig,
        SetTable(ALONE, rig.plate, SHARED),
        judged=judged,
        sensed_every=0.001,
    ) as chain:
        chain.is_felt = False
        chain.witness.contacts(threads.now(), ())
        try:
            async with asyncio.timeout(_LONGEST):
                await chain.open()
                yield chain
                chain.holding.cancel()
                chain.witness.contacts(threads.now(), ())
                await chain.close()
        finally:
            chain.judge()
        assert chain.witness.frames > 5


def _played() -> list[tuple[str, str, int]]:
    """Each scenario, a wire and the amplifiers: on two wires each, the day on every wire."""
    wires: dict[str, tuple[str, ...]] = {"stranger": ("serial",)}
    wires |= dict.fromkeys(NOT_OVER_RTU, ("serial", "modbus-tcp", "socketcand", "slcan"))
    played = [("day", wire, amplifiers) for wire in WITNESSED for amplifiers in (1, 2)]
    played += [("arc", wire, 1) for wire in wires["arc"]]
    for number, name in enumerate(SCENARIOS):
        possible = wires.get(name, WITNESSED)
        played += [(name, wire, 1) for wire in (possible[0], possible[number % len(possible)])]
    return [*dict.fromkeys(played)]


@pytest.mark.parametrize(("scenario", "wire", "amplifiers"), _played())
def test_witness_finds_nothing_in_the_chain(scenario: str, wire: str, amplifiers: int) -> None:
    """Every scenario passes clean; amplifiers share a wire of a kind that can be shared."""
    course = {**SCENARIOS[scenario], "amplifiers": ("a", "b")[:amplifiers], "wire": wire}
    follow(course, scene, rng=random.Random(1))


def summary(message: WitnessedMessage) -> tuple[str, dict[str, Any]]:
    """Return what a message is, and its values; of one that is wrong what is said of it."""
    if isinstance(message, WitnessedRequest):
        return message.name, {"problem": True} if message.problem else message.values
    if isinstance(message, WitnessedReply):
        if message.refusal or message.problem:
            return "refusal", {"code": message.refusal or message.problem}
        return "reply", message.values or {}
    return message.what, {"text": message.text} if message.text else message.values


def can(frame: str) -> bytes:
    """Return a frame as a line of a serial adapter."""
    identifier, *data = frame.split()
    return f"t{identifier}{len(data)}{''.join(data)}\r".encode()


def tcp(number: int, pdu: str) -> bytes:
    """Return an ADU of Modbus TCP for unit 1: transaction, 0, length, unit, PDU."""
    data = bytes.fromhex(pdu)
    return struct.pack(">HHHB", number, 0, len(data) + 1, 1) + data


def rtu(adu: str) -> bytes:
    """Return an ADU of RTU with its checksum."""
    unit, *pdu = bytes.fromhex(adu)
    return framed(unit, bytes(pdu), is_rtu=True)


Heard = tuple[str, bytes, str, dict[str, Any]]
"""A direction, bytes, and the message that they complete: "" for none."""
PING: tuple[Heard, ...] = (
    (">", tcp(5, "10 0C00 0003 06 0008 0007 0000"), "Ping", {"session": 7, "rate": 0}),
    ("<", tcp(5, "10 0C00 0003"), "carried out", {}),
    (">", tcp(6, "04 0C80 0002"), "read on", {}),
)
"""With tag 8 and session 7."""
PART = rtu("01 04 04")
"""The first of a response: its checksum is the first register, the tag."""
WHOLE = rtu(
    "01 04 32 9F55 0000 0004 0000 0001 0000 00FA 00FA 0708 36FF DBDF 32"
    "0A 0408 07C0 081B 17B9 06B8 320A 0000 0000 0000 0000 0000 0000 0000"
)
"""A status of which 13 bytes, from the 27th on, are a frame of unit 10 with its checksum."""
OFF = "0000 0000 0001 0000 0000 0000 0000 00FA 0708 0000 0101 0000 0000 0000 0000"
"""Registers of a status without a tag: state 1, one channel and one layer."""
SET_ADDRESS = ("201 04 00 0F 04 09 00 03 00", "201 04 01 2D 41 00 31 00 00")
"""Address 9 for the amplifier A-1, in two frames."""
NEW_ADDRESS = {"address": 9, "serial_number": "A-1"}
TALKS: dict[str, tuple[str, tuple[Heard, ...]]] = {
    "unknown type": ("modbus-tcp", (*PING, ("<", tcp(6, "84 02"), "refusal", {"code": 1}))),
    "busy": ("modbus-tcp", (*PING, ("<", tcp(6, "84 06"), "refusal", {"code": 7}))),
    "wrong state": (
        "modbus-tcp",
        (*PING, ("<", tcp(6, "04 04 0008 0500"), "refusal", {"code": 5})),
    ),
    "reply with another tag": (
        "modbus-tcp",
        (*PING, ("<", tcp(6, "04 04 0009 0000"), "refusal", {"code": "tag must be 8, got 9"})),
    ),
    "response of another function": (
        "modbus-tcp",
        (
            *PING,
            ("<", tcp(6, "03 04 0008 0000"), "refusal", {"code": "function must be 4, got 3"}),
        ),
    ),
    "gateway that finds no amplifier": ("modbus-tcp", (PING[0], ("<", tcp(5, "90 0B"), "", {}))),
    "status without a write": (
        "modbus-tcp",
        (
            (">", tcp(1, "04 0980 000F"), "GetStatus", {}),
            ("<", tcp(1, f"04 1E {OFF}"), "reply", {"state": 1}),
        ),
    ),
    "function 23": (
        "modbus-tcp",
        ((">", tcp(1, "17 0980 0002 0C00 0002 04 0008 0007"), "a read", {"problem": True}),),
    ),
    "function 6": ("modbus-tcp", ((">", tcp(1, "06 0C00 0008"), "a read", {"problem": True}),)),
    "write amid a message": (
        "modbus-tcp",
        ((">", tcp(1, "10 0C01 0001 02 0008"), "a read", {"problem": True}),),
    ),
    "broadcast on RTU": (
        "modbus-rtu",
        ((">", rtu("00 10 0800 0002 04 0003 0005"), "Stop", {"ramp": 5}),),
    ),
    "parts, the first with a checksum of its own": (
        "modbus-rtu",
        (
            (
                ">",
                rtu(f"01 10 0C00 0003 06 {PART[3:].hex()} 0007 0000"),
                "Ping",
                {"session": 7, "rate": 0},
            ),
            ("<", rtu("01 10 0C00 0003"), "carried out", {}),
            (">", rtu("01 04 0C80 0002"), "read on", {}),
            ("<", PART, "", {}),
            ("<", rtu(f"{PART.hex()} 0000")[len(PART) :], "reply", {}),
        ),
    ),
    "response of which a piece has a checksum of its own": (
        "modbus-rtu",
        (
            (">", rtu("01 10 0C00 0003 06 9F55 B882 0000"), "Ping", {"session": 0xB882}),
            ("<", rtu("01 10 0C00 0003"), "carried out", {}),
            (">", rtu("01 04 0C80 0019"), "read on", {}),
            ("<", WHOLE[:26], "", {}),
            ("<", WHOLE[26:39], "", {}),
            ("<", WHOLE[39:], "reply", {"state": 4}),
        ),
    ),
    "frames in any order, and a copy": (
        "slcan",
        (
            (">", can(SET_ADDRESS[1]), "", {}),
            (">", can(SET_ADDRESS[0]), "SetAddress", NEW_ADDRESS),
            (">", can(SET_ADDRESS[0]), "", {}),
        ),
    ),
    "frame that does not come": (
        "slcan",
        (
            (">", can(SET_ADDRESS[0]), "", {}),
            (
                ">",
                can("201 05 00 0C 02 07 00 00 00"),
                "damaged",
                {"text": "message 4 without all frames"},
            ),
        ),
    ),
    "echo, and another host": (
        "slcan",
        (
            (">", can("201 01 00 0C 02 07 00 00 00"), "Ping", {"session": 7, "rate": 0}),
            ("<", can("201 01 00 0C 02 07 00 00 00"), "", {}),
            ("<", can("201 02 00 03 02 17 2A FA 00"), "other host", {"text": "Arm"}),
        ),
    ),
    "boot-up": ("slcan", (("<", b"t701100\r", "boot", {}),)),
    "reset by NMT": ("slcan", ((">", b"t00028101\r", "boot", {}),)),
}


@pytest.mark.parametrize("talk", TALKS)
def test_decoders_read_what_no_page_shows(talk: str) -> None:
    """Refusals, late and damaged frames, other hosts; numbers are by the page on messages."""
    kind, pieces = TALKS[talk]
    decoder = DECODERS[kind]()
    for arrow, data, what, values in pieces:
        direction: TransferDirection = "amplifier" if arrow == ">" else "host"
        heard = [message for _, message in decoder.feed(direction, 0.001, data)]
        name, found = summary(heard[0]) if heard and heard[0] is not None else ("", {})
        assert name == what
        assert {each: found[each] for each in values} == values


BROKEN = {**hand.HOST_VIOLATIONS_BROKEN, **hand.BROKEN}
FADING: dict[str, Any] = {**HALF, "tokens": (0, 0, 0, 0)}


@pytest.mark.parametrize("name", BROKEN)
def test_witness_finds_a_broken_rule(name: str) -> None:
    """The conversation breaks one rule, and no other."""
    rule, talk = BROKEN[name]
    assert {*talk().found} == {rule}


def test_every_rule_is_found_broken_and_has_a_planted_fault() -> None:
    """By conversations, and by faults that show them.

    No fault shows damage, which one codec for both sides hides, nor identified, since a host that
    does not identify an amplifier has no limits to play by.
    """
    listed = {rule for rule, _ in BROKEN.values()}
    assert listed >= RULES.keys()
    shown = {
        fault["shows"].removesuffix(": ")
        for area in sorted((ROOT / "tests" / "faults").glob("*.yaml"))
        for fault in read_yaml(area)
        if any("tests/sim/test_host_rules.py" in test for test in fault["found_by"])
        if "shows" in fault
    }
    assert shown == listed - {"damage", "identified"}


def _committed_at(at: int) -> Talk:
    """0.2 on channel 0 plays; a set of 0.5 is committed for a moment, 1 ms after the clock was 0.

    Its high word counts 0.305 ms.
    """
    talk = Talk().armed().playing(4, 0.2).staged(5, hand.layer(0, hand.tone(0, 100, 0.5)))
    before: dict[str, Any] = {"tokens": (4, 0, 0, 0), "levels": (2000, 0)}
    talk.says(clock=0, token=4, **before)
    return talk.exchange(hand.COMMIT, (9, 5, at), hand.status(token=5, **before))


def waited(seconds: float) -> Talk:
    """The fifth request of a host has its reply after it has given it up and sent the sixth."""
    talk = Talk().armed().sends(hand.SET, hand.part(5, hand.layer(0))).rest(seconds)
    talk.sends(hand.GET_STATUS).numbered(5).rest(0.0005).replies(hand.SET, hand.taken(5))
    return talk.numbered(6).replies(hand.GET_STATUS, hand.status())


def tripped(kind: int, latch: int) -> Talk:
    """A request to fall silent and its reply take 4 ms, 250 ms after Arm: the watchdog expires."""
    status = hand.status(hand.FAULT, fault=hand.WATCHDOG, latch=latch)
    return Talk().armed().rest(0.246).sends(kind, (5,)).rest(0.004).replies(kind, status)


def fading(kind: int, latch: int) -> Talk:
    """Arm was not heard either: the reply shows half of the level, amid the fade of 5 ms."""
    talk = Talk().identified(hand.ENABLED)
    talk.exchange(hand.SILENCE, (9, 5), hand.status()).rest(0.02).playing()
    shown: dict[str, Any] = {"fault": hand.WATCHDOG, "latch": latch, "token": 5}
    status = hand.status(hand.REACTING, levels=(2500, 0), **shown)
    return talk.rest(0.2).sends(kind, (5,)).rest(0.0005).replies(kind, status)


def ended(after: float, level: int) -> Talk:
    """A layer ends 60 ms after its commit, whose reply took 12; a silent set came 3 ms later."""
    talk = Talk().armed()
    talk.staged(5, hand.layer(0, hand.tone(0, 100, 0.5), ramp=40, valid_for=60))
    talk.sends(hand.COMMIT, (9, 5, 0)).rest(0.012)
    talk.replies(hand.COMMIT, hand.status(token=5, tokens=(5, 0, 0, 0)))
    talk.rest(0.049).staged(6, hand.layer(0, ramp=40)).committed(6, levels=(4878, 0))
    return talk.rest(after).says(token=6, levels=(level, 0))


def at_new_address(talk: Talk) -> Talk:
    """A status at address 3, which is its own, and another that has no reply."""
    talk.exchange(hand.GET_STATUS, (), hand.status(hand.SWITCHED_OFF, limited=True), address=3)
    return talk.sends(hand.GET_STATUS, address=3).rest(0.04)


def at_the_moment(token: int, level: int) -> Talk:
    """A moment comes 30 ms after the clock was 0, amid 27 ms of a status.

    Meanwhile an Event would have the witness know how late it is; here contacts do.
    """
    talk = _committed_at(100).rest(0.007).sends(hand.GET_STATUS).rest(0.026)
    status = hand.status(token=5, tokens=(token, 0, 0, 0), levels=(level, 0))
    return talk.told("contacts", ()).rest(0.001).replies(hand.GET_STATUS, status)


def silenced_at_the_moment(level: int, later: int) -> Talk:
    """Silence is carried out before the moment of a set or behind it; 40 ms later it is over."""
    fading = hand.status(token=5, levels=(level, 0))
    talk = _committed_at(12).exchange(hand.SILENCE, (9, 20), fading)
    return talk.rest(0.04).says(token=5, levels=(later, 0))


def restarted(latch: int) -> Talk:
    """A stop, after which a status shows what is latched now, and the host arms."""
    talk = Talk().armed().exchange(hand.STOP, (5,), STOPPED)
    talk.says(hand.SWITCHED_OFF, kind=hand.GET_STATUS, latch=latch)
    return talk.exchange(hand.ARM, (10, 250, 0), hand.status(latch=latch))


def reopened(state: int) -> Talk:
    """A stop is lost on a disturbed wire; the host opens it again, finds a state, and arms."""
    talk = Talk().armed().told("faults", "a", are_on=True)
    talk.sends(hand.STOP, (5,)).rest(0.3).told("faults", "a", are_on=False)
    talk.told_of("closed").rest(0.6).told_of("opened").identified(state, latch=1)
    return talk.exchange(hand.ARM, (10, 250, 0), hand.status(latch=1))


STOPPED = hand.status(hand.STOPPED, latch=1)
PLAYING: dict[str, Any] = {"token": 5, "levels": (5000, 0)}
JUST_SO: Mapping[str, tuple[list[str], Callable[[], Talk]]] = {
    # A host gives a request up 30 ms after it wrote it, of which its bytes waited for 2 ms.
    "request that has waited in a transport": ([], lambda: waited(0.028)),
    "request that cannot have waited": (["credit"], lambda: waited(0.018)),
    # Within 11 ms, as the page says; 9 ms after Arm 241 ms are left.
    "all of the watchdog is left": (
        [],
        lambda: Talk().armed().rest(0.008).says(kind=hand.GET_STATUS, left=240),
    ),
    "as little of it as a host allows": (
        [],
        lambda: Talk().armed().rest(0.008).says(kind=hand.GET_STATUS, left=231),
    ),
    "less of it than a host allows": (
        ["watchdog"],
        lambda: Talk().armed().rest(0.008).says(kind=hand.GET_STATUS, left=225),
    ),
    # It is seen 100 ms after its request, of which this program did not run for that long.
    "reply that is late": (
        ["answer"],
        lambda: (
            Talk()
            .armed()
            .sends(hand.GET_STATUS)
            .rest(0.1)
            .replies(hand.GET_STATUS, hand.status(left=199))
        ),
    ),
    "reply that the witness has seen late": (
        [],
        lambda: (
            Talk()
            .armed()
            .sends(hand.GET_STATUS)
            .rest(0.1)
            .told("delayed", 0.1)
            .replies(hand.GET_STATUS, hand.status(left=199))
        ),
    ),
    # The older set, request 7, was accepted before the newer one, as its number shows.
    "reply behind newer ones says nothing of now": (
        [],
        lambda: (
            Talk()
            .armed()
            .playing()
            .told("faults", "a", are_on=True)
            .sends(hand.SET, hand.part(6, hand.layer(0, hand.tone(0, 100, 0.3))))
            .rest(0.04)
            .staged(7, hand.layer(0))
            .committed(7, tokens=(0, 0, 0, 0), levels=(5000, 0))
            .numbered(7)
            .replies(hand.SET, hand.taken(6))
        ),
    ),
    # It may be sooner than what is on its way.
    "watchdog before a stop": ([], lambda: tripped(hand.STOP, 2)),
    "watchdog before a disarm": ([], lambda: tripped(hand.DISARM, 1)),
    "watchdog of unknown time before a stop": ([], lambda: fading(hand.STOP, 2)),
    "watchdog of unknown time before a disarm": ([], lambda: fading(hand.DISARM, 1)),
    # One amplifier plays alone until watchdogs expire, since nothing can be sent.
    "loop that stalls between two commits sends the second no more": (
        [],
        lambda: (
            Talk(names=("m", "n"))
            .armed()
            .armed(address=2)
            .staged(5, hand.LOUD)
            .staged(5, hand.LOUD, address=2)
            .committed(5, tokens=(5, 0, 0, 0))
            .told("set_stalled")
            .rest(0.03)
        ),
    ),
    # 20 ms behind that the fade of 40 ms is 23 ms old: 0.25 (1 + cos(23/40 pi)).
    "layer that may have ended by itself before a set": ([], lambda: ended(0.017, 1917)),
    "layer that has ended": ([], lambda: ended(0.1, 0)),
    "layer that has not ended in time": (["plays"], lambda: ended(0.1, 1917)),
    # Nothing was asked for 0.4 s, in which an arc was sooner than the watchdog of 0.25 s.
    "fault before the watchdog shows afterwards": (
        [],
        lambda: (
            Talk()
            .armed()
            .rest(0.4)
            .says(hand.FAULT, kind=hand.GET_STATUS, fault=hand.ARC, latch=1)
            .exchange(hand.GET_FAULTS, (), (1, hand.ARC, 255, 0, 300))
        ),
    ),
    # An amplifier that was silent under the finger has nothing to end in time.
    "disarm after the last lift releases only what plays": (
        [],
        lambda: (
            Talk()
            .armed()
            .told("contacts", [1])
            .rest(0.01)
            .told("contacts", [])
            .rest(0.01)
            .exchange(hand.DISARM, (100,), hand.status(hand.SWITCHED_ON))
        ),
    ),
    # It was written with it, and on Modbus RTU each frame waits for the silence before it.
    "status behind a broadcast precedes a stop": (
        [],
        lambda: (
            Talk()
            .armed()
            .playing()
            .told("operator_command", "stop")
            .rest(0.005)
            .says(kind=hand.GET_STATUS, left=213, tokens=(5, 0, 0, 0), **PLAYING)
            .exchange(hand.STOP, (5,), hand.status(hand.STOPPED, latch=1, **PLAYING))
        ),
    ),
    # The host had begun to stop by itself, of which its operator's stop takes part.
    "stop is not awaited again while its reply is": (
        [],
        lambda: (
            Talk()
            .armed()
            .playing()
            .sends(hand.STOP, (5,))
            .told("operator_command", "stop")
            .rest(0.028)
            .replies(hand.STOP, hand.status(hand.STOPPED, latch=1, token=5))
        ),
    ),
    "stop is not awaited again 3 ms later": (
        [],
        lambda: (
            Talk()
            .armed()
            .playing()
            .sends(hand.STOP, (5,))
            .rest(0.003)
            .told("operator_command", "stop")
            .rest(0.028)
            .replies(hand.STOP, hand.status(hand.STOPPED, latch=1, token=5))
        ),
    ),
    # A broadcast for another amplifier of the line reaches it too.
    "stop of what a stop has silenced needs no second confirmation": (
        [],
        lambda: (
            Talk()
            .armed()
            .exchange(hand.STOP, (5,), STOPPED)
            .sends(hand.STOP, (5,), address=0)
            .rest(0.3)
        ),
    ),
    # A reply begins within 10 ms, or never: what is sent before may meet it on the line.
    "reading gives way once its reply is due no more": (
        [],
        lambda: Talk().armed().sends(hand.GET_STATUS).rest(0.011).says(),
    ),
    "reading gives way too soon": (
        ["credit"],
        lambda: Talk().armed().sends(hand.GET_STATUS).rest(0.005).says(),
    ),
    # Set for serial number "7" by itself or as a broadcast.
    "amplifier is followed to its new address": (
        ["plays", "answer"],
        lambda: at_new_address(
            Talk()
            .identified()
            .exchange(hand.SET_ADDRESS, (3, 1, 0x3700), hand.status(hand.SWITCHED_OFF))
        ),
    ),
    "amplifier is followed to its new address by a broadcast": (
        ["plays", "answer"],
        lambda: at_new_address(
            Talk().identified().sends(hand.SET_ADDRESS, (3, 1, 0x3700), address=0)
        ),
    ),
    # A status may show either.
    "status before a moment": ([], lambda: at_the_moment(4, 2000)),
    "status after a moment": ([], lambda: at_the_moment(5, 5000)),
    "silence before the moment of a set": ([], lambda: silenced_at_the_moment(2000, 0)),
    "silence after the moment of a set": ([], lambda: silenced_at_the_moment(5000, 0)),
    "silence at the moment of a set that does not last": (
        ["silent"],
        lambda: silenced_at_the_moment(0, 5000),
    ),
    # Its reply may show what played before, unless the moment has passed at its first byte.
    "moment before the exchange of its commit": (["token"], lambda: _committed_at(3)),
    "moment amid the exchange of its commit": ([], lambda: _committed_at(5)),
    "moment behind the exchange of its commit": ([], lambda: _committed_at(6)),
    # A Mark is shown once: a status 0.15 s later, 32.2 million steps, shows the present.
    "status that was not heard may have shown a mark": (
        ["answer"],
        lambda: (
            Talk()
            .armed()
            .sends(hand.MARK, address=0)
            .rest(0.05)
            .sends(hand.GET_STATUS)
            .rest(0.1)
            .says(kind=hand.GET_STATUS, left=98, clock=32_212_000)
        ),
    ),
    # It was carried out, so that the set committed last is none.
    "arm is withdrawn before its reply": (
        [],
        lambda: (
            Talk()
            .armed()
            .playing()
            .exchange(hand.DISARM, (5,), hand.status(hand.SWITCHED_ON, **FADING))
            .rest(0.01)
            .sends(hand.ARM, (8, 250, 0))
            .exchange(hand.DISARM, (5,), hand.status(hand.SWITCHED_ON, token=0))
        ),
    ),
    # Its latch has gone without a Clear, but it is armed; one that unlatched by itself is not.
    "stop is over where the amplifier has restarted": (["latched"], lambda: restarted(0)),
    "stop is not over where it is still latched": (["latched", "stop"], lambda: restarted(1)),
    # One that was heard shows, and must be cleared.
    "stop that was not heard is over once the wire is opened again": (
        [],
        lambda: reopened(hand.SWITCHED_OFF),
    ),
    "stop that was heard is not over once the wire is opened again": (
        ["stop", "latched"],
        lambda: reopened(hand.STOPPED),
    ),
    # 65.535 s are those 1000 ms that an amplifier has, which are too long for a stop: half of the
    # level after half a second.
    "ramp of a stop is clipped": (
        ["stop"],
        lambda: (
            Talk()
            .armed()
            .playing()
            .exchange(hand.STOP, (65535,), hand.status(hand.STOPPED, latch=1, **PLAYING))
            .rest(0.497)
            .says(hand.STOPPED, kind=hand.GET_STATUS, latch=1, token=5, levels=(2500, 0))
            .rest(0.6)
            .says(hand.STOPPED, kind=hand.GET_STATUS, latch=1, token=5)
        ),
    ),
    # By 16384 steps, 5 s; the status before it was not heard, so that of Arm may show a Mark.
    "clock goes on from where an arm has shifted it": (
        ["answer"],
        lambda: (
            Talk()
            .identified()
            .sends(hand.GET_STATUS)
            .rest(0.1)
            .exchange(hand.ARM, (9, 250, 16384), hand.status(clock=round(5.1 / 20 * 2**32)))
            .rest(0.1)
            .sends(hand.MARK, address=0)
            .rest(0.01)
            .says(clock=round(5.2 / 20 * 2**32))
        ),
    ),
}
"""Conversations that just keep to the rules, or just not, each with the rules that it breaks."""


@pytest.mark.parametrize("name", JUST_SO)
def test_witness_finds_what_is_broken_and_no_more(name: str) -> None:
    """Beside each other: what hosts and amplifiers may do, and the first that they may not."""
    broken, talk = JUST_SO[name]
    assert talk().found == broken


def refusal(kind: int, code: int) -> bytes:
    """Return the payload of a Nak that names no channel."""
    return struct.pack("<HHH", kind, code, 255)


@pytest.mark.parametrize(
    ("kind", "version", "words", "reply", "payload"),
    [
        (hand.HELLO, 3, (7,), hand.HELLO, hand.identity()),
        (hand.GET_STATUS, 3, (), hand.NAK, refusal(hand.GET_STATUS, 8)),  # UNSUPPORTED_VERSION
        (hand.STOP, hand.VERSION, (), hand.NAK, refusal(hand.STOP, 2)),  # BAD_LENGTH
        (hand.DISARM, hand.VERSION, (5, 0), hand.NAK, refusal(hand.DISARM, 2)),
    ],
)
def test_reply_to_what_no_host_may_send_is_no_fault(
    kind: int, version: int, words: tuple[int, ...], reply: int, payload: bytes
) -> None:
    """Of another version or length: refused as the pages say, but a Hello is replied to."""
    talk = Talk().identified()
    talk.host_bytes(hand.frame(kind, words, sequence=77, version=version)).rest(0.001)
    version = hand.VERSION if version == hand.VERSION else 0
    reply |= hand.REPLY
    talk.amplifier_bytes(hand.raw_frame(reply, payload, sequence=77, version=version))
    assert talk.found == ["garbage"]
    assert "host sent" in str(talk.witness.finish()[0])


@pytest.mark.parametrize(("is_disturbed", "broken"), [(True, set()), (False, {"clock"})])
def test_status_amid_a_fault_may_show_a_mark_that_came_twice(
    is_disturbed: bool, broken: set[str]
) -> None:
    """Its copy comes 40 ms later, so that a status 80 ms behind it shows a clock of 40 ms ago.

    By that every later Mark would be 40 ms late, of which 12 ms and the rate explain 16 at most.
    """
    talk = Talk().armed()
    begin = talk.time
    for copied in (0.04, 0.0, 0.0, 0.0, 0.0):
        talk.rest(0.15).sends(hand.MARK, address=0)
        marked = talk.time - begin
        talk.rest(0.01).says(clock=round(marked / 20 * 2**32))
        if copied and is_disturbed:
            talk.told("faults", "a", are_on=True).told("faults", "a", are_on=False)
        if copied:
            talk.rest(0.068).says(clock=round((marked + copied) / 20 * 2**32))
    assert {*talk.found} == broken


@pytest.mark.parametrize(
    ("beats", "broken"), [(2, ["credit"]), (13, [])], ids=["soon", "after a round of numbers"]
)
def test_request_with_the_bytes_of_an_old_one_is_no_copy(beats: int, broken: list[str]) -> None:
    """0.4 s later, on a disturbed wire, it is one, without a reply; 2.6 s later it is new."""
    talk = Talk().armed().says(kind=hand.GET_STATUS)
    number = talk.sequence - 1
    talk.fed(beats - 2).told("faults", "a", are_on=True).told("faults", "a", are_on=False)
    last = talk.fed(2).rest(0.09).sequence
    talk.numbered(number).sends(hand.GET_STATUS).rest(0.009).replies(hand.GET_STATUS, hand.status())
    assert talk.numbered(last).found == broken
