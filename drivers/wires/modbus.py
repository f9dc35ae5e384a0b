"""Modbus RTU and TCP: the host's side of a wire, its RTU port, and URLs.

    modbus+tcp://HOST:PORT/UNIT
    modbus+rtu:///dev/ttyS1?baud=115200#UNIT

A message is written, and then its reply is read. Responses are matched with requests by the
transaction number over TCP, by unit, function and length over RTU, and by the tag. `SilentPort`
keeps an RTU line silent before each frame.
"""

import asyncio
import contextlib
import random
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import ClassVar, final

from drivers.errors import LinkError, WireCounters
from drivers.ports import NETWORK_DELAY, Port, open_port
from drivers.protocol.definition import BOOT_TIME, BROADCAST, REACTION, REQUESTS, Message
from drivers.protocol.records import Refusal, Values
from drivers.urls import ADDRESS, ADDRESS_MAX, RTU_BAUD, AmplifierUrl, with_fragment
from drivers.wires.modbus_frames import (
    BOX,
    ECHO_SIZE,
    HEAD,
    IDENTITY_COUNT,
    IDENTITY_REGISTER,
    PRESENT,
    READ_SIZE,
    REPLY_OFFSET,
    RESPONSE_SIZE,
    RTU,
    RTU_MAX,
    TCP,
    WRITE,
    WRITE_SIZE,
    Adu,
    AduReader,
    Pdu,
    Read,
    Response,
    Write,
    reply_in,
    response_to,
)
from drivers.wires.wire import (
    WIDEST,
    Arrival,
    BrokenReply,
    Continuation,
    DuplicateAddress,
    PortAbove,
    Reply,
    Scheme,
    Wire,
    WireAddress,
    WrittenPart,
    read_reply,
    reply_words,
)

_TO_ALL = b"\0"


@final
class SilentPort(PortAbove):
    """A port that sends a frame after the line was silent for a time [s]; implements `Port`.

    byte_time: of a byte on the line [s]; on_data: is called with received bytes. A frame always
    waits for the last frame of this port, and for others no longer than the longest one takes, so
    that noise does not delay a stop. A newer frame replaces an older waiting one, because its
    request has timed out, and goes no later than that one would have; broadcasts have no reply, and
    are all sent.
    """

    def __init__(self, silence: float, byte_time: float, on_data: Callable[[bytes], None]) -> None:
        self._silence = silence
        self._byte_time = byte_time
        self._on_data = on_data
        self._loop = asyncio.get_running_loop()
        self._free_from = self._loop.time() + silence
        self._sent_until = 0.0  # s; the end of the last frame of this port and its silence
        self._waiting: list[tuple[float, bytes]] = []  # frames, and when [s] they go at the latest
        self._timer: asyncio.TimerHandle | None = None

    def write(self, data: bytes) -> None:
        """Send a frame as soon as the line has been silent; raises LinkError."""
        latest = self._loop.time() + RTU_MAX * self._byte_time + self._silence
        broadcasts = list[tuple[float, bytes]]()
        for waiting_latest, frame in self._waiting:
            if frame.startswith(_TO_ALL):
                broadcasts.append((waiting_latest, frame))
            else:  # repetitions of a request must not postpone it
                latest = min(latest, waiting_latest)
        self._waiting = [*broadcasts, (latest, data)]
        self._send()

    def close(self) -> None:
        """Close it; frames that wait are not sent."""
        self._waiting.clear()
        super().close()

    def received(self, data: bytes) -> None:
        """Deliver received bytes, after which the line must be silent again."""
        self._free_from = max(self._free_from, self._loop.time() + self._silence)
        self._on_data(data)

    def _send(self) -> None:
        """Send the frames that may go now; a timer sends the rest."""
        while self._waiting:
            latest, frame = self._waiting[0]
            due = max(self._sent_until, min(self._free_from, latest))
            now = self._loop.time()
            if now < due:
                if self._timer is None:
                    self._timer = self._loop.call_at(due, self._due)
                return
            del self._waiting[0]
            self._sent_until = now + len(frame) * self._byte_time + self._silence
            self._free_from = max(self._free_from, self._sent_until)
            self.below.write(frame)

    def _due(self) -> None:
        self._timer = None
        with contextlib.suppress(LinkError):  # the loss of the port is reported by itself
            self._send()


_BITS = 11  # bits of a byte, with start, parity and stop bits
_GAP = 3.5  # characters of silence before a frame
_SHORTEST_GAP = 0.00175  # s; the standard's value above 19 200 baud
_NO_SUCH_REGISTERS = (1, 2, 3, 4)
_GATEWAY = {10: "path to", 11: "response of"}
_RTU_CHECKS = "baud rate, parity, cable and protocol, and whether the adapter echoes"
_TCP_CHECKS = "that the server speaks Modbus TCP; of RTU the URL is modbus+rtu://HOST:PORT#UNIT"


