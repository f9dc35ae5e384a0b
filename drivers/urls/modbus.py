"""Modbus amplifier URLs: modbus+tcp://HOST:PORT/UNIT and modbus+rtu:///dev/ttyS1?baud=115200#UNIT."""

from dataclasses import dataclass, replace
from typing import Final
from urllib.parse import SplitResult, unquote

from drivers.errors import CommandError
from drivers.urls.options import device_of, options_of, split_url, whole_number

UNIT: Final = 1
"""Of an amplifier as it is made."""
RTU_BAUD: Final = 115_200
"""Of a line whose URL names none [baud]; 8 data bits, even parity, 1 stop bit."""

_UNIT_MAX = 247
_TCP_PORT = 502
_TCP_FORM = "modbus+tcp://HOST:PORT/UNIT (behind a gateway: ?baud=19200, that of its line)"
_RTU_FORM = "modbus+rtu:///dev/ttyS1?baud=115200#UNIT"
_BAUD_MAX = 12_000_000  # the fastest USB adapters
_PARITIES = {"even": "E", "odd": "O", "none": "N"}


@dataclass(frozen=True)
class ModbusUrl:
    """A Modbus amplifier: host and port or serial device, and its unit.

    is_rtu: RTU frames, also through a serial server. baud, parity (as named by pyserial) and stop
    bits are those of the serial device, or of the line behind a gateway or server; baud is 0 if
    unknown.
    """

    is_rtu: bool
    host: str = ""
    port: int = 0
    device: str = ""
    baud: int = 0
    parity: str = "E"
    stop: int = 1
    unit: int = 0

    @property
    def line(self) -> "ModbusUrl":
        """The URL without its unit: the line that several amplifiers share."""
        return replace(self, unit=0)

    @property
    def endpoint(self) -> str:
        """Name of the line in messages."""
        return self.device or f"{self.host}:{self.port}"

    @property
    def bits_per_byte(self) -> int:
        """Bits per byte on a serial line: start, eight data, parity, stop."""
        return 9 + (self.parity != "N") + self.stop

    @classmethod
    def parse(cls, url: str) -> "ModbusUrl":
        """Parse a URL; CommandError names the invalid part."""
        parts = split_url(url, kind="a Modbus", forms=_TCP_FORM)
        if parts.scheme == "modbus+tcp":
            return _tcp(parts, url)
        if parts.scheme == "modbus+rtu":
            return _rtu(parts, url)
        raise CommandError(f"{url!r} must be a Modbus URL; use {_TCP_FORM} or {_RTU_FORM}")


def _tcp(parts: SplitResult, url: str) -> ModbusUrl:
    options = options_of(parts.query, known=("baud",), url=url, kind="a Modbus TCP")
    if not parts.hostname or parts.fragment:
        raise CommandError(f"{url!r}: a Modbus TCP URL must have a host and no #: {_TCP_FORM}")
    return ModbusUrl(
        False,
        host=parts.hostname,
        port=parts.port or _TCP_PORT,
        baud=_baud(options, 0, url),
        unit=_unit(unquote(parts.path).strip("/"), url),
    )


def _rtu(parts: SplitResult, url: str) -> ModbusUrl:
    known = ("baud", "parity", "stop")
    options = options_of(parts.query, known=known, url=url, kind="a Modbus RTU")
    device = device_of(unquote(parts.path))
    if parts.netloc:
        if not parts.hostname or parts.port is None or device.strip("/"):
            raise CommandError(
                f"{url!r} must name a host and port; use modbus+rtu://HOST:PORT#UNIT"
            )
        device = ""
    elif not device.strip("/"):
        raise CommandError(f"{url!r} must name a port; use {_RTU_FORM}")
    parity = options.get("parity", "even")
    if parity not in _PARITIES:
        raise CommandError(f"{url!r}: parity must be one of {', '.join(_PARITIES)}, got {parity!r}")
    return ModbusUrl(
        True,
        host=parts.hostname or "",
        port=parts.port or 0,
        device=device,
        baud=_baud(options, RTU_BAUD if device else 0, url),
        parity=_PARITIES[parity],
        stop=whole_number(options.get("stop", "1"), "stop", high=2, url=url),
        unit=_unit(parts.fragment, url),
    )


def _baud(options: dict[str, str], default: int, url: str) -> int:
    text = options.get("baud")
    return default if text is None else whole_number(text, "baud", high=_BAUD_MAX, url=url)


def _unit(text: str, url: str) -> int:
    return whole_number(text, "unit", high=_UNIT_MAX, url=url) if text else UNIT
