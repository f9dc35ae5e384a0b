"""Raw access to a Modbus line, over TCP or RTU."""

import asyncio
import struct
from collections.abc import Sequence

from pymodbus.framer import FramerRTU

from drivers.backends.modbus.line import ModbusLine, modbus_line
from drivers.codec.modbus import exchanges
from drivers.codec.modbus.exchanges import Write
from drivers.codec.modbus.timing import ModbusTimes
from drivers.conformance.raw.line import NO_REPLY, REPLY, RawLine, RawRequest
from drivers.protocol.definition import PROTOCOL
from drivers.protocol.messages import Apply, Broadcast, Ping, Request, Stop
from drivers.urls.modbus import ModbusUrl

_MAP = PROTOCOL.modbus
_Q = PROTOCOL.quantities
_TIMEOUT = 0.03  # s, beyond the time on the line; three times the longest reaction
_GAP = 0.06  # s; ends a frame over RTU, where more than 40 ms are a pause
_REST = 0.003  # s; in which the rest of a response arrives
_TRANSACTION, _TAG = 0xA55A, 0x5AA5
_OTHER_UNIT = 231
_NOWHERE = 9000
_WRITE, _WRITE_ONE, _READ, _READ_WRITE = 16, 6, 4, 23
# Places of registers in a set of one channel, and in the control block.
_COMMIT, _SESSION, _TOKEN, _RAMP, _VALID_FOR = 1, 2, 3, 4, 5
_LEVEL, _PHASE, _FLAGS = 7, 8, 9
_STOP_RAMP = 3
_EXCEPTION = 0x80
_GATEWAY = ("exception 10", "exception 11")
_CONTROL: int = _MAP["holding"]["control"]["address"]
_SET: int = _MAP["holding"]["set"]["address"]
_HEARTBEAT: int = _MAP["holding"]["heartbeat"]["address"]
_STATUS: int = _MAP["input"]["status"]["address"]


