"""Open lines and their amplifiers (protocol 4) by URL."""

import asyncio
from collections.abc import Mapping
from dataclasses import dataclass

from drivers.errors import LinkError
from drivers.host.amplifier import Amplifier
from drivers.host.line import Line
from drivers.ports import Port
from drivers.wires.wire import Wire, WireAddress, address_of
from registry.limits import GuardLimits


@dataclass
class _OpenLine:
    line: Line
    port: Port
    settings: Mapping[str, object]

    async def close(self) -> None:
        """Close the line; waiting requests fail."""
        try:
            if self.line.loss is None:
                self.line.lose(f"{self.line.name} was closed")
        finally:
            self.port.close()
            await self.port.wait_closed()


class Lines:
    """The open lines of a host; amplifiers at one port, connection or bus share a line.

    last: earlier lines of the host, now closed; their request numbers are continued.
    """

    def __init__(self, last: "Lines | None" = None) -> None:
        self._wires: dict[str, Wire] = {} if last is None else last._wires
        self.is_closing = False
        """Whether their owner is closing them: lines opened meanwhile belong to others."""
        self._opened: dict[str, _OpenLine] = {}
        self._changing: dict[str, asyncio.Lock] = {}  # held while a line is opened
        self._closing: set[asyncio.Task[None]] = set()

    async def amplifier(
        self,
        url: str,
        limits: GuardLimits,
        *,
        name: str,
        serial_number: str | None = None,
        is_output: bool | None = False,
    ) -> Amplifier:
        """Return the amplifier of a URL, its line open, nothing sent; see `Amplifier`.

        A lost line is opened again; the amplifiers on the lost line stay lost. Raises CommandError
        for an invalid URL, LinkError for a line that cannot be opened or an address in use by an
        amplifier of another name; an amplifier of this name is replaced.
        """
        address = address_of(url)
        open_lines = self._opened
        async with self._changing.setdefault(address.line, asyncio.Lock()):
            opened = self._opened.get(address.line)
            if opened is not None and opened.line.loss is not None:
                del self._opened[address.line]
                await opened.close()
                opened = None
            if opened is None:
                opened = await self.open_line(address)
                if self._opened is not open_lines:  # `close` was called meanwhile
                    await opened.close()
                    raise LinkError(f"{address.line} was closed while it was being opened")
                self._opened[address.line] = opened
        address.check_agrees(opened.settings)
        former = opened.line.members.get(address.number)
        if former is not None and former.name != name:
            raise LinkError(f"address {address.number} on {address.line} must be used once")
        return Amplifier(
            opened.line,
            address.number,
            limits,
            name=name,
            serial_number=serial_number,
            is_output=is_output,
        )

    async def open_line(self, address: WireAddress) -> _OpenLine:
        """Open the line of an amplifier, for the first of its amplifiers."""
        line = Line(address.make_wire(), address.line, boot_time=address.boot_time)
        last_wire = self._wires.get(address.line)
        if last_wire is not None:
            line.wire.follow(last_wire)
        self._wires[address.line] = line.wire
        port = await address.open_port(line.received, line.lose)
        line.open(port)
        return _OpenLine(line, port, address.settings)

    async def close(self) -> None:
        """Close all lines; disarm first, or vibrations continue until the watchdogs trip.

        A second call waits for the first. Lines are closed even if the caller is cancelled.
        """
        open_lines = self._opened
        self._opened = {}
        for opened in open_lines.values():
            closing = asyncio.create_task(opened.close(), name=f"close {opened.line.name}")
            self._closing.add(closing)
            closing.add_done_callback(self._closing.discard)
        if self._closing:
            done, _ = await asyncio.wait(self._closing)
            for closing in done:
                closing.result()
