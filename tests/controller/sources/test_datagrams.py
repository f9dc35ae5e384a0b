"""Touch sources over UDP: recorded TUIO streams, invalid files, and datagrams that come too many.

Also datagrams that arrive while the loop is busy, and none at all from a finger that rests.
"""

import asyncio
import logging
import socket
import sys
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping
from contextlib import asynccontextmanager
from pathlib import Path
from typing import TypeAlias

import pytest
from hypothesis import given
from hypothesis import strategies as st

from controller.cli.main import run
from controller.sources.touch import Change, ContactTracker, RejectCounter, Touch, TouchFrame
from controller.sources.tuio import (
    HEADER,
    MAX_BYTES,
    RecordedDatagram,
    TuioSource,
    read_capture,
    replay_capture,
)
from controller.sources.udp_source import BACKLOG_THRESHOLD, Datagram, Datagrams, Peer, listen
from drivers.errors import LinkError
from examples.make_touches import tuio_datagram, write_capture
from model.errors import InputError
from model.structure.plate import Plate
from plates import make_paper_rig
from several_fingers import bundle, cursor, message
from virtual_lines import in_virtual_time

Place = tuple[float, float]


class ReferenceSender:
    """A TUIO sender that behaves as the reference implementation, TUIO11_CPP's TuioServer.

    It sends on change only: what is alive, the cursors that changed, the frame's number; nothing
    while fingers rest. periodic: it also repeats what is alive once a second, as its option does.
    It greets and parts with an empty bundle numbered -1. Times [s].
    """

    def __init__(self, *, periodic: bool = False) -> None:
        self._periodic = periodic
        self._cursors: dict[int, Place] = {}
        self._frame = 0
        self._sent_at = 0.0

    def empty(self) -> bytes:
        """The bundle with which it starts and ends."""
        return bundle(message("alive"), message("fseq", -1))

    def frame(self, cursors: Mapping[int, Place], now: float) -> bytes | None:
        """What it sends for a frame of its camera: cursors by session id."""
        self._frame += 1
        changed = {id: at for id, at in cursors.items() if self._cursors.get(id) != at}
        is_due = self._periodic and now - self._sent_at >= 1.0
        if not (changed or is_due) and cursors.keys() == self._cursors.keys():
            return None
        self._cursors, self._sent_at = dict(cursors), now
        return bundle(
            message("alive", *cursors),
            *(cursor(id, x, y) for id, (x, y) in changed.items()),
            message("fseq", self._frame),
        )


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


async def until_stamped(send: Send) -> None:
    """Wait until the system timestamps datagrams.

    Linux begins some time after the first socket requested it; until then they have the time at
    which they are read.
    """
    loop = asyncio.get_running_loop()
    async with asyncio.timeout(60):
        while True:
            begin = loop.time()
            ((_, arrived),) = await send(b"0", pause=PAUSE)
            if arrived < begin + PAUSE / 2:
                return


@pytest.mark.skipif(sys.platform != "linux", reason="timestamps of Linux")
async def test_datagrams_have_their_time_of_arrival() -> None:
    """However late they are read, arrivals are as far apart as they were sent, and in the past."""
    loop = asyncio.get_running_loop()
    async with receiving() as send:
        await until_stamped(send)
        begin = loop.time()
        received = await send(b"1", b"2", b"3", pause=PAUSE)
    assert [data for data, _ in received] == [b"1", b"2", b"3"]
    times = [arrived for _, arrived in received]
    assert begin - 0.1 * PAUSE <= times[0]
    assert times[1] - times[0] > 0.9 * PAUSE
    assert times[2] - times[1] > 0.9 * PAUSE
    assert times[2] < loop.time() - 0.9 * PAUSE


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


HERE, THERE = ("127.0.0.1", 5001), ("127.0.0.1", 5002)


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


BLOBS = full("a").replace(b"2Dcur", b"2Dblb")


