"""The drawn field, whatever the daemon sends."""

import asyncio
import struct

import pytest

from controller.api.schema import Message, PlayedTone
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
