"""TUIO 1.1 cursors and blobs over UDP, and recorded streams of them.

Also datagrams that come too many or while the loop is busy, and none from a finger that rests.
"""

import asyncio
import math
import os
import socket
import struct
import sys
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping, Sequence
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pythonosc.osc_message_builder import OscMessageBuilder

from controller.sources.contact_tracker import ContactTracker
from controller.sources.touch import Touch, TouchFrame
from controller.sources.tuio import TuioSource
from controller.sources.tuio_capture import HEADER, MAX_BYTES, RecordedDatagram, read_capture
from controller.sources.udp_source import BACKLOG_THRESHOLD, Datagram, Datagrams, Peer, listen
from examples.make_touches import tuio_datagram, write_capture
from kit.clock import in_virtual_time
from kit.fingers import bundle, cursor, frame, free_port, message
from kit.plates import make_paper_rig
from model.errors import InputError

PEER = ("192.0.2.7", 50000)


@pytest.fixture
def reader() -> TuioSource:
    """A source that is read without a port."""
    return TuioSource("tuio:")


def touches(frame: TouchFrame | None) -> list[tuple[float, ...]]:
    """What is on the plate, to compare; of a blob with its width and height."""
    return [(touch.id, touch.x, touch.y, *(touch.size or ())) for touch in frame.touches]


def test_reader_reads_a_golden_bundle(reader: TuioSource) -> None:
    """The bytes of a bundle, written out from the OSC 1.0 and TUIO 1.1 specifications, are read."""

    def element(raw: bytes) -> bytes:
        return struct.pack(">i", len(raw)) + raw

    golden = (
        b"#bundle\0"
        + b"\0\0\0\0\0\0\0\1"
        + element(b"/tuio/2Dcur\0,si\0alive\0\0\0" + b"\0\0\0\x2a")
        + element(
            b"/tuio/2Dcur\0,sifffff\0\0\0\0set\0\0\0\0\x2a"
            b"\x3f\x00\x00\x00\x3e\x80\x00\x00" + bytes(12)
        )
        + element(b"/tuio/2Dcur\0,si\0fseq\0\0\0\0\0\0\0\1")
    )
    result = reader.read(golden, PEER, 5.0)
    sender = "tuio:192.0.2.7:50000"
    assert result == TouchFrame(sender, 5.0, (Touch(42, 0.5, 0.25),), 3.0, sender)


def of(*parts: object, source: str = "table@a") -> bytes:
    """A bundle of a source with these messages."""
    return bundle(message("source", source), *parts)


def still(*alive: int, fseq: int) -> bytes:
    """A bundle in which these cursors are alive, and none is set."""
    return of(message("alive", *alive), message("fseq", fseq))


OTHER = ("127.0.0.1", 50001)
HALF = [(1, 0.5, 0.5)]
QUARTER = [(1, 0.25, 0.5)]
NAMES = [(0.1, PEER, frame(source=f"s{number}"), ...) for number in range(16)]
OTHERS = [(0.1, OTHER, frame(source=f"o{number}"), []) for number in range(8)]

HERE = cursor(1, 0.5, 0.5)
OBJECT = message("set", 3, 1, 0.5, 0.5, 0.1, address="/tuio/2Dobj")
POINTER = message(1, 0, 0, 0.5, 0.5, 0.0, 0.0, 0.0, address="/tuio2/ptr")
NO_OBJECTS = [message(*part, address="/tuio/2Dobj") for part in (["alive"], ["fseq", 7])]

BLOB, PALM, TIP = "/tuio/2Dblb", (0.25, 0.5), (0.03125, 0.0625)  # an address, and sizes


def blobs(*each: tuple[int, float, float, float, float], fseq: int = -1) -> bytes:
    """A complete bundle of blobs: session id, place, width and height; the angle is left at 1."""
    parts = [
        ("source", "table@a"),
        ("alive", *[one[0] for one in each]),
        *[("set", id, x, y, 1.0, w, h, w * h, *[0.0] * 5) for id, x, y, w, h in each],
        ("fseq", fseq),
    ]
    return bundle(*[message(*part, address=BLOB) for part in parts])


Read = tuple[float, tuple[str, int], bytes, Any]
"""Time [s], peer, datagram, and the touches that are read: None for no frame, ... for anything."""

