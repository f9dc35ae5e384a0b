"""The registers of a simulated amplifier: request PDUs in, reply PDUs out.

Written from protocol.yaml, without code of the host's side. A refused write is not applied and does
not feed the watchdog.
"""

from collections.abc import Mapping, Sequence
from typing import Protocol, TypeVar

from drivers.protocol.definition import PROTOCOL
from drivers.protocol.messages import (
    Achieved,
    AddressSet,
    Arm,
    Broadcast,
    Capabilities,
    Clear,
    Commit,
    Disarm,
    FaultList,
    GetBlock,
    GetCaps,
    GetFaults,
    GetMeasured,
    GetReading,
    GetSensors,
    GetStatus,
    Hello,
    Identity,
    Loaded,
    Measured,
    Nak,
    NakCode,
    Ping,
    Reply,
    Request,
    SetAddress,
    Status,
    Stop,
)
from sim.far_ends.modbus.pdu import (
    ILLEGAL_ADDRESS,
    ILLEGAL_FUNCTION,
    ILLEGAL_VALUE,
    READ_HOLDING,
    READ_INPUT,
    READ_WRITE,
    WRITE,
    ModbusException,
    check_range,
    pair,
    registers_read,
    to_write,
)
from sim.far_ends.modbus.registers import (
    MAP,
    NO_CHANNEL,
    RefusedWrite,
    achieved_words,
    capability_words,
    decode_address,
    decode_envelope,
    decode_set,
    fault_words,
    identity_words,
    measured_words,
    status_words,
    value_of,
)
from sim.far_ends.modbus.sensor_registers import (
    decode_measure,
    decode_sample,
    reading_words,
    sample_words,
    sensor_words,
)

_T = TypeVar("_T")

_Q = PROTOCOL.quantities
_HEAD = len(MAP["head"])
_GROUP: int = MAP["channel_registers"]
_CONTROL: int = MAP["holding"]["control"]["address"]
_WORD = _CONTROL + _HEAD  # of the control block
_HEARTBEAT: int = MAP["holding"]["heartbeat"]["address"]
_SET: int = MAP["holding"]["set"]["address"]
_ENVELOPE: int = MAP["holding"]["envelope"]["address"]
_ADDRESS: int = MAP["holding"]["address"]["address"]
_SENSOR: int = MAP["holding"]["sensor"]["address"]
_MEASURE: int = MAP["holding"]["measure"]["address"]
_SAMPLE: int = MAP["holding"]["sample"]["address"]
_CHANNELS, _KNOTS = 16, 32
# How many registers follow those of a block that have names of their own.
_FOLLOWING = {
    "control": 0,
    "heartbeat": 0,
    "set": _CHANNELS * _GROUP,
    "envelope": 2 * _KNOTS,
    "address": MAP["text_registers"],
    "sensor": 0,
    "measure": _Q.tone_count.maximum,
    "sample": 0,
    "sensors": MAP["sensors_listed"] * MAP["sensor_registers"],
    "reading": MAP["reading_registers"],
    "samples": _Q.sample_count.maximum,
    "status": _CHANNELS,
    "refusal": 0,
    "capabilities": _CHANNELS * MAP["limit_registers"],
    "measured": _CHANNELS * MAP["measured_registers"],
    "identity": len(MAP["input"]["identity"]["texts"]) * MAP["text_registers"],
    "achieved": _CHANNELS * _GROUP,
    "faults": MAP["fault_count"] * MAP["fault_registers"],
}
_SIZES = {
    name: _HEAD + len(block["registers"]) + _FOLLOWING[name]
    for name, block in {**MAP["holding"], **MAP["input"]}.items()
}
# Of the blocks that are written: by their first register, the one after their last.
_ENDS = {
    block["address"]: block["address"] + _SIZES[name] for name, block in MAP["holding"].items()
}
_STARTS = {*_ENDS, *(block["address"] for block in MAP["input"].values())}
_CONTROLWORDS: Mapping[int, str] = {word: name for name, word in MAP["controlwords"].items()}
_END = max(block["address"] + _SIZES[name] for name, block in MAP["input"].items())


