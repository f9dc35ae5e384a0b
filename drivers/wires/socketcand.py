"""CAN through a server: can+socketcand://HOST:PORT/can0#NODE."""

import asyncio
import contextlib
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
_MAX_REPLIES = 9


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
        replies: asyncio.Queue[str] = asyncio.Queue(_MAX_REPLIES)

        def note(text: str) -> None:
            with contextlib.suppress(asyncio.QueueFull):  # of a bus that is open
                replies.put_nowait(text)

        def replied(text: bytes) -> None:
            element = text.decode(errors="replace").strip()
            if not element.startswith("< frame"):  # with a long identifier
                note(f"{element} >")

        def lost(cause: str) -> None:
            note(cause)
            on_loss(cause)

        async def expect(reply: str) -> None:
            if (got := await replies.get()) != reply:
                raise LinkError(f"reply must be {reply!r}, got {got!r}")

        port = TextPort(SOCKETCAND, on_data, on_other=replied)
        port.below = await open_port(self.place, port.received, lost)
        try:
            async with asyncio.timeout(_GREETING_TIMEOUT):
                await expect("< hi >")
                port.below.write(f"< open {self.channel} >".encode())
                await expect("< ok >")
                port.below.write(b"< rawmode >")
                await expect("< ok >")
        except BaseException as error:
            port.below.close()
            if not isinstance(error, TimeoutError | LinkError):
                raise
            cause = str(error) or f"no reply within {_GREETING_TIMEOUT:g} s"
            raise LinkError(
                f"CAN bus {self.line} cannot be opened: {cause}; check address and port, and that "
                "socketcand serves this bus there"
            ) from None
        return port
