"""The session between a host and one amplifier on docs/reference/wire-can.md, in frames.

The host's frames are made by its encoder, or written here where a library makes them; the
amplifier's by the far end, which shares no code with the encoder.
"""

import asyncio
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import cast

from drivers.codec.can_bus.canopen import CanFrame
from drivers.codec.can_bus.objects import pack_envelope
from drivers.codec.can_bus.requests import PdoRequest, encode_broadcast, encode_request
from drivers.command import CommandSet, DriveCommand, Envelope, Knot
from drivers.guard import Guard, GuardLimits, SafeCommandSet
from drivers.protocol.messages import (
    Apply,
    Arm,
    Clear,
    Commit,
    Disarm,
    GetStatus,
    LoadEnvelope,
    Ping,
    Stage,
    Stop,
)
from fake_device import FakeDevice
from sim.far_ends.can_bus.node import CanNode
from vendor_pages import ScriptedSensors

NODE = 1
HEARTBEAT, INCOMPLETE_LIFE = 0.05, 0.1  # s, as on the page


@dataclass(frozen=True)
class Step:
    """A step: its title and its frames, each with whether the host sends it."""

    title: str
    frames: tuple[tuple[bool, CanFrame], ...]

    def lines(self) -> Iterator[str]:
        """Yield lines as on the page, in hexadecimal; `>` from the host, `<` to it."""
        for is_host, frame in self.frames:
            mark = ">" if is_host else "<"
            fd = " FD" if frame.fd else ""
            yield f"{mark} {frame.id:03X}{fd} {frame.data.hex(' ').upper()}".rstrip()


class Timers:
    """Timers of a node, fired by the test, by their delay [s]."""

    def __init__(self) -> None:
        self._due: list[_Timer] = []

    def call_later(self, delay: float, callback: Callable[[], None]) -> asyncio.TimerHandle:
        timer = _Timer(delay, callback)
        self._due.append(timer)
        return cast(asyncio.TimerHandle, timer)

    def ring(self, delay: float = HEARTBEAT) -> None:
        """Fire the timers of this delay that are not cancelled."""
        due = [timer for timer in self._due if timer.delay == delay]
        self._due = [timer for timer in self._due if timer.delay != delay]
        for timer in due:
            if not timer.is_cancelled:
                timer.callback()


@dataclass
class _Timer:
    """A timer that was started."""

    delay: float
    callback: Callable[[], None]
    is_cancelled: bool = False

    def cancel(self) -> None:
        """As a timer."""
        self.is_cancelled = True


