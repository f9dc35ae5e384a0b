"""A Modbus line, RTU or TCP, PDU by PDU: writes of messages, reads of their replies."""

import asyncio
import struct
from collections.abc import Iterator, Sequence

from drivers import clock
from drivers.codec.modbus.crc import crc16
from drivers.conformance.client import (
    QUIET,
    Answer,
    Client,
    Heard,
    When,
    altered,
    expect,
    expect_equal,
    expect_reply,
)
from drivers.protocol.records import Values
from drivers.protocol.table import MAX_WORDS, MESSAGES

BOX, REPLY = 256, 128  # registers of a message, offset of its reply
HEAD = 2  # registers of a reply before its words: tag, result
IDENTITY, TEXT = 1065, 16  # first register, registers of a text
WRITE, READ_HOLDING, READ = 16, 3, 4
PRESENT = tuple(MESSAGES[name].number for name in ("GetCaps", "GetStatus", "GetFaults"))
EXCEPTION = 0x80
_HEADER = struct.Struct(">HHHB")  # transaction, protocol, length, unit
_LEAST = 5  # bytes of a frame
_EXCEPTIONS = {1: "UNKNOWN_TYPE", 2: "UNKNOWN_TYPE", 3: "BAD_LENGTH"}


class ModbusClient(Client):
    """A line or a connection; number: of the last transaction and tag."""

    has_events = False

    def __init__(self, address: int, *, is_rtu: bool) -> None:
        super().__init__(address)
        self.kind = "rtu" if is_rtu else "tcp"  # type: ignore[misc]
        self.is_rtu = is_rtu
        self.number = 0
        self._buffer = b""

    def received(self, data: bytes) -> None:
        """Take bytes from the port."""
        self._buffer += data
        while len(self._buffer) >= (size := self._size()):
            frame, self._buffer = self._buffer[:size], self._buffer[size:]
            transaction, unit, pdu = 0, frame[0], frame[1:-2]
            if self.is_rtu:
                check, seen = crc16(frame[:-2]).hex(), frame[-2:].hex()
                expect(check == seen, "CRC of a response", expected=check, seen=seen)
            else:
                transaction, _, _, unit = _HEADER.unpack_from(frame)
                pdu = frame[_HEADER.size :]
            self.take(Heard(clock.now(), transaction, pdu[0], (), (unit, pdu)))

    def _size(self) -> int:
        """Return how long the frame is that the buffer begins with, at least."""
        if len(self._buffer) < _LEAST:
            return _LEAST
        if not self.is_rtu:
            return 6 + int.from_bytes(self._buffer[4:6], "big")
        _, function, count = self._buffer[:3]
        return 5 if function & EXCEPTION else 5 + count if function in (READ, READ_HOLDING) else 8

    def adu(self, pdu: bytes, *, unit: int | None = None) -> bytes:
        """Return a PDU in a frame under the next transaction number."""
        self.number = self.number % 0xFFFF + 1
        unit = self.address if unit is None else unit
        if not self.is_rtu:
            return _HEADER.pack(self.number, 0, len(pdu) + 1, unit) + pdu
        body = bytes([unit]) + pdu
        return body + crc16(body)

    async def transact(self, pdu: bytes) -> tuple[bytes, When]:
        """Send a PDU and await its response; returns that and when it was carried out."""
        data, sent = self.adu(pdu), clock.now()
        self._buffer = b""
        number = 0 if self.is_rtu else self.number
        self.port.write(data)
        heard = expect_reply(await self.next(lambda each: each.number == number), pdu[0])
        unit, response = heard.frame
        seen = unit, response[0] & ~EXCEPTION
        expect_equal(seen, (self.address, pdu[0]), "unit, function of a response")
        if response[0] == WRITE:
            expect_equal(response, pdu[:5], "response to a write")
        return response, When(sent, heard.at)

    async def read(self, first: int, count: int, *, function: int = READ) -> tuple[int, ...]:
        """Read registers; Violation for an exception."""
        response, _ = await self.transact(struct.pack(">BHH", function, first, count))
        what = f"head of the response to a read of {count} registers from {first}"
        head = bytes([function, 2 * count])
        expect_equal((response[:2], len(response)), (head, 2 + 2 * count), what)
        return struct.unpack(f">{count}H", response[2:])

    async def hello(self) -> Values:
        """Read the identity."""
        tag, versions, *texts = await self.read(IDENTITY, 2 + 4 * TEXT)
        expect_equal(tag, 0, "tag of the identity")
        identity: Values = {"versions": versions}
        for at, name in enumerate(("vendor", "product", "serial_number", "firmware")):
            raw = struct.pack(f">{TEXT}H", *texts[TEXT * at : TEXT * (at + 1)]).rstrip(b"\0")
            text = identity[name] = raw.decode("utf-8", errors="replace")
            is_good = "\ufffd" not in text and text.isprintable()
            expect(is_good, name, expected="UTF-8 without control characters", seen=raw)
        return identity

    async def exchange(self, number: int, words: Sequence[int]) -> Answer:
        """Write a message, then read its reply; one that shows the present is read alone."""
        tag, when = None, None
        if number not in PRESENT or words:
            tag = self.number % 0xFFFF + 1  # that of the frame, see `write_of`
            response, when = await self.transact(self.write_of(number, words))
            if response[0] & EXCEPTION:
                code = _EXCEPTIONS.get(response[1], f"exception {response[1]}")
                return Answer(code, None, (), when)
        sent = clock.now()
        count = HEAD + min(self.reply_words.get(number, MAX_WORDS), MAX_WORDS)
        shown, result, *reply = await self.read(BOX * number + REPLY, count)
        when = when or When(sent, clock.now())
        if tag is not None:
            expect_equal(shown, tag, f"tag of the reply to message {number}")
        if result:
            return self.refusal(*when, number, (number, *divmod(result, 256)))
        return Answer("", None, tuple(reply), when)

    def write_of(self, number: int, words: Sequence[int], *, tag: int | None = None) -> bytes:
        """Return the PDU that writes a message, tagged with the number of its frame."""
        tag = self.number % 0xFFFF + 1 if tag is None else tag
        return write_pdu(BOX * number % 0x10000, (tag, *words))

    def request(self, number: int, words: Sequence[int], *, to: int | None = None) -> bytes:
        """Return the frame that writes a message."""
        return self.adu(self.write_of(number, words), unit=to)

    def damaged(self, number: int, words: Sequence[int]) -> Iterator[tuple[str, bytes]]:
        """Yield frames with damage of all kinds."""
        pdu = self.write_of(number, words)
        yield "another unit", self.adu(pdu, unit=self.address % self.addresses + 1)
        if self.is_rtu:
            frame = self.adu(pdu)
            for at in (-2, -1, -4):
                yield f"a wrong byte {at}", altered(frame, at)

    async def send(self, data: bytes, quiet: float = QUIET) -> list[Heard]:
        """Send bytes; return what is heard until a time [s] has passed."""
        self._buffer = b""
        heard = await super().send(data, quiet)
        if self.is_rtu:
            await asyncio.sleep(QUIET)  # ends a frame that is not whole
        return heard


def write_pdu(first: int, registers: Sequence[int]) -> bytes:
    """Return the PDU that writes registers, also more than there can be."""
    count = len(registers)
    head = struct.pack(">BHHB", WRITE, first, count, 2 * count % 256)
    return head + struct.pack(f">{count}H", *registers)
