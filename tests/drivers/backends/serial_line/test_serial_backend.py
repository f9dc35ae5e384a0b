import asyncio
import errno
import socket
import struct
import sys
import threading
import zlib
from collections.abc import AsyncIterator
from dataclasses import replace
from unittest.mock import Mock

import pytest
import serial

from drivers.amplifier import Amplifier
from drivers.backends.serial_line.backend import SerialBackend
from drivers.codec.serial_line.exchanges import decode_request, encode_reply
from drivers.codec.serial_line.frame import Frame, FrameReader, encode_frame
from drivers.errors import FrameError, LinkError, LinkTimeout
from drivers.ports import opening
from drivers.protocol.messages import GetStatus, Hello, Nak, NakCode, Ping, Request
from scripted_amplifier import FarEnd
from vendor_pages import ARMED, IDENTITY, usual_reply

PATIENCE = 60.0  # s; for a busy machine
SHORT = 0.02  # s; for what is expected not to come


def reader_threads() -> list[threading.Thread]:
    """The reader threads of serial backends that live."""
    return [thread for thread in threading.enumerate() if thread.name.startswith("era-serial")]


@pytest.fixture
async def backend(far_end: FarEnd) -> AsyncIterator[SerialBackend]:
    """An open backend to the scripted far end."""
    backend = SerialBackend(far_end.url)
    await backend.open()
    yield backend
    await backend.close()


async def test_request_gets_its_reply(backend: SerialBackend, far_end: FarEnd) -> None:
    """Sequence numbers rise; replies and Naks are returned."""
    assert await backend.exchange(Hello(), timeout=PATIENCE) == IDENTITY
    far_end.answer = lambda request, frame: Nak(NakCode.BUSY)
    assert await backend.exchange(Ping(), timeout=PATIENCE) == Nak(NakCode.BUSY)
    first, second = far_end.frames
    assert (second.sequence - first.sequence) % 65536 == 1
    assert (first.address, second.address) == (1, 1)
    assert backend.last_sent_at > 0


async def test_missing_reply_is_a_timeout(backend: SerialBackend, far_end: FarEnd) -> None:
    """With a remedy; the line stays usable."""
    far_end.answer = lambda request, frame: None
    with pytest.raises(LinkTimeout, match=r"address 1 .*921600 baud"):
        await backend.exchange(Ping(), timeout=SHORT)


async def test_timeout_names_the_sequence_number_that_no_reply_had(
    backend: SerialBackend, far_end: FarEnd
) -> None:
    """As of an amplifier that repeats only one byte of it."""
    far_end.answer = lambda request, frame: encode_frame(
        encode_reply(ARMED, frame._replace(sequence=frame.sequence ^ 0x0100))
    )
    with pytest.raises(LinkTimeout, match="sequence number") as caught:
        await backend.exchange(Ping(), timeout=10 * SHORT)
    assert str(far_end.frames[0].sequence) in str(caught.value)


async def test_timeout_includes_the_time_on_a_slow_line(far_end: FarEnd) -> None:
    """At 300 baud a Ping and its reply take 2 s."""
    backend = SerialBackend(f"{far_end.url}?baud=300")
    await backend.open()
    far_end.answer = lambda request, frame: None
    asking = asyncio.create_task(backend.exchange(Ping(), timeout=0.001))
    await far_end.count(1)
    await asyncio.sleep(SHORT)
    far_end.send(ARMED, far_end.frames[0])
    assert await asking == ARMED
    await backend.close()


