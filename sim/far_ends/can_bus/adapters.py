"""Simulated CAN adapters: LAWICEL's serial ASCII commands (slcan), and socketcand over TCP.

Commands of slcan end with CR; replies are CR, or BELL for errors; elements of socketcand are
`< ... >`. Not modelled: acceptance masks, time stamps and polling, which are accepted without
effect; modes other than raw mode, extended identifiers, discovery by broadcast.
"""

import re

from drivers.wires.can_frames import SLCAN, SOCKETCAND, CanFrame
from registry import threads
from sim.far_ends.can_bus.bus import CanBus
from sim.transport.far_end import FarEnd, Send

_CR, _BELL = b"\r", b"\x07"
_MAX_LENGTH = 64  # characters; a frame has 21
_REMOTE = re.compile(rb"r[0-7][0-9A-Fa-f]{2}[0-8]|R[01][0-9A-Fa-f]{7}[0-8]")
_EXTENDED = re.compile(rb"T[01][0-9A-Fa-f]{7}[0-8](?:[0-9A-Fa-f]{2})*")
_SETTING = re.compile(rb"S[0-9]|s[0-9A-Fa-f]{4,6}|Y[0-9]|[Mm][0-9A-Fa-f]{8}|[ZX][01]|W[0-9]|")


class SlcanAdapter(FarEnd):
    """The adapter: text in, `send` called with text, frames to and from a bus."""

    def __init__(self, bus: CanBus, send: Send) -> None:
        self._bus = bus
        self._send = send
        self._rest = b""
        self._is_open = self._may_send = False
        bus.join(self._hear)

    def close(self) -> None:
        """Leave the bus."""
        self._bus.leave(self._hear)

    def receive(self, data: bytes, now: float) -> None:
        """Process text from the host."""
        *lines, self._rest = (self._rest + data).split(_CR)
        for line in lines:
            self._send(self._answer(line.strip(b"\n")))
        if len(self._rest) > _MAX_LENGTH:
            self._rest = b""
            self._send(_BELL)

    def _answer(self, line: bytes) -> bytes:
        match line:
            case b"O" | b"L" if not self._is_open:
                self._is_open, self._may_send = True, line == b"O"
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
            if frame := SLCAN.decode(line):
                self._bus.send(frame, sender=self._hear)
                return b"z" + _CR
        if not self._is_open and _SETTING.fullmatch(line):
            return _CR
        return _BELL

    def _hear(self, frame: CanFrame) -> None:
        if self._is_open:
            self._send(SLCAN.encode(frame))


BUS_NAME = "can0"
_MAX_ELEMENT = 512  # characters of an element


class SocketcandClient(FarEnd):
    """One connection, through the states new, open and raw."""

    def __init__(self, bus: CanBus, send: Send) -> None:
        self._bus = bus
        self._send = send
        self._rest = b""
        self._is_open = self._is_raw = False
        send(b"< hi >")

    def close(self) -> None:
        """Leave the bus."""
        self._bus.leave(self._hear)

    def receive(self, data: bytes, now: float) -> None:
        """Process complete elements; text between them is skipped."""
        *elements, rest = (self._rest + data).split(b">")
        self._rest = rest if len(rest) <= _MAX_ELEMENT else b""
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
                if frame := SOCKETCAND.decode_sent(b"<" + element):  # nor does socketcand say more
                    self._bus.send(frame, sender=self._hear)
            case _:
                self._send(b"< error unknown command >")

    def _hear(self, frame: CanFrame) -> None:
        stamp = f"{threads.now():.6f}"  # only differences are meaningful
        self._send(f"< frame {frame.id:03X} {stamp} {frame.data.hex().upper()} >".encode())
