"""CAN buses by URL: adapters of python-can, serial ones (LAWICEL's commands), socketcand servers.

    can+socketcand://can0#NODE
    can+python-can://INTERFACE/CHANNEL?bitrate=500000#NODE
    can+slcan:///dev/ttyACM0?bitrate=500000#NODE, or on HOST:PORT
    can+socketcand://HOST:PORT/can0#NODE

Frames come and go packed: see `drivers.wires.can_bus.frames`.
"""

import asyncio
import contextlib
import math
import random
import re
from collections.abc import Callable, Mapping
from typing import Any, final

from drivers.errors import LinkError
from drivers.ports import NETWORK_DELAY, Port, open_port
from drivers.protocol.definition import BOOT_TIME
from drivers.urls import ADDRESS, AmplifierUrl
from drivers.wires.address import PortAbove, WireAddress
from drivers.wires.can_bus.canopen import BITRATE, BLOCK, ERROR_ID, CanFrame
from drivers.wires.can_bus.frames import NODE_MAX, NUMBER_MAX, pack_frames, unpack_frames
from drivers.wires.can_bus.host import CanWire
from drivers.wires.can_bus.text import (
    SLCAN,
    SLCAN_RATES,
    SOCKETCAND,
    TextFormat,
    TextReader,
)
from registry import threads

_BITRATES = 10_000, 1_000_000
_NODE = "node must be given as #{}"


class CanAddress(WireAddress):
    """A node on a CAN bus; its kinds differ in how the bus is opened.

    line: name of the bus; delay [s]: of a network on the way to it; settings: besides the bit rate.
    """

    def __init__(
        self, url: AmplifierUrl, line: str, *, delay: float = 0.0, settings: Mapping[str, object]
    ) -> None:
        low, high = _BITRATES
        self.bitrate = url.whole_option("bitrate", BITRATE, high, low=low)
        self.line, self._delay = line, delay
        self.number = url.whole(url.number, "node", NODE_MAX) if url.number else ADDRESS
        self.settings = {"protocol": "CAN", "bitrate": self.bitrate, **settings}

    def make_wire(self) -> CanWire:
        """Make the wire; a random start, so that a reply to an earlier host does not match."""
        sequence = random.randint(0, NUMBER_MAX)  # noqa: S311  no secret
        return CanWire(self.bitrate, sequence=sequence, delay=self._delay)


_PYTHON_CAN_FORM = (
    "can+socketcan://can0#NODE or can+python-can://INTERFACE/CHANNEL?bitrate=500000#NODE"
)
_OTHERS = ("slcan", "socketcan", "socketcand")
"""Interfaces with a URL scheme of their own."""
_OPTIONS = {  # of python-can, passed on as they are: which of several adapters it is
    "canalystii": ("device",),
    "ixxat": ("unique_hardware_id",),
    "neousys": ("device",),
    "neovi": ("serial",),
    "pcan": ("device_id",),
    "systec": ("device_number",),
    "udp_multicast": ("port",),
    "vector": ("app_name", "serial"),
}


class PythonCanAddress(CanAddress):
    """A node on a bus of one of python-can's interfaces.

    bus: arguments of `can.Bus`.
    """

    def __init__(self, url: str) -> None:
        interface = url.partition("://")[2].partition("/")[0]
        options = _OPTIONS.get(interface, ())
        parsed = AmplifierUrl(url, _PYTHON_CAN_FORM, known=("bitrate", *options))
        if parsed.scheme == "can+socketcan":
            interface, channel = "socketcan", parsed.place
            parsed.check_path(parsed.path, _NODE)
        else:
            channel = parsed.path.removeprefix("/")
            parsed.require(
                interface not in ("", *_OTHERS),
                f"interface must be one of python-can, got {interface!r}",
            )
        parsed.require(bool(channel.strip("/")), "bus must be given")
        chosen = {
            name: _number_or_text(parsed.options[name])
            for name in options
            if name in parsed.options
        }
        where = "/".join(part for part in (parsed.place, parsed.path.strip("/")) if part)
        super().__init__(parsed, f"{parsed.scheme}://{where}", settings=chosen)
        self.bus: dict[str, Any] = {
            "interface": interface,
            "channel": _number_or_text(channel),
            "bitrate": self.bitrate,  # not of SocketCAN: ip link set can0 type can bitrate 500000
            "receive_own_messages": False,
            **chosen,
        }

    async def open_port(
        self, on_data: Callable[[bytes], None], on_loss: Callable[[str], None]
    ) -> Port:
        """Open the bus; raises LinkError."""
        from drivers.wires.can_bus.bus_port import open_bus  # python-can takes a tenth of a second

        return await open_bus(self.line, self.bus, on_data, on_loss)


