"""CAN buses: the host's side of the wire, its ports and URLs.

    can+socketcan://can0#NODE
    can+python-can://INTERFACE/CHANNEL?bitrate=500000#NODE
    can+slcan:///dev/ttyACM0?bitrate=500000#NODE     or on HOST:PORT; LAWICEL's commands
    can+socketcand://HOST:PORT/can0#NODE

Requests are frames of words, matched by node and sequence number. Ports carry packed frames
(`drivers.wires.can_frames`): `BusPort` for python-can, `TextPort` for slcan and socketcand.
"""

import asyncio
import contextlib
import errno
import logging
import math
import random
import re
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from typing import Any, final

import can

from drivers.errors import LinkError, WireCounters, system_message
from drivers.ports import FAILURES, NETWORK_DELAY, DevicePort, Port, open_port
from drivers.protocol.definition import (
    BOOT_TIME,
    BROADCAST,
    BY_NUMBER,
    MAX_WORDS,
    REQUESTS,
    VERSION,
    Message,
)
from drivers.protocol.records import Values
from drivers.urls import ADDRESS, AmplifierUrl
from drivers.wires.can_frames import (
    BITRATE,
    BLOCK,
    CANOPEN,
    ERROR_ID,
    NODE_MAX,
    NUMBER_MAX,
    REPLY,
    REQUEST,
    SLCAN,
    SLCAN_RATES,
    SOCKETCAND,
    Assembler,
    CanFrame,
    TextFormat,
    TextReader,
    cob_id,
    frame_time,
    frames_of,
    pack_frames,
    segments,
    unpack_frames,
)
from drivers.wires.wire import (
    Arrival,
    DuplicateAddress,
    OtherHost,
    PortAbove,
    Reply,
    Wire,
    WireAddress,
    read_event,
    read_reply,
)
from registry import threads
from registry.threads import in_thread

_KEPT = 3 * frames_of(MAX_WORDS)  # frames sent last, which an adapter may echo
_READ_VERSIONS = bytes((0x40, 0x00, 0x20, 5, 0, 0, 0, 0))  # upload of 2000:5, CiA 301 7.2.4.3.5
_VERSIONS_READ = bytes((0x4B, 0x00, 0x20, 5))  # two bytes of data follow
_BUS = (
    "that the amplifier is switched on and acknowledges, bit rate, wiring, termination, and the "
    "baud rate of a serial adapter"
)
_START: int = CANOPEN["nmt"]["start"]


