"""A status of the daemon as Prometheus metrics."""

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
    "bad": "Damaged frames.",
    "foreign": "Good frames that nobody waited for.",
    "events": "What an amplifier said unasked.",
    "retries": "Requests that were repeated.",
    "timeouts": "Requests that got no answer in time.",
    "refusals": "Requests that an amplifier refused.",
}


class DaemonCollector(Collector):
    """Asks the daemon at every scrape; ask raises LinkError or RpcError where nobody answers."""

    def __init__(self, ask: Callable[[], StatusResult]) -> None:
        self._ask = ask

    def collect(self) -> Iterable[Metric]:
        """All metrics; only `era_up 0` where no daemon answers."""
        up = GaugeMetricFamily("era_up", "Whether the daemon answers.")
        try:
            status = self._ask()
        except (LinkError, RpcError):
            up.add_metric([], 0)
            return [up]
        up.add_metric([], 1)
        return [up, *metrics_of(status)]


def metrics_of(status: StatusResult) -> Iterator[Metric]:
    """The metrics of one status."""
    state = GaugeMetricFamily("era_state", "1 for the state that it is in.", labels=["state"])
    for name in get_args(DaemonStateName):
        state.add_metric([name], float(name == status.state))
    yield state
    yield _gauge("era_armed", "Whether somebody holds a lease.", float(status.armed_by is not None))
    yield _gauge(
        "era_assume_energised",
        "Whether an amplifier that was lost may still be playing.",
        float(status.assume_energised),
    )
    yield _gauge("era_contacts", "Fingers on the plate.", len(status.contacts))
    yield _gauge("era_uptime_seconds", "Since the daemon began.", status.uptime_s)
    for name, text, value in (
        ("contrast", "Predicted contrast of what is played.", status.predicted_contrast_db),
        ("level", "Predicted level at the target.", status.predicted_level_db_sl),
    ):
        if value is not None:
            yield _gauge(f"era_predicted_{name}_decibels", text, value)
    rejected = CounterMetricFamily(
        "era_rejected_touches", "Touches that could not be contacts.", labels=["reason"]
    )
    for reason, count in status.rejected_touches.items():
        rejected.add_metric([reason], count)
    yield rejected
    yield _latency(status.latency_ms)
    yield from _amplifiers(status.amplifiers)


def _gauge(name: str, text: str, value: float) -> Metric:
    return GaugeMetricFamily(name, text, value=value)


def _latency(latency: LatencySummary) -> Metric:
    """The histogram, in seconds; its sum is not known."""
    *edges, last = latency.histogram
    sums = accumulate(count for _, count in edges)
    buckets = [
        (f"{edge / 1e3:g}", float(sum_)) for (edge, _), sum_ in zip(edges, sums, strict=True)
    ]
    # What is above the last edge counts there.
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
            ("lost", "Whether the link to it is lost."),
            ("fault", "Whether it reports a fault."),
            ("high_voltage", "Whether its high voltage is on."),
            ("temperature_celsius", "Its temperature."),
            ("reply_age_seconds", "Since its last answer."),
            ("round_trip_seconds", "From the last request to its answer."),
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