COURSES: Mapping[str, tuple[dict[str, Any], Sequence[Read]]] = {
    # One that is alive but not set again stays where it was; one not alive is gone.
    "unchanged cursors": (
        {},
        [
            (0, PEER, frame((1, 0.25, 0.5), (2, 0.75, 0.5), fseq=1), ...),
            (
                0.01,
                PEER,
                of(message("alive", 1, 2), cursor(2, 0.5, 0.5), message("fseq", 2)),
                [*QUARTER, (2, 0.5, 0.5)],
            ),
            (0.02, PEER, still(2, fseq=3), [(2, 0.5, 0.5)]),
            (0.03, PEER, still(fseq=4), []),
        ],
    ),
    # A reordered frame changes nothing, neither positions nor what is alive. A redundant one (-1)
    # is never late, and does not make the next one late.
    "late frames": (
        {"late": 1},
        [
            (0, PEER, frame((1, 0.25, 0.5), fseq=10), ...),
            (0.01, PEER, frame((1, 0.75, 0.5), (2, 0.5, 0.5), fseq=9), None),
            (0.02, PEER, still(1, fseq=11), QUARTER),
            (0.03, PEER, frame(*HALF, fseq=-1), HALF),
            (0.04, PEER, frame((1, 0.75, 0.5), fseq=12), [(1, 0.75, 0.5)]),
        ],
    ),
    # Counting from 1 again is a restart after a fall by over 100 or after a pause; all is new.
    "restart by the number": (
        {},
        [
            (0, PEER, frame((1, 0.25, 0.5), fseq=5000), ...),
            (0.001, PEER, still(1, fseq=1), []),
            (0.001, PEER, frame(*HALF, fseq=2), HALF),
        ],
    ),
    "restart after a pause": (
        {},
        [
            (0, PEER, frame((1, 0.25, 0.5), fseq=50), ...),
            (0.6, PEER, still(1, fseq=1), []),
            (0.6, PEER, frame(*HALF, fseq=2), HALF),
        ],
    ),
    # They may use the same ids and numbers, behind one address or behind two.
    "senders are kept apart": (
        {},
        [
            (0, PEER, frame((1, 0.25, 0.5), fseq=100, source="a"), QUARTER),
            (0, PEER, frame(*HALF, fseq=100, source="b"), HALF),
            (0, OTHER, frame(fseq=100, source="a"), []),
            (0, PEER, frame((1, 0.75, 0.5), fseq=99, source="c"), [(1, 0.75, 0.5)]),
            (0, PEER, of(message("alive", 1), message("fseq", 101), source="a"), QUARTER),
            (0, PEER, of(message("alive", 1), message("fseq", 101), source="b"), HALF),
        ],
    ),
    # The seventeenth sender is refused and counted until one has been quiet for a while.
    "senders are bounded": (
        {"too_many_senders": 1},
        [
            *((number / 100, PEER, frame(source=f"s{number}"), []) for number in range(16)),
            (0.2, PEER, frame(source="s16"), None),
            (0.51, PEER, frame(source="s16"), []),
        ],
    ),
    # Sixteen names that are never quiet keep no other peer out; both have eight in the end.
    "a peer with all names gives way": (
        {"too_many_senders": ...},
        [*[*NAMES, *OTHERS] * 3, (0.1, OTHER, frame(source="o8"), None)],
    ),
    # Not a number and off the sensor are the tracker's to judge, which counts them.
    "positions are passed unchecked": (
        {},
        [
            (
                0,
                PEER,
                frame((1, math.nan, 0.5), (2, 1.5, -3.0)),
                [(1, pytest.approx(math.nan, nan_ok=True), 0.5), (2, 1.5, -3.0)],
            )
        ],
    ),
    # A table without objects says so in every frame; one with some, and other protocols, count.
    "other profiles": (
        {"profile_2Dobj": 2, "profile_25Dcur": 1, "profile_tuio2": 1, "other_address": 1},
        [
            (0, PEER, bundle(*NO_OBJECTS), None),
            (0, PEER, bundle(message("alive", 3, address="/tuio/2Dobj")), None),
            (0, PEER, bundle(message("set", 3, 0.5, 0.5, 0.1, address="/tuio/25Dcur")), None),
            (0, PEER, bundle(message(1, 5, address="/tuio2/frm"), POINTER), None),
            (0, PEER, bytes(message(1, 0.5, address="/accelerometer").dgram), None),
            (0, PEER, of(*NO_OBJECTS, OBJECT, message("alive", 1), HERE), HALF),
        ],
    ),
    # The cursors of a bundle with malformed messages are read.
    "a bundle of good and bad": (
        {"malformed": 2},
        [
            (0, PEER, of(message("set", 1), message("alive", 1), HERE), HALF),
            (0, PEER, of(message("alive", 1, "2"), cursor(1, 0.25, 0.5)), QUARTER),
        ],
    ),
    # Without any alive message the cursors that a bundle sets are alive.
    "a sender that never says what is alive": (
        {},
        [
            (0, PEER, of(HERE, cursor(2, 0.75, 0.5)), [*HALF, (2, 0.75, 0.5)]),
            (0, PEER, of(cursor(2, 0.75, 0.5)), [(2, 0.75, 0.5)]),
            (0, PEER, still(fseq=1), []),
            (0, PEER, of(HERE), []),
        ],
    ),
    # Each with its size; a message without a height is refused, the others count.
    "blobs": (
        {"malformed": 1},
        [
            (0, PEER, blobs((7, 0.5, 0.5, *PALM)), [(-8, 0.5, 0.5, *PALM)]),
            (
                0.01,
                PEER,
                bundle(
                    message("source", "table@a", address=BLOB),
                    message("alive", 7, 8, 9, address=BLOB),
                    message("set", 8, 0.25, 0.5, 0.0, *TIP, address=BLOB),
                    message("set", 9, 0.75, 0.5, 0.0, 0.1, address=BLOB),
                ),
                [(-8, 0.5, 0.5, *PALM), (-9, 0.25, 0.5, *TIP)],
            ),
            (0.02, PEER, blobs((8, 0.25, 0.5, *TIP)), [(-9, 0.25, 0.5, *TIP)]),
            (0.03, PEER, blobs(), []),
        ],
    ),
    # Whichever comes first keeps its number, also as it moves faster than the other is reported,
    # and while one of the two is left, as of a finger that lies down: the blob alone.
    "a contact that is a cursor and a blob": (
        {},
        [
            (0, PEER, frame(*HALF), HALF),
            (0, PEER, blobs((7, 0.5, 0.484375, *TIP)), [(*HALF[0], *TIP)]),
            (0.01, PEER, frame((1, 0.5625, 0.5)), [(1, 0.5625, 0.5, *TIP)]),
            (0.01, PEER, blobs((7, 0.5625, 0.5, *PALM)), [(1, 0.5625, 0.5, *PALM)]),
            (0.02, PEER, frame(), [(1, 0.5625, 0.5, *PALM)]),
            (0.03, PEER, frame(*HALF), [(1, 0.5, 0.5, *PALM)]),
            (0.04, PEER, blobs(), HALF),
            (0.05, PEER, frame(), []),
        ],
    ),
    "a blob whose cursor was lost": (
        {},
        [
            (0, PEER, blobs((1, 0.5, 0.5, *TIP)), [(-2, 0.5, 0.5, *TIP)]),
            (0.01, PEER, frame(*HALF), [(-2, 0.5, 0.5, *TIP)]),
            (0.02, PEER, blobs(), [(-2, 0.5, 0.5)]),
        ],
    ),
    # Side by side, the nearest of each; a palm beside a finger is a contact of its own, and so is
    # a blob that its cursor has left.
    "blobs beside cursors": (
        {},
        [
            (0, PEER, frame((1, 0.5, 0.5), (2, 0.515625, 0.5)), ...),
            (
                0,
                PEER,
                blobs((4, 0.515625, 0.5, *TIP), (3, 0.5, 0.5, *TIP), (5, 0.25, 0.5, *PALM)),
                [(1, 0.5, 0.5, *TIP), (2, 0.515625, 0.5, *TIP), (-6, 0.25, 0.5, *PALM)],
            ),
            (0.01, PEER, frame((1, 0.75, 0.5)), ...),
            (
                0.01,
                PEER,
                blobs((3, 0.5, 0.5, *TIP)),
                [(1, 0.75, 0.5), (1 + (1 << 32), 0.5, 0.5, *TIP)],
            ),
        ],
    ),
    # Each profile has numbers of its own: a late bundle of one changes nothing, and a restart of
    # one leaves the other.
    "numbers of two profiles": (
        {"late": 1},
        [
            (0, PEER, frame(*HALF, fseq=500), HALF),
            (0, PEER, blobs((7, 0.25, 0.5, *PALM), fseq=500), ...),
            (0.01, PEER, blobs(fseq=499), None),
            (0.01, PEER, still(1, fseq=501), [*HALF, (-8, 0.25, 0.5, *PALM)]),
            (0.02, PEER, blobs(fseq=1), HALF),
        ],
    ),
    # A number that comes back is another blob, which was never set; one profile does not confirm
    # the other, whose last bundle may have been lost.
    "blobs that end": (
        {},
        [
            (0, PEER, blobs((7, 0.5, 0.5, *TIP)), ...),
            (0.01, PEER, blobs(), []),
            (
                0.02,
                PEER,
                bundle(message("source", "table@a"), message("alive", 7, address=BLOB)),
                [],
            ),
            (0.03, PEER, blobs((7, 0.25, 0.5, *PALM)), [(-8, 0.25, 0.5, *PALM)]),
            (3.02, PEER, frame(*HALF), [(-8, 0.25, 0.5, *PALM), *HALF]),
            (3.04, PEER, still(1, fseq=1), HALF),
        ],
    ),
    # As much as UDP carries, but no more messages than ten times as many contacts need.
    "big bundles": (
        {"malformed": 1},
        [
            (0, PEER, of(message("alive", 1), HERE, message("set", 2, *[0.5] * 12_000)), HALF),
            (0, PEER, frame(*((id, 0.5, 0.5) for id in range(250))), ...),
            (0, PEER, frame(*((id, 0.5, 0.5) for id in range(300))), ...),
        ],
    ),
}