class CanWire(Wire):
    """A bus at a bit rate [bit/s]; sequence: before the first request to a node, 0 to 255.

    delay [s]: of a network on the way to the bus.
    """

    def __init__(self, bitrate: int, *, sequence: int, delay: float = 0.0) -> None:
        self.counters = WireCounters()
        self.blocked = f"the adapter takes no frames: check {_BUS}"
        self.is_kept = True
        self.delay = delay
        self._frame_time = frame_time(bitrate)
        self._sequence = sequence
        self._numbers: dict[int, int] = {}  # last ones by node
        self._sent: deque[CanFrame] = deque(maxlen=_KEPT)
        self._pending: tuple[int, int, Message] | None = None  # node, number, request
        self._requested = BROADCAST  # node of the last request
        self._replies = Assembler(self.counters)
        self._events: dict[int, Assembler] = {}

    def request(self, address: int, name: str, values: Values, *, has_reply: bool = True) -> bytes:
        """Return the frames of a request, which counts as sent; address 0: a broadcast.

        Hello sets the node operational first, and reads its versions from an object, which one of
        another version has too.
        """
        number, message = 0, REQUESTS[name]
        if address != BROADCAST:
            number = self._numbers.get(address, self._sequence) % NUMBER_MAX + 1
            self._numbers[address] = number
        words = message.request.append([], values)
        made = segments(number, message.number, words)
        frames = [CanFrame(REQUEST + address, data) for data in made]
        self._sent.extend(frames)
        if name == "Hello":
            start = CanFrame(cob_id("nmt"), bytes((_START, address)))
            frames[:0] = start, CanFrame(cob_id("sdo_request", address), _READ_VERSIONS)
        self._pending = (address, number, message) if has_reply else None
        self._requested = address
        self._replies = Assembler(self.counters)
        self.counters.frames_out += len(frames)
        self.takes = len(frames) * self._frame_time
        return pack_frames(frames)

    def received(self, data: bytes) -> list[Arrival]:
        """Return the arrivals that these frames complete."""
        return [arrival for frame in unpack_frames(data) for arrival in self._arrivals(frame)]

    def withdraw(self) -> None:
        """Give up the request on the wire, so that its reply will count as unexpected."""
        self._pending = None

    def follow(self, before: Wire) -> None:
        """Continue the numbers, since amplifiers discard older ones for 0.1 s."""
        if isinstance(before, CanWire):
            self._numbers.update(before._numbers)

    def transit(self, words: int) -> float:
        """Return how long a request with this number of words takes to arrive [s]."""
        return frames_of(words) * self._frame_time

    def _arrivals(self, frame: CanFrame) -> list[Arrival]:
        node = frame.id & NODE_MAX
        kind = frame.id - node
        if node and kind == REPLY:
            return self._from_amplifier(node, frame.data)
        if node and kind == REQUEST and frame not in self._sent:
            return self._from_host(node, frame.data)
        if kind == cob_id("sdo_answer") and frame.data.startswith(_VERSIONS_READ):
            return self._other_version(node, frame.data)
        if frame.id >= ERROR_ID:
            self.counters.remark = (
                f"the adapter cannot send, or reports errors ({frame.data.hex(' ')}): check {_BUS}"
            )
        elif node and kind not in (REQUEST, cob_id("sdo_request")):
            self._remark_other(node)
        return []  # of other devices, or an echo

    def _remark_other(self, node: int) -> None:
        """Record a frame of a node that is not a reply; frames of its own amplifier matter most."""
        if node == self._requested or not self.counters.remark:
            self.counters.remark = (
                f"frames of node {node} came in place of a reply of node {self._requested}: check "
                "the node and its protocol, and that nothing delays the bus"
            )

    def _from_amplifier(self, node: int, data: bytes) -> list[Arrival]:
        now = threads.now()
        if data[:1] == b"\0":
            events = self._events.setdefault(node, Assembler(self.counters, is_numbered=False))
            event = events.add(data, now)
            return [] if event is None else read_event(node, event.type, event.words, self.counters)
        if node == self._requested and self._replies.contradicts(data):
            self._replies.add(data, now)  # which discards the message
            return [DuplicateAddress(node)]
        if self._pending is None or (node, *data[:1]) != self._pending[:2]:
            self.counters.frames_in += 1
            self.counters.unexpected_frames += data[1:2] == b"\0"
            self._remark_other(node)
            return []
        message = self._replies.add(data, now)
        if message is None:
            return []
        (_, _, request), self._pending = self._pending, None
        return [read_reply(request, message.type, message.words)]

    def _other_version(self, node: int, data: bytes) -> list[Arrival]:
        """Take the versions for the reply to Hello, if it is of a node that will not reply."""
        versions = int.from_bytes(data[4:6], "little")
        hello = node, REQUESTS["Hello"]
        if self._pending is None or self._pending[::2] != hello or versions >> VERSION & 1:
            return []
        self._pending = None
        return [Reply({"versions": versions})]

    def _from_host(self, node: int, data: bytes) -> list[Arrival]:
        """Record a frame of another host; reading and stopping do not count as driving."""
        self.counters.frames_in += 1
        if len(data) != BLOCK or data[1] != 0:
            return []
        self.counters.unexpected_frames += 1
        self._numbers[node] = data[0]  # the amplifier discards older frames
        message = BY_NUMBER.get(data[2])
        return [OtherHost(node)] if message is not None and message.feeds else []


_WATCHED = ("socketcan", "udp_multicast")
"""Interfaces with a file descriptor for the event loop: `recv` of the others may block."""

_SENDS_AT_ONCE = ("socketcan",)
"""Interfaces whose `send` never blocks without a timeout."""

_READ_TIMEOUT = 0.05  # s; interval in which a reader thread notices its end
_READS = 64  # frames per iteration, so that a flood does not block the event loop
_BUS_OFF = 0x40  # error class of SocketCAN
_FULL = "Transmit buffer full"  # of python-can, if the socket's buffer is full
_FULL_PAUSE = 0.0005  # s; before frames are sent again to a full transmit queue
FULL_TIMEOUT = 0.03  # s; without progress, after which frames are dropped as too old

logging.getLogger("can").addHandler(logging.NullHandler())  # its messages become LinkErrors


