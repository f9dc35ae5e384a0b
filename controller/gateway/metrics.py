"""The daemon's status as Prometheus metrics."""

from collections.abc import Iterable, Iterator
from itertools import accumulate
from typing import get_args

from prometheus_client import generate_latest
from prometheus_client.core import (
    CounterMetricFamily,
    GaugeMetricFamily,
    HistogramMetricFamily,
    Metric,
)
from prometheus_client.registry import Collector

from controller.api.amplifier_status import AmplifierStatus
from controller.api.learning_status import LearningState
from controller.api.methods import StatusResult
from controller.api.schema import (
    DaemonStateName,
    LatencySummary,
    LearningSummary,
)
from drivers.host.reports import ReportKind

_LINK_COUNTS = {
    "frames_out": "Frames sent to an amplifier.",
    "frames_in": "Frames received from an amplifier.",
    "invalid_frames": "Frames with a wrong checksum, length, form or version.",
    "unexpected_frames": "Valid but unexpected frames.",
    "events": "Events sent by an amplifier.",
    "retries": "Repeated requests.",
    "timeouts": "Requests without a reply in time.",
    "refusals": "Requests refused by an amplifier.",
}


class _Metrics(Collector):
    """Metrics that are known already."""

    def __init__(self, metrics: Iterable[Metric]) -> None:
        self._metrics = list(metrics)

    def collect(self) -> Iterable[Metric]:
        """All of them."""
        return self._metrics


def exposition(status: StatusResult | None) -> bytes:
    """Format a status in Prometheus' text format; only `era_up 0` without one."""
    up = _gauge("era_up", "Whether the daemon responds.", float(status is not None))
    return generate_latest(_Metrics([up, *(() if status is None else metrics_of(status))]))


def metrics_of(status: StatusResult) -> Iterator[Metric]:
    """Metrics of one status."""
    yield _one_of("era_state", "1 for the current state.", get_args(DaemonStateName), status.state)
    for name, text, value in (
        ("armed", "Whether a client holds the lease.", status.armed_by is not None),
        (
            "assume_energised",
            "Whether a lost amplifier may still be playing.",
            status.assume_energised,
        ),
        ("contacts", "Fingers on the plate.", len(status.contacts)),
        ("uptime_seconds", "Time since the daemon started.", status.uptime_s),
        (
            "promised_contrast_decibels",
            "Felt contrast that nine of ten plates within the rig's uncertainty give.",
            status.promised_contrast_db,
        ),
        (
            "predicted_contrast_decibels",
            "Felt contrast of the pattern, nominal.",
            status.predicted_contrast_db,
        ),
        (
            "predicted_level_decibels",
            "Predicted level at the target.",
            status.predicted_level_db_sl,
        ),
    ):
        if value is not None:
            yield _gauge(f"era_{name}", text, float(value))
    inputs = GaugeMetricFamily(
        "era_touch_input_open", "Whether touches can come from an input.", labels=["input"]
    )
    for each in status.inputs:
        inputs.add_metric([each.name], float(each.state == "open"))
    yield inputs
    text = "Short vibrations that came too late to be felt."
    yield CounterMetricFamily("era_clicks_too_late", text, value=status.clicks_too_late)
    rejected = "Rejected touches and messages of touch sources."
    for name, text, label, counts in (
        ("rejected_touches", rejected, "reason", status.rejected_touches),
        ("lost_events", "Events that clients read too slowly.", "topic", status.lost_events),
    ):
        counter = CounterMetricFamily(f"era_{name}", text, labels=[label])
        for key, count in counts.items():
            counter.add_metric([key], count)
        yield counter
    for name, text, latency in (
        ("touch", "From a touch to the last byte of the command.", status.latency_ms),
        ("lift", "From a lift, or an end without a touch, likewise.", status.lift_latency_ms),
    ):
        if latency is not None:
            yield _histogram(f"era_{name}_to_wire_seconds", text, latency)
    if status.learning is not None:
        yield from _learning(status.learning)
    yield from _amplifiers(status.amplifiers)


def _gauge(name: str, text: str, value: float) -> Metric:
    return GaugeMetricFamily(name, text, value=value)


def _one_of(name: str, text: str, states: Iterable[str], current: str) -> Metric:
    """1 for the current one of several states, 0 for the others."""
    metric = GaugeMetricFamily(name, text, labels=["state"])
    for state in states:
        metric.add_metric([state], float(state == current))
    return metric


def _learning(learning: LearningSummary) -> Iterator[Metric]:
    """What is learned of the plate."""
    yield _one_of(
        "era_learning_state",
        "1 for what happens to measured patterns.",
        get_args(LearningState),
        learning.state,
    )
    yield _gauge(
        "era_robust_answers",
        "Whether answers are those of a plate that is not known.",
        float(learning.robust),
    )
    for name, text, count in (
        ("readings", "Settled patterns that were measured.", learning.readings),
        ("estimates", "Of these, by the estimator.", learning.estimates),
        ("discarded_readings", "Of these, not estimated.", learning.discarded),
        ("disturbed_readings", "Begun, and spoilt by a change or the link.", learning.disturbed),
        ("corrections", "Corrections of the answers.", learning.corrections),
        ("plate_alarms", "Patterns that show another plate than known.", learning.alarms),
        ("estimator_restarts", "Restarts of the estimator.", learning.restarts),
    ):
        yield CounterMetricFamily(f"era_{name}", text, value=count)
    if learning.last_estimate_s is not None:
        yield _gauge(
            "era_estimate_age_seconds", "Time since the last estimate.", learning.last_estimate_s
        )
    yield _histogram(
        "era_reading_to_answers_seconds",
        "From the end of a measurement to the answers that follow it.",
        learning.latency_ms,
    )


def _histogram(name: str, text: str, latency: LatencySummary) -> Metric:
    """The histogram in seconds, without its unknown sum."""
    *edges, last = latency.histogram
    sums = accumulate(count for _, count in edges)
    buckets = [
        (f"{edge / 1e3:g}", float(sum_)) for (edge, _), sum_ in zip(edges, sums, strict=True)
    ]
    # The last count includes values above the last edge.
    buckets.append(("+Inf", sum(count for _, count in edges) + float(last[1])))
    return HistogramMetricFamily(name, text, buckets=buckets, sum_value=None)


def _amplifiers(amplifiers: Iterable[AmplifierStatus]) -> Iterator[Metric]:
    gauges = {
        name: GaugeMetricFamily(f"era_amplifier_{name}", text, labels=["amplifier"])
        for name, text in (
            ("degraded", "Whether it does not reply but may still play."),
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
    reports = GaugeMetricFamily(
        "era_amplifier_report", "1 for what it has reported lately.", labels=["amplifier", "kind"]
    )
    for amplifier in amplifiers:
        reported = {each.kind for each in amplifier.reports}
        for kind in get_args(ReportKind):
            reports.add_metric([amplifier.name, kind], float(kind in reported))
        round_trip = amplifier.statistics.round_trip_ms
        values = {
            "degraded": float(amplifier.degraded),
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
    yield reports
    yield from gauges.values()
    yield from counters.values()
