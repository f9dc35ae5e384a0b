"""CAN buses behind adapters and servers that carry frames as text: their port and their URLs.

can+slcan:///dev/ttyACM0?bitrate=500000#NODE     or on HOST:PORT; LAWICEL's commands
can+socketcand://HOST:PORT/can0#NODE
"""

import asyncio
import contextlib
import math
import re
from collections.abc import Callable, Mapping
from typing import ClassVar, final

from drivers.errors import LinkError
from drivers.ports import NETWORK_DELAY, Port, open_port
from drivers.protocol.definition import BOOT_TIME
from drivers.urls import AmplifierUrl
from drivers.wires.can_bus import NODE_FORM, NODE_RANGE, CanAddress
from drivers.wires.can_frames import (
    BLOCK,
    ERROR_ID,
    SLCAN,
    SLCAN_RATES,
    SOCKETCAND,
    CanFrame,
    TextFormat,
    TextReader,
    pack_frames,
    unpack_frames,
)
from drivers.wires.wire import PortAbove, Scheme
from registry import threads

_SILENCE = 1.0  # s; twenty heartbeats of an amplifier
_SLCAN_FORM = "can+slcan:///dev/ttyACM0?bitrate=500000#NODE or can+slcan://HOST:PORT#NODE"
_BAUD = 115_200  # of the adapter's serial port
_CLOSE = b"\rC\r"
_BELL = b"\x07"
# Ignored: empty lines, echoes, version and number, status, and frames of other protocols.
_SLCAN_REPLY = re.compile(rb"[zZ]?\Z|[VvNF][0-9A-Za-z]{2,}\Z|[TrRdDbB][0-9A-Fa-f]+\Z")
_SOCKETCAND_FORM = "can+socketcand://HOST:PORT/can0?bitrate=500000#NODE"
GREETING_TIMEOUT = 2.0  # s
_MAX_REPLIES = 9


@final
class TextPort(PortAbove):
    """A port of frames on top of a port of text; implements `Port`.

    on_data: called with packed frames, and with an error if text ends in BEL or is invalid.
    on_other: called with other text. hello: sent before frames if none was received for a second,
    because an adapter may have restarted, for instance when its port was opened. cut_off: ends a
    line whose rest a blocked port has dropped. goodbye: sent before closing.
    """

    def __init__(
        self,
        form: TextFormat,
        on_data: Callable[[bytes], None],
        *,
        on_other: Callable[[bytes], None] = lambda text: None,
        hello: bytes = b"",
        cut_off: bytes = b"",
        goodbye: bytes = b"",
    ) -> None:
        self._encode = form.encode
        self._reader = TextReader(form, on_other)
        self._on_data = on_data
        self._hello = hello
        self._cut_off = cut_off
        self._goodbye = goodbye
        self._heard_at = -math.inf

    def write(self, data: bytes) -> None:
        """Send frames; raises LinkError."""
        text = b"".join(map(self._encode, unpack_frames(data)))
        if threads.now() - self._heard_at > _SILENCE:
            text = self._hello + text
        self.below.write(self._cut_off + text if self.below.is_blocked else text)

    def close(self) -> None:
        """Close it; no callback is called afterwards."""
        if self._goodbye:
            with contextlib.suppress(LinkError):  # of a lost adapter
                self.below.write(self._goodbye)
        super().close()

    def received(self, data: bytes) -> None:
        """Take text of the adapter."""
        frames = pack_frames(self._reader.feed(data))
        if frames:
            self._heard_at = threads.now()
            self._on_data(frames)
        if data.endswith(_BELL) or not data.isascii():
            self._on_data(pack_frames([CanFrame(ERROR_ID, data[-BLOCK:])]))


