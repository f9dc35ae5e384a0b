"""A CAN amplifier built independently, from docs/reference/wire-can.md, the sections of
docs/reference/wire-protocol.md that it names, and from nothing else of this project.

Four channels, classic frames, no envelopes, no faults but the watchdog's.
"""

import math
import struct
from collections.abc import Callable

NODE = 1
BOOT_UP, STOPPED, OPERATIONAL, PRE_OPERATIONAL = 0, 4, 5, 127
STATUS, APPLY, STAGE, COMMIT, ARM, DISARM, STOP, CLEAR = range(8)
DISARMED, SWITCHED_ON, ARMED, STOPPED_QUICKLY, REACTING, FAULTY = 1, 3, 4, 5, 6, 7
DONE, BAD_VALUE, BAD_CHANNEL, WRONG_STATE, BAD_TOKEN, NO_ENVELOPE = 0, 3, 4, 5, 6, 9
WRONG_SESSION, WRONG_LATCH, FADING = 10, 11, 12
INCOMPLETE_SET = 15
NO_CHANNEL = 255
CHANNELS = 4
LOWEST, HIGHEST = 400, 12000  # 0.05 Hz
HEARTBEAT, WATCHDOG_FADE, COLLECTING = 0.05, 0.005, 0.1  # s

VERSIONS = 1 << 2
TEXTS = {1: "Elsewhere Ltd", 2: "From the page", 3: "EL-0042", 4: "0.1"}
FEATURES = 0b111111  # events, watchdog, staging, valid_for, phase, broadcast
CAPABILITIES = "BHHHHHHHHHBBHHHB"
LIMITS = (CHANNELS, LOWEST, HIGHEST, 1, 10000, 1, 1, 1000, 100, 2000, 0, 0, 0, 0, FEATURES, 2)
CHANNEL_LIMITS = {0x2009: LOWEST, 0x200A: HIGHEST, 0x200B: 10000}


def bits(data: bytes, first: int, count: int) -> int:
    """A field of a frame."""
    return int.from_bytes(data, "little") >> first & (1 << count) - 1


def frame(*fields: tuple[int, int, int]) -> bytes:
    """Eight bytes of fields: value, first bit, number of bits."""
    whole = sum((value & (1 << count) - 1) << first for value, first, count in fields)
    return whole.to_bytes(8, "little")


def _achieved(token: int, commands: dict[int, bytes]) -> bytes:
    """Pack object 2006 of a set, which plays as requested."""
    rows = [data[:7] + b"\0\0\0" for _, data in sorted(commands.items())]
    return struct.pack("<HB", token, len(rows)) + b"".join(rows)


class Channel:
    """An output, whose level changes along a raised cosine."""

    def __init__(self) -> None:
        self.now, self.goal, self.begin, self.ramp = 0, 0, 0.0, 0.0
        self.voices: list[float] = []  # when each has ended

    def level(self, time: float) -> int:
        s = min((time - self.begin) / self.ramp, 1.0) if self.ramp > 0 else 1.0
        gain = (1 - math.cos(math.pi * s)) / 2
        return round(self.now + (self.goal - self.now) * gain)

    def go(self, goal: int, ramp: float, time: float) -> None:
        is_silent_sooner = not self.goal and not goal and self.begin + self.ramp <= time + ramp
        if not is_silent_sooner:
            self.now, self.goal, self.begin, self.ramp = self.level(time), goal, time, ramp
        self.voices = [*self.fading(ramp, time), *([math.inf] if goal else [])]

    def fading(self, ramp: float, time: float) -> list[float]:
        """When the voices end that a set leaves to fade."""
        return [min(end, time + ramp) for end in self.voices if min(end, time + ramp) > time]


