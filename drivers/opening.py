"""Opens lines and the amplifiers on them, of protocol 3, by their URLs."""

from dataclasses import dataclass

from drivers.backends.hardware import Port, number_below
from drivers.backends.ports.opening import open_port
from drivers.backends.urls.serial_line import SerialUrl
from drivers.errors import LinkError
from drivers.host.amplifier import Amplifier
from drivers.host.line import Line
from drivers.host.serial_wire import SerialWire
from registry.limits import GuardLimits


@dataclass
class _Opened:
    line: Line
    port: Port
    baud: int


class Lines:
    """The open lines of a host; amplifiers at one port share a line."""

    def __init__(self) -> None:
        self._opened: dict[str, _Opened] = {}

    async def amplifier(
        self, url: str, limits: GuardLimits, *, name: str, serial_number: str | None = None
    ) -> Amplifier:
        """Return the amplifier of a URL, its line open, nothing sent.

        Raises CommandError for a URL that is none, LinkError for a line that cannot be opened, or
        an address that is taken.
        """
        parsed = SerialUrl.parse(url)
        opened = self._opened.get(parsed.port)
        if opened is None:
            opened = self._opened[parsed.port] = await _open(parsed)
        if opened.baud != parsed.baud:
            raise LinkError(
                f"serial port {parsed.port}: baud must be {opened.baud} as for the other "
                f"amplifiers on it, got {parsed.baud}"
            )
        if parsed.address in opened.line.members:
            raise LinkError(f"address {parsed.address} on {parsed.port} must be used once")
        return Amplifier(
            opened.line, parsed.address, limits, name=name, serial_number=serial_number
        )

    async def close(self) -> None:
        """Close all lines; disarm before, or vibrations last until the watchdogs trip."""
        opened, self._opened = self._opened, {}
        for each in opened.values():
            each.line.lose(f"{each.line.name} was closed")
            each.port.close()
        for each in opened.values():
            await each.port.wait_closed()


async def _open(url: SerialUrl) -> _Opened:
    """Open the port of a URL; what comes before its line is made is lost."""
    lines: list[Line] = []
    port = await open_port(
        url.port,
        baud=url.baud,
        on_data=lambda data: lines[0].received(data) if lines else None,
        on_loss=lambda cause: lines[0].lose(cause) if lines else None,
    )
    # A random start, so that a reply to an earlier host does not match.
    wire = SerialWire(url.baud if url.is_local else 0, sequence=number_below(1 << 16))
    lines.append(Line(wire, port, url.port))
    return _Opened(lines[0], port, url.baud)
