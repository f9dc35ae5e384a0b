"""The drawn field, whatever the daemon sends."""

import asyncio
import json
import struct
from pathlib import Path

import pytest

from controller.api.jsonrpc import ErrorCode, RpcError, error_line, result_line
from controller.api.schema import API_VERSION, Message, PlayedTone
from controller.api.topics import PatternEvent
from controller.gateway.field import DrawnField
from daemon_bench import PATIENCE
from gateway_bench import ScriptedDaemon

TONE = PlayedTone(frequency_hz=110.0, level=0.5, phase_deg=0.0)


class UnknownPattern(Message):
    """A pattern of an incompatible daemon."""

    drive: dict[str, dict[str, str]] = {"SW": {"tone": "110 Hz"}}  # noqa: RUF012  pydantic copies it


async def test_field_is_drawn_after_what_cannot_be_drawn(
    daemon: ScriptedDaemon, caplog: pytest.LogCaptureFixture
) -> None:
    """A tone that is not understood leaves no picture and one line in the log, nothing more."""
    pattern = PatternEvent(
        contacts=[],
        drive={"SW": TONE},
        predicted_contrast_db=None,
        predicted_level_db_sl=None,
        latency_ms=1.0,
    )
    field = DrawnField(daemon.socket)
    running = asyncio.create_task(field.run())
    frame = await field.newer_than(None)
    async with asyncio.timeout(PATIENCE):
        for event, frequencies in ((pattern, 1), (UnknownPattern(), 0), (pattern, 1)):
            while struct.unpack_from("<H", frame, 4) != (frequencies,):
                daemon.publish("pattern", event)
                waiting = asyncio.create_task(field.newer_than(frame))
                await asyncio.wait({waiting}, timeout=0.1)
                frame = waiting.result() if waiting.done() else frame
                waiting.cancel()
    running.cancel()
    await asyncio.wait({running})
    assert caplog.text.count("field of the plate not drawn") == 1


async def test_field_is_followed_again_after_a_refusal(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As by a daemon that has too many clients for a while."""
    monkeypatch.setattr("controller.gateway.field._RETRY_INTERVAL", 0.0)
    requests: asyncio.Queue[dict[str, object]] = asyncio.Queue()
    busy = RpcError(ErrorCode.BUSY, "too many clients", remedy="try again later")

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        hello = json.loads(await reader.readline())
        result = json.dumps({"api_version": API_VERSION, "rig_text": ""})
        writer.write(result_line(hello["id"], result))
        request = json.loads(await reader.readline())
        requests.put_nowait(request)
        writer.write(error_line(request.get("id"), busy) if "id" in request else b"")
        await reader.read()
        writer.close()

    path = tmp_path / "era.sock"
    async with await asyncio.start_unix_server(serve, path), asyncio.timeout(PATIENCE / 6):
        running = asyncio.create_task(DrawnField(path).run())
        for _ in range(3):
            assert (await requests.get())["method"] == "subscribe"
        running.cancel()
        await asyncio.wait({running})
    assert caplog.text.count("too many clients") == 1
