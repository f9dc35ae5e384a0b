"""Serial amplifier URLs.

serial:///dev/ttyUSB0?baud=921600&address=1     a port of this machine
serial+tcp://HOST:PORT                          a serial server with raw TCP
"""

from dataclasses import dataclass
from typing import Final
from urllib.parse import unquote

from drivers.errors import CommandError
from drivers.urls.options import device_of, options_of, split_url, whole_number

BAUD: Final = 921_600
"""Of a line whose URL names none [baud]; 8 data bits, no parity, 1 stop bit."""
ADDRESS: Final = 1
"""Of an amplifier as it is made."""

_FORM = "serial:///dev/ttyUSB0?baud=921600 (or serial+tcp://HOST:PORT for a serial server)"
_ADDRESS_MAX = 247  # as of Modbus, so that one label serves both
_BAUD_MAX = 12_000_000  # the fastest USB adapters


@dataclass(frozen=True)
class SerialUrl:
    """A serial amplifier: port as named by pyserial, speed [baud], address on the line."""

    port: str
    baud: int
    address: int

    @property
    def is_local(self) -> bool:
        """Whether the port is a line to the amplifier without a server in between."""
        return not self.port.startswith("socket://")

    @classmethod
    def parse(cls, url: str) -> "SerialUrl":
        """Parse a URL; CommandError names the invalid part."""
        parts = split_url(url, kind="a serial", forms=_FORM)
        if parts.fragment:
            raise CommandError(
                f"{url!r}: a serial URL must not contain #; write ?address={parts.fragment} for "
                "the address on the line"
            )
        options = options_of(parts.query, known=("baud", "address"), url=url, kind="a serial")
        path = unquote(parts.path)
        if parts.scheme == "serial+tcp":
            if parts.hostname is None or parts.port is None or path.strip("/"):
                raise CommandError(f"{url!r} must name a host and port; use {_FORM}")
            port = f"socket://{parts.netloc}"
        elif path.strip("/") and not parts.netloc:
            port = device_of(path)
        else:
            raise CommandError(f"{url!r} must name a port; use {_FORM}")
        return cls(
            port=port,
            baud=whole_number(options.get("baud", str(BAUD)), "baud", high=_BAUD_MAX, url=url),
            address=whole_number(
                options.get("address", str(ADDRESS)), "address", high=_ADDRESS_MAX, url=url
            ),
        )
