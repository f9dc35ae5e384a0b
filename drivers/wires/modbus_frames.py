"""Modbus for both ends, without I/O: pymodbus's frames and messages, and registers of messages.

pymodbus makes and parses ADUs, checksums, requests and responses, and computes their length. This
module finds the start of a frame and matches responses to requests. It does not use pymodbus's
stream readers, and keeps its exceptions and logs for damaged bytes to itself: such bytes are not a
frame.

Message n is written from register 256 n on (tag, words), its reply read from 256 n + 128 on (tag,
result, words).
"""

import logging
import struct
from collections.abc import Mapping, Sequence
from typing import NamedTuple, TypeAlias

from pymodbus.framer import FramerRTU, FramerSocket
from pymodbus.pdu import DecodePDU, ExceptionResponse, ModbusPDU
from pymodbus.pdu.register_message import (
    ReadHoldingRegistersRequest,
    ReadHoldingRegistersResponse,
    ReadInputRegistersRequest,
    ReadInputRegistersResponse,
    WriteMultipleRegistersRequest,
    WriteMultipleRegistersResponse,
)

from drivers.protocol.definition import (
    BY_NUMBER,
    HELLO,
    IDENTITY,
    MAX_WORDS,
    NAK,
    TEXTS,
    Message,
    nak_of,
)
from drivers.protocol.records import TEXT_MAX, Refusal, Values

# pymodbus logs Modbus exceptions as program errors; pymodbus_apply_logging_config shows its log.
logging.getLogger("pymodbus").setLevel(logging.CRITICAL + 1)

READS = (3, 4)
"""Function codes that read registers."""
READ = 4
"""Function code with which hosts read."""
WRITE = 16
"""Function code with which hosts write."""
EXCEPTION = 0x80
"""Bit of the function code that marks an exception response."""
WRITE_SIZE = 9
"""Bytes of a write on RTU without its registers."""
ECHO_SIZE = 8
"""Bytes of the response to a write on RTU."""
READ_SIZE = 8
"""Bytes of a read on RTU."""
RESPONSE_SIZE = 5
"""Bytes of the response to a read on RTU without its registers."""

BOX = 256
"""Registers of a message."""
REPLY_OFFSET = 128
"""Offset of the reply within the registers of its message."""
HEAD = 2
"""Registers of a reply before its words: tag and result."""
AREA = HEAD + MAX_WORDS
"""Registers of a reply, padded with zeros."""
IDENTITY_REGISTER = 1065
"""First register of the identity: tag 0, versions, texts padded with zeros."""
IDENTITY_COUNT = 2 + len(TEXTS) * TEXT_MAX // 2
"""Registers of the identity."""
PRESENT = ("GetCaps", "GetStatus", "GetFaults")
"""Messages whose reply is made at the time of reading, without a previous write."""
EXCEPTIONS: Mapping[int, str] = {
    1: "UNKNOWN_TYPE",
    2: "UNKNOWN_TYPE",
    3: "BAD_LENGTH",
    5: "BUSY",
    6: "BUSY",
}
"""Nak codes by Modbus exception."""

RTU_MAX = 256
"""Bytes of the longest frame over RTU."""
_RTU_MIN = 4  # bytes; unit, function and CRC
_TRIES_MAX = 512  # positions to search for a frame in one step; noise can be endless
_MBAP = struct.Struct(">HHHB")  # transaction, protocol, length, unit
_LENGTH_MAX = 254  # unit and PDU
_COUNT_MAX = {3: 125, 4: 125, WRITE: 123}  # registers by function
_REQUESTS = DecodePDU(is_server=True)
_RESPONSES = DecodePDU(is_server=False)
_REQUEST_KINDS: Mapping[int, type[ModbusPDU]] = {
    3: ReadHoldingRegistersRequest,
    READ: ReadInputRegistersRequest,
    WRITE: WriteMultipleRegistersRequest,
}
_RESPONSE_KINDS: Mapping[int, type[ModbusPDU]] = {
    3: ReadHoldingRegistersResponse,
    READ: ReadInputRegistersResponse,
    WRITE: WriteMultipleRegistersResponse,
}

RTU = FramerRTU(_RESPONSES)
"""pymodbus's encoder of RTU frames."""
TCP = FramerSocket(_RESPONSES)
"""pymodbus's encoder of TCP frames."""
Pdu: TypeAlias = ModbusPDU
"""A request or a response: function_code, dev_id, transaction_id, address, count, registers."""
Read = ReadInputRegistersRequest
"""A host's request that reads."""
Write = WriteMultipleRegistersRequest
"""A host's request that writes."""


class Adu(NamedTuple):
    """A PDU to or from a unit; transaction: of TCP, 0 over RTU; raw: the whole frame.

    Without a PDU, raw contains bytes that are not a frame.
    """

    unit: int
    pdu: bytes
    transaction: int = 0
    raw: bytes = b""