@pytest.mark.parametrize("name", COURSES)
def test_reader_follows_its_senders(reader: TuioSource, name: str) -> None:
    """What is read of each datagram, and what is counted in the end."""
    expected, datagrams = COURSES[name]
    for at, peer, datagram, wanted in datagrams:
        result = reader.read(datagram, peer, at)
        if wanted is not ...:
            assert (None if result is None else touches(result)) == wanted
    found = reader.rejects.counts
    assert found.keys() == expected.keys()
    assert all(count in (..., found[what]) for what, count in expected.items())


def _raw(*sizes_and_parts: tuple[int, bytes]) -> bytes:
    """A bundle whose element sizes are what one likes."""
    return b"#bundle\0" + bytes(8) + b"".join(struct.pack(">i", n) + b for n, b in sizes_and_parts)


MALFORMED = {
    "empty": b"",
    "noise": b"\xff\x00\x13hello",
    "bundle without a time tag": b"#bundle\0\0",
    "element of negative size": _raw((-4, b"")),
    "element of size zero": _raw((0, b"")),
    "element longer than the datagram": _raw((400, bytes(message("alive", 1).dgram))),
    "no type tags": b"/tuio/2Dcur\0",
    "no arguments": bytes(message().dgram),
    "types without a value": bytes(message("alive", True).dgram),
    "a type that is unknown": b"/tuio/2Dcur\0,sXi\0\0\0\0alive\0\0\0\0\0\0\1",
    "a position that is text": bytes(message("set", 1, "0.5", 0.5, 0.0, 0.0, 0.0).dgram),
    "text without an end": bytes(message("source", "abcd").dgram)[:-4],
    "floats cut off": bytes(message("set", 1, 0.5, 0.5, 0.0, 0.0, 0.0).dgram)[:-20],
    "unknown command": bytes(message("wave", 1).dgram),
    "an id that is not whole": bytes(message("alive", 1.5).dgram),
    "a number that is infinite": bytes(message("fseq", math.inf).dgram),
    "too few arguments": bytes(message("set", 1, 0.5).dgram),
}


