"""Modbus ADUs of register requests, over TCP and RTU.

A response is credited to a request alone that it answers; what is late, of others or damaged is
counted.
"""

import struct
from collections.abc import Sequence
from dataclasses import dataclass

from drivers.codec.modbus.crc import crc16
from drivers.statistics import WireCounters

_READ, _WRITE = 4, 16  # input registers, multiple registers
_MBAP = 7  # transaction, protocol, length, unit
_LENGTH_MAX = 254  # unit and PDU
_RTU_MAX = 256
_EXCEPTION = 0x80
_READS = (3, 4, 23)
_WRITES = (5, 6, 15, 16)


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

    @property
    def is_write(self) -> bool:
        """Whether it writes registers, else it reads some."""
        return self.head[0] == _WRITE


@dataclass(frozen=True)
class ModbusResponse:
    """A response: registers read, or the code of an exception."""

    registers: tuple[int, ...] = ()
    exception: int = 0


def build_adu(
    unit: int, transaction: int, address: int, transfer: int | Sequence[int], *, is_rtu: bool
) -> RequestAdu:
    """Build the request of registers from an address on: how many to read, or those to write."""
    if isinstance(transfer, int):
        pdu = struct.pack(">BHH", _READ, address, transfer)
        head, size = bytes([_READ, 2 * transfer]), 2 + 2 * transfer
    else:
        count = len(transfer)
        head, size = struct.pack(">BHH", _WRITE, address, count), 5
        pdu = head + struct.pack(f">B{count}H", 2 * count, *transfer)
    if is_rtu:
        frame = bytes([unit]) + pdu
        frame += crc16(frame)
    else:
        frame = struct.pack(">HHHB", transaction, 0, 1 + len(pdu), unit) + pdu
    return RequestAdu(unit, transaction, frame, head, size)


class ResponseReader:
    """Finds the response to a request in the received bytes, and counts everything else.

    A response has the unit, function and length of the request, over TCP its transaction number,
    over RTU a valid CRC, and echoes address and count of a write. unawaited: transactions whose
    responses are passed over.
    """

    def __init__(self, *, is_rtu: bool, counters: WireCounters) -> None:
        self._is_rtu = is_rtu
        self._counters = counters
        self._buffer = bytearray()
        self.unawaited: set[int] = set()

    def clear(self) -> None:
        """Discard partial data."""
        if self._buffer:
            self._counters.invalid_frames += 1
            self._buffer.clear()

    def feed(self, data: bytes, to: RequestAdu | None) -> list[ModbusResponse]:
        """Return the responses to a request in these bytes; to: None without a request."""
        self._buffer += data
        split = self._next_rtu if self._is_rtu else self._next_tcp
        responses = []
        while (frame := split(to)) is not None:
            self._counters.frames_in += 1
            transaction, unit, pdu = frame
            if transaction in self.unawaited:
                self.unawaited.remove(transaction)
                continue
            response = None
            if to is not None and (transaction, unit) == (to.transaction, to.unit):
                response = _response(pdu, to)
            if response is None:
                self._counters.unexpected_frames += 1
            else:
                responses.append(response)
        return responses

    def _next_tcp(self, to: RequestAdu | None) -> tuple[int, int, bytes] | None:
        if len(self._buffer) < _MBAP:
            return None
        transaction, protocol, length = (
            int.from_bytes(self._buffer[at : at + 2], "big") for at in (0, 2, 4)
        )
        if protocol != 0 or not 2 <= length <= _LENGTH_MAX:
            self.clear()  # the start of the next frame is unknown
            return None
        end = _MBAP - 1 + length
        if len(self._buffer) < end:
            return None
        unit, pdu = self._buffer[_MBAP - 1], bytes(self._buffer[_MBAP:end])
        del self._buffer[:end]
        return transaction, unit, pdu

    def _next_rtu(self, to: RequestAdu | None) -> tuple[int, int, bytes] | None:
        for start in range(len(self._buffer) - 4):
            size = self._rtu_size(start, to)
            if size and start + size <= len(self._buffer):
                frame = bytes(self._buffer[start : start + size])
                if crc16(frame[:-2]) == frame[-2:]:
                    self._counters.invalid_frames += start > 0
                    del self._buffer[: start + size]
                    return 0, frame[0], frame[1:-2]
        if len(self._buffer) > 2 * _RTU_MAX:
            self.clear()
        return None

    def _rtu_size(self, start: int, to: RequestAdu | None) -> int:
        """Return the length of a frame that begins here; 0 if none can.

        After invalid bytes only the response itself is accepted, since any bytes may look like the
        frame of another unit.
        """
        unit, function, count = self._buffer[start : start + 3]
        if start and (to is None or unit != to.unit or function & ~_EXCEPTION != to.head[0]):
            return 0
        if function & _EXCEPTION:
            return 5
        if function in _READS:
            size = 5 + count
            return size if not start or (to is not None and size == to.size + 3) else 0
        return 8 if function in _WRITES else 0


def _response(pdu: bytes, to: RequestAdu) -> ModbusResponse | None:
    """Decode a PDU as the response to a request; None if it is not."""
    if len(pdu) == 2 and pdu[0] == to.head[0] | _EXCEPTION and pdu[1]:
        return ModbusResponse(exception=pdu[1])
    if len(pdu) != to.size or not pdu.startswith(to.head):
        return None
    values = pdu[len(to.head) :]
    return ModbusResponse(struct.unpack(f">{len(values) // 2}H", values))
