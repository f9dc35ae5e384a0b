"""The amplifier's side of a pseudo-terminal, with raw frames from the host's side."""

import asyncio
import contextlib
import os
import resource
import struct
import time
import tty
import zlib
from collections.abc import AsyncIterator

import pytest

from drivers.codec.serial_line.exchanges import decode_reply, encode_request
from drivers.codec.serial_line.frame import Frame, FrameReader, encode_frame
from drivers.errors import LinkError
from drivers.protocol.definition import PROTOCOL
from drivers.protocol.messages import (
    AmplifierState,
    GetStatus,
    Hello,
    Identity,
    Nak,
    NakCode,
    Reply,
    Request,
    Status,
    Stop,
)
from model.rig.rig import Rig
from sim.amplifier.sensor_messages import SensedAmplifier
from sim.bench.bench import Bench
from sim.bench.simulated_device import SimulatedDevice
from sim.far_ends.serial_end import SerialEnd
from sim.transport.pseudo_terminal import PseudoTerminal

ADDRESS = PROTOCOL.serial.address


class Host:
    """The other side of the line."""

    def __init__(self, url: str) -> None:
        self.fd = os.open(url.removeprefix("serial://").partition("?")[0], os.O_RDWR | os.O_NOCTTY)
        tty.setraw(self.fd)
        os.set_blocking(self.fd, False)
        self._reader = FrameReader()
        self._frames: asyncio.Queue[Frame] = asyncio.Queue()
        asyncio.get_running_loop().add_reader(self.fd, self._readable)

    def _readable(self) -> None:
        for frame in self._reader.feed(os.read(self.fd, 4096)):
            self._frames.put_nowait(frame)

    async def frame(self) -> Frame:
        """The next frame from the amplifier."""
        return await asyncio.wait_for(self._frames.get(), 5)

    async def ask(self, request: Request, sequence: int = 1) -> Reply:
        """A request and its reply."""
        frame = encode_request(request, address=ADDRESS, sequence=sequence)
        os.write(self.fd, encode_frame(frame))
        return decode_reply(await self.frame(), frame)

    def close(self) -> None:
        """Leave."""
        asyncio.get_running_loop().remove_reader(self.fd)
        os.close(self.fd)


@pytest.fixture
async def end(coarse_rig: Rig) -> AsyncIterator[SerialEnd]:
    """An amplifier on a line."""
    end = SerialEnd(
        [
            SimulatedDevice(
                Bench(coarse_rig, now=time.monotonic(), make_amplifier=SensedAmplifier), "main"
            )
        ]
    )
    end.start()
    yield end
    end.close()


@pytest.fixture
async def host(end: SerialEnd) -> AsyncIterator[Host]:
    """A host on that line."""
    host = Host(end.urls["main"])
    yield host
    host.close()


async def test_serial_end_skips_noise(end: SerialEnd, host: Host) -> None:
    """Garbage and a frame with a flipped bit have no effect; the next good frame is understood."""
    good = encode_frame(encode_request(Stop(0.0), address=ADDRESS, sequence=4))
    flipped = bytearray(good)
    flipped[5] ^= 0x10
    os.write(host.fd, b"\x00\x17garbage\x00" + bytes(flipped) + good[:6])
    status = await host.ask(GetStatus())
    assert isinstance(status, Status)
    assert status.state is AmplifierState.SWITCH_ON_DISABLED
    assert end.counters.good == 1
    assert end.counters.invalid_frames >= 2


@pytest.mark.parametrize(
    ("kind", "payload", "code"),
    [
        (PROTOCOL.types["arm"], b"", NakCode.BAD_LENGTH),
        (PROTOCOL.types["arm"], b"\xff\xff\x09\x00", NakCode.BAD_VALUE),
        (PROTOCOL.types["commit"], b"\x09\x00\x00\x00", NakCode.BAD_TOKEN),
        (29, b"", NakCode.UNKNOWN_TYPE),
        (PROTOCOL.types["stop"], b"\x05", NakCode.BAD_LENGTH),
        (PROTOCOL.types["stop"], b"\x05\x00\x00", NakCode.BAD_LENGTH),
        (PROTOCOL.types["load_envelope"], b"\x01\x00\x00\x00", NakCode.BAD_VALUE),
        (PROTOCOL.types["get_sensors"], b"\x20", NakCode.BAD_VALUE),
        (PROTOCOL.types["set_address"], b"\x05\x04A-1", NakCode.BAD_LENGTH),
    ],
)
async def test_serial_end_refuses_invalid_payloads(
    host: Host, kind: int, payload: bytes, code: NakCode
) -> None:
    """A good frame with a bad content gets a Nak with the reason."""
    frame = Frame(kind=kind, address=ADDRESS, sequence=9, payload=payload)
    os.write(host.fd, encode_frame(frame))
    reply = decode_reply(await host.frame(), frame)
    assert isinstance(reply, Nak)
    assert reply.code is code