class Response(NamedTuple):
    """The response to a request: registers read, or the code of an exception."""

    registers: Sequence[int] = ()
    exception: int = 0


def framed(unit: int, pdu: bytes, transaction: int = 0, *, is_rtu: bool) -> bytes:
    """Return the frame of a PDU."""
    return (RTU if is_rtu else TCP).encode(pdu, unit, transaction)


def pdu_of(message: Pdu) -> bytes:
    """Return the PDU of a message."""
    return bytes([message.function_code]) + message.encode()


def read_pdu(address: int, count: int, *, function: int = READ) -> bytes:
    """Return the PDU that reads 1 to 125 registers."""
    return pdu_of(_REQUEST_KINDS[function](address=address, count=count))


def write_pdu(address: int, registers: Sequence[int]) -> bytes:
    """Return the PDU that writes registers."""
    return pdu_of(Write(address=address, registers=[*registers]))


def response_pdu(request: Pdu, registers: Sequence[int] = ()) -> bytes:
    """Return the PDU of the response to a request; registers: that were read."""
    if request.function_code == WRITE:
        return pdu_of(WriteMultipleRegistersResponse(address=request.address, count=request.count))
    return pdu_of(_RESPONSE_KINDS[request.function_code](registers=[*registers]))


def exception_to(function: int, code: int) -> bytes:
    """Return the PDU of an exception to a request of a function."""
    return pdu_of(ExceptionResponse(function, code))


def parse_request(adu: Adu) -> Pdu | None:
    """Return the request of an ADU that reads or writes registers; None for any other."""
    function = adu.pdu[0]
    kind = _REQUEST_KINDS.get(function)
    if kind is None:
        return None
    request = kind(dev_id=adu.unit, transaction_id=adu.transaction)
    try:
        request.decode(adu.pdu[1:])
        register_count = request.count if function == WRITE else 0
        is_whole = pdu_of(request) == adu.pdu and len(request.registers) == register_count
    except Exception:  # pymodbus raises various exceptions for damaged bytes
        return None
    return request if is_whole and 1 <= request.count <= _COUNT_MAX[function] else None


def message_written(request: Pdu) -> Message | None:
    """Return the message that a request writes, or None."""
    number, offset = divmod(request.address, BOX)
    is_write = request.function_code == WRITE and request.count <= MAX_WORDS + 1
    return BY_NUMBER.get(number) if is_write and offset == 0 else None


def message_shown(request: Pdu) -> Message | None:
    """Return the message whose reply area a request reads, or None."""
    number, offset = divmod(request.address, BOX)
    is_read = request.function_code in READS
    return BY_NUMBER.get(number) if is_read and offset >= REPLY_OFFSET else None


def response_to(request: Pdu | None, adu: Adu) -> Response | None:
    """Read an ADU as the response to a request; None if it is not.

    It has the unit, the transaction and the function of the request, and as many registers, or
    echoes address and count.
    """
    if request is None or adu.unit != request.dev_id:
        return None
    if adu.transaction != request.transaction_id:
        return None
    pdu = adu.pdu
    function = request.function_code
    if pdu[0] == function | EXCEPTION:
        return Response(exception=pdu[1]) if len(pdu) == 2 and pdu[1] else None
    if function == WRITE:
        return Response() if pdu == response_pdu(request) else None
    size = 2 * request.count
    if pdu[:2] != bytes((function, size)) or len(pdu) != 2 + size:
        return None
    return Response(struct.unpack(f">{request.count}H", pdu[2:]))


def reply_in(number: int, response: Response) -> tuple[int, Sequence[int]]:
    """Return type and words of the reply to a message number.

    A result or exception that means a rejection becomes a Nak. Raises Refusal for an unreadable
    identity, and for any other exception.
    """
    if response.exception:
        if response.exception not in EXCEPTIONS:
            raise Refusal(f"Modbus exception {response.exception}")
        return NAK, nak_of(Refusal("", EXCEPTIONS[response.exception]), number)
    if number == HELLO:
        return HELLO, IDENTITY.pack(unpack_identity(response.registers))
    _, result, *words = response.registers
    if not result:
        return number, words
    code, channel = divmod(result, 256)
    return NAK, (number, code, channel)


