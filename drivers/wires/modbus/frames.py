"""Modbus ADUs of register requests, over TCP and RTU, for both ends; no I/O.

A response is credited to a request alone that it answers; what is late, of others or damaged is
counted.
"""

import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

from drivers.counters import WireCounters
from drivers.wires.modbus.crc import crc16

READS, READ, WRITE = (3, 4), 4, 16
"""Functions that read registers, the one of a host, and the one that writes them."""
EXCEPTION = 0x80
"""Bit of the function in a response that is an exception."""
RTU_MAX = 256
"""Longest frame on a serial line [bytes]."""
_MBAP = struct.Struct(">HHHB")  # transaction, protocol, length, unit
_LENGTH_MAX = 254  # unit and PDU
_RTU_MIN = 4  # unit, function, CRC
_WITH_TWO_WORDS, _TWO_WORDS_SIZE = range(1, 7), 8  # functions, and the size of their requests
_WRITE_SIZE, _COUNT_AT = 9, 6  # without the registers that the byte there counts
_RTU_CHECKS = "baud rate, parity, cable and protocol, and whether the adapter echoes"
_TCP_CHECKS = "that the server speaks Modbus TCP; of RTU the URL is modbus+rtu://HOST:PORT#UNIT"
_COUNTED, _ECHOING = (3, 4, 23), (5, 6, 15, 16)  # functions by the form of their responses


class Adu(NamedTuple):
    """A PDU for a unit, or of it; transaction: of TCP, 0 over RTU; raw: the whole frame.

    Without a PDU raw are bytes that are no frame.
    """

    unit: int
    pdu: bytes
    transaction: int = 0
    raw: bytes = b""


def framed(unit: int, pdu: bytes, transaction: int = 0, *, is_rtu: bool) -> bytes:
    """Return the frame of a PDU."""
    if not is_rtu:
        return _MBAP.pack(transaction, 0, len(pdu) + 1, unit) + pdu
    body = bytes([unit]) + pdu
    return body + crc16(body)


def read_pdu(address: int, count: int, *, function: int = READ) -> bytes:
    """Return the PDU that reads registers."""
    return struct.pack(">BHH", function, address, count)


def write_pdu(address: int, registers: Sequence[int]) -> bytes:
    """Return the PDU that writes registers."""
    count = len(registers)
    return struct.pack(f">BHHB{count}H", WRITE, address, count, 2 * count % 256, *registers)


def split_tcp(data: bytes) -> tuple[list[Adu], bytes]:
    """Split bytes by the lengths in headers; returns what is left, too."""
    found: list[Adu] = []
    while len(data) >= _MBAP.size:
        transaction, protocol, length, unit = _MBAP.unpack_from(data)
        if protocol != 0 or not 2 <= length <= _LENGTH_MAX:
            return [*found, Adu(unit, b"", raw=data)], b""  # the next frame cannot be found
        raw, rest = data[: _MBAP.size - 1 + length], data[_MBAP.size - 1 + length :]
        if len(raw) < _MBAP.size - 1 + length:
            break
        found.append(Adu(unit, raw[_MBAP.size :], transaction, raw))
        data = rest
    return found, data


def checked(data: bytes, start: int = 0, size: int | None = None) -> Adu | None:
    """Return what an RTU frame of a size holds if it is whole and its CRC valid, else None."""
    size = len(data) - start if size is None else size
    frame = data[start : start + size]
    if not _RTU_MIN <= size == len(frame) or crc16(frame[:-2]) != frame[-2:]:
        return None
    return Adu(frame[0], frame[1:-2], raw=frame)


def request_size(data: bytes) -> int:
    """Return the size of the RTU request that begins here, at least; 0 where none can."""
    function = data[1] if len(data) > 1 else 0
    if function == WRITE:
        size = _WRITE_SIZE + sum(data[_COUNT_AT : _COUNT_AT + 1])
        return size if size <= RTU_MAX else 0
    return _TWO_WORDS_SIZE if function in _WITH_TWO_WORDS else 0


def response_size(data: bytes) -> int:
    """Return the size of the RTU response that begins here, at least; 0 where none can."""
    function = data[1] if len(data) > 1 else 0
    if function & EXCEPTION:
        return 5
    if function in _COUNTED:
        return 5 + sum(data[2:3])
    return 8 if function in _ECHOING else 0


def split_rtu(data: bytes, size_of: Callable[[bytes], int]) -> tuple[list[Adu], bytes]:
    """Split bytes that were heard by CRCs and lengths; returns what is left, too.

    size_of: `request_size` or `response_size`.
    """
    found: list[Adu] = []
    start = 0
    while start + _RTU_MIN <= len(data):
        adu = checked(data, start, size_of(data[start:]))
        if adu is None:
            start += 1
            continue
        if start:
            found.append(Adu(0, b"", raw=data[:start]))
        found.append(adu)
        start, data = 0, data[start + len(adu.raw) :]
    if len(data) >= max(_RTU_MIN, size_of(data)):  # it cannot become an ADU
        return [*found, Adu(0, b"", raw=data)], b""
    return found, data