async def open_bus(
    name: str,
    bus: Mapping[str, Any],
    on_data: Callable[[bytes], None],
    on_loss: Callable[[str], None],
) -> "BusPort":
    """Open a bus by the arguments of `can.Bus`; raises LinkError. See `BusPort`."""
    try:
        opened = await in_thread(
            lambda: can.Bus(ignore_config=True, **bus), name=f"era-open {name}", undo=_shut
        )
    except Exception as problem:  # of the drivers of many vendors
        remedy = "check its name, and that the driver of its vendor is installed"
        if bus["interface"] == "socketcan":
            remedy = (
                "check that the interface exists (ip link) and is up: sudo ip link set "
                f"{bus['channel']} up type can bitrate {bus['bitrate']}"
            )
        raise LinkError(
            f"CAN bus {name} cannot be opened: {remedy} (system error: {system_message(problem)})"
        ) from problem
    interface = bus["interface"]
    return BusPort(
        opened,
        name,
        on_data,
        on_loss,
        is_watched=interface in _WATCHED,
        sends_at_once=interface in _SENDS_AT_ONCE,
    )


class Outbox:
    """Frames that an adapter has not taken yet; times [s] are arguments.

    Newer frames replace older ones, whose request was given up. Broadcasts, which have no reply to
    wait for, stay for as long as a request would. Frames that make no progress for 30 ms are
    dropped as too old.
    """

    def __init__(self) -> None:
        self._frames: deque[tuple[CanFrame, float]] = deque()  # with the expiry [s] of a broadcast
        self._given_up_at = 0.0

    def __len__(self) -> int:
        """Return the number of frames."""
        return len(self._frames)

    def put(self, frames: Iterable[CanFrame], now: float) -> None:
        """Add the frames of a request in place of all others but broadcasts."""
        self._given_up_at = now + FULL_TIMEOUT
        broadcasts = [entry for entry in self._frames if entry[0].id == REQUEST]
        added = [(frame, self._given_up_at) for frame in frames]
        self._frames = deque([*broadcasts, *added])

    def first(self, now: float) -> CanFrame | None:
        """Return the next frame to send, without frames that are too old; None without any."""
        if now > self._given_up_at:
            self._frames.clear()
        while self._frames:
            frame, expires_at = self._frames[0]
            if frame.id != REQUEST or now <= expires_at:
                return frame
            self._frames.popleft()
        return None

    def taken(self, frame: CanFrame, now: float) -> None:
        """Note that the adapter has taken a frame, unless a newer request has replaced it."""
        if self._frames and self._frames[0][0] is frame:
            self._frames.popleft()
            if now <= self._given_up_at:
                self._given_up_at = now + FULL_TIMEOUT

    def clear(self) -> None:
        """Drop all frames."""
        self._frames.clear()


