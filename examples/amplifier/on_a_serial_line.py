"""The amplifier of `amplifier.py` on a serial line, following the wire protocol alone.

    python on_a_serial_line.py

The line is a pseudo-terminal; its URL is printed first.
"""

import contextlib
import os
import select
import struct
import tty
import zlib

import amplifier as parts
from amplifier import Amplifier, Refused

ADDRESS = 1
MAX_FRAME = 249  # bytes between two zeros
FEATURES = 0b111110  # watchdog, staging, valid_for, phase, broadcast; it sends no events
IDENTITY = ("Example", "Bench amplifier", "EX-1", "0.1")
HELLO, GET_CAPS, ARM, DISARM, STAGE, COMMIT, APPLY, STOP = range(1, 9)
GET_STATUS, GET_FAULTS, CLEAR, PING, LOAD_ENVELOPE, NAK = 9, 10, 11, 12, 13, 31
READ_ONLY = (GET_CAPS, GET_STATUS, GET_FAULTS)
NUMBERS = {ARM: "<HH", DISARM: "<H", COMMIT: "<HH", STOP: "<H", CLEAR: "<B", PING: "<H"}
UNKNOWN_TYPE, BAD_LENGTH, UNSUPPORTED_VERSION = 1, 2, 8
REPLY, NEUTRAL, VERSION = 0x80, 0, 2


def stuff(data):
    """Encode by COBS: before each piece between zeros its length plus one."""
    return b"".join(bytes([len(piece) + 1]) + piece for piece in data.split(b"\0"))


def unstuff(data):
    """Decode COBS; None for invalid data."""
    pieces = []
    while data:
        length, data = data[0], data[1:]
        if length == 0 or length - 1 > len(data):
            return None
        pieces.append(data[: length - 1])
        data = data[length - 1 :]
    return b"\0".join(pieces)


def framed(kind, version, address, sequence, payload):
    """Make a frame with its delimiters."""
    body = struct.pack("<BBBH", kind, version, address, sequence) + payload
    return b"\0" + stuff(body + struct.pack("<I", zlib.crc32(body))) + b"\0"