class SlcanAddress(CanAddress):
    """A node behind a serial adapter with LAWICEL's commands, on a port or behind a TCP port."""

    SCHEMES: ClassVar[Mapping[str, Scheme]] = {
        "can+slcan": Scheme(
            line_kind="can-usb",
            example="can+slcan:///dev/ttyACM0?bitrate=500000#NODE",
            help="CAN on a serial adapter",
            number=NODE_RANGE,
            forms={
                "can+slcan:///PATH#NODE": "`bitrate` 500000 (10, 20, 50, 100, 125, 250, 500, "
                "800 kbit/s, 1 Mbit/s), `baud` 115200",
                "can+slcan://HOST:PORT#NODE": "the same",
            },
        )
    }
    boot_time = BOOT_TIME

    def __init__(self, url: str) -> None:
        parsed = AmplifierUrl(url, _SLCAN_FORM, known=("bitrate", "baud"))
        self.place = parsed.server(number=NODE_FORM) if parsed.place else parsed.device(_BAUD)
        super().__init__(
            parsed,
            f"can+slcan://{self.place.name}",
            delay=NETWORK_DELAY if self.place.host else 0.0,
            settings={"baud": self.place.baud},
        )
        parsed.require(
            self.bitrate in SLCAN_RATES,
            f"bitrate must be one of {', '.join(map(str, SLCAN_RATES))}",
        )

    async def open_port(
        self, on_data: Callable[[bytes], None], on_loss: Callable[[str], None]
    ) -> Port:
        """Open the port; the first request opens the adapter's channel. Raises LinkError."""
        # Closed first, where an earlier host has left it open.
        hello = _CLOSE + b"S%d\rO\r" % SLCAN_RATES.index(self.bitrate)

        def unknown(text: bytes) -> None:
            """Report text that no adapter replies with as an error."""
            if not _SLCAN_REPLY.match(text):
                on_data(pack_frames([CanFrame(ERROR_ID, text[:BLOCK])]))

        port = TextPort(
            SLCAN, on_data, on_other=unknown, hello=hello, cut_off=b"\r", goodbye=_CLOSE
        )
        port.below = await open_port(self.place, port.received, on_loss)
        return port


class _Opening:
    """The replies of a socketcand server, or its loss, while a bus is opened."""

    def __init__(self) -> None:
        self._replies: asyncio.Queue[str] = asyncio.Queue(_MAX_REPLIES)

    def take(self, text: bytes) -> None:
        """Take an element without its end, which is no frame with a short identifier."""
        element = text.decode(errors="replace").strip()
        if not element.startswith("< frame"):  # with a long identifier
            self.note(f"{element} >")

    def note(self, text: str) -> None:
        """Keep a reply or the cause of a loss; nobody awaits those of an open bus."""
        with contextlib.suppress(asyncio.QueueFull):
            self._replies.put_nowait(text)

    async def expect(self, expected: str) -> None:
        """Await a reply; raises LinkError for another one."""
        reply = await self._replies.get()
        if reply != expected:
            raise LinkError(f"reply must be {expected!r}, got {reply!r}")


class SocketcandAddress(CanAddress):
    """A node on a bus that a socketcand server has."""

    SCHEMES: ClassVar[Mapping[str, Scheme]] = {
        "can+socketcand": Scheme(
            line_kind="ethernet",
            example="can+socketcand://HOST:PORT/can0#NODE",
            help="CAN through a socketcand server",
            number=NODE_RANGE,
            forms={
                "can+socketcand://HOST:PORT/BUS#NODE": "`bitrate` 500000; must match the server's"
            },
        )
    }

    def __init__(self, url: str) -> None:
        parsed = AmplifierUrl(url, _SOCKETCAND_FORM, known=("bitrate",))
        self.place = parsed.server()
        self.channel, _, rest = parsed.path.strip("/").partition("/")
        parsed.check_path(rest, NODE_FORM)
        parsed.require(bool(self.channel), "bus must be given behind the host")
        line = f"can+socketcand://{self.place.name}/{self.channel}"
        super().__init__(parsed, line, delay=NETWORK_DELAY, settings={})

    async def open_port(
        self, on_data: Callable[[bytes], None], on_loss: Callable[[str], None]
    ) -> Port:
        """Connect, and open the bus in raw mode; raises LinkError."""
        opening = _Opening()

        def lost(cause: str) -> None:
            """Report a loss, which also ends the opening."""
            opening.note(cause)
            on_loss(cause)

        port = TextPort(SOCKETCAND, on_data, on_other=opening.take)
        port.below = await open_port(self.place, port.received, lost)
        try:
            async with asyncio.timeout(GREETING_TIMEOUT):
                await opening.expect("< hi >")
                port.below.write(f"< open {self.channel} >".encode())
                await opening.expect("< ok >")
                port.below.write(b"< rawmode >")
                await opening.expect("< ok >")
        except BaseException as error:
            port.below.close()
            if not isinstance(error, TimeoutError | LinkError):
                raise
            cause = str(error) or f"no reply within {GREETING_TIMEOUT:g} s"
            raise LinkError(
                f"CAN bus {self.line} cannot be opened: {cause}; check address and port, and that "
                "socketcand serves this bus there"
            ) from None
        return port
