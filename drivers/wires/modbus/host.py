"""The host's side of Modbus, RTU and TCP: a message is written, then its reply is read.

Message n is written from register 256 n on (tag, words), its reply read from 256 n + 128 on (tag,
result, words). Responses are matched by the transaction number over TCP, by unit, function and
length over RTU, and by the tag.
"""

from collections.abc import Sequence
from dataclasses import dataclass

from drivers.counters import WireCounters
from drivers.protocol.records import Refusal, Values
from drivers.protocol.table import BROADCAST, MESSAGES, REACTION
from drivers.wires.modbus.frames import (
    WRITE,
    ModbusResponse,
    RequestAdu,
    ResponseReader,
    build_adu,
)
from drivers.wires.modbus.registers import (
    BOX,
    EXCEPTIONS,
    HEAD,
    IDENTITY,
    IDENTITY_COUNT,
    REPLY,
    unpack_identity,
)
from drivers.wires.wire import (
    WIDEST,
    Arrival,
    Broken,
    More,
    Nak,
    Reply,
    Several,
    Wire,
    read_nak,
    reply_words,
)

_WRITE_SIZE = 9  # bytes on RTU of a write, without its registers
_FRAME_SIZE = 3  # bytes on RTU of a frame beside its PDU
_HEADER_SIZE = 7  # bytes on TCP of a frame beside its PDU
_ANSWERS_SIZE = 21  # bytes on RTU of the response to a write, of a read and its response
_BITS = 11  # of a byte, with start, parity and stop
_GAP = 3.5  # characters of silence before a frame
_SHORTEST_GAP = 0.00175  # s; by the standard above 19 200 baud
_NO_SUCH_REGISTERS = (1, 2, 3, 4)
_GATEWAY = {10: "path to", 11: "response of"}


@dataclass(slots=True)
class _Request:
    """A request and its transaction on the wire; tag: 0 for one that only reads."""

    name: str
    tag: int
    adu: RequestAdu


