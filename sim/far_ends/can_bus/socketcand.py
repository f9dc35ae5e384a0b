"""A CAN bus in the protocol of socketcand: ASCII elements `< ... >`.

Not modelled: modes other than raw mode, extended identifiers, discovery by broadcast.
"""

import re

from drivers import clock
from drivers.codec.can_bus.canopen import CanFrame
from sim.far_ends.can_bus.bus import CanBus
from sim.transport.far_end import FarEnd, Send

BUS_NAME = "can0"
_MAX_LENGTH = 512  # characters of an element
_FRAME = re.compile(r"send ([0-7]?[0-9A-Fa-f]{1,2}) ([0-8])((?: [0-9A-Fa-f]{1,2})*)")


class SocketcandClient(FarEnd):
    """One connection, through the states new, open and raw."""

    def __init__(self, bus: CanBus, send: Send) -> None:
        self._bus = bus
        self._send = send
        self._rest = ""
        self._is_open = self._is_raw = False
        self._listener = self._hear  # one object, by which the bus knows it
        send(b"< hi >")

    def close(self) -> None:
        """Leave the bus."""
        self._bus.leave(self._listener)

    def receive(self, data: bytes, now: float) -> None:
        """Process complete elements; text between them is skipped."""
        *elements, rest = (self._rest + data.decode("ascii", errors="replace")).split(">")
        self._rest = rest if len(rest) <= _MAX_LENGTH else ""
        for element in elements:
            _, bracket, content = element.partition("<")
            if bracket:
                self._element(content.strip())

    def _element(self, element: str) -> None:
        name = element.partition(" ")[0]
        if not self._is_open:
            self._is_open = element == f"open {BUS_NAME}"
            self._send(b"< ok >" if self._is_open else b"< error could not open bus >")
            if not self._is_open:
                self._send(b"")
        elif element == "rawmode":
            self._send(b"< ok >")
            if not self._is_raw:
                self._is_raw = True
                self._bus.join(self._listener)
        elif element == "echo":
            self._send(b"< echo >")
        elif name == "send":
            if frame := _parse(element):  # socketcand sends no error either
                self._bus.send(frame, sender=self._listener)
        else:
            self._send(b"< error unknown command >")

    def _hear(self, frame: CanFrame) -> None:
        stamp = f"{clock.now():.6f}"  # only differences are meaningful
        self._send(f"< frame {frame.id:03X} {stamp} {frame.data.hex().upper()} >".encode())


def _parse(element: str) -> CanFrame | None:
    """The frame of an element send, else None."""
    found = _FRAME.fullmatch(element)
    if found is None or len(found[3].split()) != int(found[2]):
        return None
    return CanFrame(int(found[1], 16), bytes(int(byte, 16) for byte in found[3].split()))