async def test_unexpected_replies_are_discarded(backend: SerialBackend, far_end: FarEnd) -> None:
    """A late reply, one of another address and an echo are counted and never credited."""
    far_end.answer = lambda request, frame: None
    with pytest.raises(LinkTimeout):
        await backend.exchange(GetStatus(), timeout=SHORT)
    late = far_end.frames[0]

    def answer(request: object, frame: Frame) -> bytes:
        other = Frame(frame.kind, address=2, sequence=frame.sequence, payload=frame.payload)
        return b"".join(
            encode_frame(one)
            for one in (
                encode_reply(ARMED, late),
                encode_reply(replace(IDENTITY, serial_number="B-1"), other),
                frame,
                encode_reply(IDENTITY, frame),
                encode_reply(IDENTITY, frame),
            )
        )

    far_end.answer = answer
    assert await backend.exchange(Hello(), timeout=PATIENCE) == IDENTITY
    far_end.answer = lambda request, frame: usual_reply(request)
    assert await backend.exchange(Ping(), timeout=PATIENCE) == ARMED
    assert backend.counters.unexpected_frames == 4


async def test_noise_before_a_reply_is_skipped(backend: SerialBackend, far_end: FarEnd) -> None:
    """Garbage and a damaged copy are only counted."""

    def answer(request: object, frame: Frame) -> bytes:
        good = encode_frame(encode_reply(ARMED, frame))
        damaged = bytearray(good)
        damaged[6] ^= 0x10
        return b"\x55\xff" + bytes(damaged) + good

    far_end.answer = answer
    assert await backend.exchange(Ping(), timeout=PATIENCE) == ARMED
    assert backend.counters.invalid_frames == 2


async def test_invalid_reply_is_a_frame_error(backend: SerialBackend, far_end: FarEnd) -> None:
    """The right sequence number with another type or an invalid payload."""
    far_end.answer = lambda request, frame: encode_frame(
        Frame(kind=0x81, address=1, sequence=frame.sequence, payload=b"")
    )
    with pytest.raises(FrameError, match="type 0x81"):
        await backend.exchange(Ping(), timeout=PATIENCE)
    with pytest.raises(FrameError, match="too short"):
        await backend.exchange(Hello(), timeout=PATIENCE)


async def test_unplugged_line_fails_pending_and_later_requests(
    backend: SerialBackend, far_end: FarEnd
) -> None:
    """Closing is safe then, twice."""
    far_end.answer = lambda request, frame: far_end.unplug()
    for _ in range(2):
        with pytest.raises(LinkError, match=r"/dev/\S+ was lost .*check the cable") as caught:
            await backend.exchange(Ping(), timeout=PATIENCE)
        assert not isinstance(caught.value, LinkTimeout)
    await backend.close()
    await backend.close()


async def test_close_fails_pending_requests(backend: SerialBackend, far_end: FarEnd) -> None:
    """The event loop watches a local port itself: no thread."""
    assert reader_threads() == []
    far_end.answer = lambda request, frame: None
    waiting = asyncio.create_task(backend.exchange(Ping(), timeout=PATIENCE))
    await far_end.count(1)
    await backend.close()
    with pytest.raises(LinkError, match="was closed"):
        await waiting


async def test_port_is_exclusive(far_end: FarEnd, backend: SerialBackend) -> None:
    """Within a program and between programs."""
    with pytest.raises(LinkError, match="already open in this program"):
        await SerialBackend(far_end.url).open()
    script = (
        "import asyncio, sys; from drivers.backends.serial_line.backend import SerialBackend; "
        "asyncio.run(SerialBackend(sys.argv[1]).open())"
    )
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, "-c", script, far_end.url), stderr=asyncio.subprocess.PIPE
    )
    _, errors = await process.communicate()
    assert b"in use by another program" in errors


async def test_port_refuses_a_second_speed(far_end: FarEnd, backend: SerialBackend) -> None:
    """The first amplifier is not disturbed."""
    with pytest.raises(LinkError, match=r"921600 .*got 9600"):
        await SerialBackend(f"{far_end.url}?baud=9600&address=2").open()
    assert await backend.exchange(Hello(), timeout=PATIENCE) == IDENTITY


