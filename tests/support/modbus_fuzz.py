"""Both ends of Modbus for damaged bytes; see `mutation`."""

import random
from collections.abc import Iterator, Sequence

from drivers.codec.modbus import exchanges
from drivers.codec.modbus.adu import ResponseReader, build_adu
from drivers.errors import FrameError
from drivers.protocol.messages import Request
from drivers.statistics import WireCounters
from fake_device import FakeDevice
from sim.far_ends.modbus.frames import FRAME_TIMEOUT, RtuReader, TcpReader, rtu_frame, tcp_frame
from sim.far_ends.modbus.frames import RequestAdu as Asked
from sim.far_ends.modbus.unit import ModbusUnit

_REVIVAL = 10  # telegrams until it is armed again: most damaged ones stop or disarm it
_TAG = 7
_READ_WRITE = 23
_BLOCK = 10  # offset of the written block of function 23


class ModbusEnds:
    """Host and far end of Modbus, which get the same damaged bytes.

    telegrams: PDUs of good requests and of their answers.
    """

    def __init__(self, requests: Sequence[Request], *, is_rtu: bool) -> None:
        self._is_rtu = is_rtu
        self._requests = requests
        self._chance = random.Random(1)
        self._device = FakeDevice()
        self._unit = ModbusUnit(self._device)
        self._far = RtuReader() if is_rtu else TcpReader()
        self._host = ResponseReader(is_rtu=is_rtu, counters=WireCounters())
        self._taken = 0
        self._requests_by_size: dict[int, Request] = {}  # in bytes
        self.telegrams: list[bytes] = []
        for request in requests:
            exchange = exchanges.encode_request(request, tag=_TAG, channels=4)
            telegram = build_adu(exchange.read, exchange.write, unit=1, transaction=0, is_rtu=True)
            pdu = telegram.frame[1:-2]
            answer = self._unit.reply(pdu)
            assert answer is not None
            self.telegrams += [pdu, answer]
            self._requests_by_size[answer[1]] = request

    def mend(self, pdu: bytes) -> bytes:
        """Make a frame with a valid header or CRC, and mostly valid lengths."""
        pdu = pdu[:200]
        block = pdu[_BLOCK : _BLOCK + (len(pdu) - _BLOCK) // 2 * 2]
        if self._chance.random() < 0.3:  # as a response
            pdu = pdu[:1] + bytes([len(pdu) - 2]) + pdu[2:]
        elif pdu[0] == _READ_WRITE and len(block) >= 4 and self._chance.random() < 0.8:
            size = bytes([0, len(block) // 2, len(block)])
            pdu = pdu[:7] + size + block
        elif pdu[0] in (3, 4):
            pdu = pdu[:5]
        if self._is_rtu:
            return rtu_frame(1, pdu)
        return tcp_frame(Asked(1, b"", _TAG), pdu)

    def take(self, data: bytes) -> list[object]:
        """Feed bytes to both; the far end's requests and the host's replies."""
        self._taken += 1
        if self._taken % _REVIVAL == 0:
            self._device.revive()
        self._device.asked.clear()
        for piece in self._pieces(data):
            for request in self._far.feed(piece, self._device.now):
                self._serve(request)
        understood = [*self._device.asked, *self._read(data)]
        self._device.pass_time(self._chance.choice((0.0, 0.0, 0.001, 0.02, 2 * FRAME_TIMEOUT)))
        return understood

    def _pieces(self, data: bytes) -> Iterator[bytes]:
        while data:
            size = self._chance.choice((len(data), len(data), self._chance.randint(1, len(data))))
            yield data[:size]
            data = data[size:]

    def _serve(self, request: Asked) -> None:
        """Let the unit respond; the response must fit into a frame."""
        if request.unit == 0:
            self._unit.handle_broadcast(request.pdu)
            return
        pdu = self._unit.reply(request.pdu)
        if pdu is not None:
            assert 2 <= len(pdu) <= 253
            assert pdu[0] & 0x7F == request.pdu[0] & 0x7F

    def _read(self, data: bytes) -> list[object]:
        """Return the replies that the host accepts."""
        size = data[2] if self._is_rtu else data[8] if len(data) > 8 else 0
        request = self._requests_by_size.get(size, self._requests[0])
        exchange = exchanges.encode_request(request, tag=_TAG, channels=4)
        telegram = build_adu(
            exchange.read,
            exchange.write,
            unit=1,
            transaction=0 if self._is_rtu else _TAG,
            is_rtu=self._is_rtu,
        )
        replies: list[object] = []
        for answer in self._host.feed(data, telegram):
            if not answer.exception and exchanges.is_of(answer.registers, tag=_TAG):
                try:
                    exchanges.reported_state(request, answer.registers)
                    replies.append(exchanges.decode_reply(request, answer.registers))
                except FrameError:
                    continue
        self._host.clear()
        return replies
