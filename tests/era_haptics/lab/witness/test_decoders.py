"""The witness on days of sound amplifiers, of which it finds nothing, and its decoders.

The days are random and scenarios, on every kind of wire; the decoders read bytes that were written
by hand.
"""

import asyncio
import math
import random
import re
import struct
from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest
import yaml

import hand_written as hand
from controller.sources.touch import Touch, TouchFrame
from courses import Acted, courses, follow
from drivers.host.amplifier import Amplifier
from drivers.wires.modbus_frames import framed
from era_haptics.lab.witness.capture import Direction, Message, WitnessedReply, WitnessedRequest
from era_haptics.lab.witness.witness import DECODERS
from group_stops import RandomGroup
from long_form import shortly
from model.vibration import Excitation, Tone
from plate_witness import RULES
from registry import threads
from registry.limits import GuardLimits
from set_table import STROKE, SetTable, make_rig
from sim.far_ends.wire_assignment import SimulatedWire
from virtual_lines import run_virtual

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
    """Both sides bear them as the decision says, and half a second later all rules hold again."""
    live(kind, lines, seed, lossy_steps=25)


ROOT = Path(__file__).parents[4]
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
        tone = Tone(frequency, level * STROKE, float(phase))
        self.table.excitation = {**ALONE, "NE": tone}
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
                assert chain.holding is not None
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


def test_a_fault_is_planted_for_every_rule() -> None:
    """Each rule, of the page or of the plate, has one that the witness must report as broken.

    But for damage, which one codec for both sides hides, and for identified, since a host that does
    not identify an amplifier has no limits to play by: conversations written by hand break them.
    """
    faults, page = ROOT / "tests" / "faults", ROOT / "docs" / "reference" / "witness.md"
    rules = page.read_text(encoding="utf-8").partition("## The rules")[2].partition("## In tests")
    planted = [
        fault
        for area in sorted(faults.glob("*.yaml"))
        for fault in yaml.load(area.read_text("utf-8"), Loader=yaml.CSafeLoader)
        if any("tests/era_haptics/lab/witness" in test for test in fault["found_by"])
    ]
    shown = {fault["shows"].removesuffix(": ") for fault in planted if "shows" in fault}
    listed = set(re.findall(r"^\| (\w+) \|", rules[0], flags=re.M))
    assert shown == listed - {"name", "damage", "identified"} | RULES.keys()


def summary(message: Message) -> tuple[str, dict[str, Any]]:
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
TONES = ("201 04 00 11 05 01 00 64 00", "201 04 01 02 00 D0 07 E8 03")
"""Measure, two tones."""
MEASURE = {"reading": 1, "window": 100, "tones": 2, "frequencies": [2000, 1000]}
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
            (">", can(TONES[1]), "", {}),
            (">", can(TONES[0]), "Measure", MEASURE),
            (">", can(TONES[0]), "", {}),
        ),
    ),
    "frame that does not come": (
        "slcan",
        (
            (">", can(TONES[0]), "", {}),
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
        direction: Direction = "amplifier" if arrow == ">" else "host"
        heard = [message for _, message in decoder.feed(direction, 0.001, data)]
        name, found = summary(heard[0]) if heard and heard[0] is not None else ("", {})
        assert name == what
        assert {each: found[each] for each in values} == values
