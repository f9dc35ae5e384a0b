"""Frames of the firmware on each wire, by the bytes of docs/decisions/0061."""

import struct
import zlib
from pathlib import Path

import pytest

from firmware_script import GET_STATUS, NAK, request, stuffed, unstuffed
from moved_firmware import CAN, MODBUS, SERIAL, TCP, MovedFirmware
from sim.far_ends.modbus_frames import rtu_frame

HELLO, GET_CAPS, PING, SET_ADDRESS, EVENT = 1, 2, 12, 15, 30
UNKNOWN_TYPE, WRONG_STATE, UNSUPPORTED_VERSION, WRONG_SESSION = 1, 5, 8, 10
NAME = b"FW-1"


@pytest.fixture
def firmware(replaying: Path) -> MovedFirmware:
    """An amplifier that was switched on, its lines silent, its CAN adapter open."""
    firmware = MovedFirmware(replaying)
    firmware.receive(CAN, b"O\r")
    firmware.sent(CAN)
    return firmware


def serial(firmware: MovedFirmware, data: bytes) -> list[bytes]:
    """Header and payload of what is sent upon bytes on the serial line."""
    firmware.receive(SERIAL, data)
    return [unstuffed(part)[:-4] for part in firmware.sent(SERIAL).split(b"\0") if part]


def frame(firmware: MovedFirmware, can_id: int, text: str) -> list[tuple[int, str]]:
    """Identifiers and data of the frames that are sent upon one, as hexadecimal digits."""
    data = bytes.fromhex(text)
    firmware.receive(CAN, f"t{can_id:03X}{len(data)}{data.hex().upper()}\r".encode())
    lines = firmware.sent(CAN).decode().split("\r")
    return [(int(line[1:4], 16), line[5:].lower()) for line in lines if line.startswith("t")]


def pdu(firmware: MovedFirmware, text: str, *, unit: int = 1) -> str:
    """The reply's PDU to one over TCP, as hexadecimal digits; empty: none."""
    data = bytes.fromhex(text)
    firmware.receive(TCP, struct.pack(">HHHB", 7, 0, len(data) + 1, unit) + data)
    sent = firmware.sent(TCP)
    assert not sent or sent[:7] == struct.pack(">HHHB", 7, 0, len(sent) - 6, unit)
    return sent[7:].hex()


def test_hello_has_version_0_and_the_texts(firmware: MovedFirmware) -> None:
    """In bytes as in every version; another version is refused in version 0."""
    texts = (b"ERA haptics", b"Example firmware", NAME, b"2.0")
    payload = b"\x08\0" + b"".join(bytes([len(text)]) + text for text in texts)
    assert serial(firmware, request(HELLO)) == [b"\x81\0\1\7\0" + payload]
    body = b"\x09\2\1\7\0"
    frame_of_2 = stuffed(body + struct.pack("<I", zlib.crc32(body)))
    words = struct.pack("<3H", GET_STATUS, UNSUPPORTED_VERSION, 255)
    assert serial(firmware, frame_of_2) == [bytes([NAK, 0, 1, 7, 0]) + words]


@pytest.mark.parametrize(
    ("text", "reply"),
    [
        ("0600010001", "8601"),  # another function
        ("03 0280 0000", "8303"),  # no register
        ("03 0280 007E", "8303"),  # more than 125
        ("04 0280 007B", "8402"),  # beyond the area
        ("03 0200 0001", "8302"),  # a request cannot be read
        ("10 0901 0001 02 0001", "9002"),  # not at the beginning of a message
        ("10 1E00 0001 02 0001", "9002"),  # of a message that is none
        ("10 0900 0001 03 000100", "9003"),  # count and bytes differ
        ("10 0900 0001 02 0007", "1009000001"),
        ("04 0980 0003", "04060007" + "0000" + "0001"),  # tag, no refusal, disarmed
        ("04 0982 0001", "04020001"),  # a part, read at any time
        ("03 0429 0006", "030c" + "0000" + "0008" + b"ERA hapt".hex()),
    ],
)
def test_modbus_replies(firmware: MovedFirmware, text: str, reply: str) -> None:
    """Exceptions that Modbus defines, and areas; another unit and broadcasts have no reply."""
    if reply.startswith("0406"):
        pdu(firmware, "10 0900 0001 02 0007")
    assert pdu(firmware, text) == reply
    assert pdu(firmware, text, unit=2) == pdu(firmware, text, unit=0) == ""


def test_modbus_address_holds_once_its_reply_was_read(firmware: MovedFirmware) -> None:
    """Then it is another unit's; written without being read it changes nothing."""
    write = "10 0F00 0005 0A 0001 0009 0004" + NAME.hex()
    assert pdu(firmware, write) == "100f000005"
    assert pdu(firmware, "03 0982 0001") == "03020001"
    assert pdu(firmware, "03 0F80 0002") == "030400010000"
    assert pdu(firmware, "03 0982 0001") == ""
    assert pdu(firmware, "03 0982 0001", unit=9) == "03020001"


