"""A simulated serial CAN adapter: LAWICEL's ASCII commands on a pseudo-terminal.

Commands end with CR; replies are CR, or BELL for errors; CAN FD frames as of CANable adapters. Not
modelled: acceptance masks, time stamps and polling, which are accepted without effect.
"""

import re
from collections.abc import Callable

from drivers.codec.can_bus.canopen import CanFrame
from sim.far_ends.can_bus.bus import LENGTHS, CanBus
from sim.transport.pseudo_terminal import make_terminal

_CR, _BELL = b"\r", b"\x07"
_MAX_LENGTH = 160  # characters; a CAN FD frame has 133
_FRAME = re.compile(rb"([tdb])([0-7][0-9A-Fa-f]{2})([0-9A-Fa-f])((?:[0-9A-Fa-f]{2})*)")
_REMOTE = re.compile(rb"r[0-7][0-9A-Fa-f]{2}[0-8]|R[01][0-9A-Fa-f]{7}[0-8]")
_EXTENDED = re.compile(rb"[TDB][01][0-9A-Fa-f]{7}[0-9A-Fa-f](?:[0-9A-Fa-f]{2})*")
_SETTING = re.compile(rb"S[0-9]|s[0-9A-Fa-f]{4,6}|Y[0-9]|[Mm][0-9A-Fa-f]{8}|[ZX][01]|W[0-9]|")


class SlcanEnd:
    """An adapter between a pseudo-terminal and a bus; unpluggable: see `make_terminal`."""

    def __init__(self, bus: CanBus, *, unpluggable: bool = False) -> None:
        self._adapter = SlcanAdapter(bus, lambda data: self._port.write(data))
        self._port = make_terminal(self._adapter.receive, unpluggable=unpluggable)
        self._port.listen()

    @property
    def path(self) -> str:
        """The serial port of the adapter."""
        return self._port.port

    def plug(self, is_plugged: bool) -> None:
        """Plug the adapter in, or unplug it."""
        self._adapter.reset()
        self._port.plug(is_plugged)

    def close(self) -> None:
        """Leave the bus and close the port."""
        self._adapter.close()
        self._port.close()


class SlcanAdapter:
    """The adapter: text in, `write` called with text, frames to and from a bus."""

    def __init__(self, bus: CanBus, write: Callable[[bytes], None]) -> None:
        self._bus = bus
        self._write = write
        self._listener = self._hear  # one object, by which the bus knows it
        self.reset()
        bus.join(self._listener)

    def reset(self) -> None:
        """Reset, as after plugging in."""
        self._rest = b""
        self._is_open = self._may_send = False

    def close(self) -> None:
        """Leave the bus."""
        self._bus.leave(self._listener)

    def receive(self, data: bytes) -> None:
        """Process text from the host."""
        *lines, self._rest = (self._rest + data).split(_CR)
        for line in lines:
            self._write(self._answer(line.strip(b"\n")))
        if len(self._rest) > _MAX_LENGTH:
            self._rest = b""
            self._write(_BELL)

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
                return (b"z" if line[:1] in b"rt" else b"Z") + _CR  # no receiver for these
            if frame := _parse(line):
                self._bus.send(frame, sender=self._listener)
                return b"z" + _CR
        if not self._is_open and _SETTING.fullmatch(line):
            return _CR
        return _BELL

    def _hear(self, frame: CanFrame) -> None:
        if not self._is_open:
            return
        kind = "d" if frame.fd else "t"
        length = LENGTHS.index(len(frame.data))
        self._write(f"{kind}{frame.id:03X}{length:X}{frame.data.hex().upper()}\r".encode())


def _parse(line: bytes) -> CanFrame | None:
    """The frame of a command t, d or b, else None."""
    found = _FRAME.fullmatch(line)
    if found is None:
        return None
    kind, identifier, length, data = found.groups()
    is_fd = kind != b"t"
    expected = LENGTHS[int(length, 16)]
    if len(data) != 2 * expected or (not is_fd and expected > 8):
        return None
    return CanFrame(int(identifier, 16), bytes.fromhex(data.decode()), fd=is_fd)