def response_form(pdu: bytes) -> tuple[bytes, int]:
    """Return the first bytes of the response to a PDU that reads or writes registers; its size."""
    if pdu[0] == WRITE:
        return pdu[:5], 5
    count = int.from_bytes(pdu[3:5], "big")
    return bytes([pdu[0], 2 * count % 256]), 2 + 2 * count


@dataclass(frozen=True)
class RequestAdu:
    """A request to one unit: its frame, and what identifies its response.

    transaction: of a TCP frame, 0 for RTU; head: the first bytes of the PDU of the response; size
    of that PDU [bytes].
    """

    unit: int
    transaction: int
    frame: bytes
    head: bytes
    size: int


@dataclass(frozen=True)
class ModbusResponse:
    """A response: registers read, or the code of an exception."""

    registers: tuple[int, ...] = ()
    exception: int = 0


def build_adu(
    unit: int, transaction: int, address: int, transfer: int | Sequence[int], *, is_rtu: bool
) -> RequestAdu:
    """Build the request of registers from an address on: how many to read, or those to write."""
    pdu = read_pdu(address, transfer) if isinstance(transfer, int) else write_pdu(address, transfer)
    frame = framed(unit, pdu, transaction, is_rtu=is_rtu)
    return RequestAdu(unit, transaction, frame, *response_form(pdu))


class ResponseReader:
    """Finds the response to a request in the received bytes, and counts everything else.

    A response has the unit, function and length of the request, over TCP its transaction number,
    over RTU a valid CRC, and echoes address and count of a write. unawaited: transactions whose
    responses are passed over.
    """

    def __init__(self, *, is_rtu: bool, counters: WireCounters) -> None:
        self._is_rtu = is_rtu
        self._counters = counters
        self._buffer = self._request = b""
        self.unawaited: set[int] = set()

    def clear(self) -> None:
        """Discard partial data."""
        if self._buffer:
            self._count_invalid(self._buffer)
        self._buffer = b""

    def feed(self, data: bytes, to: RequestAdu | None) -> list[ModbusResponse]:
        """Return the responses to a request in these bytes; to: None without a request."""
        self._buffer += data
        self._request = b"" if to is None else to.frame
        responses = []
        for adu in self._split(to):
            if not adu.pdu:
                self._count_invalid(adu.raw)
                continue
            self._counters.frames_in += 1
            if adu.transaction in self.unawaited:
                self.unawaited.remove(adu.transaction)
                continue
            response = None
            if to is not None and (adu.transaction, adu.unit) == (to.transaction, to.unit):
                response = _response(adu.pdu, to)
            if response is None:
                self._counters.unexpected_frames += 1
                number = "" if self._is_rtu else f"transaction {adu.transaction}, "
                self._counters.remark = (
                    f"a response of {number}unit {adu.unit} and function {adu.pdu[0]} came that is "
                    "not of this request: check the unit, that a gateway repeats unit and "
                    "transaction, and that nothing delays responses"
                )
            else:
                responses.append(response)
        return responses

    def _split(self, to: RequestAdu | None) -> list[Adu]:
        if self._is_rtu:
            return [*iter(partial(self._next_rtu, to), None)]
        found, self._buffer = split_tcp(self._buffer)
        return found

    def _next_rtu(self, to: RequestAdu | None) -> Adu | None:
        for start in range(len(self._buffer) - 4):
            adu = checked(self._buffer, start, self._rtu_size(start, to))
            if adu is not None:
                if start:
                    self._count_invalid(self._buffer[:start])
                self._buffer = self._buffer[start + len(adu.raw) :]
                return adu
        if len(self._buffer) > 2 * RTU_MAX:
            self.clear()
        return None

    def _count_invalid(self, data: bytes) -> None:
        self._counters.invalid_frames += 1
        what = f"{len(data)} bytes that are no valid frame came ({data[:8].hex(' ')})"
        if data == self._request:
            what = "the request itself came back, and nothing else"
        self._counters.remark = f"{what}: check {_RTU_CHECKS if self._is_rtu else _TCP_CHECKS}"

    def _rtu_size(self, start: int, to: RequestAdu | None) -> int:
        """Return the length of a frame that begins here; 0 if none can.

        After invalid bytes only the response itself is accepted, since any bytes may look like the
        frame of another unit.
        """
        size = response_size(self._buffer[start:])
        if not start:
            return size
        unit, function = self._buffer[start : start + 2]
        if to is None or unit != to.unit or function & ~EXCEPTION != to.head[0]:
            return 0
        return size if function not in _COUNTED or size == to.size + 3 else 0


def _response(pdu: bytes, to: RequestAdu) -> ModbusResponse | None:
    """Decode a PDU as the response to a request; None if it is not."""
    if len(pdu) == 2 and pdu[0] == to.head[0] | EXCEPTION and pdu[1]:
        return ModbusResponse(exception=pdu[1])
    if len(pdu) != to.size or not pdu.startswith(to.head):
        return None
    values = pdu[len(to.head) :]
    return ModbusResponse(struct.unpack(f">{len(values) // 2}H", values))