@pytest.mark.parametrize("datagram", MALFORMED.values(), ids=MALFORMED.keys())
def test_reader_counts_malformed_datagrams(
    reader: TuioSource, datagram: bytes, caplog: pytest.LogCaptureFixture
) -> None:
    """Each is counted and logged, none raises or changes a touch."""
    reader.read(frame((1, 0.25, 0.5), fseq=1), PEER, 0)
    assert reader.read(datagram, PEER, 0) is None
    assert reader.rejects.counts == {"malformed": 1}
    assert [record.name for record in caplog.records] == ["controller.sources.touch"]
    still = bundle(message("source", "table@a"), message("alive", 1, 2), message("fseq", 2))
    assert touches(reader.read(still, PEER, 0)) == [(1, 0.25, 0.5)]


def typed(tags: str, *values: Any) -> Any:
    """A message of cursors whose arguments have these types."""
    builder = OscMessageBuilder("/tuio/2Dcur")
    for tag, value in zip(tags, values, strict=True):
        builder.add_arg(value, tag)
    return builder.build()


ALIVE = message("alive", 1)
REST = (0.0, 0.0, 0.0)
LIBERAL = {
    "float ids": bundle(typed("sf", "alive", 1.0), typed("sfff", "set", 1.0, 0.25, 0.5)),
    "double positions": bundle(ALIVE, typed("siddddd", "set", 1, 0.25, 0.5, *REST)),
    "int64": bundle(typed("sh", "alive", 1), typed("shff", "set", 1, 0.25, 0.5)),
    "further arguments": bundle(ALIVE, message("set", 1, 0.25, 0.5, *REST, 0.05, 0.06, "a")),
    "further types": bundle(
        ALIVE, typed("siffTFNbi", "set", 1, 0.25, 0.5, True, False, None, b"abcde", 7)
    ),
    "impulse, time tag and array": b"/tuio/2Dcur\0,siffI[t]\0\0\0set\0"
    + struct.pack(">iffQ", 1, 0.25, 0.5, 1),
    "bundles in a bundle": _raw(*[(len(frame(*QUARTER)), frame(*QUARTER))] * 2),
    "a name in Latin-1": bundle(ALIVE, cursor(1, 0.25, 0.5))
    + struct.pack(">i", 28)
    + b"/tuio/2Dcur\0,ss\0source\0\0T\xfcr\0",
    "a long name": of(ALIVE, cursor(1, 0.25, 0.5), source="x" * 4000),
    "a time tag": frame(*QUARTER)[:8] + b"\xff" * 8 + frame(*QUARTER)[16:],
}