def _number_or_text(text: str) -> int | str:
    return int(text) if text.isdecimal() else text


_SILENCE = 1.0  # s; twenty heartbeats of an amplifier


@final
class TextPort(PortAbove):
    """A port of frames on one of text, below; implements `Port`.

    on_data: called with packed frames, and with an error where text ends in BEL or is no text;
    on_other: with other text; hello: goes before frames while none has come for a second, since an
    adapter may have restarted, as by the opening of its port; cut_off: ends a line of which a port
    that was blocked has dropped the rest; goodbye: sent before it is closed.
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
        self._encode, self._reader, self._on_data = form.encode, TextReader(form, on_other), on_data
        self._hello, self._cut_off, self._goodbye = hello, cut_off, goodbye
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
        if frames := pack_frames(self._reader.feed(data)):
            self._heard_at = threads.now()
            self._on_data(frames)
        if data.endswith(_BELL) or not data.isascii():
            self._on_data(pack_frames([CanFrame(ERROR_ID, data[-BLOCK:])]))


_SLCAN_FORM = "can+slcan:///dev/ttyACM0?bitrate=500000#NODE or can+slcan://HOST:PORT#NODE"
_BAUD = 115_200  # of the adapter's serial port
_CLOSE, _BELL = b"\rC\r", b"\x07"
# Nothing, of what was sent, version and number, status, and frames that are not of this protocol.
_SLCAN_REPLY = re.compile(rb"[zZ]?\Z|[VvNF][0-9A-Za-z]{2,}\Z|[TrRdDbB][0-9A-Fa-f]+\Z")


class SlcanAddress(CanAddress):
    """A node behind a serial adapter with LAWICEL's commands, on a port or behind a TCP port."""

    boot_time = BOOT_TIME

    def __init__(self, url: str) -> None:
        parsed = AmplifierUrl(url, _SLCAN_FORM, known=("bitrate", "baud"))
        self.place = parsed.server(number=_NODE) if parsed.place else parsed.device(_BAUD)
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
            if not _SLCAN_REPLY.match(text):
                on_data(pack_frames([CanFrame(ERROR_ID, text[:BLOCK])]))

        port = TextPort(
            SLCAN, on_data, on_other=unknown, hello=hello, cut_off=b"\r", goodbye=_CLOSE
        )
        port.below = await open_port(self.place, port.received, on_loss)
        return port


_SOCKETCAND_FORM = "can+socketcand://HOST:PORT/can0?bitrate=500000#NODE"
_GREETING_TIMEOUT = 2.0  # s
_MAX_REPLIES = 9


class SocketcandAddress(CanAddress):
    """A node on a bus that a socketcand server has."""

    def __init__(self, url: str) -> None:
        parsed = AmplifierUrl(url, _SOCKETCAND_FORM, known=("bitrate",))
        self.place, path = parsed.server(), parsed.path.strip("/")
        self.channel, _, rest = path.partition("/")
        parsed.check_path(rest, _NODE)
        parsed.require(bool(self.channel), "bus must be given behind the host")
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
