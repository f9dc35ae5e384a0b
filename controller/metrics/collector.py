"""The daemon's status as Prometheus metrics."""

from collections.abc import Callable, Iterable, Iterator
from itertools import accumulate
from typing import get_args

from prometheus_client.core import (
    CounterMetricFamily,
    GaugeMetricFamily,
    HistogramMetricFamily,
    Metric,
)
from prometheus_client.registry import Collector

from controller.api.jsonrpc import RpcError
from controller.api.methods import StatusResult
from controller.api.schema import AmplifierStatus, DaemonStateName, LatencySummary
from drivers.errors import LinkError

_LINK_COUNTS = {
    "frames_out": "Frames sent to an amplifier.",
    "frames_in": "Frames received from an amplifier.",
    "bad": "Frames with CRC errors.",
    "foreign": "Valid but unexpected frames.",
    "events": "Events sent by an amplifier.",
    "retries": "Repeated requests.",
    "timeouts": "Requests without a reply in time.",
    "refusals": "Requests refused by an amplifier.",
}


class DaemonCollector(Collector):
    """Reads the daemon's status at every scrape; read_status may raise LinkError or RpcError."""

    def __init__(self, read_status: Callable[[], StatusResult]) -> None:
        self._read_status = read_status

    def collect(self) -> Iterable[Metric]:
        """All metrics; only `era_up 0` without a daemon."""
        up = GaugeMetricFamily("era_up", "Whether the daemon responds.")
        try:
            status = self._read_status()
        except (LinkError, RpcError):
            up.add_metric([], 0)
            return [up]
        up.add_metric([], 1)
        return [up, *metrics_of(status)]


def metrics_of(status: StatusResult) -> Iterator[Metric]:
    """Metrics of one status."""
    state = GaugeMetricFamily("era_state", "1 for the current state.", labels=["state"])
    for name in get_args(DaemonStateName):
        state.add_metric([name], float(name == status.state))
    yield state
    yield _gauge(
        "era_armed", "Whether a client holds the lease.", float(status.armed_by is not None)
    )
    yield _gauge(
        "era_assume_energised",
        "Whether a lost amplifier may still be playing.",
        float(status.assume_energised),
    )
    yield _gauge("era_contacts", "Fingers on the plate.", len(status.contacts))
    yield _gauge("era_uptime_seconds", "Time since the daemon started.", status.uptime_s)
    for name, text, value in (
        ("contrast", "Predicted contrast of the current pattern.", status.predicted_contrast_db),
        ("level", "Predicted level at the target.", status.predicted_level_db_sl),
    ):
        if value is not None:
            yield _gauge(f"era_predicted_{name}_decibels", text, value)
    rejected = CounterMetricFamily(
        "era_rejected_touches", "Touches rejected as contacts.", labels=["reason"]
    )
    for reason, count in status.rejected_touches.items():
        rejected.add_metric([reason], count)
    yield rejected
    yield _latency(status.latency_ms)
    yield from _amplifiers(status.amplifiers)


def _gauge(name: str, text: str, value: float) -> Metric:
    return GaugeMetricFamily(name, text, value=value)


def _latency(latency: LatencySummary) -> Metric:
    """The histogram in seconds, without its unknown sum."""
    *edges, last = latency.histogram
    sums = accumulate(count for _, count in edges)
    buckets = [
        (f"{edge / 1e3:g}", float(sum_)) for (edge, _), sum_ in zip(edges, sums, strict=True)
    ]
    # The last count includes values above the last edge.
    buckets.append(("+Inf", sum(count for _, count in edges) + float(last[1])))
    return HistogramMetricFamily(
        "era_touch_to_wire_seconds",
        "From a touch to the last byte of the command.",
        buckets=buckets,
        sum_value=None,
    )


def _amplifiers(amplifiers: Iterable[AmplifierStatus]) -> Iterator[Metric]:
    gauges = {
        name: GaugeMetricFamily(f"era_amplifier_{name}", text, labels=["amplifier"])
        for name, text in (
            ("lost", "Whether the link is lost."),
            ("fault", "Whether it reports a fault."),
            ("high_voltage", "Whether high voltage is on."),
            ("temperature_celsius", "Temperature."),
            ("reply_age_seconds", "Time since the last reply."),
            ("round_trip_seconds", "From the last request to its reply."),
        )
    }
    counters = {
        name: CounterMetricFamily(f"era_link_{name}", text, labels=["amplifier"])
        for name, text in _LINK_COUNTS.items()
    }
    for amplifier in amplifiers:
        round_trip = amplifier.statistics.round_trip_ms
        values = {
            "lost": float(amplifier.lost),
            "fault": None if amplifier.fault is None else float(amplifier.fault != "NONE"),
            "high_voltage": amplifier.high_voltage,
            "temperature_celsius": amplifier.temperature_c,
            "reply_age_seconds": amplifier.reply_age_s,
            "round_trip_seconds": None if round_trip is None else round_trip / 1e3,
        }
        for name, value in values.items():
            if value is not None:
                gauges[name].add_metric([amplifier.name], float(value))
        counts = amplifier.statistics.model_dump()
        for name, counter in counters.items():
            counter.add_metric([amplifier.name], counts[name])
    yield from gauges.values()
    yield from counters.values()