@pytest.mark.parametrize("datagram", LIBERAL.values(), ids=LIBERAL.keys())
def test_reader_is_liberal(reader: TuioSource, datagram: bytes) -> None:
    """Whatever its types, further arguments, name and bundles: a cursor is where it says."""
    assert touches(reader.read(datagram, PEER, 0)) == QUARTER
    assert not reader.rejects.counts


@pytest.mark.parametrize(
    ("sent", "seconds"),
    [
        # by port: one that takes another port for each datagram, another one a moment after
        ([(1, 5, 0.0), (2, 6, 0.0), (3, 7, 0.0), (4, 5, 0.1), (3, 8, 0.1)], {4}),
        # a program that is restarted, from another port
        ([(1, 900, 0.0), (2, 1, 0.6), (2, 2, 0.7)], set()),
        # two that are not numbered, or number alike, each with the next number
        ([(1, -1, 0.0), (2, -1, 0.0), (1, -1, 0.1), (2, -1, 0.1)], {1}),
        ([(1, 1, 0.0), (2, 2, 0.0), (1, 3, 0.1), (2, 4, 0.1)], {1}),
    ],
)
def test_reader_tells_programs_of_one_name_apart(
    reader: TuioSource, sent: list[tuple[int, int, float]], seconds: set[int]
) -> None:
    """By port, frame number and time [s]: those of a second program, counted once, and others."""
    for number, (port, fseq, now) in enumerate(sent):
        datagram = frame((port, 0.5, 0.5), fseq=fseq, source="a")
        result = reader.read(datagram, ("192.0.2.7", port), now)
        assert [id for id, _, _ in touches(result)] == [port]
        is_second = port in seconds and number > 0
        assert result.source == f"tuio:192.0.2.7{f':{port}' if is_second else ''}/a"
    assert reader.rejects.counts == ({"same_name": 1} if seconds else {})


def test_reader_knows_that_a_sender_is_mute(reader: TuioSource) -> None:
    """After 10 s without anything, but not of a panel at rest.

    A sender that repeats itself at rest and falls silent is mute, too.
    """
    assert [reader.is_mute(since=0, now=now) for now in (9.9, 10.1)] == [False, True]
    for now in range(11, 14):
        reader.read(frame((1, 0.5, 0.5)) if now < 13 else frame(), PEER, now)
    assert not reader.is_mute(since=0, now=100)
    for now in range(100, 120):
        reader.read(frame(), PEER, now)
    assert [reader.is_mute(since=0, now=now) for now in (128.9, 129.1)] == [False, True]