class SerialEnd:
    """The amplifier's end of the line: bytes in, bytes out."""

    def __init__(self):
        self.amplifier = Amplifier()
        self._waiting = b""

    def take(self, data):
        """Process received bytes and return the replies."""
        *frames, self._waiting = (self._waiting + data).split(b"\0")
        self._waiting = self._waiting[: MAX_FRAME + 1]  # the rest cannot be a frame
        return b"".join(self._frame(frame) for frame in frames if 0 < len(frame) <= MAX_FRAME)

    def _frame(self, stuffed):
        frame = unstuff(stuffed)
        if frame is None or len(frame) < 9:
            return b""
        body, (crc,) = frame[:-4], struct.unpack("<I", frame[-4:])
        kind, version, address, sequence = struct.unpack("<BBBH", body[:5])
        if crc != zlib.crc32(body) or kind & REPLY or address not in (0, ADDRESS):
            return b""
        payload = body[5:]
        if kind == HELLO and address:
            return framed(REPLY | HELLO, NEUTRAL, address, sequence, hello())
        if version != VERSION and address:
            refusal = bytes([kind, UNSUPPORTED_VERSION, 255])
            return framed(REPLY | NAK, NEUTRAL, address, sequence, refusal)
        if version != VERSION or (address == 0 and kind not in (COMMIT, STOP)):
            return b""
        self.amplifier.update()
        try:
            reply_kind, reply = REPLY | kind, self._answer(kind, payload)
        except Refused as refused:
            channel = 255 if refused.channel is None else refused.channel
            reply_kind, reply = REPLY | NAK, bytes([kind, refused.code, channel])
        return framed(reply_kind, VERSION, address, sequence, reply) if address else b""

    def _answer(self, kind, payload):
        """The payload of the reply; raises Refused."""
        if kind in READ_ONLY:
            return self._read(kind, payload)
        done = self._carry_out(kind, payload)
        return self._status() if done is None else achieved(*done)

    def _carry_out(self, kind, payload):
        """Carry out a request; return token and commands of one about sets."""
        a = self.amplifier
        if kind in (STAGE, APPLY):
            command_set = read_set(payload)
            return a.stage(*command_set) if kind == STAGE else a.apply(*command_set)
        if kind == LOAD_ENVELOPE:
            raise Refused(parts.BAD_VALUE)  # there are no slots
        if kind not in NUMBERS:
            raise Refused(UNKNOWN_TYPE)
        if len(payload) != struct.calcsize(NUMBERS[kind]):
            raise Refused(BAD_LENGTH)
        numbers = struct.unpack(NUMBERS[kind], payload)
        doing = {ARM: a.arm, DISARM: a.disarm, COMMIT: a.commit, STOP: a.stop, CLEAR: a.clear}
        return doing.get(kind, a.ping)(*numbers)

    def _read(self, kind, payload):
        a = self.amplifier
        if payload:
            raise Refused(BAD_LENGTH)
        if kind == GET_CAPS:
            steps = (1, 10000, 1, 1, parts.MAX_RAMP, *parts.WATCHDOG_RANGE)
            numbers = struct.pack("<B9H", parts.CHANNELS, *parts.FREQUENCY, *steps)
            no_envelopes, rest = bytes(6), struct.pack("<HB", FEATURES, parts.VOICES)
            each = struct.pack("<3H", *parts.FREQUENCY, 10000)
            return numbers + no_envelopes + rest + parts.CHANNELS * each
        if kind == GET_FAULTS:
            records = [struct.pack("<BBI", fault, 255, age) for fault, age in a.faults]
            return bytes([len(records)]) + b"".join(records)
        return self._status()

    def _status(self):
        a = self.amplifier
        a.update()
        head = struct.pack("<BBHB", a.state, a.fault, a.token, a.high_voltage)
        rest = struct.pack("<hHHBB", 250, a.watchdog_left, 0, a.latch, parts.CHANNELS)
        return head + rest + struct.pack(f"<{parts.CHANNELS}H", *a.levels)


def read_set(payload):
    """Session, token, ramp, valid_for and commands of a set; raises Refused."""
    if len(payload) < 9:
        raise Refused(BAD_LENGTH)
    *head, count = struct.unpack("<HHHHB", payload[:9])
    commands, payload = [], payload[9:]
    for _ in range(count):
        if len(payload) < 8:
            raise Refused(BAD_LENGTH)
        channel, flags, frequency, level, phase = struct.unpack("<BBHHh", payload[:8])
        payload = payload[8:]
        if flags & ~0b111:
            raise Refused(parts.BAD_VALUE, channel)
        if flags & 0b100:  # onset and ending follow
            if len(payload) < 2:
                raise Refused(BAD_LENGTH)
            if any(payload[:2]):
                raise Refused(parts.NO_ENVELOPE, channel)
            payload = payload[2:]
        commands.append((channel, flags & 0b011, frequency, level, phase))
    if payload:
        raise Refused(BAD_LENGTH)
    return *head, commands


def hello():
    """The payload of a reply to Hello, in any version: a bit for each version, and the texts."""
    texts = (text.encode() for text in IDENTITY)
    packed = (bytes([len(text)]) + text for text in texts)
    return struct.pack("<H", 1 << VERSION) + b"".join(packed)


def achieved(token, commands):
    """Its payload: this amplifier plays every step of the wire."""
    packed = (struct.pack("<BBHHh", *command) for command in commands)
    return struct.pack("<HB", token, len(commands)) + b"".join(packed)


def main():
    """Serve until it is ended."""
    line, host_side = os.openpty()
    tty.setraw(line)
    print(f"serial://{os.ttyname(host_side)}", flush=True)
    end = SerialEnd()
    while True:
        ready, _, _ = select.select([line], [], [], 0.005)
        if ready:
            os.write(line, end.take(os.read(line, 4096)))
        end.amplifier.update()


if __name__ == "__main__":
    with contextlib.suppress(KeyboardInterrupt):  # Ctrl-C
        main()