@pytest.mark.parametrize(
    ("url", "remedy"),
    [
        ("serial:///dev/no-such-port", "plug in"),
        ("serial:///dev/null", "check its name"),
        ("serial+tcp://127.0.0.1:1", "check the address"),
    ],
)
async def test_unusable_port_has_a_remedy(url: str, remedy: str) -> None:
    """By what the system says."""
    with pytest.raises(LinkError, match=remedy):
        await SerialBackend(url).open()


@pytest.mark.parametrize(
    ("code", "remedy"), [(errno.EACCES, "dialout"), (errno.EBUSY, "another program")]
)
async def test_refused_port_has_a_remedy(
    monkeypatch: pytest.MonkeyPatch, code: int, remedy: str
) -> None:
    """By the system's error code."""
    refused = serial.SerialException(code, "could not open port")
    monkeypatch.setattr(opening.serial, "serial_for_url", Mock(side_effect=refused))
    with pytest.raises(LinkError, match=remedy):
        await SerialBackend("serial:///dev/ttyUSB9").open()


async def test_serial_server_replies_and_its_end_is_a_loss() -> None:
    """Over TCP."""
    loop = asyncio.get_running_loop()
    listener = socket.create_server(("127.0.0.1", 0))
    listener.setblocking(False)
    backend = SerialBackend(f"serial+tcp://127.0.0.1:{listener.getsockname()[1]}")
    opening = asyncio.create_task(backend.open())
    connection, _ = await loop.sock_accept(listener)
    await opening

    async def answer_once() -> None:
        reader = FrameReader()
        while not (frames := reader.feed(await loop.sock_recv(connection, 4096))):
            pass
        reply = encode_reply(usual_reply(decode_request(frames[0])), frames[0])
        await loop.sock_sendall(connection, encode_frame(reply))

    answering = asyncio.create_task(answer_once())
    assert await backend.exchange(Hello(), timeout=PATIENCE) == IDENTITY
    await answering
    connection.close()
    with pytest.raises(LinkError, match="was lost"):
        await backend.exchange(Hello(), timeout=PATIENCE)
    await backend.close()
    listener.close()
    assert reader_threads() == []


async def test_open_refuses_two_amplifiers_at_one_address(far_end: FarEnd) -> None:
    """Two different replies to one Hello; a repeated one is accepted."""
    other = replace(IDENTITY, serial_number="B-18")

    def both(request: object, frame: Frame) -> bytes:
        replies = [IDENTITY, other if isinstance(request, Hello) else usual_reply(request)]
        return b"".join(encode_frame(encode_reply(reply, frame)) for reply in replies)

    def twice(request: object, frame: Frame) -> bytes:
        return 2 * encode_frame(encode_reply(usual_reply(request), frame))

    far_end.answer = both
    amplifier = Amplifier(SerialBackend(far_end.url), reply_timeout=PATIENCE)
    with pytest.raises(LinkError, match=r"several amplifiers .*address 1"):
        await amplifier.open()
    far_end.answer = twice
    await amplifier.open()
    await amplifier.close()


async def test_amplifier_of_version_3_alone_is_refused_by_name(far_end: FarEnd) -> None:
    """Its Hello is understood: bit 3 of the versions, then the texts, and what version 3 added."""

    def answer(request: Request, frame: Frame) -> bytes:
        payload = b"\x08\0" + b"".join(bytes([len(t)]) + t for t in (b"Acme", b"Quad", b"A", b"9"))
        head = struct.pack("<BBBH", 0x81, 0, 1, frame.sequence)
        content = head + payload + b"and more"
        content += struct.pack("<I", zlib.crc32(content))
        return b"\0" + b"".join(bytes([len(p) + 1]) + p for p in content.split(b"\0")) + b"\0"

    far_end.answer = answer
    with pytest.raises(LinkError, match="version must be 2, got 3 from Acme Quad A"):
        await Amplifier(SerialBackend(far_end.url)).open()
    assert [type(request) for request in far_end.requests] == [Hello]
    assert far_end.frames[0].version == 0