class ModbusWire(Wire):
    """A line at a speed [baud], 0 for a network; number: of the last tag and transaction.

    silence: before each frame of a serial line [s], kept by its port; delay [s]: of a network.
    """

    def __init__(self, baud: int, *, is_rtu: bool, number: int, delay: float = 0.0) -> None:
        self.counters = WireCounters()
        self.silence = max(_GAP * _BITS / baud, _SHORTEST_GAP) if baud else 0.0
        self.delay = delay
        self._baud = baud
        self._is_rtu = is_rtu
        self._number = number
        self._request: _Request | None = None
        self._replied: tuple[RequestAdu, ModbusResponse] | None = None  # the last reply
        self._reader = ResponseReader(is_rtu=is_rtu, counters=self.counters)
        self._sizes: dict[int, tuple[int, int]] = {}  # channels and layers of each unit

    def request(self, address: int, name: str, values: Values) -> bytes:
        """Return the frame of a request, which is on the wire from now on; address 0: of all.

        Over TCP a request of all is a frame to each unit that was sent something before.
        """
        self._request = self._replied = None
        if address == BROADCAST:
            if self._is_rtu:
                return self._written(BROADCAST, name, values).adu.frame
            adus = [self._written(unit, name, values).adu for unit in self._sizes]
            self._reader.unawaited = {adu.transaction for adu in adus}
            if self._baud and adus:  # a gateway sends a write once the one before was replied to
                echo = self._time(adus[0].size + _FRAME_SIZE) + self.silence + REACTION
                self.takes += (len(adus) - 1) * (self.takes + echo)
            return b"".join(adu.frame for adu in adus)
        self._sizes.setdefault(address, WIDEST)
        if name == "Hello":
            self._request = _Request(name, 0, self._adu(address, IDENTITY, IDENTITY_COUNT))
        else:
            self._request = self._written(address, name, values)
        return self._request.adu.frame

    def received(self, data: bytes) -> list[Arrival]:
        """Return what these bytes complete."""
        adu = None
        if self._request is not None:
            adu = self._request.adu
        elif self._replied is not None:
            adu = self._replied[0]
        arrivals: list[Arrival] = []
        for response in self._reader.feed(data, adu):
            if self._request is None or self._request.adu is not adu:  # a second response
                self.counters.unexpected_frames += 1
                if self._replied is not None and self._replied != (adu, response):
                    arrivals.append(Several(self._replied[0].unit))
            elif (arrival := self._arrival(self._request, response)) is not None:
                arrivals.append(arrival)
        return arrivals

    def withdraw(self) -> None:
        """Take the request off the wire: its reply will be unexpected."""
        self._request = None
        self._reader.clear()  # a damaged length would take the next responses

    def transit(self, words: int) -> float:
        """Return how long a request of so many words takes to arrive [s]: its write."""
        return self._time(_WRITE_SIZE + 2 * (1 + words)) + self.silence

    def exchange_time(self, words: int, reply: int) -> float:
        """Return how long a request and a reply of so many words take [s]; 0 over a network.

        Two transactions, with the silences before all four frames.
        """
        rest = self._time(_ANSWERS_SIZE + 2 * (HEAD + reply))
        return self.transit(words) + rest + 3 * self.silence

    def _time(self, characters: int) -> float:
        return _BITS * characters / self._baud if self._baud else 0.0

    def _adu(self, unit: int, address: int, transfer: int | Sequence[int]) -> RequestAdu:
        self._number = self._number % 0xFFFF + 1
        self._reader.unawaited.discard(self._number)
        self.counters.frames_out += 1
        transaction = 0 if self._is_rtu else self._number
        adu = build_adu(unit, transaction, address, transfer, is_rtu=self._is_rtu)
        size = len(adu.frame) - (0 if self._is_rtu else _HEADER_SIZE - _FRAME_SIZE)
        self.takes = self._time(size) + self.silence
        if self._is_rtu:
            self.busy = self.takes + self._time(adu.size + _FRAME_SIZE) + self.silence
        return adu

    def _written(self, unit: int, name: str, values: Values) -> _Request:
        """Return a request whose write goes first."""
        message = MESSAGES[name]
        tag = self._number % 0xFFFF + 1
        registers = (tag, *message.request.append([], values))
        return _Request(name, tag, self._adu(unit, message.number * BOX, registers))

    def _arrival(self, request: _Request, response: ModbusResponse) -> Arrival | None:
        """Return what a response to the transaction on the wire means."""
        if response.exception in _GATEWAY:  # as no response
            self.counters.remark = (
                f"the gateway has no {_GATEWAY[response.exception]} unit {request.adu.unit} "
                f"(exception {response.exception}): check the unit, its supply and its line"
            )
            return None
        if response.exception:
            self._request = None
            if request.name == "Hello" and response.exception in _NO_SUCH_REGISTERS:
                return Broken(
                    f"unit {request.adu.unit} is no amplifier of this protocol: its identity "
                    f"cannot be read (Modbus exception {response.exception}); check address and "
                    "unit"
                )
            if (refusal := EXCEPTIONS.get(response.exception)) is not None:
                return Nak(refusal, None)
            return Broken(f"Modbus exception {response.exception}")
        unit = request.adu.unit
        if request.adu.head[0] == WRITE:
            first = MESSAGES[request.name].number * BOX + REPLY
            count = HEAD + reply_words(request.name, *self._sizes[unit])
            request.adu = self._adu(unit, first, count)
            return More(request.adu.frame)
        tag, result, *words = response.registers
        if request.name != "Hello" and tag != request.tag:
            self.counters.unexpected_frames += 1
            self.counters.remark = "a reply to another master came: end that one"
            return None
        self._request, self._replied = None, (request.adu, response)
        try:
            if request.name == "Hello":
                return Reply(unpack_identity(response.registers))
            if result:
                return read_nak((0, *divmod(result, 256)))
            values = MESSAGES[request.name].reply.unpack(words, is_strict=False)
        except Refusal as error:
            return Broken(str(error))
        if request.name == "GetCaps":
            self._sizes[unit] = values["channels"], values["layers"]
        return Reply(values)