class VendorAmplifier:
    """The amplifier, between frames that arrive and those that it sends."""

    def __init__(self, send: Callable[[int, bytes], None], clock: Callable[[], float]) -> None:
        self._send, self._clock = send, clock
        self._beat_due = 0.0
        self.nmt = PRE_OPERATIONAL
        self.state, self.fault, self.latch = DISARMED, 0, 0
        self.faults: list[tuple[int, float]] = []
        self.channels = [Channel() for _ in range(CHANNELS)]
        self._forget()
        self.host, self.watchdog, self.fed = 0, 0.0, 0.0
        self._begin_set(0, 0.0)
        self.ends_at, self.end_ramp = math.inf, 0.0
        self.upload = b""
        self.achieved = b""
        self.exact = True
        self.period = HEARTBEAT

    def boot(self) -> None:
        """Say that it is there."""
        self._send(0x700 + NODE, bytes([BOOT_UP]))

    def _forget(self) -> None:
        self.staged: tuple[int, dict[int, bytes], int, int] | None = None
        self.staged_until = -math.inf
        self.token = 0
        self.played: tuple[bytes, int, int] | None = None

    # Frames received

    def take(self, identifier: int, data: bytes) -> None:
        """Take a frame."""
        now = self._clock()
        if identifier == 0x000 and len(data) == 2 and data[1] in (0, NODE):
            self._manage(data[0], now)
        elif identifier == 0x600 + NODE and len(data) == 8:
            if data[0] >> 5 != 4:  # an abort has no answer
                self._send(0x580 + NODE, self._sdo(data, now))
        elif self.host and identifier == 0x700 + self.host and len(data) == 1:
            self.fed = now
        elif self.nmt != OPERATIONAL:
            return
        elif identifier in (0x200 + NODE, 0x300 + NODE, 0x400 + NODE, 0x500 + NODE):
            if len(data) == 8 and self._belongs(bits(data, 56, 8), now):
                self.commands[(identifier - 0x200) >> 8] = data
                self._check_set(now)
        elif identifier == 0x680 + NODE and len(data) == 8:
            if self._belongs(bits(data, 56, 8), now):
                self.has_slots = True
                self._check_set(now)
        elif identifier == 0x480 + NODE and len(data) == 8:
            self._ordered(data, now)
        elif identifier == 0x480 and len(data) == 8:
            if data[7] == 0 and bits(data, 48, 3) == STOP:
                self._stop(bits(data, 16, 16), now)
            elif data[7] == 0 and bits(data, 48, 3) == COMMIT:
                is_done = self._set(data, now) == (DONE, NO_CHANNEL)
                self.fed = now if is_done else self.fed

    def _manage(self, command: int, now: float) -> None:
        if command == 129:
            self._reset()
            self.boot()
            return
        self.nmt = {1: OPERATIONAL, 2: STOPPED}.get(command, PRE_OPERATIONAL)
        if self.nmt != OPERATIONAL and self.state == ARMED:
            self._stop(5, now)

    def _reset(self) -> None:
        self.nmt, self.state, self.fault = PRE_OPERATIONAL, DISARMED, 0
        self.channels = [Channel() for _ in range(CHANNELS)]
        self.host = 0
        self._forget()

    def _ordered(self, order: bytes, now: float) -> None:
        action, sequence = bits(order, 48, 3), bits(order, 56, 8)
        if sequence == 0:
            return
        if action in (APPLY, STAGE):
            if self._belongs(sequence, now):
                self.order = order
                self._check_set(now)
            return
        if self.collected and 1 <= (sequence - self.collected) % 255 <= 127:
            self._begin_set(0, now)
        if action == COMMIT:
            self._carry_out(order, now)
            return
        result = DONE
        ramp, span = bits(order, 16, 16), bits(order, 32, 16)
        if action == ARM:
            host = bits(order, 0, 16)
            if self.state not in (DISARMED, SWITCHED_ON, ARMED):
                result = WRONG_STATE
            elif not 100 <= span <= 2000 or not 1 <= host <= 127:
                result = BAD_VALUE
            elif self.state == ARMED and host != self.host:
                result = WRONG_SESSION
            else:
                if self.state != ARMED:
                    self._silence(0.005, now)
                    self._forget()
                self.host, self.watchdog, self.fed = host, span / 1000, now
                self._become(ARMED)
        elif action == DISARM:
            self._silence(min(ramp, 1000) / 1000, now)
            self.staged = None
            if self.state == ARMED:
                self._become(SWITCHED_ON)
        elif action == STOP:
            self._stop(ramp, now)
        elif action == CLEAR and self.state in (STOPPED_QUICKLY, FAULTY):
            if bits(order, 0, 16) != self.latch:
                result = WRONG_LATCH
            elif self._is_silent(now):
                was_fault, self.fault = self.state == FAULTY, 0
                self._become(DISARMED, tells_fault=was_fault)
        if result == DONE:
            self._tell_condition(sequence, now)
        self._answer(sequence, action, result, now)

    def _begin_set(self, sequence: int, now: float) -> None:
        """Discard what was collected; 0: collect nothing."""
        self.collected, self.collected_since = sequence, now
        self.commands: dict[int, bytes] = {}
        self.has_slots = False  # of its only group
        self.order: bytes | None = None

    def _belongs(self, sequence: int, now: float) -> bool:
        """Whether a frame belongs to the set that is collected, or begins one."""
        if sequence == 0:
            return False
        if not self.collected or 1 <= (sequence - self.collected) % 255 <= 127:
            self._begin_set(sequence, now)
        return sequence == self.collected

    def _check_set(self, now: float) -> None:
        """Carry out the set as soon as it is complete."""
        if self.order is None or len(self.commands) != bits(self.order, 51, 5):
            return
        if self.has_slots or not any(bits(data, 50, 1) for data in self.commands.values()):
            self._carry_out(self.order, now)
            self._begin_set(0, now)

    def _carry_out(self, order: bytes, now: float) -> None:
        action, sequence = bits(order, 48, 3), bits(order, 56, 8)
        result, channel = self._set(order, now)
        if result == DONE:
            self.fed = now
        self._answer(sequence, action, result, now, channel=channel)

    def _set(self, order: bytes, now: float) -> tuple[int, int]:
        """Carry out a complete set or a commit; its result, and the channel at fault."""
        action, token, mine = bits(order, 48, 3), bits(order, 0, 16), self.commands
        if self.state != ARMED:
            return WRONG_STATE, NO_CHANNEL
        if token == 0:
            return BAD_TOKEN, NO_CHANNEL
        ramp, span = bits(order, 16, 16), bits(order, 32, 16)
        if action != STAGE and token == self.token:
            if action == APPLY and self.played != (_achieved(token, mine), ramp, span):
                return BAD_TOKEN, NO_CHANNEL
            self.achieved, self.exact = self.played[0], True
            return DONE, NO_CHANNEL
        if self.token and not 1 <= (token - self.token) % 65536 <= 32767:
            return BAD_TOKEN, NO_CHANNEL
        if action == COMMIT:
            if self.staged is None or self.staged[0] != token or now > self.staged_until:
                return BAD_TOKEN, NO_CHANNEL
            full = self._without_room(self.staged[1], self.staged[2], now)
            if full is not None:
                return FADING, full
            self.achieved, self.exact = _achieved(token, self.staged[1]), True
            self._play(now)
            return DONE, NO_CHANNEL
        for place, data in mine.items():
            if bits(data, 52, 4) != place:
                return BAD_CHANNEL, bits(data, 52, 4)
            frequency, level = bits(data, 0, 16), bits(data, 16, 16)
            phase = bits(data, 32, 16)
            is_phase = phase < 18000 or phase >= 0x10000 - 18000
            if level > 10000 or not is_phase or bits(data, 51, 1):
                return BAD_VALUE, place
            if level and not LOWEST <= frequency <= HIGHEST:
                return BAD_VALUE, place
            if bits(data, 50, 1):
                return NO_ENVELOPE, place  # no envelope is ever loaded here
        if ramp > 1000 or span > 60000:
            return BAD_VALUE, NO_CHANNEL
        full = self._without_room(mine, ramp, now) if action == APPLY else None
        if full is not None:
            return FADING, full
        self.staged, self.staged_until = (token, mine, ramp, span), now + 1.0
        self.achieved, self.exact = _achieved(token, mine), True
        if action == APPLY:
            self._play(now)
        return DONE, NO_CHANNEL

    def _without_room(self, commands: dict[int, bytes], ramp: int, now: float) -> int | None:
        """A channel on which a set would be a third voice."""
        for number, data in commands.items():
            if bits(data, 16, 16) and len(self.channels[number].fading(ramp / 1000, now)) > 1:
                return number
        return None

    def _play(self, now: float) -> None:
        assert self.staged is not None
        self.token, commands, ramp, span = self.staged
        self.staged = None
        self.played = self.achieved, ramp, span
        for number, channel in enumerate(self.channels):
            data = commands.get(number)
            channel.go(bits(data, 16, 16) if data else 0, ramp / 1000, now)
        self.ends_at = now + span / 1000 if span else math.inf
        self.end_ramp = ramp / 1000

    # Changes by itself

    def tick(self) -> None:
        """Do what is due."""
        now = self._clock()
        if self.period and now >= self._beat_due:
            self._beat_due = now + self.period
            self._send(0x700 + NODE, bytes([self.nmt]))
        if now >= self.ends_at:
            self._silence(self.end_ramp, now)
        if self.collected and now - self.collected_since >= COLLECTING:
            order = self.order
            self._begin_set(0, now)
            if order is not None:
                action, sequence = bits(order, 48, 3), bits(order, 56, 8)
                self._answer(sequence, action, INCOMPLETE_SET, now)
        if self.state == ARMED and now - self.fed > self.watchdog:
            self._silence(WATCHDOG_FADE, now)
            self.staged = None
            self.fault = 1
            self.latch = self.latch % 255 + 1
            self.faults.insert(0, (1, now))
            self._become(REACTING, tells_fault=True)
        if self.state == REACTING and self._is_silent(now):
            self._become(FAULTY, tells_fault=True)
        if self.state == SWITCHED_ON and self._is_silent(now):
            self._become(DISARMED)

    def _stop(self, ramp: int, now: float) -> None:
        self._silence(min(ramp, 1000) / 1000, now)
        self.staged = None
        self.latch = self.latch % 255 + 1
        if self.state in (DISARMED, SWITCHED_ON, ARMED):
            self._become(STOPPED_QUICKLY)

    def _silence(self, ramp: float, now: float) -> None:
        self.ends_at = math.inf
        for channel in self.channels:
            channel.go(0, ramp, now)

    def _is_silent(self, now: float) -> bool:
        return not any(channel.level(now) for channel in self.channels)

    # Frames sent

    def _become(self, state: int, *, tells_fault: bool = False) -> None:
        if state == self.state:
            return
        self.state = state
        if tells_fault:
            code, register = (0x8130, 0x11) if self.fault else (0, 0)
            self._send(
                0x080 + NODE,
                frame(
                    *((code, 0, 16), (register, 16, 8), (state, 24, 4), (self.fault, 28, 4)),
                    (NO_CHANNEL, 32, 8),
                ),
            )
        else:
            self._send(0x180 + NODE, frame((state, 16, 4), (self.fault, 20, 4), (255, 24, 8)))

    def _tell_condition(self, sequence: int, now: float) -> None:
        levels = [(one.level(now), 14 * place, 14) for place, one in enumerate(self.channels)]
        self._send(0x380 + NODE, frame(*levels, (sequence, 56, 8)))
        is_on = self.state in (SWITCHED_ON, ARMED) or not self._is_silent(now)
        self._send(
            0x280 + NODE,
            frame(
                *((sequence, 0, 8), (is_on, 8, 1), (250, 16, 16), (CHANNELS, 48, 5)),
                (self.latch, 56, 8),
            ),
        )

    def _answer(
        self, sequence: int, action: int, result: int, now: float, *, channel: int = NO_CHANNEL
    ) -> None:
        is_exact = result == DONE and action in (APPLY, STAGE, COMMIT) and self.exact
        left = 0.0
        if self.state == ARMED:
            left = max(0.0, self.watchdog - (now - self.fed))
        self._send(
            0x180 + NODE,
            frame(
                *((sequence, 0, 8), (action, 8, 3), (is_exact, 11, 1)),
                *((result, 12, 4), (self.state, 16, 4), (self.fault, 20, 4), (channel, 24, 8)),
                *((self.token, 32, 16), (round(left * 1000), 48, 16)),
            ),
        )

    # Objects (CiA 301): expedited and segmented uploads, expedited downloads

    def _sdo(self, data: bytes, now: float) -> bytes:
        command, place = data[0] >> 5, data[1:4]
        index, subindex = struct.unpack("<HB", place)
        if command == 2:
            value = self._object(index, subindex, now)
            if value is None:
                return struct.pack("<B3sL", 0x80, place, 0x06020000)
            if 1 <= len(value) <= 4:
                return bytes([0x43 | (4 - len(value)) << 2]) + place + value.ljust(4, b"\0")
            self.upload = value
            return struct.pack("<B3sL", 0x41, place, len(value))
        if command == 3:
            piece, self.upload = self.upload[:7], self.upload[7:]
            head = data[0] & 0x10 | (7 - len(piece)) << 1 | (not self.upload)
            return bytes([head]) + piece.ljust(7, b"\0")
        if command == 1 and (index, subindex) == (0x1017, 0):
            self.period = struct.unpack("<H", data[4:6])[0] / 1000
            return struct.pack("<B3sL", 0x60, place, 0)
        return struct.pack("<B3sL", 0x80, place, 0x06020000)

    def _object(self, index: int, subindex: int, now: float) -> bytes | None:
        match index, subindex:
            case 0x1001, 0:
                return bytes([0x11 if self.fault else 0])
            case 0x1017, 0:
                return struct.pack("<H", round(self.period * 1000))
            case 0x1018, 4:
                return struct.pack("<L", 42)
            case 0x2000, number if number in TEXTS:
                return TEXTS[number].encode()
            case 0x2000, 5:
                return struct.pack("<H", VERSIONS)
            case 0x2001, number if 1 <= number <= 16:
                return struct.pack("<" + CAPABILITIES[number - 1], LIMITS[number - 1])
            case limit, channel if limit in CHANNEL_LIMITS and 1 <= channel <= CHANNELS:
                return struct.pack("<H", CHANNEL_LIMITS[limit])
            case 0x2006, 0:
                return self.achieved
            case 0x2008, 0:
                return b"".join(
                    struct.pack("<BBL", fault, NO_CHANNEL, round((now - when) * 1000))
                    for fault, when in self.faults
                )
        return None