@dataclass(slots=True)
class _Request:
    """A request and its transaction on the wire."""

    message: Message
    tag: int
    """0 for a request that only reads."""
    pdu: Pdu
    frame: bytes
    has_reply: bool = True


class ModbusWire(Wire):
    """The host's side of a Modbus line or connection.

    baud: speed of the line; 0 for a network. number: of the last tag and transaction. delay: how
    late a network may deliver a frame [s].
    """

    def __init__(self, baud: int, *, is_rtu: bool, number: int, delay: float = 0.0) -> None:
        self.counters = WireCounters()
        self.silence = max(_GAP * _BITS / baud, _SHORTEST_GAP) if baud else 0.0
        self.delay = delay
        self._baud = baud
        self._is_rtu = is_rtu
        self.confirms_parts = is_rtu or baud > 0
        self.number = number
        self._request: _Request | None = None
        self._write: _Request | None = None  # the write of a set that was sent with its read
        self._last: _Request | None = None  # the last request that had a response
        self._replied = Response()  # that response
        self._reader = AduReader(is_rtu=is_rtu, of_requests=False, is_host=True)
        self._damaged = b""  # first bytes that follow the last valid frame and are no frame
        self._damaged_size = 0  # number of all such bytes
        self._unawaited: set[int] = set()  # transactions whose responses are ignored
        self._sizes: dict[int, tuple[int, int]] = {}  # channels and layers of each unit

    def request(self, address: int, name: str, values: Values, *, has_reply: bool = True) -> bytes:
        """Return the frame of a request, which counts as sent; address 0: a broadcast.

        Over TCP, a broadcast is a frame to each unit that was sent something before.
        """
        self._request = self._last = self._write = None
        if address == BROADCAST:
            if self._is_rtu:
                return self._written(BROADCAST, name, values).frame
            writes = [self._written(unit, name, values) for unit in self._sizes]
            self._unawaited.update(write.pdu.transaction_id for write in writes)
            if self._baud and writes:  # a gateway sends each write after the reply to the last one
                echo = self._time(ECHO_SIZE) + self.silence + REACTION
                self.takes += (len(writes) - 1) * (self.takes + echo)
            return b"".join(write.frame for write in writes)
        self._sizes.setdefault(address, WIDEST)
        if name == "Hello":
            pdu = Read(dev_id=address, address=IDENTITY_REGISTER, count=IDENTITY_COUNT)
            self._request = self._sent(REQUESTS[name], 0, pdu)
        else:
            self._request = self._written(address, name, values)
            self._request.has_reply = has_reply
            if name == "Set" and not self.confirms_parts:
                return self._without_pause(self._request)
        return self._request.frame

    def _without_pause(self, write: _Request) -> bytes:
        """Return the frames of a part of a set over a network; the last part includes its read."""
        if write.has_reply:
            self._write = write
            self._request = self._read_of(write)
            return write.frame + self._request.frame
        self._request = None
        self._unawaited.add(write.pdu.transaction_id)
        return write.frame

    def _read_of(self, write: _Request) -> _Request:
        """Return the request that reads the reply to a written one."""
        unit = write.pdu.dev_id
        message = write.message
        first = message.number * BOX + REPLY_OFFSET
        channels, layers = self._sizes[unit]
        count = HEAD + reply_words(message.name, channels, layers)
        return self._sent(message, write.tag, Read(dev_id=unit, address=first, count=count))

    def received(self, data: bytes) -> list[Arrival]:
        """Return the arrivals that these bytes complete."""
        request = self._request or self._last
        arrivals: list[Arrival] = []
        for adu in self._reader.feed(data, None if request is None else request.pdu):
            if not adu.pdu:
                self._count_damaged(adu.raw)
                continue
            self._damaged = b""
            self.counters.frames_in += 1
            if adu.transaction in self._unawaited:
                self._unawaited.remove(adu.transaction)
                continue
            arrival = self._arrival_in(adu, request)
            if arrival is not None:
                arrivals.append(arrival)
        return arrivals

    def _arrival_in(self, adu: Adu, request: _Request | None) -> Arrival | None:
        """Return the arrival in a valid ADU; None: ignore it.

        request: on the wire, or else the last one, when the bytes came.
        """
        write = self._write
        if write is not None:
            response = response_to(write.pdu, adu)
            if response is not None:
                self._write = None
                return self._arrival(write, response) if response.exception else None
        response = None if request is None else response_to(request.pdu, adu)
        if request is None or response is None:
            self._count_unexpected(adu)
            return None
        if self._request is not request:  # a second response
            self.counters.unexpected_frames += 1
            is_other = self._last is request and self._replied != response
            return DuplicateAddress(adu.unit) if is_other else None
        if request.pdu.function_code == WRITE and not response.exception:
            return self._written_arrival(request, response)
        return self._arrival(request, response)

    def _written_arrival(self, request: _Request, response: Response) -> Arrival:
        """Return the arrival after a confirmed write: its read, or the end of a part of a set."""
        if request.has_reply:
            self._request = self._read_of(request)
            is_present = request.message.name in PRESENT
            return Continuation(self._request.frame, is_present=is_present)
        self._finish(request, response)
        return WrittenPart()

    def _finish(self, request: _Request, response: Response) -> None:
        """Take the request off the wire, and keep it and its response for comparison."""
        self._request = None
        self._last = request
        self._replied = response

    def _count_unexpected(self, adu: Adu) -> None:
        """Count a response to no request on the wire."""
        self.counters.unexpected_frames += 1
        number = "" if self._is_rtu else f"transaction {adu.transaction}, "
        self.counters.remark = (
            f"a response of {number}unit {adu.unit} and function {adu.pdu[0]} came that is "
            "not of this request: check the unit, that a gateway repeats unit and "
            "transaction, and that nothing delays responses"
        )

    def withdraw(self) -> None:
        """Give up the request on the wire, so that its reply will count as unexpected."""
        for adu in self._reader.end():  # a damaged length would swallow the next responses
            self._count_damaged(adu.raw)
        self._request = self._write = None
        self._damaged = b""

    def transit(self, words: int) -> float:
        """Return how long the write of a request with this number of words takes to arrive [s]."""
        return self._time(WRITE_SIZE + 2 * (1 + words)) + self.silence

    def exchange_time(self, words: int, reply: int) -> float:
        """Return how long a request and a reply with these numbers of words take [s].

        They are two transactions, with a silence before each of the four frames; 0 over a network.
        """
        after_write = self._time(ECHO_SIZE + READ_SIZE + RESPONSE_SIZE + 2 * (HEAD + reply))
        return self.transit(words) + after_write + 3 * self.silence

    def _time(self, characters: int) -> float:
        return _BITS * characters / self._baud if self._baud else 0.0

    def _sent(self, message: Message, tag: int, pdu: Pdu) -> _Request:
        """Return a request with its frame, under the next transaction number."""
        self.number = self.number % 0xFFFF + 1
        self._unawaited.discard(self.number)
        self.counters.frames_out += 1
        is_write = pdu.function_code == WRITE
        if self._baud:
            size = WRITE_SIZE + 2 * pdu.count if is_write else READ_SIZE
            self.takes = self._time(size) + self.silence
        if self._is_rtu:
            size = ECHO_SIZE if is_write else RESPONSE_SIZE + 2 * pdu.count
            self.busy = self.takes + self._time(size) + self.silence
            return _Request(message, tag, pdu, RTU.buildFrame(pdu))
        pdu.transaction_id = self.number
        return _Request(message, tag, pdu, TCP.buildFrame(pdu))

    def _written(self, unit: int, name: str, values: Values) -> _Request:
        """Return a request that begins with a write."""
        message = REQUESTS[name]
        tag = self.number % 0xFFFF + 1
        registers = message.request.append([tag], values)
        write = Write(dev_id=unit, address=message.number * BOX, registers=registers)
        return self._sent(message, tag, write)

    def _count_damaged(self, data: bytes) -> None:
        """Count invalid bytes; all bytes between two frames count once."""
        self.counters.invalid_frames += not self._damaged
        self._damaged_size = len(data) + (self._damaged_size if self._damaged else 0)
        self._damaged = (self._damaged + data[: RTU_MAX + 5])[: RTU_MAX + 5]
        first_bytes = self._damaged[:8].hex(" ")
        symptom = f"{self._damaged_size} bytes that are no valid frame came ({first_bytes})"
        if self._request is not None and self._damaged == self._request.frame:
            symptom = "the request itself came back, and nothing else"
        checks = _RTU_CHECKS if self._is_rtu else _TCP_CHECKS
        self.counters.remark = f"{symptom}: check {checks}"

    def _arrival(self, request: _Request, response: Response) -> Arrival | None:
        """Interpret a response to the transaction on the wire; None: ignore it."""
        unit = request.pdu.dev_id
        is_hello = request.message.name == "Hello"
        if response.exception in _GATEWAY:  # counts as no response
            self.counters.remark = (
                f"the gateway has no {_GATEWAY[response.exception]} unit {unit} "
                f"(exception {response.exception}): check the unit, its supply and its line"
            )
            return None
        if response.exception:
            self._request = None
            if is_hello and response.exception in _NO_SUCH_REGISTERS:
                return BrokenReply(
                    f"unit {unit} is no amplifier of this protocol: its identity cannot be read "
                    f"(Modbus exception {response.exception}); check address and unit"
                )
        elif not is_hello and response.registers[0] != request.tag:
            self.counters.unexpected_frames += 1
            self.counters.remark = "a reply to another master came: stop that master"
            return None
        else:
            self._finish(request, response)
        try:
            arrival = read_reply(request.message, *reply_in(request.message.number, response))
        except Refusal as error:
            return BrokenReply(str(error))
        if request.message.name == "GetCaps" and isinstance(arrival, Reply):
            channels = arrival.values["channels"]
            layers = arrival.values["layers"]
            self._sizes[unit] = (channels, layers)
        return arrival


