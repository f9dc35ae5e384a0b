"""The registers of a simulated amplifier: request PDUs of a Modbus master in, answer PDUs out.

Written apart from the host's side, from protocol.yaml alone, so that the two check each other. What
is refused is not applied and does not feed the watchdog; what is damaged is not answered.
"""

from collections.abc import Mapping, Sequence
from typing import Protocol, TypeVar

from drivers.protocol.definition import PROTOCOL
from drivers.protocol.messages import (
    Achieved,
    Arm,
    Broadcast,
    Capabilities,
    Clear,
    Commit,
    Disarm,
    FaultList,
    GetCaps,
    GetFaults,
    GetStatus,
    Hello,
    Identity,
    Loaded,
    Nak,
    NakCode,
    Ping,
    Reply,
    Request,
    Status,
    Stop,
)
from sim.far_ends.modbus.identification import IDENTIFY, IdentificationRequest
from sim.far_ends.modbus.pdu import (
    ILLEGAL_ADDRESS,
    ILLEGAL_FUNCTION,
    ILLEGAL_VALUE,
    READ_HOLDING,
    READ_INPUT,
    READ_WRITE,
    WRITE,
    WRITE_ONE,
    ModbusException,
    check_range,
    pair,
    registers_read,
    to_write,
)
from sim.far_ends.modbus.words import (
    MAP,
    NO_CHANNEL,
    Unfit,
    achieved_words,
    capability_words,
    checksum,
    envelope_load,
    fault_words,
    identity_words,
    playing,
    status_words,
    value_of,
)

_T = TypeVar("_T")

