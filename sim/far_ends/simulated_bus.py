"""A CAN bus within this process, amplifiers on it, and adapters to it.

All other members of the bus receive a frame simultaneously. Not modeled: arbitration,
retransmission, bus-off.

Adapters use LAWICEL's serial ASCII commands (slcan), which end with CR and are acknowledged with
CR, or BELL for errors, and socketcand over TCP, with elements `< ... >`. Acceptance masks, time
stamps and polling are accepted without effect. Not modeled: modes other than raw mode, extended
identifiers, discovery by broadcast.
"""

import asyncio
import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from functools import partial

from drivers.wires.can_frames import (
    BITRATE,
    SLCAN,
    SOCKETCAND,
    CanFrame,
    pack_frames,
    unpack_frames,
)
from registry import threads
from sim.bench.amplifier_device import AmplifierDevice
from sim.far_ends.can_amplifiers import CanAmplifiers
from sim.transport.far_end import FarEnd, SendBytes
from sim.transport.serving import FarEndKind, MakeEnd, Numbered, TimedFarEnd
from sim.transport.simulated_line import TwoWayLine

BUS_NAME = "can0"
"""Name of the bus for socketcand."""

_OVERHEAD = 8  # approximate bytes of a frame in addition to its data, with stuffing and gap
_MAX_ELEMENT = 512  # characters of an element
_CR = b"\r"
_BELL = b"\x07"
_MAX_LENGTH = 64  # characters; a frame has 21
_REMOTE = re.compile(rb"r[0-7][0-9A-Fa-f]{2}[0-8]|R[01][0-9A-Fa-f]{7}[0-8]")
_EXTENDED = re.compile(rb"T[01][0-9A-Fa-f]{7}[0-8](?:[0-9A-Fa-f]{2})*")
_SETTING = re.compile(rb"S[0-9]|s[0-9A-Fa-f]{4,6}|Y[0-9]|[Mm][0-9A-Fa-f]{8}|[ZX][01]|W[0-9]|")

Listener = Callable[[CanFrame], None]
"""A member of a bus: called with the frames of all others."""


class CanBus:
    """A bus; each member is identified by a listener.

    bitrate [bit/s]: None for no transmission time.
    """

    def __init__(self, bitrate: int | None = None) -> None:
        self._members: list[Listener] = []
        self._bitrate = bitrate
        self._free_from = 0.0
        self._in_flight: set[asyncio.TimerHandle] = set()

    def join(self, listener: Listener) -> None:
        """Add a member."""
        self._members.append(listener)

    def leave(self, listener: Listener) -> None:
        """Remove a member, if it is one."""
        if listener in self._members:
            self._members.remove(listener)

    def send(self, frame: CanFrame, *, sender: Listener) -> None:
        """Deliver a frame to all but its sender, after the frames that were sent before."""
        if self._bitrate is None:
            self._deliver(frame, sender)
            return

        def arrive() -> None:
            self._in_flight.discard(timer)
            self._deliver(frame, sender)

        bits = 8 * (_OVERHEAD + len(frame.data))
        self._free_from = max(threads.now(), self._free_from) + bits / self._bitrate
        timer = asyncio.get_running_loop().call_at(self._free_from, arrive)
        self._in_flight.add(timer)

    def close(self) -> None:
        """Discard the frames in flight."""
        for timer in self._in_flight:
            timer.cancel()
        self._in_flight.clear()

    def _deliver(self, frame: CanFrame, sender: Listener) -> None:
        for member in tuple(self._members):
            if member != sender:
                member(frame)


class BusNodes:
    """Amplifiers on a bus, each at the node of its number, with its own faults in each direction.

    A damaged frame fails its CRC and is dropped. All amplifiers receive a frame at the same time,
    regardless of the time that the simulation needs.
    """

    def __init__(self, bus: CanBus, devices: Sequence[AmplifierDevice]) -> None:
        self._bus = bus
        self._leaving = ExitStack()
        """Removes the boot listeners."""
        self._nodes = [self._connect(device) for device in devices]
        bus.join(self._hear)

    def close(self) -> None:
        """Leave the bus and discard frames in flight."""
        self._leaving.close()
        self._bus.leave(self._hear)
        for line, served in self._nodes:
            line.close()
            served.close()

    def _hear(self, frame: CanFrame) -> None:
        now = threads.now()
        for line, _ in self._nodes:
            line.inward.send(pack_frames([frame]), now)

    def _send_to_bus(self, data: bytes) -> None:
        for frame in unpack_frames(data):
            self._bus.send(frame, sender=self._hear)

    def _connect(self, device: AmplifierDevice) -> tuple[TwoWayLine, TimedFarEnd]:
        def send(frames: bytes) -> None:
            for frame in unpack_frames(frames):
                line.outward.send(pack_frames([frame]))

        def boot() -> None:
            end.start(threads.now())
            served.schedule()

        line = TwoWayLine(self._send_to_bus, faults=device.faults, finds_damage=True)
        end = CanAmplifiers({device.address: device}, send)
        served = TimedFarEnd(end)
        line.to_amplifier = served.receive
        device.boot_listeners.append(boot)
        self._leaving.callback(device.boot_listeners.remove, boot)
        boot()
        return line, served


