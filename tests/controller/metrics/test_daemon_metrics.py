"""Metrics as read by a Prometheus parser."""

from collections.abc import Callable
from pathlib import Path

import pytest
from prometheus_client import CollectorRegistry, generate_latest
from prometheus_client.parser import text_string_to_metric_families

from controller.api.client import Client
from controller.api.methods import StatusResult
from controller.metrics.collector import DaemonCollector
from daemon_bench import ready_daemon


def scraped(read_status: Callable[[], StatusResult]) -> dict[tuple[str, str], float]:
    """Samples by name and first label."""
    registry = CollectorRegistry(auto_describe=False)
    registry.register(DaemonCollector(read_status))
    text = generate_latest(registry).decode()
    return {
        (sample.name, next(iter(sample.labels.values()), "")): sample.value
        for family in text_string_to_metric_families(text)
        for sample in family.samples
    }


async def test_metrics_follow_status(tmp_path: Path) -> None:
    """State, link counters and latency of a daemon, in base units."""
    async with ready_daemon(tmp_path) as (_, era):
        status = await era.status()
        read = scraped(lambda: status)
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
    read = scraped(lambda: later)
    assert read["era_touch_to_wire_seconds_bucket", "0.001"] == 2
    assert read["era_touch_to_wire_seconds_bucket", "0.005"] == 5
    assert read["era_touch_to_wire_seconds_bucket", "+Inf"] == 9
    assert read["era_rejected_touches_total", "off_plate"] == 3


def test_metrics_are_era_up_0_without_daemon(tmp_path: Path) -> None:
    """No other sample is given."""

    def read_status() -> StatusResult:
        with Client.connect(tmp_path / "none") as era:
            return era.status()

    assert scraped(read_status) == {("era_up", ""): 0}