_Q = PROTOCOL.quantities
_HEAD = 2
_GROUP: int = MAP["channel_registers"]
_CONTROL: int = MAP["holding"]["control"]["address"]
_SET: int = MAP["holding"]["set"]["address"]
_ENVELOPE: int = MAP["holding"]["envelope"]["address"]
_CHANNELS, _KNOTS = 16, 32
# How many registers follow those of a block that have names of their own.
_FOLLOWING = {
    "control": 0,
    "set": _CHANNELS * _GROUP,
    "envelope": 2 * _KNOTS,
    "status": _CHANNELS,
    "refusal": 0,
    "capabilities": 0,
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
_WORDS: Mapping[int, str] = {word: name for name, word in MAP["controlwords"].items()}
_END = MAP["input"]["faults"]["address"] + _SIZES["faults"]


class Amplifier(Protocol):
    """Whose registers these are."""

    @property
    def is_answering(self) -> bool:
        """Whether it does anything at all."""

    def exchange(self, request: Request) -> Reply | None:
        """Its answer to a request; None if it keeps still."""

    def broadcast(self, request: Broadcast) -> None:
        """Carry out what was said to all."""


class _Still(Exception):
    """No answer at all."""


class ModbusUnit:
    """The registers of one amplifier. damaged: writes whose check was wrong."""

    def __init__(self, amplifier: Amplifier) -> None:
        self._amplifier = amplifier
        self.damaged = 0
        self._tag = 0
        self._refusal = [0, NO_CHANNEL, 0]
        self._achieved: Achieved | None = None
        # As they were written last; at first the watchdog and ramp that a bare controlword takes.
        self._written = {_CONTROL + 3: _Q.watchdog.to_wire(0.25), _CONTROL + 4: 5}

    def answer(self, pdu: bytes) -> bytes | None:
        """The answer to a request of at least one byte; None if there is none."""
        if not self._amplifier.is_answering:
            return None
        try:
            return self._carry_out(pdu[0], pdu[1:])
        except ModbusException as exception:
            return bytes([pdu[0] | 0x80, exception.code])
        except _Still:
            return None

    def hear(self, pdu: bytes) -> None:
        """Carry out a broadcast: a commit or a stop, and nothing else."""
        try:
            if pdu[0] not in (WRITE_ONE, WRITE):
                return
            address, words = to_write(pdu[0], pdu[1:])
            request = self._request(address, self._without_head(address, words))
        except (ModbusException, _Still, Unfit):
            return
        if isinstance(request, Commit | Stop):
            self._amplifier.broadcast(request)

    def _carry_out(self, function: int, body: bytes) -> bytes:
        if function in (READ_HOLDING, READ_INPUT):
            return registers_read(function, self._read(*pair(body)))
        if function in (WRITE_ONE, WRITE):
            self._write(*to_write(function, body))
            return bytes([function]) + body[:4]
        if function == READ_WRITE:
            if len(body) < 4:
                raise ModbusException(ILLEGAL_VALUE)
            wanted = pair(body[:4])
            check_range(*wanted, end=_END)
            self._write(*to_write(READ_WRITE, body[4:]))
            return registers_read(function, self._read(*wanted))
        if function == IDENTIFY and body[:1] == b"\x0e":
            asked = IdentificationRequest.of(body)
            return asked.answered(_of(Identity, self._asked(Hello())))
        raise ModbusException(ILLEGAL_FUNCTION)

    def _ask(self, request: Request) -> Reply:
        reply = self._amplifier.exchange(request)
        if reply is None:
            raise _Still
        if isinstance(reply, Nak):
            raise Unfit(reply.code, reply.channel)
        return reply

    def _asked(self, request: Request) -> Reply:
        """The same where only a busy amplifier refuses."""
        try:
            return self._ask(request)
        except Unfit as unfit:
            raise ModbusException(MAP["exceptions"][unfit.code.name]) from None

    # Reading

    def _read(self, address: int, count: int) -> list[int]:
        check_range(address, count, end=_END)
        words = [self._written.get(at, 0) for at in range(address, address + count)]
        for name, block in MAP["input"].items():
            begin = block["address"]
            if begin < address + count and address < begin + _SIZES[name]:
                for at, word in enumerate([self._tag, 0, *self._block(name)], start=begin):
                    if address <= at < address + count:
                        words[at - address] = word
        if address in _STARTS:
            words[:1] = [self._tag]
            words[1:2] = [checksum(words[_HEAD:])] * (count > 1)
        return words

    def _block(self, name: str) -> list[int]:
        match name:
            case "refusal":
                return self._refusal
            case "capabilities":
                return capability_words(_of(Capabilities, self._asked(GetCaps())))
            case "identity":
                return identity_words(_of(Identity, self._asked(Hello())))
            case "faults":
                return fault_words(_of(FaultList, self._asked(GetFaults())))
            case "achieved":
                return achieved_words(self._achieved, _of(Status, self._asked(GetStatus())))
            case _:
                return status_words(_of(Status, self._asked(GetStatus())))

    # Writing

    def _write(self, address: int, words: Sequence[int]) -> None:
        tag = 0
        try:
            if address in (MAP["heartbeat"], MAP["look"]) or address in _ENDS:
                tag = words[0]
            fields = self._without_head(address, words)
            if tag:
                self._tag = tag
            request = self._request(address, fields)
            reply = None if request is None else self._ask(request)
        except Unfit as unfit:
            channel = NO_CHANNEL if unfit.channel is None else unfit.channel & 0xFFFF
            self._refusal = [int(unfit.code), channel, tag]
            raise ModbusException(MAP["exceptions"][unfit.code.name]) from None
        if isinstance(reply, Achieved):
            self._achieved = reply
        self._written.update(enumerate(words, start=address))
        if isinstance(reply, Loaded):  # read back as it is kept
            self._written.update({_ENVELOPE + 2: reply.slot, _ENVELOPE + 4: reply.knots})

    def _without_head(self, address: int, words: Sequence[int]) -> Sequence[int]:
        """The words after the tag and the check, where a write begins with them."""
        if address not in _ENDS:
            return words
        if len(words) <= _HEAD:
            raise Unfit(NakCode.BAD_LENGTH)
        if words[1] not in (0, checksum(words[_HEAD:])):
            self.damaged += 1
            raise _Still
        return words[_HEAD:]

    def _request(self, address: int, words: Sequence[int]) -> Request | None:
        """What these words ask for, a block's without its head; None for nothing."""
        if address in (MAP["heartbeat"], MAP["look"]):
            if len(words) > 1:
                raise ModbusException(ILLEGAL_ADDRESS)
            return Ping() if address == MAP["heartbeat"] else None
        if address in _ENDS:
            address += _HEAD
        for begin, end in _ENDS.items():
            if begin + _HEAD <= address and address + len(words) <= end:
                break
        else:
            raise ModbusException(ILLEGAL_ADDRESS)
        if begin == _CONTROL:
            return self._order(address, words)
        if address != begin + _HEAD:  # a part of it would be a torn one
            raise ModbusException(ILLEGAL_ADDRESS)
        return playing(words) if begin == _SET else envelope_load(words)

    def _order(self, address: int, words: Sequence[int]) -> Request | None:
        control = {**self._written, **dict(enumerate(words, start=address))}
        if address > _CONTROL + _HEAD:
            return None
        name = _WORDS.get(words[0])
        ramp = min(control[_CONTROL + 4], _Q.ramp.maximum) / _Q.ramp.per_unit
        match name:
            case "ARM":
                return Arm(value_of(_Q.watchdog, control[_CONTROL + 3]))
            case "DISARM":
                return Disarm(ramp)
            case "STOP":
                return Stop(ramp)
            case "CLEAR":
                return Clear()
            case _:
                raise Unfit(NakCode.BAD_VALUE)


def _of(kind: type[_T], reply: Reply) -> _T:
    if not isinstance(reply, kind):
        raise TypeError(f"a {kind.__name__} was asked for, not a {type(reply).__name__}")
    return reply
