"""The example backend against late, damaged and missing replies."""

import asyncio
import json
import sys
from collections.abc import AsyncIterator, Callable
from importlib import util
from pathlib import Path
from typing import Any

import pytest

from drivers.backend import Backend
from drivers.command import CommandSet, DriveCommand
from drivers.errors import CommandError, LinkError, LinkTimeout
from drivers.protocol.messages import AmplifierState, Apply, Nak, NakCode, Ping, Status

MODULE = Path(__file__).parents[2] / "examples" / "plugins" / "backend" / "lines_backend.py"
STATUS = {"state": 1, "fault": 0, "token": 0, "high_voltage": False} | {
    "watchdog_left": 0,
    "latch": 0,
    "levels": [0, 2500],
}
SOON, LONG = 0.05, 5.0  # s

Replies = Callable[[int], bytes | None]
"""Reply to the request of a number; None closes the connection."""


def line(number: int, reply: dict[str, Any]) -> bytes:
    """The line of a reply."""
    return json.dumps({"id": number, **reply}).encode() + b"\n"


class FarEnd:
    """An amplifier with scripted replies."""

    def __init__(self) -> None:
        self.replies: Replies = lambda number: line(number, STATUS)
        self.is_over = asyncio.Event()

    async def serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Serve one host until the connection is closed."""
        while request := await reader.readline():
            reply = self.replies(json.loads(request)["id"])
            if reply is None:
                break
            writer.write(reply)
        writer.close()
        await writer.wait_closed()
        self.is_over.set()


@pytest.fixture
def far_end() -> FarEnd:
    """The amplifier."""
    return FarEnd()


@pytest.fixture
async def backend(far_end: FarEnd) -> AsyncIterator[Backend]:
    """The example backend, open."""
    spec = util.spec_from_file_location("lines_backend", MODULE)
    assert spec is not None
    assert spec.loader is not None
    module = util.module_from_spec(spec)
    spec.loader.exec_module(module)
    server = await asyncio.start_server(far_end.serve, "127.0.0.1", 0)
    port = server.sockets[0].getsockname()[1]
    made = module.LinesBackend(f"lines://127.0.0.1:{port}")
    await made.open()
    yield made
    await made.close()
    await far_end.is_over.wait()
    server.close()
    assert sys.modules.get("lines_backend") is None


async def test_backend_converts_levels(backend: Backend) -> None:
    """2500 on the wire is a level of 0.25."""
    status = await backend.exchange(Ping(), timeout=LONG)
    assert isinstance(status, Status)
    assert status.levels == pytest.approx((0.0, 0.25))


async def test_backend_drops_a_late_reply(backend: Backend, far_end: FarEnd) -> None:
    """It is counted, and the next request gets its own."""
    late: list[bytes] = []

    def later(number: int) -> bytes:
        if not late:
            late.append(line(number, STATUS | {"state": 7}))
            return b""
        return late[0] + line(number, STATUS)

    far_end.replies = later
    with pytest.raises(LinkTimeout, match="no answer from lines://"):
        await backend.exchange(Ping(), timeout=SOON)
    status = await backend.exchange(Ping(), timeout=LONG)
    assert isinstance(status, Status)
    assert status.state is AmplifierState.SWITCH_ON_DISABLED
    assert backend.counters.unexpected_frames == 1


@pytest.mark.parametrize(
    "damaged",
    [
        b"\xff\xfe\n",
        b"7\n",
        b"{}\n",
        b'{"id": 1}\n',
        b'{"id": 1, "state": 99}\n',
        line(1, STATUS | {"levels": [float("nan")]}),
        b"[" * 100_000 + b"\n",
    ],
    ids=range(7),
)
async def test_backend_counts_and_drops_damaged_lines(
    damaged: bytes, backend: Backend, far_end: FarEnd
) -> None:
    """The valid line after them is read."""
    far_end.replies = lambda number: damaged + line(number, STATUS)
    assert isinstance(await backend.exchange(Ping(), timeout=LONG), Status)
    assert backend.counters.invalid_frames >= 1


async def test_backend_returns_a_refusal_as_nak(backend: Backend, far_end: FarEnd) -> None:
    """The refusal names its channel."""
    far_end.replies = lambda number: line(number, {"refused": 4, "channel": 3})
    assert await backend.exchange(Ping(), timeout=LONG) == Nak(NakCode.BAD_CHANNEL, 3)


async def test_backend_reports_a_lost_and_a_closed_connection(
    backend: Backend, far_end: FarEnd
) -> None:
    """During a request and after closing, which may be repeated."""
    far_end.replies = lambda number: None
    with pytest.raises(LinkError, match="is lost: the amplifier has hung up"):
        await backend.exchange(Ping(), timeout=LONG)
    for _ in range(2):
        await backend.close()
    with pytest.raises(LinkError, match="is not open"):
        await backend.exchange(Ping(), timeout=LONG)


async def test_backend_sends_only_guarded_sets(backend: Backend) -> None:
    """Anything else raises TypeError before it is sent."""
    plain = CommandSet(1, (DriveCommand(0, 110.0, 0.5),), ramp=0.0, valid_for=0.0)
    with pytest.raises(TypeError, match="SafeCommandSet"):
        await backend.exchange(Apply(plain), timeout=LONG)
    assert backend.counters.frames_out == 0


@pytest.mark.parametrize("url", ["lines://", "lines://host", "lines://host:x", "lines://h:1/2?a=b"])
async def test_backend_refuses_an_invalid_url(url: str, backend: Backend) -> None:
    """No connection is opened."""
    with pytest.raises(CommandError, match="must be lines://HOST:PORT"):
        type(backend)(url)
