"""Client of a Modbus unit, RTU or TCP: writes of messages, reads of their reply areas."""

import asyncio
import struct
from collections.abc import Iterator, Sequence
from typing import Any

from drivers.protocol.definition import MAX_WORDS, MESSAGES
from drivers.protocol.records import Values
from drivers.wires.modbus_frames import (
    BOX,
    EXCEPTION,
    EXCEPTIONS,
    HEAD,
    IDENTITY_COUNT,
    IDENTITY_REGISTER,
    PRESENT,
    READ,
    REPLY_OFFSET,
    WRITE,
    Adu,
    AduReader,
    framed,
    parse_request,
    read_pdu,
    response_to,
    unpack_identity,
    write_pdu,
)
from era_haptics.lab.conformance.judge_client import (
    GATEWAY_TIMEOUT,
    QUIET_TIME,
    HeardMessage,
    JudgeClient,
    RequestOutcome,
    message_name,
    with_flipped_bit,
)
from era_haptics.lab.conformance.outcomes import expect_equal, read_as, verify
from era_haptics.lab.expectations.tolerances import Interval
from registry import threads

_PRESENT_NUMBERS = tuple(MESSAGES[name].number for name in PRESENT)
_GATEWAY_EXCEPTIONS = b"\x0a", b"\x0b"  # no path to a unit, or no response from it