def test_rtu_takes_broadcasts_and_discards_a_frame_with_a_pause(firmware: MovedFirmware) -> None:
    """A Stop to unit 0 stops; the second half of a frame that comes 30 ms late is none."""
    firmware.receive(MODBUS, rtu_frame(0, bytes.fromhex("1008000002040001 0000")))
    firmware.move(0.01)
    assert firmware.sent(MODBUS) == b""
    assert pdu(firmware, "03 0982 0001") == "03020005"
    ask = rtu_frame(1, bytes.fromhex("0409820001"))
    firmware.receive(MODBUS, ask[:4])
    firmware.move(0.04)
    firmware.receive(MODBUS, ask[4:])
    firmware.move(0.08)
    assert firmware.sent(MODBUS) == b""
    firmware.receive(MODBUS, ask)
    firmware.move(0.09)
    assert firmware.sent(MODBUS)[:5].hex() == "0104020005"


def test_node_replies_once_it_is_operational(firmware: MovedFirmware) -> None:
    """A status in frames of three words, under the number of its request; to a new number again."""
    ask = "0100 0900 00000000"
    assert frame(firmware, 0x201, ask) == []
    frame(firmware, 0x000, "0101")
    reply = frame(firmware, 0x201, ask)
    words = 9 + 4 + 8
    assert [each[0] for each in reply] == [0x181] * 8
    assert reply[0][1] == f"010009{words:02x}01000000"  # disarmed, no fault
    assert [each[1][:4] for each in reply] == [f"01{index:02x}" for index in range(8)]
    assert frame(firmware, 0x201, ask) == []  # the same once more
    assert len(frame(firmware, 0x201, ask.replace("0100", "0200", 1))) == 8
    assert frame(firmware, 0x202, "0300 0900 00000000") == []


def test_frames_come_in_any_order_and_broadcasts_have_no_reply(firmware: MovedFirmware) -> None:
    """An Arm under number 9 whose frames do not fit one; events have number 0."""
    frame(firmware, 0x000, "0100")
    first, second, status, *_ = frame(firmware, 0x201, "0900 0302 0900 F401")
    assert (first[1], second[1]) == ("00001e0404000000", "0001ff0000000000")
    assert status[1].startswith("090003")
    part = ["0A00 0506 0900 0100", "0A01 0200 0000 0000", "0A02 0000 0000 0000"]
    assert [frame(firmware, 0x201, each) for each in (part[2], part[1])] == [[], []]
    taken = frame(firmware, 0x201, part[0])
    assert [each[1] for each in taken] == ["0a00050301000600", "0a01000000000000"]
    assert frame(firmware, 0x200, "0000 0602 0900 0100") == []
    assert serial(firmware, request(GET_STATUS))[-1][5 + 14 : 5 + 16] == b"\1\0"  # the token
    stop = frame(firmware, 0x200, "0000 0801 0500 0000")
    assert [each[1][:8] for each in stop] == ["00001e04", "0001ff00"]  # the event of two frames


def test_frames_of_two_hosts_are_no_message(firmware: MovedFirmware) -> None:
    """Two frames of one number and place that differ: neither is obeyed."""
    frame(firmware, 0x000, "0100")
    assert frame(firmware, 0x201, "0501 0000 0000 0000") == []
    assert frame(firmware, 0x201, "0501 0100 0000 0000") == []
    assert frame(firmware, 0x201, "0500 0903 0000 0000") == []
    reply = frame(firmware, 0x201, "0600 0903 0000 0000")
    assert reply == []  # of three words, one frame is missing
    (first, *_) = frame(firmware, 0x201, "0601 0000 0000 0000")
    assert first[1] == "06001f0309000200"  # a status has no words


def test_objects_are_read_and_one_is_written(firmware: MovedFirmware) -> None:
    """Texts and versions, words of the capabilities, and the interval of the heartbeat."""
    assert frame(firmware, 0x601, "4000200500000000") == [(0x581, "4b00200508000000")]
    assert frame(firmware, 0x601, "4000200300000000") == [(0x581, "43002003" + NAME.hex())]
    assert frame(firmware, 0x601, "4001200100000000") == [(0x581, "4b01200104000000")]
    assert frame(firmware, 0x601, "4001200000000000") == [(0x581, f"4f012000{18 + 12:02x}000000")]
    assert frame(firmware, 0x601, "4000200100000000") == [(0x581, "410020010b000000")]
    assert frame(firmware, 0x601, "6000000000000000") == [(0x581, "00" + b"ERA hap".hex())]
    assert frame(firmware, 0x601, "7000000000000000") == [(0x581, "17" + b"tics\0\0\0".hex())]
    assert frame(firmware, 0x601, "2B01200109000000") == [(0x581, "8001200102000106")]
    assert frame(firmware, 0x601, "2B17100064000000") == [(0x581, "6017100000000000")]
    assert frame(firmware, 0x601, "4017100000000000") == [(0x581, "4b17100064000000")]
    firmware.move(0.05)
    beats = []
    for tenth in range(1, 6):
        firmware.move(0.05 + tenth / 10)
        beats += frame(firmware, 0x7FF, "00")
    assert beats == [(0x701, "7f")] * 5


def test_can_address_boots_the_node_again(firmware: MovedFirmware) -> None:
    """The reply has the old number; above 127 is refused."""
    frame(firmware, 0x000, "0100")
    frame(firmware, 0x201, "0101 2D57 3100 0000")
    assert frame(firmware, 0x201, "0100 0F04 8000 0400")[0][1].startswith("01001f03")
    frame(firmware, 0x201, "0201 5746 312D 0000")
    moved = frame(firmware, 0x201, "0200 0F04 0900 0400")
    assert moved[0] == (0x181, "02000f1501000000")
    assert moved[-1] == (0x709, "00")
    assert frame(firmware, 0x609, "4000200500000000") == [(0x589, "4b00200508000000")]
