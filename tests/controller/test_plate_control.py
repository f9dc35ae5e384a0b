"""Asking a simulated plate by its control socket, where what listens there does not do its part."""

import asyncio
import json
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from pathlib import Path

import pytest

from controller import plate_control
from controller.plate_control import PlateControl
from drivers.errors import LinkError

Serve = Callable[[asyncio.StreamReader, asyncio.StreamWriter], Awaitable[None]]
HELLO = {"op": "hello"}


@asynccontextmanager
async def listening(path: Path, serve: Serve) -> AsyncIterator[PlateControl]:
    """Whoever serves at a path, and the control that asks it."""

    async def until_told(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            await serve(reader, writer)
        finally:
            writer.close()

    server = await asyncio.start_unix_server(until_told, path)
    control = PlateControl(path, remedy="start it again")
    try:
        yield control
    finally:
        await control.close()
        server.close()


def saying(*answers: bytes) -> Serve:
    """One that answers a line each, and hangs up when it has no more."""

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        for answer in answers:
            await reader.readline()
            writer.write(answer)

    return serve


async def test_refused_request_keeps_the_connection(
    tmp_path: Path,
) -> None:
    """The error quotes the plate's reason; the next reply belongs to the next request."""
    answers = saying(b'{"error": "finger is 1; it must be a text"}\n', b'{"time_s": 1.5}\n')
    async with listening(tmp_path / "sock", answers) as control:
        with pytest.raises(LinkError, match=r"touch.*finger is 1"):
            await control.request({"op": "touch"})
        assert await control.request({"op": "state"}) == {"time_s": 1.5}


@pytest.mark.parametrize("answer", [b"", b'{"time_s": '], ids=["nothing", "half a line"])
async def test_plate_control_reconnects_after_the_plate_ends(tmp_path: Path, answer: bytes) -> None:
    """The error has a remedy; the next request opens a new connection."""
    async with listening(tmp_path / "sock", saying(answer)) as control:
        with pytest.raises(LinkError, match=f"{tmp_path}/sock.*; start it again"):
            await control.request(HELLO)
    async with listening(tmp_path / "again", saying(b'{"version": 2}\n')):
        (tmp_path / "again").rename(tmp_path / "sock")
        assert await control.request(HELLO) == {"version": 2}
        await control.close()


async def test_plate_control_times_out_when_the_plate_hangs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A late reply is not taken for that of the next request."""
    monkeypatch.setattr(plate_control, "_REPLY_TIMEOUT", 0.02)
    late = asyncio.Event()

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        asked = json.loads(await reader.readline())
        if asked["op"] == "felt":
            await late.wait()
        writer.write(json.dumps({"answer": asked["op"]}).encode() + b"\n")

    async with listening(tmp_path / "sock", serve) as control:
        with pytest.raises(LinkError, match=r"0.02 s; start it again"):
            await control.request({"op": "felt"})
        late.set()
        monkeypatch.setattr(plate_control, "_REPLY_TIMEOUT", 20.0)
        assert await control.request({"op": "state"}) == {"answer": "state"}


@pytest.mark.parametrize(
    "said",
    [
        b'{"jsonrpc": "2.0", "id": null, "error": {"code": -32600}}\n',
        b"HTTP/1.1 400 Bad Request\n",
        b"[1]\n",
        b"x" * (plate_control._MAX_LINE + 1),
    ],
    ids=["the daemon", "a web server", "no object", "no line"],
)
async def test_invalid_plate_reply_is_quoted_in_the_error(tmp_path: Path, said: bytes) -> None:
    """The error quotes only the start of a reply from another program."""
    async with listening(tmp_path / "sock", saying(said)) as control:
        with pytest.raises(LinkError, match=r"/sock: .*--control") as caught:
            await control.request(HELLO)
    assert len(str(caught.value)) < 300