class ModbusClient(JudgeClient):
    """A unit on a line or a connection; numbers are of transactions and tags."""

    has_events = False
    transactions = 2
    has_gateway = False
    """Whether a gateway replies for units that are not there."""

    def __init__(self, address: int, *, is_rtu: bool) -> None:
        super().__init__(address)
        self.kind = "rtu" if is_rtu else "tcp"  # type: ignore[misc]
        self.has_broadcasts = is_rtu  # type: ignore[misc]
        self.is_rtu = is_rtu
        self._reader = AduReader(is_rtu=is_rtu, of_requests=False, is_host=True)

    def hear(self, data: bytes) -> bytes:
        """Extract responses and other bytes; skip the responses of a gateway.

        A response can arrive in pieces, which can contain a frame with a valid checksum.
        """
        for adu in self._reader.feed(data):
            is_own = adu.unit == self.address or not adu.pdu
            if not is_own and adu.pdu[0] & EXCEPTION and adu.pdu[1:] in _GATEWAY_EXCEPTIONS:
                self.has_gateway = True
                self.timeout = GATEWAY_TIMEOUT
                continue
            function = adu.pdu[0] if adu.pdu else 0
            frame = (adu.unit, adu.pdu or adu.raw)
            self.take(HeardMessage(threads.now(), adu.transaction, function, (), frame))
            if not is_own:
                self._heard_addresses.add(adu.unit)
        return data

    def question(self, address: int) -> bytes:
        """Return the frame that reads the identity of a unit."""
        return self.adu(read_pdu(IDENTITY_REGISTER, IDENTITY_COUNT), unit=address)

    def adu(self, pdu: bytes, *, unit: int | None = None) -> bytes:
        """Return a PDU in a frame under the next transaction number."""
        self.number = self.number % 0xFFFF + 1
        unit = self.address if unit is None else unit
        transaction = 0 if self.is_rtu else self.number
        return framed(unit, pdu, transaction, is_rtu=self.is_rtu)

    async def transact(self, pdu: bytes) -> tuple[bytes, Interval]:
        """Send a PDU and await its response; return that and when it was carried out."""
        data = self.adu(pdu)
        sent_at = threads.now()
        self._reader.end()
        number = 0 if self.is_rtu else self.number
        self.write(data)
        description = f"function {pdu[0]} from register {int.from_bytes(pdu[1:3])}"
        message = await self.replied(
            lambda message: message.number == number or not message.type, description
        )
        unit, response = message.frame
        hexadecimal = response.hex(" ")
        is_valid = bool(message.type)
        verify(is_valid, "response", expected="a valid frame", actual=hexadecimal)
        source = unit, response[0] & ~EXCEPTION
        expect_equal(source, (self.address, pdu[0]), "unit, function of a response")
        request = parse_request(Adu(unit, pdu))
        if request is not None:
            fits = response_to(request, Adu(unit, response)) is not None
            expected = "its registers, or address and count"
            quantity = f"response to {pdu[:5].hex(' ')}"
            verify(fits, quantity, expected=expected, actual=hexadecimal)
        return response, Interval(sent_at, message.at)

    async def read(self, first: int, count: int, *, function: int = READ) -> tuple[int, ...]:
        """Read registers; ContractViolation for an exception."""
        response, _ = await self.transact(read_pdu(first, count, function=function))
        quantity = f"function of the response to a read of {count} registers from {first}"
        expect_equal(response[0], function, quantity)
        return struct.unpack(f">{count}H", response[2:])

    async def hello(self) -> Values:
        """Read the identity."""
        registers = await self.read(IDENTITY_REGISTER, IDENTITY_COUNT)
        expect_equal(registers[0], 0, "tag of the identity")
        return read_as("identity", unpack_identity, registers)

    async def exchange(self, number: int, words: Sequence[int], **options: Any) -> RequestOutcome:
        """Write a message, then read its reply; a request for present values is only read."""
        if number in _PRESENT_NUMBERS and not words:
            return await self._read_reply(number)
        tag = self.number % 0xFFFF + 1  # the tag of the frame, see `write_of`
        response, when = await self.transact(self.write_of(number, words))
        if response[0] & EXCEPTION:
            code = EXCEPTIONS.get(response[1], f"exception {response[1]}")
            return RequestOutcome(code, None, (), when)
        return await self._read_reply(number, tag, when)

    async def _read_reply(
        self, number: int, tag: int | None = None, when: Interval | None = None
    ) -> RequestOutcome:
        """Read the reply area of a message; tag, when: of the write before it, if there is one."""
        sent_at = threads.now()
        word_count = min(self.reply_words.get(number, MAX_WORDS), MAX_WORDS)
        area = await self.read(BOX * number + REPLY_OFFSET, HEAD + word_count)
        area_tag, result, *words = area
        if when is None:
            when = Interval(sent_at, threads.now())
        if tag is not None:
            expect_equal(area_tag, tag, f"tag of the reply to {message_name(number)}")
        if result:
            return self.rejection(when, number, (number, *divmod(result, 256)))
        return RequestOutcome("", None, tuple(words), when)

    async def part(self, number: int, words: Sequence[int]) -> None:
        """Write a message, whose reply area is not read."""
        response, _ = await self.transact(self.write_of(number, words))
        expect_equal(response[0], WRITE, f"function of the response to {message_name(number)}")

    def write_of(self, number: int, words: Sequence[int], *, tag: int | None = None) -> bytes:
        """Return the PDU that writes a message, tagged with the number of its frame."""
        tag = self.number % 0xFFFF + 1 if tag is None else tag
        return write_pdu(BOX * number % 0x10000, (tag, *words))

    def request(self, number: int, words: Sequence[int], *, to: int | None = None) -> bytes:
        """Return the frame that writes a message."""
        return self.adu(self.write_of(number, words), unit=to)

    def damaged(self, number: int, words: Sequence[int]) -> Iterator[tuple[str, bytes]]:
        """Yield frames with damage of all kinds; a gateway keeps those to other units."""
        pdu = self.write_of(number, words)
        if not self.has_gateway:
            yield "another unit", self.adu(pdu, unit=self.free_address)
        if self.is_rtu:
            frame = self.adu(pdu)
            for position in (-2, -1, -4):
                yield f"a wrong byte {position}", with_flipped_bit(frame, position)

    async def send(self, data: bytes, *earlier: bytes, count: int = 0) -> list[HeardMessage]:
        """Send frames, data last; return the frames received until a reply is due."""
        self._reader.end()
        messages = await super().send(data, *earlier, count=count)
        if self.is_rtu:
            await asyncio.sleep(QUIET_TIME)  # ends a frame that is not whole
        return messages
