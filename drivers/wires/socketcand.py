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
        port = TextPort(SOCKETCAND, on_data)
        said: asyncio.Queue[bytes | LinkError] = asyncio.Queue()
        is_raw = False

        def received(data: bytes) -> None:
            if is_raw:
                port.received(data)
            else:
                said.put_nowait(data)

        def lost(cause: str) -> None:
            if is_raw:
                on_loss(cause)
            else:
                said.put_nowait(LinkError(cause))

        port.below = await open_port(self.place, received, lost)
        try:
            async with asyncio.timeout(_GREETING_TIMEOUT):
                rest = await _expected(b"< hi >", b"", said)
                port.below.write(f"< open {self.channel} >".encode())
                rest = await _expected(b"< ok >", rest, said)
                port.below.write(b"< rawmode >")
                rest = await _expected(b"< ok >", rest, said)
        except BaseException as error:
            port.below.close()
            if not isinstance(error, TimeoutError | LinkError):
                raise
            cause = str(error) or f"no reply within {_GREETING_TIMEOUT:g} s"
            raise LinkError(
                f"CAN bus {self.line} cannot be opened: {cause}; check address and port, and that "
                "socketcand serves this bus there"
            ) from None
        is_raw = True
        port.received(rest)
        while not said.empty():
            data = said.get_nowait()
            if isinstance(data, LinkError):
                lost(str(data))
            else:
                received(data)
        return port


async def _expected(element: bytes, rest: bytes, said: "asyncio.Queue[bytes | LinkError]") -> bytes:
    """Wait for an element of the server, and return what follows; LinkError for another one.

    rest: what was said and not looked at yet. Frames may come before it.
    """
    while True:
        while b">" not in rest:
            data = await said.get()
            if isinstance(data, LinkError):
                raise data
            rest += data
        found, _, rest = rest.partition(b">")
        if not _IS_FRAME.match(found):
            break
    if (found + b">").strip() != element:
        raise LinkError(f"reply must be {element!r}, got {found + b'>'!r}")
    return rest