class SlcanAdapter(FarEnd):
    """The adapter: text in, `send` called with text, frames to and from a bus."""

    def __init__(self, bus: CanBus, send: SendBytes) -> None:
        self._bus = bus
        self._send = send
        self._unfinished = b""
        self._is_open = False
        self._may_send = False
        bus.join(self._hear)

    def close(self) -> None:
        """Leave the bus."""
        self._bus.leave(self._hear)

    def receive(self, data: bytes, now: float) -> None:
        """Process text from the host."""
        *lines, self._unfinished = (self._unfinished + data).split(_CR)
        for line in lines:
            self._send(self._reply(line.strip(b"\n")))
        if len(self._unfinished) > _MAX_LENGTH:
            self._unfinished = b""
            self._send(_BELL)

    def _reply(self, line: bytes) -> bytes:
        match line:
            case b"O" | b"L" if not self._is_open:
                self._is_open = True
                self._may_send = line == b"O"
                return _CR
            case b"C":  # also when closed: hosts begin with it
                self._is_open = False
                return _CR
            case b"V" | b"v":
                return line + b"1013" + _CR
            case b"N":
                return b"NE0A1" + _CR
            case b"F" if self._is_open:
                return b"F00" + _CR
        if self._is_open and self._may_send:
            if _REMOTE.fullmatch(line) or _EXTENDED.fullmatch(line):
                return (b"z" if line[:1] == b"r" else b"Z") + _CR  # no receiver for these
            frame = SLCAN.decode(line)
            if frame:
                self._bus.send(frame, sender=self._hear)
                return b"z" + _CR
        if not self._is_open and _SETTING.fullmatch(line):
            return _CR
        return _BELL

    def _hear(self, frame: CanFrame) -> None:
        if self._is_open:
            self._send(SLCAN.encode(frame))


class SocketcandClient(FarEnd):
    """One connection, through the states new, open and raw."""

    def __init__(self, bus: CanBus, send: SendBytes) -> None:
        self._bus = bus
        self._send = send
        self._unfinished = b""
        self._is_open = False
        self._is_raw = False
        send(b"< hi >")

    def close(self) -> None:
        """Leave the bus."""
        self._bus.leave(self._hear)

    def receive(self, data: bytes, now: float) -> None:
        """Process complete elements; text between them is skipped."""
        *elements, unfinished = (self._unfinished + data).split(b">")
        self._unfinished = unfinished if len(unfinished) <= _MAX_ELEMENT else b""
        for element in elements:
            _, bracket, content = element.partition(b"<")
            if bracket:
                self._element(content.strip())

    def _element(self, element: bytes) -> None:
        match element:
            case _ if not self._is_open:
                self._is_open = element == f"open {BUS_NAME}".encode()
                self._send(b"< ok >" if self._is_open else b"< error could not open bus >")
                if not self._is_open:
                    self._send(b"")
            case b"rawmode":
                self._send(b"< ok >")
                if not self._is_raw:
                    self._is_raw = True
                    self._bus.join(self._hear)
            case b"echo":
                self._send(b"< echo >")
            case _ if element.startswith(b"send "):
                frame = SOCKETCAND.decode_sent(b"<" + element)
                if frame:  # otherwise socketcand does not reply, either
                    self._bus.send(frame, sender=self._hear)
            case _:
                self._send(b"< error unknown command >")

    def _hear(self, frame: CanFrame) -> None:
        stamp = f"{threads.now():.6f}"  # only differences are meaningful
        self._send(f"< frame {frame.id:03X} {stamp} {frame.data.hex().upper()} >".encode())


class BehindAdapter(FarEndKind):
    """A kind of wire that is an adapter to a CAN bus with the amplifiers."""

    def url_of(self, *, port: int | str, speed: int, address: int) -> str:
        """The URL of an amplifier, without options that have their default values."""
        url = super().url_of(port=port, speed=speed, address=address)
        return url.replace(f"{BUS_NAME}?bitrate={BITRATE}#", f"{BUS_NAME}#")

    @contextmanager
    def serve(self, speed: int | None, numbered: Numbered) -> Iterator[MakeEnd]:
        """Serve amplifiers by node on a bus; yields how to make an adapter."""
        devices = [*numbered.values()]
        with closing(CanBus(speed)) as bus, closing(BusNodes(bus, devices)):
            yield partial(self.end, bus)


SOCKETCAND_KIND = BehindAdapter(
    "socketcand",
    f"can+socketcand://{{host}}:{{port}}/{BUS_NAME}?bitrate={{speed}}#{{address}}",
    "a CAN bus behind a loopback port",
    BITRATE,
    "can",
    SocketcandClient,
)
SLCAN_KIND = BehindAdapter(
    "slcan",
    "can+slcan://{port}?bitrate={speed}#{address}",
    "a CAN bus behind a pseudo-terminal",
    BITRATE,
    "can-usb",
    SlcanAdapter,
)