@given(
    st.lists(
        st.integers(0, 9)
        | st.binary(min_size=1, max_size=40).filter(lambda raw: not raw.startswith((b"/", b"#")))
    )
)
def test_reader_reads_cursors_among_noise(parts: list[int | bytes]) -> None:
    """Every cursor is read, and every other element is counted."""
    raw = [each if isinstance(each, bytes) else cursor(each, 0.5, 0.5).dgram for each in parts]
    reader = TuioSource("tuio:")
    result = reader.read(_raw(*((len(each), each) for each in raw)), PEER, 0)
    found = set() if result is None else {touch.id for touch in result.touches}
    assert found == {each for each in parts if isinstance(each, int)}
    noise = sum(isinstance(each, bytes) for each in parts)
    assert reader.rejects.counts == ({"malformed": noise} if noise else {})


@given(st.binary(max_size=200), st.integers(0, 300))
def test_reader_never_raises(noise: bytes, cut: int) -> None:
    """Any bytes are read or counted, alone or within a valid bundle."""
    reader = TuioSource("tuio:")
    good = frame((1, 0.25, 0.5), fseq=1)
    for datagram in (noise, good[:cut], good[:cut] + noise, good[:cut] + noise + good[cut:]):
        reader.read(datagram, PEER, 0)


@given(
    st.dictionaries(
        st.integers(-(2**31), 2**31 - 1),
        st.tuples(st.floats(0, 1, width=32), st.floats(0, 1, width=32)),
        max_size=10,
    )
)
def test_tuio_datagram_round_trip(places: dict[int, tuple[float, float]]) -> None:
    """What tuio_datagram writes, the reader reads: ids and positions of single precision."""
    wanted = tuple(Touch(id, x, y) for id, (x, y) in places.items())
    datagram = tuio_datagram(TouchFrame("table@a", 0.0, wanted), 7)
    result = TuioSource("tuio:").read(datagram, PEER, 2.0)
    assert (result.source, result.time, result.touches) == ("tuio:192.0.2.7/table@a", 2.0, wanted)


@in_virtual_time
async def test_tuio_source_delivers_over_udp() -> None:
    """A datagram to the bound port becomes a frame at the loop's time."""
    source = TuioSource(f"tuio:127.0.0.1:{free_port()}")
    delivered: asyncio.Queue[TouchFrame] = asyncio.Queue()
    running = asyncio.create_task(source.run(delivered.put_nowait))
    await asyncio.sleep(0.1)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        sender.sendto(b"noise", ("127.0.0.1", source.port))
        sender.sendto(frame((1, 0.25, 0.5)), ("127.0.0.1", source.port))
        received = await delivered.get()
    running.cancel()
    await asyncio.gather(running, return_exceptions=True)
    assert source.rejects.counts == {"malformed": 1}
    assert received.time == pytest.approx(asyncio.get_running_loop().time(), abs=0.01)
    assert touches(received) == [(1, 0.25, 0.5)]


