"""Frames and messages of Modbus: what is one, what answers what, and what a library must not do."""

import logging
import random

import pytest
from pymodbus.logging import Log

from drivers.wires import modbus_frames
from drivers.wires.modbus_frames import (
    Adu,
    AduReader,
    Read,
    Response,
    Write,
    exception_to,
    parse_request,
    response_to,
)

# A write to unit 3; minimalmodbus makes its CRC DD 00, and 00 DD fits what is before them, too.
WHOLE = bytes.fromhex("0310050000070E1FEFA085D0790003000000140000DD00")


def test_frame_is_not_taken_before_it_is_whole() -> None:
    """The CRC of its first 22 bytes is valid; the length that is in it is 23."""
    reader = AduReader(is_rtu=True, of_requests=True, waits=True)
    assert reader.feed(WHOLE[:-1]) == []
    (adu,) = reader.feed(WHOLE[-1:])
    assert (adu.unit, adu.pdu, adu.raw, reader.rest) == (3, WHOLE[1:-2], WHOLE, b"")


@pytest.mark.parametrize("is_host", [True, False])
@pytest.mark.parametrize("unit", [1, 2])
def test_frame_behind_damaged_bytes_is_found(unit: int, is_host: bool) -> None:
    """That of docs/reference/modbus.md; a host takes none there that is not its response."""
    noise, response = b"\x01\x03", bytes.fromhex("01 10 06 00 00 03 80 80")
    reader = AduReader(is_rtu=True, of_requests=False, is_host=is_host)
    request = Write(dev_id=unit, address=0x600, registers=[3, 9, 7])
    found = reader.feed(noise + response, request) + reader.end()
    is_taken = unit == 1 or not is_host
    assert [each.raw for each in found if each.pdu] == [response] * is_taken
    assert b"".join(each.raw for each in found) == noise + response


@pytest.mark.parametrize(
    ("pdu", "expected"),
    [
        ("04 0980 007D", (0x980, 125, [])),
        ("03 0980 0001", (0x980, 1, [])),
        ("04 0980 0000", None),
        ("04 0980 007E", None),
        ("04 0980 0001 00", None),
        ("04 0980 00", None),
        ("04", None),
        ("10 0300 0002 04 0007 FFFF", (0x300, 2, [7, 0xFFFF])),
        ("10 0300 0000 00", None),
        ("10 0300 007C F8" + "0000" * 124, None),
        ("10 0300 0002 06 0007 FFFF", None),
        ("10 0300 0002 05 0007 FFFF 00", None),
        ("10 0300 0002 04 0007 FF", None),
        ("10 0300 0002 04", None),
        ("10 0300 0002 04 0007 FFFF 00", None),
        ("10 0300 FFFF 04 0007 FFFF", None),
        ("06 0300 0002", None),
        ("17 0980 0001 0C00 0001 02 0001", None),
        ("84 01", None),
    ],
)
def test_requests_are_those_of_the_standard(
    pdu: str, expected: tuple[int, int, list[int]] | None
) -> None:
    """Read 1 to 125 registers or write 1 to 123, the bytes as many as are counted."""
    request = parse_request(Adu(1, bytes.fromhex(pdu)))
    if expected is None or request is None:
        assert expected is request
        return
    assert (request.address, request.count) == expected[:2]
    if expected[2]:
        assert [*request.registers] == expected[2]


READING, WRITING = Read(dev_id=1, address=9, count=2), Write(dev_id=1, address=9, registers=[5, 6])


@pytest.mark.parametrize(
    ("request_sent", "pdu", "expected"),
    [
        (READING, "04 04 0001 FFFF", Response([1, 0xFFFF])),
        (READING, "04 02 0001", None),
        (READING, "04 05 0001 FFFF", None),
        (READING, "04 03 0001 FFFF", None),
        (READING, "04 04 0001 FFFF 00", None),
        (READING, "03 04 0001 FFFF", None),
        (READING, "04", None),
        (READING, "84 02", Response(exception=2)),
        (READING, "84 00", None),
        (READING, "84 02 00", None),
        (READING, "84", None),
        (READING, "90 02", None),
        (WRITING, "10 0009 0002", Response()),
        (WRITING, "10 0008 0002", None),
        (WRITING, "10 0009 0003", None),
        (WRITING, "10 0009 0002 00", None),
        (WRITING, "10 0009", None),
        (None, "04 04 0001 FFFF", None),
    ],
)
def test_response_is_that_of_its_request(
    request_sent: Read | Write | None, pdu: str, expected: Response | None
) -> None:
    """By unit, transaction, function, and registers or their address and count."""
    found = response_to(request_sent, Adu(1, bytes.fromhex(pdu)))
    assert (found and ([*found.registers], found.exception)) == (
        expected and ([*expected.registers], expected.exception)
    )
    assert response_to(request_sent, Adu(2, bytes.fromhex(pdu))) is None
    assert response_to(request_sent, Adu(1, bytes.fromhex(pdu), transaction=1)) is None


def test_damaged_bytes_raise_and_log_nothing(caplog: pytest.LogCaptureFixture) -> None:
    """Bytes of every function, as requests, responses and frames; exceptions are no errors."""
    caplog.set_level(logging.DEBUG)
    chance = random.Random(5)
    readers = [
        AduReader(is_rtu=True, of_requests=of_requests, waits=waits)
        for of_requests in (True, False)
        for waits in (True, False)
    ]
    for number in range(256 * 40):
        data = bytes([1, number % 256]) + chance.randbytes(chance.randrange(12))
        parse_request(Adu(1, data[1:]))
        for request in (READING, WRITING):
            response_to(request, Adu(1, data[1:]))
        for reader in readers:
            reader.feed(data)
            reader.end()
    assert exception_to(16, 3) == b"\x90\x03"
    Log.error("of a library")
    assert caplog.records == []


@pytest.mark.parametrize("noise", [b"\x03\xfa", b"\x01\x63", b"\x17", b"\x18\x00\xf0"])
@pytest.mark.parametrize("waits", [True, False])
@pytest.mark.parametrize("part", [250, 1 << 18])
def test_noise_without_end_is_neither_kept_nor_searched_without_bound(
    noise: bytes, waits: bool, part: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each of its bytes is there once, and the frame behind it is found."""
    tried = 0

    def counted(frame: bytes) -> Adu | None:
        nonlocal tried
        tried += 1
        return checked(frame)

    checked = modbus_frames._checked
    monkeypatch.setattr(modbus_frames, "_checked", counted)
    reader = AduReader(is_rtu=True, of_requests=waits, waits=waits)
    data = (noise * (1 << 18))[: 1 << 18]
    found: list[Adu] = []
    for at in range(0, len(data), part):
        tried = 0
        found += reader.feed(data[at : at + part])
        assert len(reader.rest) <= 256
        assert tried <= 1024
    response = bytes.fromhex("01 10 06 00 00 03 80 80")
    found += reader.end() + reader.feed(WHOLE if waits else response)
    assert b"".join(each.raw for each in found) == data + found[-1].raw
    assert [each.raw for each in found if each.pdu] == [WHOLE if waits else response]
