"""Waiting bundles: which are superseded, and that dropping those loses nothing."""

import asyncio
import logging
import socket

from hypothesis import given
from hypothesis import strategies as st

from controller.sources.datagrams import BACKLOG_THRESHOLD, Datagram, Peer, listen
from controller.sources.reject_counter import RejectCounter
from controller.sources.touch import Touch, TouchFrame
from controller.sources.tuio import TuioReader, tuio_datagram, without_superseded
from tuio_messages import bundle, cursor, message

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


def test_without_superseded_keeps_the_newest_complete_bundle_of_each_sender() -> None:
    """Another name or port is another sender; the order stays."""
    all_of_it = waiting(
        (full("a", 1), HERE), (full("b", 1), HERE), (full("a", 2), THERE), (full("a"), HERE)
    )
    assert without_superseded(all_of_it) == all_of_it[1:]


def test_without_superseded_keeps_bundles_before_an_incomplete_one() -> None:
    """The position of a cursor that is alive may be in an older bundle only."""
    all_of_it = waiting(
        (full("a", 1, 2), HERE), (partial("a", [1, 2], {1: 0.1}), HERE), (b"no bundle", HERE)
    )
    assert without_superseded(all_of_it) == all_of_it
    assert without_superseded(all_of_it[:2]) == all_of_it[:2]


bundles = st.builds(
    lambda source, alive, placed: partial(
        source, alive, {id: 0.1 * id for id in alive if id in placed}
    ),
    st.sampled_from("ab"),
    st.lists(st.integers(1, 4), unique=True, max_size=3),
    st.sets(st.integers(1, 4)),
)


@given(st.lists(st.tuples(bundles, st.sampled_from([HERE, THERE])), max_size=12))
def test_without_superseded_preserves_the_final_touches(sent: list[tuple[bytes, Peer]]) -> None:
    """Any bundles of senders with one port each leave the same touches with and without it."""
    sent = [(data, peer) for data, peer in sent if (peer == HERE) == (b"a\0\0\0" in data)]
    frames: list[dict[str, tuple[Touch, ...]]] = []
    for each in (waiting(*sent), without_superseded(waiting(*sent))):
        reader = TuioReader(RejectCounter(logging.getLogger(__name__)))
        frames.append({})
        for data, peer, arrived in each:
            frame = reader.read(data, peer, now=arrived)
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

    line = await listen("127.0.0.1", 0, feed, max_size=8192, drop_superseded=without_superseded)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        for number in range(200):
            sender.sendto(full("a", number), ("127.0.0.1", line.port))
        sender.sendto(up, ("127.0.0.1", line.port))
        async with asyncio.timeout(60):
            await done.wait()
    line.close()
    assert len(received) <= BACKLOG_THRESHOLD
    assert received[-1] == up
