"""Amplifiers and lines that report anything: replies are refused or counted, stops stay truthful.

In virtual time with the whole host. Replies are altered in one word, or in their bytes.
"""

import asyncio
import contextlib
import random
from collections.abc import Callable

import pytest

from drivers.errors import DriverError, LinkDegraded
from drivers.protocol.definition import MESSAGES
from drivers.protocol.records import Values
from drivers.wires.can_frames import CanFrame, pack_frames
from drivers.wires.serial_frames import Frame, encode_frame
from kit.clock import KINDS, MemoryLine, run_virtual, unaltered
from tests.drivers.host.group_on_lines import SILENT, Rig, connect, on_wires

CAPABILITIES = [
    ("channels", 255),
    ("channels", 0),
    ("layers", 0),
    ("voices", 0),
    ("set_words", 0),
    ("knots", 255),
    ("frequency_step", 0),
    ("level_step", 0),
    ("level_step", 10001),
    ("phase_step", 0),
    ("ramp_max", 65535),
    ("watchdog_min", 2001),
    ("watchdog_max", 65535),
    ("level_max", 0),
    ("level_max", 65535),
    ("frequency_min", 65535),
    ("envelope_step_max", 5),
    ("limits", 30000),
]
"""Words of capabilities, and impossible values of them."""

STATUS = {
    "state": ("state", 255),
    "latch": ("latch", 0),
    "latch jumps": ("latch", 77),
    "watchdog_left": ("watchdog_left", 65535),
    "temperature": ("temperature", 32767),
    "channels": ("channels", 200 << 8 | 8),
    "no channels": ("channels", 8),
    "layers": ("layers", 2 << 8 | 7),
    "levels": ("levels", 65535),
    "fault": ("fault", 2),
    "interlock": ("flags", 0b11),
}
"""Words of a status, and values of them that end what is played."""


def alter(patch: pytest.MonkeyPatch, message: str, field: str, value: int) -> None:
    """Have all replies to a message report a value in a word, or in the first of a list."""
    record = MESSAGES[message].reply
    pack = record.pack
    index = record.places.get(field, record.words)

    def pack_altered(values: Values) -> list[int]:
        words = list(pack(values))
        if index < len(words):
            words[index] = value
        return words

    patch.setattr(record, "pack", pack_altered)


async def check_stop(rig: Rig) -> None:
    """Stop: the amplifier is silent if that is confirmed, otherwise from the stated time on."""
    outcome = (await rig.group.stop())["a"]
    if not outcome.is_confirmed:
        assert outcome.cause
        await asyncio.sleep(max(outcome.may_play_until - rig.line.loop.time(), 0.0))
    assert rig.levels == {"a": SILENT}


