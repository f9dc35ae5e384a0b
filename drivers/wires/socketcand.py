"""CAN through a server: can+socketcand://HOST:PORT/can0#NODE."""

import asyncio
import re
from collections.abc import Callable

from drivers.codec.can_bus.adapter_text import SOCKETCAND
from drivers.errors import LinkError
from drivers.hardware import Port
from drivers.host.wire import NETWORK_DELAY
from drivers.ports.opening import open_port
from drivers.urls import AmplifierUrl
from drivers.wires.can_address import CanAddress
from drivers.wires.text_port import TextPort

_FORM = "can+socketcand://HOST:PORT/can0?bitrate=500000#NODE"
_GREETING_TIMEOUT = 2.0  # s
_IS_FRAME = re.compile(rb"\s*< frame ")


class SocketcandAddress(CanAddress):
    """A node on a bus that a socketcand server has."""

    def __init__(self, url: str) -> None:
        parsed = AmplifierUrl(url, _FORM, known=("bitrate",))
        self.place, self.channel = parsed.server(has_path=True), parsed.path.strip("/")
        if not self.channel:
            raise parsed.refused("bus must be named")
        line = f"can+socketcand://{self.place.name}/{self.channel}"
        super().__init__(parsed, line, delay=NETWORK_DELAY, settings={})

    async def open_port(
        self, on_data: Callable[[bytes], None], on_loss: Callable[[str], None]
    ) -> Port:
        """Connect, and open the bus in raw mode; raises LinkError."""
        greeting = _Greeting()
        port = TextPort(SOCKETCAND, on_data)

        def received(data: bytes) -> None:
            (port.received if greeting.is_over else greeting.received)(data)

        def lost(cause: str) -> None:
            (on_loss if greeting.is_over else greeting.lost)(cause)

        port.below = await open_port(self.place, received, lost)
        try:
            async with asyncio.timeout(_GREETING_TIMEOUT):
                await greeting.expect(b"< hi >")
                port.below.write(f"< open {self.channel} >".encode())
                await greeting.expect(b"< ok >")
                port.below.write(b"< rawmode >")
                await greeting.expect(b"< ok >")
        except asyncio.CancelledError:
            port.below.close()
            raise
        except (TimeoutError, LinkError) as error:
            port.below.close()
            said = str(error) or f"no reply within {_GREETING_TIMEOUT:g} s"
            raise LinkError(
                f"CAN bus {self.line} cannot be opened: {said}; check address and port, and that "
                "socketcand serves this bus there"
            ) from None
        greeting.is_over = True
        port.received(greeting.rest)
        return port


class _Greeting:
    """The elements of a server before it is in raw mode; frames may be among them."""

    def __init__(self) -> None:
        self.is_over = False
        self.rest = b""
        self._cause: str | None = None
        self._changed = asyncio.Event()

    def received(self, data: bytes) -> None:
        """Take text of the server."""
        self.rest += data
        self._changed.set()

    def lost(self, cause: str) -> None:
        """Note that the connection was lost."""
        self._cause = cause
        self._changed.set()

    async def expect(self, expected: bytes) -> None:
        """Wait for an element; LinkError for another one."""
        while True:
            while b">" not in self.rest:
                if self._cause is not None:
                    raise LinkError(self._cause)
                self._changed.clear()
                await self._changed.wait()
            element, _, self.rest = self.rest.partition(b">")
            if not _IS_FRAME.match(element):
                break
        if (element + b">").strip() != expected:
            raise LinkError(f"reply must be {expected!r}, got {element + b'>'!r}")
