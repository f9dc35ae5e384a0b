"""What the gateway reads once for all: metrics of the daemon, and the field that is drawn."""

import asyncio
import contextlib
import signal
import struct
from collections.abc import AsyncIterator
from pathlib import Path
from typing import NamedTuple
from unittest.mock import AsyncMock, Mock

import httpx
import numpy as np
import pytest
from aiohttp import web
from aiohttp.test_utils import make_mocked_request
from prometheus_client.parser import text_string_to_metric_families

from controller.api.jsonrpc import ErrorCode, RpcError
from controller.api.link import Unreachable
from controller.api.methods import StatusResult
from controller.api.schema import Message, PlayedTone
from controller.api.server import Hub, PatternEvent
from controller.gateway import app
from controller.gateway.app import serve
from controller.gateway.field import DrawnField, FieldSolver
from controller.gateway.metrics import exposition
from controller.gateway.settings import Access, Settings
from daemons import PATIENCE, ready_daemon, until
from gateway_bench import ScriptedDaemon
from model.arrays import ComplexArray
from model.rig.rig_file import example_rig_path, load_rig


def scraped(status: StatusResult | None) -> dict[tuple[str, str], float]:
    """Samples by name and first label."""
    return {
        (sample.name, next(iter(sample.labels.values()), "")): sample.value
        for family in text_string_to_metric_families(exposition(status).decode())
        for sample in family.samples
    }


async def test_metrics_follow_status(tmp_path: Path) -> None:
    """State, link counters and latency of a daemon, in base units."""
    async with ready_daemon(tmp_path) as (_, era):
        status = await era.status()
        read = scraped(status)
    assert read["era_up", ""] == 1
    assert read["era_state", "READY_TO_SWITCH_ON"] == 1
    assert read["era_state", "FAULT"] == 0
    assert read["era_link_frames_out_total", "main"] == status.amplifiers[0].statistics.frames_out
    assert read["era_amplifier_temperature_celsius", "main"] == pytest.approx(25)
    assert read["era_amplifier_high_voltage", "main"] == 0
    assert read["era_amplifier_high_voltage_volts", "main"] == 0
    round_trip = status.amplifiers[0].statistics.round_trip_ms
    assert round_trip is not None
    assert read["era_amplifier_round_trip_seconds", "main"] == pytest.approx(round_trip / 1000)
    assert read["era_touch_to_wire_seconds_bucket", "+Inf"] == 0
    histogram = [(1.0, 2), (5.0, 3), (100.0, 4)]
    latency = status.latency_ms.model_copy(update={"count": 9, "histogram": histogram})
    counts = {"rejected_touches": {"off_plate": 3}, "lost_events": {"log": 5}}
    lifts = {"lift_latency_ms": latency.model_copy(update={"histogram": [(1.0, 4), (2.0, 0)]})}
    later = status.model_copy(update={"latency_ms": latency, **lifts, **counts})
    read = scraped(later)
    assert read["era_touch_to_wire_seconds_bucket", "0.001"] == 2
    assert read["era_touch_to_wire_seconds_bucket", "0.005"] == 5
    assert read["era_touch_to_wire_seconds_bucket", "+Inf"] == 9
    assert read["era_lift_to_wire_seconds_bucket", "+Inf"] == 4
    assert read["era_rejected_touches_total", "off_plate"] == 3
    assert read["era_lost_events_total", "log"] == 5


async def test_metrics_need_the_token_elsewhere(tmp_path: Path) -> None:
    """Nothing of the machine is told to a network without it."""
    certificate = tmp_path / "panel.pem"
    certificate.touch()
    settings = Settings(
        socket=tmp_path / "era.sock",
        host="192.0.2.7",
        certificate=certificate,
        key=certificate,
        is_token_user_supplied=True,
        extra_hosts=("panel.local",),
    )
    access = Access(settings)
    for path, token, expected in (
        ("/metrics", "wrong", 401),
        ("/metrics%0A", "wrong", 400),
        ("/metrics", settings.token, 200),
    ):
        headers = {"Host": "panel.local", "Authorization": f"Bearer {token}"}
        status = 200
        try:
            access.check(make_mocked_request("GET", path, headers=headers))
        except web.HTTPException as refused:
            status = refused.status
        assert status == expected


@contextlib.asynccontextmanager
async def served(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, status: AsyncMock
) -> AsyncIterator[httpx.AsyncClient]:
    """A client of a gateway in this process whose daemon has a status; it ends at SIGTERM."""
    monkeypatch.setattr(app.AsyncClient, "status", status)
    monkeypatch.setattr("os.nice", lambda _: 0)
    port: asyncio.Future[int] = asyncio.get_running_loop().create_future()
    settings = Settings(socket=tmp_path / "era.sock")
    serving = asyncio.create_task(serve(settings, announce=port.set_result))
    async with httpx.AsyncClient(base_url=f"http://localhost:{await port}") as client:
        yield client
    signal.raise_signal(signal.SIGTERM)
    await serving