@pytest.mark.parametrize(("field", "value"), CAPABILITIES)
@on_wires("serial", "can")
async def test_amplifier_with_impossible_capabilities_is_not_opened(
    wire: str, field: str, value: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Only questions are sent to it, and the error names the word."""
    alter(monkeypatch, "GetCaps", field, value)
    line = MemoryLine(wire, "a")

    with pytest.raises(DriverError, match=r"must|too short|limits"):
        await line.hosts["a"].open()

    assert {request for _, request in line.sent} <= {"1:1", "1:2"}


@pytest.mark.parametrize("case", STATUS)
@on_wires()
async def test_impossible_status_ends_in_silence(
    wire: str, case: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two heartbeats find it at the latest; a stop that cannot be read is not confirmed."""
    rig = await connect("a", wire=wire)
    await rig.play(0.5)
    await asyncio.sleep(0.01)
    alter(monkeypatch, "GetStatus", *STATUS[case])
    if case != "latch":
        with contextlib.suppress(DriverError):
            await rig.group.beat()
        await asyncio.sleep(0.03)
        with pytest.raises(DriverError):
            await rig.group.beat()
        assert not rig.group.is_armed

    confirmed = await rig.stop()

    has_levels_and_latch = case in ("layers", "fault", "interlock")
    assert confirmed == {"a": has_levels_and_latch}
    await check_stop(rig)


FRAME_LENGTH = len(pack_frames([CanFrame(0, b"")]))
"""Bytes of a CAN frame with its head."""


class LyingLine:
    """Alters the replies of a line; each method is a way to do so."""

    def __init__(self, wire: str) -> None:
        self.wire = wire
        self.replies: list[bytes] = []
        self.chance = random.Random(4)

    def late(self, reply: bytes) -> list[tuple[float, bytes]]:
        """Deliver it after 40 ms."""
        return [(0.04, reply)]

    def byte_by_byte(self, reply: bytes) -> list[tuple[float, bytes]]:
        """Deliver single bytes, or CAN frames, 20 us apart."""
        step = FRAME_LENGTH if self.wire == "can" else 1
        pieces = []
        for start in range(0, len(reply), step):
            delay = 0.0002 + 2e-5 * len(pieces)
            pieces.append((delay, reply[start : start + step]))
        return pieces

    def with_old_replies(self, reply: bytes) -> list[tuple[float, bytes]]:
        """Deliver copies of up to 19 earlier replies first."""
        copies = b"".join(self.replies[-20:-1])
        return [(0.0002, copies), (0.0003, reply)]

    def doubled(self, reply: bytes) -> list[tuple[float, bytes]]:
        """Deliver it twice."""
        return [(0.0002, reply), (0.0003, reply)]

    def damaged(self, reply: bytes) -> list[tuple[float, bytes]]:
        """Flip a bit of every second reply."""
        if len(self.replies) % 2:
            reply = reply[:-2] + bytes([reply[-2] ^ 64, reply[-1]])
        return [(0.0002, reply)]

    def cut(self, reply: bytes) -> list[tuple[float, bytes]]:
        """Deliver two thirds of every second reply, in whole frames on CAN."""
        if len(self.replies) % 2:
            frames = len(reply) * 2 // 3 // FRAME_LENGTH
            reply = reply[: frames * FRAME_LENGTH]
        return [(0.0002, reply)]

    def after_noise(self, reply: bytes) -> list[tuple[float, bytes]]:
        """Deliver random bytes first, or frames of other devices on CAN."""
        noise = self.chance.randbytes(40)
        if self.wire == "can":
            identifier = self.chance.randrange(0x300, 0x500)
            noise = pack_frames([CanFrame(identifier, self.chance.randbytes(8))] * 20)
        return [(0.0001, noise), (0.0002, reply)]

    def after_endless_bytes(self, reply: bytes) -> list[tuple[float, bytes]]:
        """Deliver 4000 bytes without the end of a frame first."""
        noise = b"" if self.wire == "can" else b"\x01" * 4000
        return [(0.0001, noise), (0.0002, reply)]

    def after_events(self, reply: bytes) -> list[tuple[float, bytes]]:
        """Deliver fifty whole events of the amplifier first, if the wire has some."""
        words = bytes.fromhex("05 00 00 00 ff 00 00 00")
        first = CanFrame(0x181, bytes.fromhex("00 00 1e 04") + words[:4])
        second = CanFrame(0x181, bytes.fromhex("00 01") + words[4:] + bytes(2))
        events = {
            "can": pack_frames([first, second] * 50),
            "serial": encode_frame(Frame(30, 1, 0, words, 3)) * 50,
        }
        return [(0.0001, events.get(self.wire, b"")), (0.0002, reply)]

    def half_open(self, _: bytes) -> list[tuple[float, bytes]]:
        """Deliver nothing."""
        return []


WAYS = [name for name in vars(LyingLine) if not name.startswith("_")]
UNCOUNTED = {
    ("tcp", "after_events"),
    ("rtu", "after_events"),
    ("can", "after_noise"),
    ("can", "after_endless_bytes"),
}
"""Alterations without bytes that the host must count."""


@pytest.mark.parametrize(
    ("wire", "way"),
    [
        (wire, way)
        for wire in KINDS
        for way in WAYS
        if (wire, way) != ("tcp", "damaged")  # TCP itself detects damage
    ],
)
def test_lying_line_is_counted_and_has_no_other_effect(wire: str, way: str) -> None:
    """Sets and heartbeats succeed or stop it; the stop is truthful; afterwards all is as before."""
    run_virtual(lie(wire, way))


async def lie(wire: str, way: str) -> None:
    """Play three sets over a lying line, stop, and play another set once it is truthful."""
    rig = await connect("a", wire=wire)
    await rig.play(0.5)
    liar = LyingLine(wire)
    alter_reply: Callable[[bytes], list[tuple[float, bytes]]] = getattr(liar, way)

    def outward(_: str, data: bytes) -> list[tuple[float, bytes]]:
        liar.replies.append(data)
        return alter_reply(data)

    rig.line.outward = outward
    has_failed = False
    try:
        for level in (0.4, 0.3, 0.2):
            await rig.play(level)
            await asyncio.sleep(0.02)
            assert rig.levels == {"a": [level, 0.0]}
            await rig.group.beat()
    except LinkDegraded:
        pass  # armed, but nothing new is played until it replies
    except DriverError:
        has_failed = True
    assert rig.group.is_armed is not has_failed
    await check_stop(rig)

    rig.line.outward = unaltered
    await asyncio.sleep(0.3)
    await rig.group.open()
    await rig.group.clear()
    await rig.group.arm()
    await rig.play(0.5)
    assert await rig.stop() == {"a": True}
    if way not in ("byte_by_byte", "half_open", "cut", "late") and (wire, way) not in UNCOUNTED:
        counters = rig.line.line.wire.counters
        assert counters.invalid_frames + counters.unexpected_frames + counters.events > 0
