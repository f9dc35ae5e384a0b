"""TUIO 1.1 cursors and blobs as a reader follows their senders, and captures of them."""

import asyncio
import math
import os
import socket
import struct
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pythonosc.osc_message_builder import OscMessageBuilder

from controller.sources.contact_tracker import ContactTracker
from controller.sources.touch import Touch, TouchFrame
from controller.sources.tuio import TuioSource
from controller.sources.tuio_capture import HEADER, MAX_BYTES, RecordedDatagram, read_capture
from controller.sources.udp_source import Datagram, Peer
from kit.clock import in_virtual_time
from kit.fingers import bundle, cursor, frame, free_port, message
from kit.plates import make_paper_rig
from model.errors import InputError

PEER = ("192.0.2.7", 50000)
ANOTHER_PEER = ("127.0.0.1", 50001)
TABLE = message("source", "table@a")
BLOB = "/tuio/2Dblb"
PALM = (0.25, 0.5)
TIP = (0.03125, 0.0625)
"""Sizes of blobs."""
MIDDLE = {1: (0.5, 0.5)}
LEFT = {1: (0.25, 0.5)}
RIGHT = {1: (0.75, 0.5)}
"""A cursor at positions."""

Touches = dict[int, tuple[float, ...]]


class Reader:
    """A TUIO source without a port, and what it reads."""

    def __init__(self) -> None:
        self.source = TuioSource("tuio:")

    def read(self, time: float, datagram: bytes, peer: Peer = PEER) -> Touches | None:
        """Position of each touch, and the size of a blob; None if there is no frame."""
        touch_frame = self.source.read(datagram, peer, time)
        if touch_frame is None:
            return None
        return {touch.id: (touch.x, touch.y, *(touch.size or ())) for touch in touch_frame.touches}

    def must_read(
        self, time: float, datagram: bytes, expected: Touches | None, peer: Peer = PEER
    ) -> None:
        """Require these touches, or no frame."""
        assert self.read(time, datagram, peer) == expected

    @property
    def rejects(self) -> dict[str, int]:
        """Counts of rejected datagrams and messages."""
        return dict(self.source.rejects.counts)


@pytest.fixture
def reader() -> Reader:
    """A reader that has read nothing."""
    return Reader()


def at(position: Touches, *, fseq: int = -1, source: str = "table@a") -> bytes:
    """A complete bundle of cursors."""
    cursors = [(id, x, y) for id, (x, y) in position.items()]
    return frame(*cursors, fseq=fseq, source=source)


def alive(*ids: int, fseq: int, source: str = "table@a") -> bytes:
    """A bundle in which these cursors are alive, and none is set."""
    return bundle(message("source", source), message("alive", *ids), message("fseq", fseq))


def blob(id: int, x: float, y: float, size: tuple[float, float]) -> Any:
    """A set message of a blob at rest."""
    width, height = size
    return message("set", id, x, y, 1.0, width, height, 0.0, *[0.0] * 5, address=BLOB)


def blobs(*messages: Any, ids: tuple[int, ...] = (), fseq: int = -1) -> bytes:
    """A complete bundle of blobs."""
    return bundle(
        message("source", "table@a", address=BLOB),
        message("alive", *ids, address=BLOB),
        *messages,
        message("fseq", fseq, address=BLOB),
    )


def osc_element(raw: bytes) -> bytes:
    """An element of an OSC bundle."""
    return struct.pack(">i", len(raw)) + raw


def test_reader_reads_a_bundle_of_the_specifications(reader: Reader) -> None:
    """The bytes are written out by hand from OSC 1.0 and TUIO 1.1."""
    set_message = (
        b"/tuio/2Dcur\0,sifffff\0\0\0\0set\0\0\0\0\x2a\x3f\x00\x00\x00\x3e\x80\x00\x00" + bytes(12)
    )
    alive_element = osc_element(b"/tuio/2Dcur\0,si\0alive\0\0\0\0\0\0\x2a")
    set_element = osc_element(set_message)
    number_element = osc_element(b"/tuio/2Dcur\0,si\0fseq\0\0\0\0\0\0\0\1")
    header = b"#bundle\0\0\0\0\0\0\0\0\1"
    golden = header + alive_element + set_element + number_element

    sender = "tuio:192.0.2.7:50000"
    touch = Touch(42, 0.5, 0.25)
    expected = TouchFrame(sender, 5.0, (touch,), 3.0, sender)
    assert reader.source.read(golden, PEER, 5.0) == expected


