"""Metrics as read by a Prometheus parser."""

import asyncio
from pathlib import Path

import pytest
from prometheus_client.parser import text_string_to_metric_families

from controller.api.methods import StatusResult
from controller.metrics.collector import exposition
from controller.metrics.server import MAX_CONNECTIONS, PageServer
from daemon_bench import ready_daemon


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
    round_trip = status.amplifiers[0].statistics.round_trip_ms
    assert round_trip is not None
    assert read["era_amplifier_round_trip_seconds", "main"] == pytest.approx(round_trip / 1000)
    assert read["era_touch_to_wire_seconds_bucket", "+Inf"] == 0
    histogram = [(1.0, 2), (5.0, 3), (100.0, 4)]
    latency = status.latency_ms.model_copy(update={"count": 9, "histogram": histogram})
    later = status.model_copy(update={"latency_ms": latency, "rejected_touches": {"off_plate": 3}})
    read = scraped(later)
    assert read["era_touch_to_wire_seconds_bucket", "0.001"] == 2
    assert read["era_touch_to_wire_seconds_bucket", "0.005"] == 5
    assert read["era_touch_to_wire_seconds_bucket", "+Inf"] == 9
    assert read["era_rejected_touches_total", "off_plate"] == 3


def test_metrics_are_era_up_0_without_daemon() -> None:
    """No other sample is given."""
    assert scraped(None) == {("era_up", ""): 0}


async def request(port: int, head: str) -> str:
    """Status code of a response; empty if the connection is closed without one."""
    reader, writer = await asyncio.open_connection("127.0.0.1", port)
    writer.write(head.replace("\n", "\r\n").encode())
    answer = await reader.read()
    writer.close()
    return answer.decode().partition(" ")[2][:3]


async def test_page_server_checks_requests(monkeypatch: pytest.MonkeyPatch) -> None:
    """Host, method, path and length; what is not sent in time is not waited for."""

    async def page() -> bytes:
        return b"here"

    server = await PageServer("/metrics", page, content="text/plain").start(0)
    port = server.sockets[0].getsockname()[1]
    for head, status in (
        (f"GET /metrics HTTP/1.1\nHost: localhost:{port}\n\n", "200"),
        ("GET /metrics?a=b HTTP/1.1\nHost: 127.0.0.1\n\n", "200"),
        (f"GET /metrics HTTP/1.1\nHost: evil.example:{port}\n\n", "421"),
        ("GET /metrics HTTP/1.1\nHost: localhost\nHost: evil.example\n\n", "421"),
        ("GET /metrics HTTP/1.0\n\n", "421"),
        ("POST /metrics HTTP/1.1\nHost: localhost\n\n", "405"),
        ("GET / HTTP/1.1\nHost: localhost\n\n", "404"),
        (f"GET /metrics HTTP/1.1\nHost: localhost\nX: {'x' * 9000}\n\n", ""),
    ):
        assert await request(port, head) == status
    monkeypatch.setattr("controller.metrics.server._TIMEOUT", 0.05)
    assert await request(port, "GET /metrics HTTP/1.1\n") == ""
    server.close()


async def test_page_server_closes_oldest_of_too_many_connections() -> None:
    """A hundred silent ones keep no other client out, and all but eight of them are closed."""

    async def page() -> bytes:
        return b"here"

    server = await PageServer("/metrics", page, content="text/plain").start(0)
    port = server.sockets[0].getsockname()[1]
    silent = [await asyncio.open_connection("127.0.0.1", port) for _ in range(100)]
    assert await request(port, "GET /metrics HTTP/1.1\nHost: localhost\n\n") == "200"
    closed = [reader for reader, _ in silent if reader.at_eof() or reader.exception()]
    assert len(closed) >= 100 - MAX_CONNECTIONS
    for _, writer in silent:
        writer.close()
    server.close()