async def test_metrics_are_read_once_for_all(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """However many read them within half a second."""
    status = AsyncMock(side_effect=Unreachable)
    monkeypatch.setattr(app, "_METRICS_TIME", 1e9)
    async with served(tmp_path, monkeypatch, status) as client:
        for _ in range(3):
            assert "era_up 0.0" in (await client.get("/metrics")).text
        assert status.await_count == 1
        monkeypatch.setattr(app, "_METRICS_TIME", 0.0)
        await client.get("/metrics")
    assert status.await_count == 2


async def test_failure_of_the_gateway_is_answered_and_logged(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Unlike what is no HTTP, and with the security headers."""
    failing = AsyncMock(side_effect=ZeroDivisionError)
    async with served(tmp_path, monkeypatch, failing) as client:
        response = await client.get("/metrics")
        _, writer = await asyncio.open_connection(client.base_url.host, client.base_url.port)
        writer.write(b"evil\r\n\r\n")
        await client.get("/metrics")
        writer.close()
    assert response.status_code == 500
    assert response.headers["x-frame-options"] == "DENY"
    assert "server" not in response.headers
    errors = [each.exc_info[0] for each in caplog.records if each.exc_info]
    assert errors == [ZeroDivisionError] * 2


TONE = PlayedTone(frequency_hz=110.0, level=0.5, phase_deg=0.0)


class UnknownPattern(Message):
    """A pattern of an incompatible daemon."""

    layers: dict[str, dict[str, dict[str, str]]] = {  # noqa: RUF012  pydantic copies it
        "0": {"SW": {"tone": "110 Hz"}}
    }


async def test_field_is_drawn_after_what_cannot_be_drawn(
    daemon: ScriptedDaemon, caplog: pytest.LogCaptureFixture
) -> None:
    """A tone that is not understood leaves no picture and one line in the log, nothing more."""
    pattern = PatternEvent(
        contacts=[],
        drive={"SW": TONE},
        layers={"0": {"SW": TONE}},
        predicted_contrast_db=None,
        predicted_level_db_sl=None,
        latency_ms=1.0,
    )
    field = DrawnField(daemon.socket)
    running = asyncio.create_task(field.run())
    frames = field.frames()
    frame = await anext(frames)
    waiting = asyncio.ensure_future(anext(frames))
    async with asyncio.timeout(PATIENCE):
        for event, frequencies in ((pattern, 1), (UnknownPattern(), 0), (pattern, 1)):
            while struct.unpack_from("<H", frame, 4) != (frequencies,):
                daemon.publish("pattern", event)
                await asyncio.wait({waiting}, timeout=0.1)
                if waiting.done():
                    frame, waiting = waiting.result(), asyncio.ensure_future(anext(frames))
    waiting.cancel()
    running.cancel()
    await asyncio.wait({running})
    assert caplog.text.count("field of the plate not drawn") == 1


async def test_field_is_followed_again_after_a_refusal(
    daemon: ScriptedDaemon, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As by a daemon that has too many clients for a while."""
    monkeypatch.setattr("controller.gateway.field._RETRY_INTERVAL", 0.0)
    busy = RpcError(ErrorCode.BUSY, "too many clients", remedy="try again later")
    subscribe = Mock(side_effect=busy)
    monkeypatch.setattr(Hub, "subscribe", subscribe)
    running = asyncio.create_task(DrawnField(daemon.socket).run())
    await until(lambda: subscribe.call_count > 2, patience=PATIENCE / 6)
    running.cancel()
    await asyncio.wait({running})
    assert caplog.text.count("too many clients") == 1


def test_frame_has_a_field_of_each_content() -> None:
    """Two contents at one frequency stay apart, and each is what it is alone.

    With the threshold of feeling at 100 Hz, 0.249 m/s² in the file of the set by the probe.
    """
    solver = FieldSolver(load_rig(example_rig_path()))
    one = PlayedTone(frequency_hz=100.0, level=0.5, phase_deg=0.0)
    other = PlayedTone(frequency_hz=100.0, level=0.25, phase_deg=90.0)
    drives = {0: {"SW": one}, 3: {"SW": other, "NE": other}}
    both = decoded(solver.frame(drives))
    assert both.layers == (0, 3)
    assert both.frequencies == (100.0, 100.0)
    assert both.thresholds == pytest.approx((0.249, 0.249))
    for field, (number, drive) in zip(both.fields, drives.items(), strict=True):
        (alone,) = decoded(solver.frame({number: drive})).fields
        assert field == pytest.approx(alone, abs=1e-4 * np.abs(both.fields).max())


class Decoded(NamedTuple):
    """A frame: fields (count, points) [m/s²], and of each its frequency, threshold and layer."""

    fields: ComplexArray
    frequencies: tuple[float, ...]
    thresholds: tuple[float, ...]
    layers: tuple[int, ...]


def decoded(frame: bytes) -> Decoded:
    """Decode a frame as the page of the reference describes it."""
    columns, rows, count, _ = struct.unpack_from("<4H", frame)
    scale, *numbers = struct.unpack_from(f"<{1 + 2 * count}f", frame, 8)
    layers = struct.unpack_from(f"<{count}H", frame, 12 + 8 * count)
    parts = np.frombuffer(frame, "<i2", offset=12 + 10 * count).reshape(count, rows * columns, 2)
    fields = (parts[..., 0] + 1j * parts[..., 1]) * scale / 32767
    return Decoded(fields, tuple(numbers[:count]), tuple(numbers[count:]), layers)