def test_cursor_that_is_alive_but_not_set_stays_where_it_was(reader: Reader) -> None:
    """One that is not alive is gone."""
    reader.read(0.0, at({1: (0.25, 0.5), 2: (0.75, 0.5)}, fseq=1))
    moved = bundle(TABLE, message("alive", 1, 2), cursor(2, 0.5, 0.5), message("fseq", 2))
    reader.must_read(0.01, moved, {1: (0.25, 0.5), 2: (0.5, 0.5)})
    reader.must_read(0.02, alive(2, fseq=3), {2: (0.5, 0.5)})
    reader.must_read(0.03, alive(fseq=4), {})


def test_late_frame_changes_nothing(reader: Reader) -> None:
    """A redundant frame (-1) is never late, and does not make the next one late."""
    reader.read(0.0, at(LEFT, fseq=10))
    reader.must_read(0.01, at({1: (0.75, 0.5), 2: (0.5, 0.5)}, fseq=9), None)
    reader.must_read(0.02, alive(1, fseq=11), LEFT)
    reader.must_read(0.03, at(MIDDLE, fseq=-1), MIDDLE)
    reader.must_read(0.04, at(RIGHT, fseq=12), RIGHT)
    assert reader.rejects == {"late": 1}


@pytest.mark.parametrize(("number", "pause"), [(5000, 0.001), (50, 0.6)])
def test_sender_that_counts_from_one_again_has_restarted(
    reader: Reader, number: int, pause: float
) -> None:
    """Its number falls by more than 100, or it has paused; all its cursors are new."""
    reader.read(0.0, at(LEFT, fseq=number))
    reader.must_read(pause, alive(1, fseq=1), {})
    reader.must_read(pause, at(MIDDLE, fseq=2), MIDDLE)
    assert reader.rejects == {}


def test_seventeenth_sender_is_refused_until_another_has_been_quiet(reader: Reader) -> None:
    """It is counted once."""
    for number in range(16):
        reader.must_read(number / 100, at({}, source=f"s{number}"), {})
    reader.must_read(0.2, at({}, source="s16"), None)
    reader.must_read(0.51, at({}, source="s16"), {})
    assert reader.rejects == {"too_many_senders": 1}


def test_peer_with_all_names_gives_way_to_another(reader: Reader) -> None:
    """Sixteen names that are never quiet exclude no other peer; both have eight in the end."""
    for _ in range(3):
        for number in range(16):
            reader.read(0.1, at({}, source=f"s{number}"))
        for number in range(8):
            reader.must_read(0.1, at({}, source=f"o{number}"), {}, ANOTHER_PEER)
    reader.must_read(0.1, at({}, source="o8"), None, ANOTHER_PEER)


def test_other_profiles_and_protocols_are_counted(reader: Reader) -> None:
    """A table without objects sends empty bundles of them in every frame, which do not count."""
    no_objects = message("alive", address="/tuio/2Dobj")
    reader.must_read(0.0, bundle(no_objects), None)
    objects = message("alive", 3, address="/tuio/2Dobj")
    objects_and_cursor = bundle(TABLE, objects, message("alive", 1), cursor(1, 0.5, 0.5))
    reader.must_read(0.0, objects_and_cursor, MIDDLE)
    reader.read(0.0, bundle(message("set", 3, 0.5, 0.5, 0.1, address="/tuio/25Dcur")))
    pointer = message(1, 0, 0, 0.5, 0.5, 0.0, 0.0, 0.0, address="/tuio2/ptr")
    reader.read(0.0, bundle(message(1, 5, address="/tuio2/frm"), pointer))
    reader.read(0.0, bytes(message(1, 0.5, address="/accelerometer").dgram))
    assert reader.rejects == {
        "profile_2Dobj": 1,
        "profile_25Dcur": 1,
        "profile_tuio2": 1,
        "other_address": 1,
    }


def test_blobs_have_sizes_and_negative_ids(reader: Reader) -> None:
    """A message without a height is refused, and the other blobs count."""
    reader.must_read(0.0, blobs(blob(7, 0.5, 0.5, PALM), ids=(7,)), {-8: (0.5, 0.5, *PALM)})
    incomplete = message("set", 9, 0.75, 0.5, 0.0, 0.1, address=BLOB)
    both_blobs = blobs(blob(8, 0.25, 0.5, TIP), incomplete, ids=(7, 8, 9))
    expected = {-8: (0.5, 0.5, *PALM), -9: (0.25, 0.5, *TIP)}
    reader.must_read(0.01, both_blobs, expected)
    reader.must_read(0.02, blobs(), {})
    assert reader.rejects == {"malformed": 1}