@in_virtual_time
async def test_tuio_source_reports_a_taken_port() -> None:
    """The error names the port and what to do."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("127.0.0.1", 0))
        port = other.getsockname()[1]
        with pytest.raises(InputError, match=f"127.0.0.1:{port}.*another port"):
            await TuioSource(f"tuio:127.0.0.1:{port}").run(lambda frame: None)


@pytest.mark.parametrize(
    ("url", "host", "port"),
    [
        ("tuio:", "127.0.0.1", 3333),
        ("tuio:4000", "127.0.0.1", 4000),
        ("tuio:192.0.2.1:4000", "192.0.2.1", 4000),
        ("tuio:[::1]:4000?timeout=0.5", "::1", 4000),
        ("tuio://192.0.2.1:4000", "192.0.2.1", 4000),
    ],
)
def test_tuio_source_defaults_of_urls(url: str, host: str, port: int) -> None:
    """A URL without host or port means the loopback and the registered port."""
    source = TuioSource(url)
    assert (source.host, source.port) == (host, port)


PAUSE = 0.02  # s

Send: TypeAlias = Callable[..., Awaitable[list[tuple[bytes, float]]]]


@asynccontextmanager
async def receiving() -> AsyncIterator[Send]:
    """Sends datagrams while the loop is busy; returns them with their reported arrival.

    pause [s]: after each of them.
    """
    received: asyncio.Queue[tuple[bytes, float]] = asyncio.Queue()

    def feed(data: bytes, peer: Peer, arrived: float) -> None:
        assert peer == sender.getsockname()
        received.put_nowait((data, arrived))

    async def send(*datagrams: bytes, pause: float = 0.0) -> list[tuple[bytes, float]]:
        for datagram in datagrams:
            sender.sendto(datagram, ("127.0.0.1", line.port))
            time.sleep(pause)  # noqa: ASYNC251  the loop is to be busy
        async with asyncio.timeout(60):
            return [await received.get() for _ in datagrams]

    line = await listen("127.0.0.1", 0, feed, max_size=100)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        sender.bind(("127.0.0.1", 0))
        try:
            yield send
        finally:
            line.close()


@pytest.mark.skipif(sys.platform != "linux", reason="timestamps of Linux")
async def test_datagrams_have_their_time_of_arrival() -> None:
    """However late they are read, arrivals are as far apart as they were sent, and in the past.

    Linux begins some time after the first socket requested it; until then they have the time at
    which they are read.
    """
    loop = asyncio.get_running_loop()
    async with receiving() as send, asyncio.timeout(60):
        arrived = math.inf
        while arrived >= loop.time() - PAUSE / 2:
            ((_, arrived),) = await send(b"0", pause=PAUSE)
        begin = loop.time()
        received = await send(b"1", b"2", b"3", pause=PAUSE)
    assert [data for data, _ in received] == [b"1", b"2", b"3"]
    first, *others = [arrived for _, arrived in received]
    assert begin - 0.1 * PAUSE <= first
    assert min(np.diff([first, *others, loop.time()])) > 0.9 * PAUSE


async def test_oversized_datagram_is_cut_to_one_byte_more() -> None:
    """The receiver sees by its size that it was cut."""
    async with receiving() as send:
        (short, _), (long, _) = await send(bytes(100), bytes(150))
    assert (len(short), len(long)) == (100, 101)


async def test_receiver_may_close_within_its_callback() -> None:
    """Datagrams that arrived after that one are not handed on."""
    received: list[bytes] = []
    lines: list[Datagrams] = []
    done = asyncio.Event()

    def feed(data: bytes, peer: Peer, arrived: float) -> None:
        received.append(data)
        lines[0].close()
        done.set()

    lines.append(await listen("127.0.0.1", 0, feed, max_size=100))
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        for datagram in (b"1", b"2"):
            sender.sendto(datagram, ("127.0.0.1", lines[0].port))
    async with asyncio.timeout(60):
        await done.wait()
    await asyncio.sleep(0)
    assert received == [b"1"]


async def test_datagrams_have_the_time_of_reading_when_the_clock_was_set(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A clock that jumps by an hour between arrival and reading does not make touches old."""
    loop = asyncio.get_running_loop()
    begin = loop.time()
    clock = time.time
    monkeypatch.setattr(time, "time", lambda: clock() + 3600)
    async with receiving() as send:
        ((_, arrived),) = await send(b"1", pause=PAUSE)
    assert begin + 0.9 * PAUSE < arrived <= loop.time()


def partial(source: str, alive: list[int], places: dict[int, float]) -> bytes:
    """A bundle with the positions of only some cursors, as TUIO 1.1 allows."""
    cursors = (cursor(id, x, x) for id, x in places.items())
    return bundle(message("source", source), message("alive", *alive), *cursors)


def full(source: str, *ids: int) -> bytes:
    """A bundle with all positions."""
    return tuio_datagram(TouchFrame(source, 0.0, tuple(Touch(id, 0.5, 0.5) for id in ids)), -1)


def waiting(*sent: tuple[bytes, Peer]) -> list[Datagram]:
    """Datagrams in order of arrival."""
    return [Datagram(data, peer, float(number)) for number, (data, peer) in enumerate(sent)]


bundles = st.builds(
    lambda source, alive, placed: partial(
        source, alive, {id: 0.1 * id for id in alive if id in placed}
    ),
    st.sampled_from("ab"),
    st.lists(st.integers(1, 4), unique=True, max_size=3),
    st.sets(st.integers(1, 4)),
)