class Amplifier(Protocol):
    """The amplifier behind the registers."""

    @property
    def is_answering(self) -> bool:
        """Whether it replies at all."""

    def exchange(self, request: Request) -> Reply | None:
        """Its reply to a request; None for no reply."""

    def broadcast(self, request: Broadcast) -> Reply | None:
        """Execute a broadcast; what it would reply."""


class _NoReply(Exception):
    """No reply is sent."""


class ModbusUnit:
    """The registers of one amplifier."""

    def __init__(self, amplifier: Amplifier) -> None:
        self._amplifier = amplifier
        self._tag = 0
        self._refusal = [0, NO_CHANNEL, 0]
        self._achieved: Achieved | None = None
        self._first_sensor = 0
        self._first_sample = GetBlock(0, 0)
        # As written last; initially the defaults of watchdog and ramp.
        self._written = dict.fromkeys(range(_CONTROL, _ENDS[_CONTROL]), 0)
        self._written |= {_WORD + 1: _Q.watchdog.to_wire(0.25), _WORD + 2: 5}

    def reply(self, pdu: bytes) -> bytes | None:
        """The reply to a request of at least one byte; None for no reply."""
        if not self._amplifier.is_answering:
            return None
        try:
            return self._carry_out(pdu[0], pdu[1:])
        except ModbusException as exception:
            return bytes([pdu[0] | 0x80, exception.code])
        except _NoReply:
            return None

    def handle_broadcast(self, pdu: bytes) -> int | None:
        """Execute a broadcast commit, stop or address; the unit's number if it has changed."""
        try:
            if pdu[0] != WRITE:
                return None
            address, words = to_write(WRITE, pdu[1:])
            request = self._request(address, self._without_head(address, words))
        except (ModbusException, _NoReply, RefusedWrite):
            return None
        if not isinstance(request, Commit | Stop | SetAddress):
            return None
        reply = self._amplifier.broadcast(request)
        return reply.address if isinstance(reply, AddressSet) else None

    def _carry_out(self, function: int, body: bytes) -> bytes:
        if function in (READ_HOLDING, READ_INPUT):
            return registers_read(function, self._read(*pair(body)))
        if function == WRITE:
            self._write(*to_write(function, body))
            return bytes([function]) + body[:4]
        if function == READ_WRITE:
            if len(body) < 4:
                raise ModbusException(ILLEGAL_VALUE)
            wanted = pair(body[:4])
            check_range(*wanted, end=_END)
            self._write(*to_write(READ_WRITE, body[4:]))
            return registers_read(function, self._read(*wanted))
        raise ModbusException(ILLEGAL_FUNCTION)

    def _exchange(self, request: Request) -> Reply:
        reply = self._amplifier.exchange(request)
        if reply is None:
            raise _NoReply
        if isinstance(reply, Nak):
            raise RefusedWrite(reply.code, reply.channel)
        return reply

    def _query(self, request: Request, kind: type[_T]) -> _T:
        """Exchange a request that only a busy amplifier refuses, for a reply of a kind."""
        try:
            reply = self._exchange(request)
        except RefusedWrite as refused:
            raise ModbusException(MAP["exceptions"][refused.code.name]) from None
        if not isinstance(reply, kind):
            raise TypeError(f"reply must be {kind.__name__}, got {type(reply).__name__}")
        return reply

    # Reading

    def _read(self, address: int, count: int) -> list[int]:
        check_range(address, count, end=_END)
        words = [self._written.get(at, 0) for at in range(address, address + count)]
        for name, block in MAP["input"].items():
            begin = block["address"]
            if begin < address + count and address < begin + _SIZES[name]:
                for at, word in enumerate([self._tag, *self._block(name)], start=begin):
                    if address <= at < address + count:
                        words[at - address] = word
        if address in _STARTS:
            words[0] = self._tag
        return words

    def _block(self, name: str) -> list[int]:
        match name:
            case "refusal":
                return self._refusal
            case "capabilities":
                return capability_words(self._query(GetCaps(), Capabilities))
            case "identity":
                return identity_words(self._query(Hello(), Identity))
            case "measured":
                reply = self._amplifier.exchange(GetMeasured())
                return measured_words(reply if isinstance(reply, Measured) else Measured(()))
            case "sensors":
                listed = GetSensors(self._first_sensor)
                return sensor_words(self._amplifier.exchange(listed))
            case "reading":
                return reading_words(self._amplifier.exchange(GetReading(self._first_sensor)))
            case "samples":
                return sample_words(self._amplifier.exchange(self._first_sample))
            case "faults":
                return fault_words(self._query(GetFaults(), FaultList))
            case "achieved":
                return achieved_words(self._achieved, self._query(GetStatus(), Status))
            case _:
                return status_words(self._query(GetStatus(), Status))

    # Writing

    def _write(self, address: int, words: Sequence[int]) -> None:
        tag = 0
        try:
            if address == MAP["look"] or address in _ENDS:
                tag = words[0]
            fields = self._without_head(address, words)
            if tag:
                self._tag = tag
            request = self._request(address, fields)
            if isinstance(request, SetAddress):  # by broadcast only
                raise ModbusException(ILLEGAL_ADDRESS)
            reply = None if request is None else self._exchange(request)
        except RefusedWrite as refused:
            channel = NO_CHANNEL if refused.channel is None else refused.channel & 0xFFFF
            self._refusal = [int(refused.code), channel, tag]
            raise ModbusException(MAP["exceptions"][refused.code.name]) from None
        if isinstance(reply, Achieved):
            self._achieved = reply
        if isinstance(request, GetSensors):
            self._first_sensor = request.first
        if isinstance(request, GetBlock):
            self._first_sample = request
        self._written.update(enumerate(words, start=address))
        if isinstance(reply, Loaded):  # reads return it as stored
            slot = _ENVELOPE + _HEAD
            self._written.update({slot: reply.slot, slot + 2: reply.knots})

    def _without_head(self, address: int, words: Sequence[int]) -> Sequence[int]:
        """The words after the tag, where a write begins with it."""
        if address not in _ENDS:
            return words
        if len(words) <= _HEAD:
            raise RefusedWrite(NakCode.BAD_LENGTH)
        return words[_HEAD:]

    def _request(self, address: int, words: Sequence[int]) -> Request | None:
        """Decode the words of a write, without the tag; None where no request follows."""
        if address == MAP["look"]:
            if len(words) > 1:
                raise ModbusException(ILLEGAL_ADDRESS)
            return None
        if address in _ENDS:
            address += _HEAD
        for begin, end in _ENDS.items():
            if begin + _HEAD <= address and address + len(words) <= end:
                break
        else:
            raise ModbusException(ILLEGAL_ADDRESS)
        if address != begin + _HEAD:
            raise ModbusException(ILLEGAL_ADDRESS)
        if begin == _CONTROL:
            return self._control_request(words)
        if begin == _HEARTBEAT:
            return Ping(words[0])
        if begin == _ADDRESS:
            return decode_address(words)
        if begin == _SENSOR:
            return GetSensors(int(value_of(_Q.sensor, words[0])))
        if begin == _MEASURE:
            return decode_measure(words)
        if begin == _SAMPLE:
            return decode_sample(words)
        return decode_set(words) if begin == _SET else decode_envelope(words)

    def _control_request(self, words: Sequence[int]) -> Request:
        """The request of a controlword; registers left out have what was written last."""
        control = {**self._written, **dict(enumerate(words, start=_WORD))}
        ramp = min(control[_WORD + 2], _Q.ramp.maximum) / _Q.ramp.per_unit
        match _CONTROLWORDS.get(words[0]):
            case "ARM":
                session = int(value_of(_Q.session, control[_WORD + 3]))
                return Arm(value_of(_Q.watchdog, control[_WORD + 1]), session)
            case "DISARM":
                return Disarm(ramp)
            case "STOP":
                return Stop(ramp)
            case "CLEAR":
                return Clear(int(value_of(_Q.latch, control[_WORD + 4])))
            case _:
                raise RefusedWrite(NakCode.BAD_VALUE)