_TCP_FORM = "modbus+tcp://HOST:PORT/UNIT (behind a gateway: ?baud=38400, the speed of its line)"
_RTU_FORM = "modbus+rtu:///dev/ttyS1?baud=115200#UNIT or modbus+rtu://HOST:PORT#UNIT"
_TCP_PORT = 502
_PARITIES = {"even": "E", "odd": "O", "none": "N"}


class ModbusAddress(WireAddress):
    """A unit over TCP, on a serial port of this machine, or behind a serial server."""

    SCHEMES: ClassVar[Mapping[str, Scheme]] = {
        "modbus+tcp": Scheme(
            line_kind="ethernet",
            example="modbus+tcp://HOST:PORT/UNIT",
            help="Modbus over TCP; ?baud=38400 for a gateway",
            number="`/UNIT` 1 to 247",
            forms={
                "modbus+tcp://HOST:PORT/UNIT": "`baud`: speed of the line behind a gateway (none). "
                "Default port: 502"
            },
        ),
        "modbus+rtu": Scheme(
            line_kind="",
            example="modbus+rtu:///dev/ttyS1?baud=115200#UNIT",
            help="Modbus on a serial port",
            number="`#UNIT` 1 to 247",
            forms={
                "modbus+rtu:///PATH#UNIT": "`baud` 115200, `parity` `even` (`odd`, `none`), "
                "`stop` 1 (2)",
                "modbus+rtu://HOST:PORT#UNIT": "`baud`: speed of the line behind the server "
                "(unknown); `parity`, `stop`",
            },
        ),
    }

    def __init__(self, url: str) -> None:
        self._is_rtu = url.lower().startswith("modbus+rtu")
        if self._is_rtu:
            parsed = AmplifierUrl(url, _RTU_FORM, known=("baud", "parity", "stop"))
            number = "unit must be given as #{}"
            place = parsed.server(number=number) if parsed.place else parsed.device(RTU_BAUD)
            unit = parsed.number
        else:
            parsed = AmplifierUrl(url, _TCP_FORM, known=("baud",))
            parsed.require(
                not parsed.number, f"unit must be given as /{parsed.number} behind the host"
            )
            place = parsed.server(port=_TCP_PORT)
            unit = parsed.path.strip("/")
        parity = parsed.options.get("parity", "even")
        parsed.require(
            parity in _PARITIES, f"parity must be one of {', '.join(_PARITIES)}, got {parity!r}"
        )
        stop = parsed.whole_option("stop", 1, 2)
        self.place = replace(place, parity=_PARITIES[parity], stop=stop)
        self.number = parsed.whole(unit, "unit", ADDRESS_MAX) if unit else ADDRESS
        self.line = self.place.name
        self.boot_time = BOOT_TIME if self._is_rtu else 0.0
        self.settings = {
            "protocol": "Modbus RTU" if self._is_rtu else "Modbus TCP",
            "baud": self.place.baud,
            "parity": self.place.parity,
            "stop": self.place.stop,
        }

    @staticmethod
    def with_address(url: str, address: int) -> str:
        """Return a URL with another unit."""
        if url.lower().startswith("modbus+rtu"):
            return with_fragment(url, address)
        location, _, options = url.partition("?")
        host = "/".join(location.split("/")[:3])
        query = f"?{options}" if options else ""
        return f"{host}/{address}{query}"

    def make_wire(self) -> ModbusWire:
        """Make the wire with a random number, so that a reply to an earlier host does not match."""
        delay = 0.0 if self.place.device else NETWORK_DELAY
        number = random.getrandbits(16)
        return ModbusWire(self.place.baud, is_rtu=self._is_rtu, number=number, delay=delay)

    async def open_port(
        self, on_data: Callable[[bytes], None], on_loss: Callable[[str], None]
    ) -> Port:
        """Open the port; raises LinkError."""
        if not self.place.device:
            return await super().open_port(on_data, on_loss)
        port = SilentPort(self.make_wire().silence, self.place.byte_time, on_data)
        port.below = await open_port(self.place, port.received, on_loss)
        return port