class AduReader:
    """Splits a stream of requests or responses into ADUs; invalid bytes have no PDU.

    Over TCP each header gives the start of the next frame. Over RTU a frame starts at a byte from
    which the length given in the frame leads to a valid CRC. Damaged bytes can look like a frame:
    an amplifier (waits) does not search inside a frame that may become complete, or one with an
    unknown function, which ends with a pause; a host (is_host) accepts only the awaited response
    after them. rest: a possible beginning of a frame.
    """

    def __init__(
        self, *, is_rtu: bool, of_requests: bool, waits: bool = False, is_host: bool = False
    ) -> None:
        self.rest = b""
        self._is_rtu = is_rtu
        self._decoder = _REQUESTS if of_requests else _RESPONSES
        self._waits = waits
        self._is_host = is_host
        self._is_lost = False  # after damaged bytes

    def feed(self, data: bytes, request: Pdu | None = None) -> list[Adu]:
        """Return the ADUs that these bytes complete, in order; request: whose response is due."""
        data = self.rest + data
        if self._is_rtu:
            return self._split_rtu(data, request, waits=self._waits)
        return self._split_tcp(data)

    def _split_tcp(self, data: bytes) -> list[Adu]:
        adus: list[Adu] = []
        while len(data) >= _MBAP.size:
            transaction, protocol, length, unit = _MBAP.unpack_from(data)
            if protocol or not 2 <= length <= _LENGTH_MAX:  # the next frame cannot be found
                self.rest = b""
                return [*adus, Adu(unit, b"", raw=data)]
            size = _MBAP.size - 1 + length
            if len(data) < size:
                break
            adus.append(Adu(unit, data[_MBAP.size : size], transaction, data[:size]))
            data = data[size:]
        self.rest = data
        return adus

    def end(self) -> list[Adu]:
        """Return the ADUs of the rest, ended by a pause."""
        adus: list[Adu] = []
        invalid = self.rest
        if self._is_rtu and self.rest:
            whole = checked_adu(self.rest)
            if whole is not None:
                adus = [whole]
                invalid = b""
            else:
                adus = self._split_rtu(self.rest, None, waits=False)
                invalid = self.rest
        self.rest = b""
        self._is_lost = False
        if invalid:
            adus.append(Adu(0, b"", raw=invalid))
        return adus

    def _split_rtu(self, data: bytes, request: Pdu | None, *, waits: bool) -> list[Adu]:
        adus: list[Adu] = []
        start = 0  # search position
        rest = -1  # start of a possibly incomplete frame
        tries = 0
        while start < len(data):
            size = self._size(data[start : start + RTU_MAX])
            adu = self._adu_at(data, start, size, request)
            if adu is not None:
                if start:
                    adus.append(Adu(0, b"", raw=data[:start]))
                adus.append(adu)
                data = data[start + size :]
                start = 0
                rest = -1
                self._is_lost = False
                continue
            is_short = len(data) <= RTU_MAX
            may_wait = waits and is_short and start == 0 and not self._is_lost
            may_end = size == 0 and may_wait  # by a pause
            if rest < 0 and (size > len(data) - start or may_end):
                rest = start
            if rest == start and may_wait:
                break
            start += 1
            tries += 1
            if tries >= _TRIES_MAX:
                start = max(start, len(data) - RTU_MAX)
        return [*adus, *self._keep_rest(data, len(data) if rest < 0 else rest)]

    def _keep_rest(self, data: bytes, start: int) -> list[Adu]:
        """Keep data from a position on for the next call; return the invalid bytes before it."""
        self.rest = data[start:]
        if start == 0:
            return []
        self._is_lost = True
        return [Adu(0, b"", raw=data[:start])]

    def _adu_at(self, data: bytes, start: int, size: int, request: Pdu | None) -> Adu | None:
        """Return the valid frame of a size at a position, or None."""
        is_whole = 0 < size <= len(data) - start
        adu = checked_adu(data[start : start + size]) if is_whole else None
        is_after_damage = self._is_lost or start > 0
        if adu is not None and is_after_damage and self._is_host:
            return adu if response_to(request, adu) is not None else None
        return adu

    def _size(self, data: bytes) -> int:
        """Return the size of an RTU frame here; 0 if impossible, the maximum if unknown."""
        if len(data) < _RTU_MIN:
            return RTU_MAX
        try:
            kind = self._decoder.lookupPduClass(data)
            size = 0 if kind is None else kind.calculateRtuFrameSize(data) or RTU_MAX
        except Exception:  # pymodbus raises various exceptions for damaged bytes
            return 0
        return size if size <= RTU_MAX else 0


def checked_adu(frame: bytes) -> Adu | None:
    """Return the ADU in an RTU frame, or None if its CRC is invalid."""
    if len(frame) < _RTU_MIN:
        return None
    if not FramerRTU.check_CRC(frame[:-2], int.from_bytes(frame[-2:], "big")):
        return None
    return Adu(frame[0], frame[1:-2], raw=frame)


def pack_identity(identity: Values) -> Sequence[int]:
    """Return the registers of an identity."""
    texts = b"".join(field.encoded(identity).ljust(TEXT_MAX, b"\0") for field in TEXTS)
    return (0, identity["versions"], *struct.unpack(f">{len(texts) // 2}H", texts))


def unpack_identity(registers: Sequence[int]) -> Values:
    """Read the registers of an identity; raises Refusal."""
    raw = struct.pack(f">{len(registers)}H", *registers)
    identity: Values = {"versions": registers[1]}
    for number, field in enumerate(TEXTS):
        start = 4 + number * TEXT_MAX
        text = raw[start : start + TEXT_MAX].rstrip(b"\0")
        field.read(text, len(text), identity)
    return identity