def test_cursor_and_blob_of_one_contact_are_one_touch(reader: Reader) -> None:
    """It keeps its number while one of the two is left, as when a finger lies down."""
    reader.read(0.0, at(MIDDLE))
    near_blob = blobs(blob(7, 0.5, 0.484375, TIP), ids=(7,))
    reader.must_read(0.0, near_blob, {1: (0.5, 0.5, *TIP)})
    reader.must_read(0.01, at({1: (0.5625, 0.5)}), {1: (0.5625, 0.5, *TIP)})
    lying = {1: (0.5625, 0.5, *PALM)}
    reader.must_read(0.01, blobs(blob(7, 0.5625, 0.5, PALM), ids=(7,)), lying)
    reader.must_read(0.02, at({}), lying)
    reader.must_read(0.03, at(MIDDLE), {1: (0.5, 0.5, *PALM)})
    reader.must_read(0.04, blobs(), MIDDLE)


def test_blobs_near_several_cursors_belong_to_the_nearest(reader: Reader) -> None:
    """A palm near a finger is a contact of its own, and so is a blob that its cursor has left."""
    reader.read(0.0, at({1: (0.5, 0.5), 2: (0.515625, 0.5)}))
    three_blobs = blobs(
        blob(4, 0.515625, 0.5, TIP),
        blob(3, 0.5, 0.5, TIP),
        blob(5, 0.25, 0.5, PALM),
        ids=(3, 4, 5),
    )
    expected = {1: (0.5, 0.5, *TIP), 2: (0.515625, 0.5, *TIP), -6: (0.25, 0.5, *PALM)}
    reader.must_read(0.0, three_blobs, expected)
    reader.read(0.01, at(RIGHT))
    left_blob = blobs(blob(3, 0.5, 0.5, TIP), ids=(3,))
    number = 1 + (1 << 32)
    reader.must_read(0.01, left_blob, {**RIGHT, number: (0.5, 0.5, *TIP)})


def test_bundle_has_as_many_messages_as_ten_times_as_many_contacts_need(reader: Reader) -> None:
    """250 cursors fit, 300 do not."""
    positions: Touches = dict.fromkeys(range(300), (0.5, 0.5))
    assert len(reader.read(0.0, at(positions)) or ()) < 300
    assert reader.rejects == {"malformed": 1}


def raw_bundle(*sizes_and_parts: tuple[int, bytes]) -> bytes:
    """A bundle whose elements state any size."""
    elements = [struct.pack(">i", size) + part for size, part in sizes_and_parts]
    return b"#bundle\0" + bytes(8) + b"".join(elements)


MALFORMED = {
    "empty": b"",
    "bundle without a time tag": b"#bundle\0\0",
    "element of negative size": raw_bundle((-4, b"")),
    "element longer than the datagram": raw_bundle((400, b"/tuio")),
    "no type tags": b"/tuio/2Dcur\0",
    "unknown type": b"/tuio/2Dcur\0,sXi\0\0\0\0alive\0\0\0\0\0\0\1",
    "text without an end": message("source", "abcd").dgram[:-4],
    "unknown command": message("wave", 1).dgram,
    "id that is not whole": message("alive", 1.5).dgram,
    "infinite number": message("fseq", math.inf).dgram,
}


@pytest.mark.parametrize("datagram", MALFORMED.values(), ids=MALFORMED.keys())
def test_malformed_datagram_is_counted_and_changes_no_touch(
    reader: Reader, datagram: bytes, caplog: pytest.LogCaptureFixture
) -> None:
    """It is logged once, and raises nothing."""
    reader.read(0.0, at(LEFT, fseq=1))
    reader.must_read(0.0, datagram, None)
    assert reader.rejects == {"malformed": 1}
    assert [record.name for record in caplog.records] == ["controller.sources.touch"]
    reader.must_read(0.0, alive(1, 2, fseq=2), LEFT)