@final
class BusPort(DevicePort):
    """A bus of python-can; implements `Port`.

    is_watched: whether the event loop watches the bus for frames, otherwise a thread reads it;
    sends_at_once: whether `send` of the interface never blocks, otherwise a thread calls it, so
    that an adapter that hangs delays neither a stop on another line nor a heartbeat. on_data:
    called with packed frames.
    """

    kind = "CAN bus"
    failures = (*FAILURES, can.CanError)

    def __init__(
        self,
        bus: can.BusABC,
        name: str,
        on_data: Callable[[bytes], None],
        on_loss: Callable[[str], None],
        *,
        is_watched: bool,
        sends_at_once: bool,
    ) -> None:
        self._bus = bus
        self.outbox = Outbox()
        self._outbox_changed = threading.Condition()  # its lock guards the outbox
        self._sends_at_once = sends_at_once
        self._is_blocked = False
        self._timer: asyncio.TimerHandle | None = None
        super().__init__(name, bus.fileno() if is_watched else None, on_data, on_loss, bus.shutdown)
        if not sends_at_once:
            self.start_thread(self._send_in_thread, name=f"era-send {name}")

    @property
    def is_blocked(self) -> bool:
        """Whether the adapter has not taken the frame that was given to it last."""
        return self._is_blocked

    def write(self, data: bytes) -> None:
        """Send frames, as soon as the adapter takes them; raises LinkError."""
        if self.closing.is_set():
            raise self.lose(OSError("it is closed"))
        with self._outbox_changed:
            self.outbox.put(unpack_frames(data), self.loop.time())
            self._outbox_changed.notify()
        if self._sends_at_once:
            self._send()

    def read_watched(self) -> bytes:
        """Return the frames that have come."""
        frames: list[CanFrame] = []
        try:
            for _ in range(_READS):
                message = self._bus.recv(timeout=0)
                if message is None:
                    break
                frames += _frames(message)
        except self.failures:
            self.received(pack_frames(frames))
            raise
        return pack_frames(frames)

    def read_waiting(self) -> bytes:
        """Return the frame that comes within a short time."""
        message = self._bus.recv(timeout=_READ_TIMEOUT)
        return b"" if message is None else pack_frames(_frames(message))

    def close(self) -> None:
        """Stop reading and writing; `wait_closed` closes the bus."""
        with self._outbox_changed:
            self.outbox.clear()
            super().close()
            self._outbox_changed.notify()

    def _send(self) -> None:
        """Send frames until the adapter takes no more, then again after a pause."""
        try:
            while (frame := self.outbox.first(self.loop.time())) and self._take(frame):
                self.outbox.taken(frame, self.loop.time())
        except self.failures as error:
            raise self.lose(error) from error
        if self.outbox and self._timer is None:
            self._timer = self.loop.call_later(_FULL_PAUSE, self._send_again)

    def _send_again(self) -> None:
        self._timer = None
        if not self.closing.is_set():
            with contextlib.suppress(LinkError):  # reported as a loss
                self._send()

    def _send_in_thread(self) -> None:
        """Send frames as they come, each as soon as the adapter has taken the last one."""
        while True:
            with self._outbox_changed:
                frame = self.outbox.first(self.loop.time())
                while frame is None and not self.closing.is_set():
                    self._outbox_changed.wait()
                    frame = self.outbox.first(self.loop.time())
                if frame is None or self.closing.is_set():
                    return
            is_taken = self._take(frame)  # without the lock: it may block
            with self._outbox_changed:
                if is_taken:
                    self.outbox.taken(frame, self.loop.time())
                else:
                    self._outbox_changed.wait(_FULL_PAUSE)

    def _take(self, frame: CanFrame) -> bool:
        """Give a frame to the adapter; returns whether it has taken it."""
        self._is_blocked = True
        message = can.Message(
            arbitration_id=frame.id,
            is_extended_id=False,
            data=frame.data,
            timestamp=time.time(),
        )
        try:
            self._bus.send(message)
        except can.CanOperationError as error:
            if error.error_code == errno.ENOBUFS or _FULL in str(error):
                return False
            raise
        self._is_blocked = False
        return True


def _frames(message: can.Message) -> list[CanFrame]:
    """Return the data frame with an 11-bit identifier that a message is, if it is one.

    For an error frame, its class is reported; OSError if the adapter is off the bus.
    """
    if message.is_error_frame and message.arbitration_id & _BUS_OFF:
        raise OSError("the adapter went bus-off; check wiring, termination and bit rate")
    if message.is_error_frame:
        return [CanFrame(ERROR_ID, bytes([message.arbitration_id & 0xFF]))]
    if message.is_remote_frame or message.is_extended_id:
        return []
    return [] if message.is_fd else [CanFrame(message.arbitration_id, bytes(message.data))]


def _shut(bus: can.BusABC) -> None:
    """Close an adapter that is not used."""
    with contextlib.suppress(*BusPort.failures):
        bus.shutdown()


_BITRATES = 10_000, 1_000_000
_NODE = "node must be given as #{}"


class CanAddress(WireAddress):
    """A node on a CAN bus; subclasses open the bus in different ways.

    line: name of the bus; delay: of a network in between [s]; settings: other than the bit rate.
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
        """Make the wire with a random number, so that a reply to an earlier host does not match."""
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
    """A node on a bus of a python-can interface.

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

        return await open_bus(self.line, self.bus, on_data, on_loss)


def _number_or_text(text: str) -> int | str:
    return int(text) if text.isdecimal() else text


_SILENCE = 1.0  # s; twenty heartbeats of an amplifier


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
# Ignored: empty lines, echoes, version and number, status, and frames of other protocols.
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
GREETING_TIMEOUT = 2.0  # s
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
            async with asyncio.timeout(GREETING_TIMEOUT):
                await expect("< hi >")
                port.below.write(f"< open {self.channel} >".encode())
                await expect("< ok >")
                port.below.write(b"< rawmode >")
                await expect("< ok >")
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