class Session:
    """Plays the session."""

    def __init__(self) -> None:
        self.device = FakeDevice()
        self.device.amplifier.identity = replace(
            self.device.amplifier.identity,
            vendor="Acme",
            product="Quad 1800 V",
            serial_number="A-17",
            firmware="1.2",
        )
        self.device.amplifier.attach(ScriptedSensors())
        self.device.capabilities = self.device.amplifier.capabilities
        self._said: list[CanFrame] = []
        self.timers = Timers()
        self.node = CanNode(self.device, NODE, send=self._said.append)  # type: ignore[arg-type]
        self.guard = Guard(GuardLimits(20.0, 600.0, 1.0), self.device.capabilities)

    def steps(self) -> Iterator[Step]:
        self.node.start(self.timers.call_later)
        yield self._heard("Power-up: boot-up")
        self.timers.ring()
        yield self._heard("Heartbeat, pre-operational")
        yield self._asked("Read the serial number, 1018sub4", _read(0x1018, 4))
        yield self._asked(
            "Read the product's name, 2000sub2",
            *(_read(0x2000, 2), _next_segment(0), _next_segment(1)),
        )
        yield self._asked("Read the versions of the protocol, 2000sub5", _read(0x2000, 5))
        yield self._asked("Read the number of channels, 2001sub1", _read(0x2001, 1))
        yield self._asked("Read the highest frequency, 2001sub3", _read(0x2001, 3))
        yield self._asked("Read the features, 2001sub15", _read(0x2001, 15))
        yield self._asked("Read the highest level of channel 3, 200Bsub4", _read(0x200B, 4))
        yield self._asked("NMT: start", CanFrame(0x000, bytes([1, NODE])))
        self.timers.ring()
        yield self._heard("Heartbeat, operational")
        yield self._ordered("Arm, watchdog 250 ms", Arm(0.25), 1)
        safe = self.guard.check(CommandSet(513, _COMMANDS, ramp=0.02, valid_for=0.5))
        yield self._ordered("Apply token 513", Apply(safe), 2)
        yield self._ordered("The same again, after a lost answer", Apply(safe), 3)
        self.device.pass_time(0.05)
        yield self._ordered("Ping: the host's heartbeat, and a status order", Ping(), 4)
        yield self._asked("Read the voltage of channel 0, 200Csub1", _read(0x200C, 1))
        yield self._asked(
            "Describe sensor 1, 2010sub2",
            *(_read(0x2010, 2), *(_next_segment(n % 2) for n in range(3))),
        )
        yield self._asked("Measure 110 and 250.5 Hz for 200 ms as reading 1234, 2011", *_MEASURE)
        yield self._asked(
            "Read reading 1234, 2012", *(_read(0x2012, 0), _next_segment(0), _next_segment(1))
        )
        yield self._asked(
            "Its tones at sensor 0, 2013sub1",
            *(_read(0x2013, 1), *(_next_segment(n % 2) for n in range(3))),
        )
        yield self._asked("Raw samples of sensor 1 from 1595 on, 2014", *_FIRST_SAMPLE)
        yield self._asked(
            "Read them, 2015", *(_read(0x2015, 0), *(_next_segment(n % 2) for n in range(3)))
        )
        staged = self.guard.check(CommandSet(514, _COMMANDS[:1], ramp=0.0, valid_for=0.0))
        yield self._ordered("Stage token 514", Stage(staged), 5)
        yield self._ordered("Commit token 514", Commit(514), 6)
        other = self.guard.check(CommandSet(515, _COMMANDS, ramp=0.0, valid_for=0.0))
        yield self._ordered("Stage token 515", Stage(other), 7)
        yield self._asked(
            "Commit token 515, to every amplifier of the bus", *encode_broadcast(Commit(515))
        )
        incomplete = encode_request(
            Apply(self.guard.check(CommandSet(516, _COMMANDS, ramp=0.0, valid_for=0.0))),
            node=NODE,
            sequence=8,
        )
        lost = self._asked("", incomplete[0], *incomplete[2:])
        self.device.pass_time(INCOMPLETE_LIFE)
        self.timers.ring(INCOMPLETE_LIFE)
        title = "Apply token 516, with the frame of channel 3 lost: an answer after 100 ms"
        yield Step(title, (*lost.frames, *self._heard("").frames))
        shape = self.guard.check_envelope(Envelope(5, 0.005, (Knot(0.1, 90.0), Knot(1.0, -0.01))))
        assert (
            pack_envelope(LoadEnvelope(shape))
            == b"".join(frame.data[1:] for frame in _ENVELOPE[1:])[:11]
        )
        yield self._asked("Load an envelope into slot 5, 2100sub5", *_ENVELOPE)
        shaped = self.guard.check(CommandSet(517, _SHAPED, ramp=0.0, valid_for=0.0))
        yield self._ordered("Apply token 517 with this onset", Apply(shaped), 9)
        yield self._ordered("Apply token 518, as CAN FD", Apply(self._next(518)), 10, fd=True)
        yield self._ordered("Status, as CAN FD", GetStatus(), 11, fd=True)
        self.device.pass_time(0.3)
        yield self._heard("No heartbeat for 250 ms: an emergency, and another once silent")
        yield self._ordered("Arm, refused before Clear", Arm(0.25), 12)
        yield self._ordered("Clear of latch 1", Clear(1), 13)
        yield self._ordered("Stop, ramp 5 ms", Stop(0.005), 14)
        self.device.pass_time(0.01)
        yield self._ordered("Clear of latch 2", Clear(2), 15)
        yield self._ordered("Disarm, ramp 50 ms", Disarm(0.05), 16)
        yield self._asked("NMT: reset node", CanFrame(0x000, bytes([129, NODE])))
        yield self._asked("Give the amplifier A-17 the node number 5, 200E", *_NUMBER)
        yield self._asked("NMT: reset communication", CanFrame(0x000, bytes([130, NODE])))

    def _next(self, token: int) -> SafeCommandSet:
        return self.guard.check(CommandSet(token, _COMMANDS, ramp=0.0, valid_for=0.0))

    def _ordered(self, title: str, order: PdoRequest, sequence: int, *, fd: bool = False) -> Step:
        frames = encode_request(order, node=NODE, sequence=sequence, fd=fd)
        return self._asked(title, *frames)

    def _asked(self, title: str, *frames: CanFrame) -> Step:
        exchanged: list[tuple[bool, CanFrame]] = []
        for frame in frames:
            self._said.clear()
            self.node.receive(frame)
            exchanged += [(True, frame), *((False, said) for said in self._said)]
        self._said.clear()
        return Step(title, tuple(exchanged))

    def _heard(self, title: str) -> Step:
        said = tuple((False, frame) for frame in self._said)
        self._said.clear()
        return Step(title, said)


def session() -> Sequence[Step]:
    """All steps."""
    return tuple(Session().steps())


def _read(index: int, subindex: int) -> CanFrame:
    return CanFrame(0x600 + NODE, bytes([0x40, index & 0xFF, index >> 8, subindex, 0, 0, 0, 0]))


def _next_segment(toggle: int) -> CanFrame:
    return CanFrame(0x600 + NODE, bytes([0x60 | toggle << 4, *bytes(7)]))


_COMMANDS = (
    DriveCommand(channel=0, frequency=110.0, level=0.2, phase=0.0),
    DriveCommand(channel=3, frequency=250.5, level=1.0, phase=-90.0, keep_phase=True),
)
_SHAPED = (DriveCommand(0, 110.0, 0.2, onset=5),)
_NUMBER = (  # five bytes, the node and the serial number
    CanFrame(0x601, bytes.fromhex("21 0E 20 00 05 00 00 00")),
    CanFrame(0x601, bytes.fromhex("05 05 41 2D 31 37 00 00")),
)
_MEASURE = [
    CanFrame(0x600 + NODE, bytes.fromhex(text))
    for text in ("21 11 20 00 09 00 00 00", "00 D2 04 C8 00 02 98 08", "1B 92 13 00 00 00 00 00")
]
_FIRST_SAMPLE = [
    CanFrame(0x600 + NODE, bytes.fromhex(text))
    for text in ("21 14 20 00 05 00 00 00", "05 01 3B 06 00 00 00 00")
]
_ENVELOPE = [
    CanFrame(0x600 + NODE, bytes.fromhex(text))
    for text in ("21 00 21 05 0B 00 00 00", "00 32 00 02 E8 03 28 23", "17 10 27 FF FF 00 00 00")
]