def by_hand(kind: int, version: int, payload: bytes) -> bytes:
    """A frame of sequence 9, from the words of the page."""
    body = struct.pack("<BBBH", kind, version, ADDRESS, 9) + payload
    content = body + struct.pack("<I", zlib.crc32(body))
    return b"\0" + b"".join(bytes([len(p) + 1]) + p for p in content.split(b"\0")) + b"\0"


@pytest.mark.parametrize(("version", "payload"), [(0, b""), (1, b""), (3, b"more"), (255, b"")])
async def test_serial_end_answers_a_hello_of_any_version(
    host: Host, version: int, payload: bytes
) -> None:
    """The reply is of version 0 and begins with the bits of the versions; bit 2 is set."""
    os.write(host.fd, by_hand(1, version, payload))
    reply = await host.frame()
    assert (reply.kind, reply.version, reply.sequence) == (0x81, 0, 9)
    assert reply.payload[:2] == b"\x04\x00"


@pytest.mark.parametrize("version", [0, 1, 3, 255])
async def test_serial_end_refuses_another_version_neutrally(host: Host, version: int) -> None:
    """Type 31 of version 0: the refused type, UNSUPPORTED_VERSION, no channel. Nothing is done."""
    os.write(host.fd, by_hand(8, version, b"\0\0"))  # a stop
    reply = await host.frame()
    assert (reply.kind, reply.version, reply.sequence) == (0x9F, 0, 9)
    assert reply.payload == bytes([8, 8, 255])
    status = await host.ask(GetStatus())
    assert isinstance(status, Status)
    assert status.state is AmplifierState.SWITCH_ON_DISABLED


@pytest.mark.parametrize("address", [ADDRESS, 0])
async def test_serial_end_accepts_a_stop_with_any_ramp(host: Host, address: int) -> None:
    """Silence is never refused: a ramp of 65.5 s, which no set may have, is taken as longest."""
    kind = PROTOCOL.types["stop"]
    frame = Frame(kind=kind, address=address, sequence=9, payload=b"\xff\xff")
    os.write(host.fd, encode_frame(frame))
    frames = [await host.frame() for _ in range(2 if address else 1)]
    assert all(frame.kind != 0x9F for frame in frames)  # neither of the event and the reply refuses
    status = await host.ask(GetStatus(), sequence=10)
    assert isinstance(status, Status)
    assert status.state is AmplifierState.QUICK_STOP_ACTIVE


async def test_serial_end_ignores_echoes_and_other_addresses(host: Host) -> None:
    """Only requests to its own address get a reply: the first reply is that of the last frame."""
    hello = encode_request(Hello(), address=ADDRESS + 1, sequence=1)
    echo = Frame(kind=hello.kind | 0x80, address=ADDRESS, sequence=2, payload=b"")
    os.write(host.fd, encode_frame(hello) + encode_frame(echo))
    await host.ask(GetStatus(), sequence=3)


async def test_serial_end_host_may_reconnect(end: SerialEnd) -> None:
    """The amplifier stays on its line when a host leaves, and answers the next one."""
    for _ in range(3):
        host = Host(end.urls["main"])
        assert isinstance(await host.ask(Hello()), Identity)
        host.close()


async def test_serial_end_survives_a_host_that_does_not_read(end: SerialEnd) -> None:
    """Unread replies are dropped and counted; requests are still executed."""
    fd = os.open(
        end.urls["main"].removeprefix("serial://").partition("?")[0], os.O_RDWR | os.O_NOCTTY
    )
    os.set_blocking(fd, False)  # or a full buffer would wait for a reader in this very thread
    hello = encode_frame(encode_request(Hello(), address=ADDRESS, sequence=1))
    async with asyncio.timeout(60):  # as long as the system takes to hand the bytes over
        while not end.dropped_replies:
            with contextlib.suppress(BlockingIOError):
                os.write(fd, hello)
            await asyncio.sleep(0)
    os.close(fd)


def test_serial_end_reports_missing_pseudo_terminals() -> None:
    """As when too many files are open: LinkError with the system's reason and what to do."""
    before = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (0, before[1]))
    try:
        with pytest.raises(LinkError, match="Too many open files"):
            PseudoTerminal(lambda _: None)
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, before)