def typed(tags: str, *values: object) -> Any:
    """A message of cursors whose arguments have these types."""
    builder = OscMessageBuilder("/tuio/2Dcur")
    for tag, value in zip(tags, values, strict=True):
        builder.add_arg(value, tag)
    return builder.build()


ALIVE = message("alive", 1)
SET_LEFT = ("set", 1, 0.25, 0.5)
REST = (0.0, 0.0, 0.0)
LATIN_1_NAME = osc_element(b"/tuio/2Dcur\0,ss\0source\0\0T\xfcr\0")


VALID_FORMS = {
    "float ids": bundle(typed("sf", "alive", 1.0), typed("sfff", "set", 1.0, 0.25, 0.5)),
    "64 bits": bundle(typed("sh", "alive", 1), typed("shddddd", *SET_LEFT, *REST)),
    "further types": bundle(ALIVE, typed("siffTFNb", *SET_LEFT, True, False, None, b"abcde")),
    "bundle in a bundle": raw_bundle((len(at(LEFT)), at(LEFT))),
    "name in Latin-1": bundle(ALIVE, cursor(1, 0.25, 0.5)) + LATIN_1_NAME,
}


@pytest.mark.parametrize("datagram", VALID_FORMS.values(), ids=VALID_FORMS.keys())
def test_reader_accepts_any_valid_form_of_a_cursor(reader: Reader, datagram: bytes) -> None:
    """Types, further arguments, names and nested bundles do not matter."""
    reader.must_read(0.0, datagram, LEFT)
    assert reader.rejects == {}


@given(st.binary(max_size=200), st.integers(0, 300))
def test_reader_never_raises(noise: bytes, cut: int) -> None:
    """Any bytes are read or counted, alone or within a valid bundle."""
    reader = Reader()
    valid = at(LEFT, fseq=1)
    for datagram in (noise, valid[:cut], valid[:cut] + noise + valid[cut:]):
        reader.read(0.0, datagram)


@pytest.mark.parametrize(
    ("sent", "second_programs"),
    [
        # one that takes another port for each datagram, and another one a moment later
        ([(1, 5, 0.0), (2, 6, 0.0), (3, 7, 0.0), (4, 5, 0.1), (3, 8, 0.1)], {4}),
        # a program that is restarted, from another port
        ([(1, 900, 0.0), (2, 1, 0.6), (2, 2, 0.7)], set()),
        # two programs that count alike
        ([(1, 1, 0.0), (2, 2, 0.0), (1, 3, 0.1), (2, 4, 0.1)], {1}),
    ],
)
def test_programs_of_one_name_are_told_apart(
    reader: Reader, sent: list[tuple[int, int, float]], second_programs: set[int]
) -> None:
    """By port, frame number and time [s]; the second program has its port in its name."""
    for number, (port, fseq, time) in enumerate(sent):
        datagram = at({port: (0.5, 0.5)}, fseq=fseq, source="a")
        touch_frame = reader.source.read(datagram, ("192.0.2.7", port), time)
        assert touch_frame is not None
        assert [touch.id for touch in touch_frame.touches] == [port]
        is_second = port in second_programs and number > 0
        name = f"tuio:192.0.2.7:{port}/a" if is_second else "tuio:192.0.2.7/a"
        assert touch_frame.source == name
    assert reader.rejects == ({"same_name": 1} if second_programs else {})


def test_sender_is_mute_after_10_s_unless_its_panel_rests(reader: Reader) -> None:
    """A sender that repeats itself at rest and then falls silent is mute, too."""
    assert not reader.source.is_mute(since=0, now=9.9)
    assert reader.source.is_mute(since=0, now=10.1)
    reader.read(11.0, at(MIDDLE))
    reader.read(13.0, at({}))
    assert not reader.source.is_mute(since=0, now=100)
    for second in range(100, 120):
        reader.read(second, at({}))
    assert not reader.source.is_mute(since=0, now=128.9)
    assert reader.source.is_mute(since=0, now=129.1)