@given(st.lists(st.tuples(bundles, st.sampled_from([PEER, OTHER])), max_size=12))
def test_superseded_bundles_do_not_change_the_final_touches(sent: list[tuple[bytes, Peer]]) -> None:
    """Any bundles of senders with one port each leave the same touches with and without it."""
    sent = [(data, peer) for data, peer in sent if (peer == PEER) == (b"a\0\0\0" in data)]
    frames: list[dict[str, tuple[Touch, ...]]] = []
    for each in (waiting(*sent), TuioSource("tuio:").drop_superseded(waiting(*sent))):
        reader = TuioSource("tuio:")
        frames.append({})
        for data, peer, arrived in each:
            frame = reader.read(data, peer, arrived)
            if frame is not None:
                frames[-1][frame.source] = frame.touches
    assert frames[0] == frames[1]


async def test_listen_drops_superseded_bundles_of_a_flood() -> None:
    """Of 200 frames that arrived while the loop was busy a few and the newest are delivered."""
    received: list[bytes] = []
    done = asyncio.Event()
    up = full("a")

    def feed(data: bytes, peer: Peer, arrived: float) -> None:
        received.append(data)
        if data == up:
            done.set()

    line = await listen(
        "127.0.0.1", 0, feed, max_size=8192, drop_superseded=TuioSource("tuio:").drop_superseded
    )
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        for number in range(200):
            sender.sendto(full("a", number), ("127.0.0.1", line.port))
        sender.sendto(up, ("127.0.0.1", line.port))
        async with asyncio.timeout(60):
            await done.wait()
    line.close()
    assert len(received) <= BACKLOG_THRESHOLD
    assert received[-1] == up


@pytest.mark.parametrize(
    ("is_periodic", "options", "ends"),
    [(False, "", [3.0]), (True, "", []), (False, "?timeout=0.5", [0.5])],
)
def test_resting_finger_of_a_silent_sender_is_lifted_after_three_seconds(
    is_periodic: bool, options: str, ends: list[float]
) -> None:
    """Or as the URL says; a sender that repeats what is alive keeps it, without positions.

    The reference implementation, TUIO11_CPP's TuioServer, sends on change only; as its option is,
    it also repeats what is alive once a second. The camera has 64 frames a second.
    """
    reader, tracker = TuioSource(f"tuio:{options}"), ContactTracker(make_paper_rig(12, 9).plate)
    up = list[float]()
    for number in range(640):
        now, alive, fseq = number / 64, message("alive", 1), message("fseq", number + 1)
        if number == 0 or (is_periodic and number % 64 == 0):
            set_once = [cursor(1, 0.25, 0.5)] if number == 0 else []
            frame = reader.read(bundle(alive, *set_once, fseq), PEER, now)
            assert frame is not None
            assert bool(tracker.update(frame)) is (number == 0)
        up += [now for _ in tracker.expire(now).up]
    assert up == ends


@given(
    st.lists(
        st.tuples(st.integers(0, 10**8), st.binary(min_size=1, max_size=40)), min_size=1, max_size=9
    )
)
def test_capture_round_trip(
    tmp_path_factory: pytest.TempPathFactory, sent: list[tuple[int, bytes]]
) -> None:
    """What was written to a microsecond comes back, malformed datagrams too."""
    path = tmp_path_factory.mktemp("capture") / "stream.tuio"
    datagrams = [RecordedDatagram(micros / 1e6, payload) for micros, payload in sorted(sent)]
    write_capture(path, datagrams)
    assert read_capture(path) == datagrams


def test_read_capture_reads_the_documented_format_up_to_its_maximum_size(tmp_path: Path) -> None:
    """As documented, comments included.

    A sparse file one byte above it is refused before it is read as text; so is a datagram's.
    """
    path = tmp_path / "golden.tuio"
    path.write_text(f"{HEADER}\n# two fingers\n0 2f00ff\n1.5 0a\n", encoding="ascii")
    assert read_capture(path) == [
        RecordedDatagram(0.0, b"\x2f\x00\xff"),
        RecordedDatagram(1.5, b"\n"),
    ]
    path.write_text(f"{HEADER}\n1 {'00' * 65508}\n")
    with pytest.raises(InputError, match=r"line 2.*65507"):
        read_capture(path)
    os.truncate(path, MAX_BYTES + 1)
    with pytest.raises(InputError, match="16 MiB"):
        read_capture(path)