@pytest.mark.parametrize(
    ("sent", "first"),
    [
        # another name, port or profile is of another kind; the order stays
        ([(full("a", 1), HERE), (full("b"), HERE), (full("a"), THERE), (full("a"), HERE)], 1),
        ([(full("a", 1), HERE), (BLOBS, HERE)], 0),
        ([(BLOBS, HERE), (full("a", 1), HERE), (BLOBS, HERE)], 1),
        # the position of a cursor that is alive may be in an older bundle only
        ([(full("a", 1, 2), HERE), (partial("a", [1, 2], {1: 0.1}), HERE)], 0),
        ([(full("a", 1, 2), HERE), (b"no bundle", HERE)], 0),
    ],
)
def test_newest_complete_bundle_supersedes_those_of_its_kind(
    sent: list[tuple[bytes, Peer]], first: int
) -> None:
    """All are kept from the first of these on."""
    assert TuioSource("tuio:").drop_superseded(waiting(*sent)) == waiting(*sent)[first:]


bundles = st.builds(
    lambda source, alive, placed: partial(
        source, alive, {id: 0.1 * id for id in alive if id in placed}
    ),
    st.sampled_from("ab"),
    st.lists(st.integers(1, 4), unique=True, max_size=3),
    st.sets(st.integers(1, 4)),
)


@given(st.lists(st.tuples(bundles, st.sampled_from([HERE, THERE])), max_size=12))
def test_superseded_bundles_do_not_change_the_final_touches(sent: list[tuple[bytes, Peer]]) -> None:
    """Any bundles of senders with one port each leave the same touches with and without it."""
    sent = [(data, peer) for data, peer in sent if (peer == HERE) == (b"a\0\0\0" in data)]
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


PLATE: Plate = make_paper_rig(12, 9).plate
CAMERA = 1 / 64  # s; exact in binary


class Scene:
    """A sender's camera at 64 frames a second, and the changes of contacts that come of it."""

    def __init__(self, sender: ReferenceSender, *, options: str = "") -> None:
        self.now = 0.0
        self.log: list[tuple[float, str, int]] = []
        self._sender = sender
        self._reader = TuioSource(f"tuio:{options}")
        self._tracker = ContactTracker(PLATE)

    def play(self, duration: float, cursors: Callable[[float], Mapping[int, Place]]) -> None:
        """Film cursors for a duration [s]; expiry is checked between frames."""
        end = self.now + duration
        while self.now < end:
            self.send(self._sender.frame(cursors(self.now), self.now))
            self._note(self._tracker.expire(self.now))
            self.now += CAMERA

    def send(self, datagram: bytes | None) -> None:
        """Deliver a datagram, if there is one."""
        frame = None if datagram is None else self._reader.read(datagram, HERE, self.now)
        if frame is not None:
            self._note(self._tracker.update(frame))

    def _note(self, change: Change) -> None:
        self.log += [(self.now, "down", contact.key.id) for contact in change.down]
        self.log += [(self.now, "up", contact.key.id) for contact in change.up]


@pytest.mark.parametrize(
    ("periodic", "options", "ends"),
    [
        (False, "", [(3.0, "up", 1)]),
        (True, "", []),
        (False, "?timeout=0.5", [(0.5, "up", 1)]),
    ],
)
def test_resting_finger_of_a_silent_sender_is_lifted_after_three_seconds(
    periodic: bool, options: str, ends: list[tuple[float, str, int]]
) -> None:
    """Or as the URL says; a sender that repeats what is alive keeps it, without positions."""
    scene = Scene(ReferenceSender(periodic=periodic), options=options)
    scene.play(10.0, lambda now: {1: (0.25, 0.5)})
    assert scene.log == [(0.0, "down", 1), *ends]