@pytest.mark.parametrize(
    ("repeats", "options", "lift_times"),
    [(False, "", [3.0]), (True, "", []), (False, "?timeout=0.5", [0.5])],
)
def test_resting_finger_of_a_silent_sender_is_lifted_after_three_seconds(
    repeats: bool, options: str, lift_times: list[float]
) -> None:
    """The URL can state another time; a sender that repeats `alive` each second keeps its finger.

    The reference implementation, TUIO11_CPP's TuioServer, sends only changes by default. A camera
    has 64 frames per second.
    """
    source = TuioSource(f"tuio:{options}")
    tracker = ContactTracker(make_paper_rig(12, 9).plate)
    first = source.read(at(LEFT, fseq=1), PEER, 0.0)
    assert first is not None
    tracker.update(first)

    lifts: list[float] = []
    for number in range(1, 640):
        time = number / 64
        if repeats and number % 64 == 0:
            repeated = source.read(alive(1, fseq=number + 1), PEER, time)
            assert repeated is not None
            assert not tracker.update(repeated)
        lifts += [time for _ in tracker.expire(time).up]
    assert lifts == lift_times


@in_virtual_time
async def test_source_delivers_datagrams_to_its_port() -> None:
    """A datagram becomes a frame at the loop's time; noise is counted."""
    source = TuioSource(f"tuio:127.0.0.1:{free_port()}")
    delivered: asyncio.Queue[TouchFrame] = asyncio.Queue()
    running = asyncio.create_task(source.run(delivered.put_nowait))
    await asyncio.sleep(0.1)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        sender.sendto(b"noise", ("127.0.0.1", source.port))
        sender.sendto(at(LEFT), ("127.0.0.1", source.port))
        touch_frame = await delivered.get()
    running.cancel()
    await asyncio.gather(running, return_exceptions=True)

    assert source.rejects.counts == {"malformed": 1}
    loop = asyncio.get_running_loop()
    assert touch_frame.time == pytest.approx(loop.time(), abs=0.01)
    assert touch_frame.touches == (Touch(1, 0.25, 0.5),)


@in_virtual_time
async def test_source_reports_a_port_that_is_in_use() -> None:
    """The error names the port and the remedy."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as holder:
        holder.bind(("127.0.0.1", 0))
        port = holder.getsockname()[1]
        with pytest.raises(InputError, match=f"127.0.0.1:{port}.*another port"):
            await TuioSource(f"tuio:127.0.0.1:{port}").run(lambda frame: None)


@pytest.mark.parametrize(
    ("url", "host", "port"),
    [
        ("tuio:", "127.0.0.1", 3333),
        ("tuio:4000", "127.0.0.1", 4000),
        ("tuio://192.0.2.1:4000", "192.0.2.1", 4000),
        ("tuio:[::1]:4000?timeout=0.5", "::1", 4000),
    ],
)
def test_url_without_host_or_port_means_the_loopback_and_the_registered_port(
    url: str, host: str, port: int
) -> None:
    """3333 is the port that TUIO has registered."""
    source = TuioSource(url)
    assert (source.host, source.port) == (host, port)


def partial_bundle(source: str, ids: list[int], placed: set[int]) -> bytes:
    """A bundle with the positions of only some cursors, as TUIO 1.1 permits."""
    cursors = [cursor(id, 0.1 * id, 0.5) for id in ids if id in placed]
    return bundle(message("source", source), message("alive", *ids), *cursors)


BUNDLES_OF_CURSORS = st.tuples(
    st.sampled_from("ab"),
    st.lists(st.integers(1, 4), unique=True, max_size=3),
    st.sets(st.integers(1, 4)),
)


def touches_after(datagrams: list[Datagram]) -> dict[str, tuple[Touch, ...]]:
    """The touches of each sender after these datagrams."""
    source = TuioSource("tuio:")
    touches = {}
    for data, peer, arrived in datagrams:
        touch_frame = source.read(data, peer, arrived)
        if touch_frame is not None:
            touches[touch_frame.source] = touch_frame.touches
    return touches


@given(st.lists(BUNDLES_OF_CURSORS, max_size=12))
def test_dropping_superseded_bundles_does_not_change_the_final_touches(
    sent: list[tuple[str, list[int], set[int]]],
) -> None:
    """Any bundles of two senders that have a port each."""
    peers = {"a": PEER, "b": ANOTHER_PEER}
    datagrams = [
        Datagram(partial_bundle(source, ids, placed), peers[source], float(number))
        for number, (source, ids, placed) in enumerate(sent)
    ]
    reduced = TuioSource("tuio:").drop_superseded(datagrams)
    assert touches_after(reduced) == touches_after(datagrams)


def test_capture_is_read_in_the_documented_format_up_to_its_maximum_size(tmp_path: Path) -> None:
    """A sparse file one byte above it is refused before it is read; so is a longer datagram."""
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