class ModbusRaw(RawLine):
    """Raw access to the line of an open amplifier at a URL."""

    page = "wire-modbus.md"

    def __init__(self, url: str) -> None:
        self.url = url
        self._url = ModbusUrl.parse(url)
        self._data = bytearray()
        self._came = asyncio.Event()

    @property
    def address(self) -> int:
        """See `RawLine`."""
        return self._url.unit

    async def send(self, request: RawRequest) -> str:
        """See `RawLine`."""
        self._data.clear()
        self._came.clear()
        self._line.tap = self._heard
        try:
            await self._write(request)
            try:
                async with asyncio.timeout(self._time_of(request) + self._timeout):
                    while (outcome := self._outcome()) is None:
                        self._came.clear()
                        await self._came.wait()
            except TimeoutError:
                return NO_REPLY if not self._data else f"{len(self._data)} bytes, no response"
            await asyncio.sleep(self._time_of(request) + _REST)
        finally:
            self._line.tap = None
        return outcome

    async def send_only(self, request: RawRequest) -> None:
        """See `RawLine`."""
        await self._write(request)
        await asyncio.sleep(self._time_of(request) + (_GAP if self._url.is_rtu else _REST))

    def invalid(self, ping: Ping, apply: Apply) -> Sequence[RawRequest]:
        """See `RawLine`."""
        beat, played = self._registers(ping), self._registers(apply)
        body = _write(_HEARTBEAT, beat)
        head = struct.pack(">BHHB", _WRITE, _HEARTBEAT, len(beat) + 1, 2 * len(beat))
        nowhere = struct.pack(">BHH", _READ_WRITE, _NOWHERE, 4) + body[1:]
        found = [
            *self._damaged(body, "a heartbeat"),
            *self._damaged(_write(_SET, played), "a set"),
            self._made("a heartbeat for another unit", body, NO_REPLY, *_GATEWAY, unit=_OTHER_UNIT),
            self._made("an unknown function", b"\x63\0\0", "exception 1"),
            self._made("a heartbeat without session", _write(_HEARTBEAT, beat[:1]), "exception 3"),
            self._made(
                "a heartbeat with a register too many",
                _write(_HEARTBEAT, [*beat, 0]),
                "exception 2",
                "exception 3",
            ),
            self._made("a heartbeat with a wrong count", head + body[6:], "exception 3", NO_REPLY),
            self._made(
                "a session by function 6",
                struct.pack(">BHH", _WRITE_ONE, _HEARTBEAT + 1, beat[1]),
                "exception 1",
            ),
            self._made(
                "a heartbeat that reads registers that do not exist",
                nowhere,
                "exception 1",
                "exception 2",
            ),
            self._made(
                "registers that do not exist",
                struct.pack(">BHH", _READ, _NOWHERE, 4),
                "exception 2",
            ),
            self._made("a write to the status", _write(_STATUS, [1, 0, 4]), "exception 2"),
            self._made(
                "a write amid a set", _write(_SET + 4, played[4:]), "exception 2", "exception 3"
            ),
            self._made("no registers", struct.pack(">BHH", _READ, _STATUS, 0), "exception 3"),
        ]
        return [*found, *self._bad_sets(played)]

    def _bad_sets(self, played: Sequence[int]) -> list[RawRequest]:
        """Make sets with one register out of range."""
        changes = [
            ("flag bit 2", _FLAGS, played[_FLAGS] | 4, 3),
            ("flag bit 3", _FLAGS, played[_FLAGS] | 8, 3),
            ("a level out of range", _LEVEL, _Q.level.maximum + 1, 3),
            ("a phase out of range", _PHASE, _Q.phase.maximum + 1, 3),
            ("a ramp out of range", _RAMP, _Q.ramp.maximum + 1, 3),
            ("a valid_for out of range", _VALID_FOR, _Q.valid_for.maximum + 1, 3),
            ("token 0", _TOKEN, 0, 3),
            ("another commit_token", _COMMIT, played[_TOKEN] % 65535 + 1, 3),
            ("another session", _SESSION, played[_SESSION] % 65535 + 1, 4),
        ]
        found = [("a register too few", played[:-1], 3)]
        for name, place, value, code in changes:
            found.append((name, [*played[:place], value, *played[place + 1 :]], code))
        return [
            self._made(f"a set with {name}", _write(_SET, registers), f"exception {code}")
            for name, registers, code in found
        ]

    def tolerated(self, ping: Ping) -> Sequence[RawRequest]:
        """See `RawLine`."""
        whole = self._framed(_write(_HEARTBEAT, self._registers(ping)))
        half, rest = whole[: len(whole) // 2], whole[len(whole) // 2 :]
        holding = self._framed(struct.pack(">BHH", 3, _STATUS, 8))
        found = [
            RawRequest("a heartbeat by function 16", (whole,), frozenset({REPLY})),
            RawRequest("a read by function 3", (holding,), frozenset({REPLY})),
        ]
        if self._url.is_rtu:
            found.append(
                RawRequest(
                    "half a frame, a pause, a heartbeat", (half, whole), frozenset({REPLY}), _GAP
                )
            )
            found.append(
                RawRequest(
                    "noise, a pause, a heartbeat",
                    (b"\xff\x55\xaa" * 5, whole),
                    frozenset({REPLY}),
                    _GAP,
                )
            )
        else:
            found.append(
                RawRequest("a heartbeat in two pieces", (half, rest), frozenset({REPLY}), 0.2)
            )
        return found

    def broadcasts(self, ping: Ping, apply: Apply) -> Sequence[RawRequest]:
        """See `RawLine`."""
        all_units: int = _MAP["broadcast"]
        beat, played = self._registers(ping), self._registers(apply)
        return [
            self._made("a broadcast heartbeat", _write(_HEARTBEAT, beat), NO_REPLY, unit=all_units),
            self._made("a broadcast set", _write(_SET, played), NO_REPLY, unit=all_units),
            self._made(
                "a broadcast read", struct.pack(">BHH", _READ, _STATUS, 8), NO_REPLY, unit=all_units
            ),
        ]

    def stop_out_of_range(self) -> RawRequest:
        """See `RawLine`."""
        stop = self._registers(Stop(0.0))
        stop[_STOP_RAMP] = 0xFFFF
        body = _write(_CONTROL, stop)
        return self._made("a Stop with a ramp out of range", body, REPLY)

    def carried_out(self, request: Broadcast) -> RawRequest:
        """See `RawLine`."""
        write = exchanges.encode_broadcast(request)
        return self._made(
            f"a broadcast {type(request).__name__}",
            _write(write.address, write.registers),
            NO_REPLY,
            unit=_MAP["broadcast"],
        )

    @property
    def _line(self) -> ModbusLine:
        return modbus_line(self._url)

    @property
    def _timeout(self) -> float:
        """Time [s] after which no response comes; over RTU a pause may end the request first."""
        return _TIMEOUT + (_GAP if self._url.is_rtu else 0.0)

    async def _write(self, request: RawRequest) -> None:
        for number, piece in enumerate(request.pieces):
            assert isinstance(piece, bytes)  # noqa: S101  made here
            if number:
                await asyncio.sleep(request.pause)
            await self._line.send_raw(piece)

    def _heard(self, data: bytes) -> None:
        self._data += data
        self._came.set()

    def _outcome(self) -> str | None:
        """Describe the response received so far; None while it is incomplete."""
        data, head = bytes(self._data), 1 if self._url.is_rtu else 7
        if len(data) < head + 2:
            return None
        unit, function = data[head - 1], data[head]
        if not self._url.is_rtu and data[:4] != struct.pack(">HH", _TRANSACTION, 0):
            return f"a response of transaction {int.from_bytes(data[:2], 'big')}"
        if unit != self._url.unit:
            return f"a response of unit {unit}"
        return f"exception {data[head + 1]}" if function & _EXCEPTION else REPLY

    def _time_of(self, request: RawRequest) -> float:
        size = sum(len(piece) for piece in request.pieces if isinstance(piece, bytes))
        if not self._url.baud:
            return 0.0
        return ModbusTimes(self._url.baud, self._url.bits_per_byte).of(size + 64)

    def _registers(self, request: Request) -> list[int]:
        write = exchanges.encode_request(request, tag=_TAG).write
        assert isinstance(write, Write)  # noqa: S101  of requests that write
        return list(write.registers)

    def _framed(self, pdu: bytes, *, unit: int | None = None) -> bytes:
        number = self._url.unit if unit is None else unit
        if not self._url.is_rtu:
            return struct.pack(">HHHB", _TRANSACTION, 0, len(pdu) + 1, number) + pdu
        body = bytes([number]) + pdu
        return body + FramerRTU.compute_CRC(body).to_bytes(2, "big")

    def _made(self, name: str, pdu: bytes, *outcomes: str, unit: int | None = None) -> RawRequest:
        return RawRequest(name, (self._framed(pdu, unit=unit),), frozenset(outcomes))

    def _damaged(self, pdu: bytes, what: str) -> list[RawRequest]:
        """Make frames that are damaged as they can be on this line."""
        whole = bytearray(self._framed(pdu))
        if self._url.is_rtu:
            whole[-1] ^= 0x40
            return [RawRequest(f"{what} with a wrong CRC", (bytes(whole),), frozenset({NO_REPLY}))]
        whole[3] = 1
        return [RawRequest(f"{what} of protocol 1", (bytes(whole),), frozenset({NO_REPLY}))]


def _write(address: int, registers: Sequence[int]) -> bytes:
    """Make the PDU of a write."""
    words = [word & 0xFFFF for word in registers]
    head = struct.pack(">BHHB", _WRITE, address, len(words), 2 * len(words))
    return head + struct.pack(f">{len(words)}H", *words)