def test_reject_counter_logs_once_per_interval(caplog: pytest.LogCaptureFixture) -> None:
    """A thousand bad datagrams within a second are all counted and make one line, as do later.

    The first of another reason makes one at once.
    """
    now = 0.0
    rejects = RejectCounter(logging.getLogger("bad input"), clock=lambda: now)
    for _ in range(1000):
        rejects.count("malformed", "ends too early")
    assert rejects.counts == {"malformed": 1000}
    assert len(caplog.records) == 1
    rejects.count("late", "frame\x1b[2J 3")
    assert len(caplog.records) == 2
    assert "new=1000" in caplog.records[1].getMessage()
    assert "late 1, malformed 1000" in caplog.records[1].getMessage()
    assert "\x1b" not in rejects.examples["late"]
    now = 1.0
    rejects.count("late", "frame 4")
    assert len(caplog.records) == 3


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


def test_read_capture_reads_the_documented_format(tmp_path: Path) -> None:
    """The format as documented, comments included, is read."""
    path = tmp_path / "golden.tuio"
    path.write_text(f"{HEADER}\n# two fingers\n0 2f00ff\n1.5 0a\n", encoding="ascii")
    assert read_capture(path) == [
        RecordedDatagram(0.0, b"\x2f\x00\xff"),
        RecordedDatagram(1.5, b"\n"),
    ]


@in_virtual_time
async def test_replay_capture_keeps_times_over_udp() -> None:
    """Datagrams arrive unchanged, each at its own time."""
    loop = asyncio.get_running_loop()
    start = loop.time()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.bind(("127.0.0.1", 0))
        receiver.setblocking(False)
        datagrams = [
            RecordedDatagram(0.0, b"one"),
            RecordedDatagram(0.25, b"two"),
            RecordedDatagram(1.0, b"three"),
        ]
        port = receiver.getsockname()[1]
        replay = asyncio.create_task(replay_capture(datagrams, "127.0.0.1", port))
        received = [(await loop.sock_recv(receiver, 100), loop.time() - start) for _ in datagrams]
        await replay
    assert received == [(b"one", 0.0), (b"two", 0.25), (b"three", 1.0)]


@in_virtual_time
async def test_replay_capture_raises_when_the_port_is_closed() -> None:
    """The refusal of one datagram is raised at the next."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as closed:
        closed.bind(("127.0.0.1", 0))
        port = closed.getsockname()[1]
    with pytest.raises(LinkError, match=rf"127.0.0.1:{port} \(Connection refused\)"):
        await replay_capture(
            [RecordedDatagram(t, b"x") for t in (0.0, 0.1, 0.2)], "127.0.0.1", port
        )


@in_virtual_time
async def test_replay_capture_raises_when_the_system_refuses() -> None:
    """An address to which the system may not send is reported at once."""
    with pytest.raises(LinkError, match=r"255\.255\.255\.255:3333 \(Perm"):
        await replay_capture([RecordedDatagram(0.0, b"x")], "255.255.255.255", 3333)


def test_era_touch_sends_a_capture(tmp_path: Path) -> None:
    """To the UDP port of the daemon's source; fingers and a capture exclude each other."""
    commands = ["controller.cli.commands"]
    path = tmp_path / "taps.tuio"
    write_capture(path, [RecordedDatagram(0.0, b"one"), RecordedDatagram(0.0, b"two")])
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.bind(("127.0.0.1", 0))
        receiver.settimeout(10)
        options = ["--replay", str(path), "--port", str(receiver.getsockname()[1])]
        assert run(["touch", *options], commands) == 0
        assert [receiver.recv(100) for _ in range(2)] == [b"one", b"two"]
        assert run(["touch", "0.1,0.1", *options], commands) == 2
    assert run(["touch"], commands) == 2


def test_capture_has_a_maximum_size(tmp_path: Path) -> None:
    """A sparse file one byte above it is refused before it is read as text; so is a datagram's."""
    path = tmp_path / "long"
    with path.open("wb") as stream:
        stream.truncate(MAX_BYTES + 1)
    with pytest.raises(InputError, match="16 MiB"):
        read_capture(path)
    path.write_text(f"{HEADER}\n1 {'00' * 65508}\n")
    with pytest.raises(InputError, match=r"line 2.*65507"):
        read_capture(path)
