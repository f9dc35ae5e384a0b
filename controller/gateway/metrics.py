"""The daemon's status as Prometheus metrics."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from itertools import accumulate
from operator import attrgetter
from typing import Any, TypeAlias, get_args

from prometheus_client import generate_latest
from prometheus_client.core import (
    CounterMetricFamily,
    GaugeMetricFamily,
    HistogramMetricFamily,
    Metric,
)
from prometheus_client.registry import Collector

from controller.api.methods import StatusResult
from controller.api.schema import (
    AmplifierStatus,
    DaemonStateName,
    LatencySummary,
)
from drivers.host.clock import ReportKind
from drivers.protocol.definition import READINGS

_Row: TypeAlias = tuple[str, str, Mapping[Any, float | None], tuple[str, ...]]
"""Name, meaning, values by label values, and label names of a metric."""

_AMPLIFIER_GAUGES: tuple[tuple[str, str, Callable[[AmplifierStatus], float | None]], ...] = (
    ("degraded", "Whether the amplifier does not reply but may still play.", lambda a: a.degraded),
    ("lost", "Whether the link to the amplifier is lost.", lambda a: a.lost),
    (
        "fault",
        "Whether the amplifier reports a fault.",
        lambda a: None if a.fault is None else a.fault != "NONE",
    ),
    ("high_voltage", "Whether high voltage is on.", lambda a: a.high_voltage),
    *(
        (each.metric, f"{each.label.capitalize()} {each.meaning}.", attrgetter(each.key))
        for each in READINGS
    ),
    ("reply_age_seconds", "Time since the last reply.", lambda a: a.reply_age_s),
    (
        "clock_skew_seconds",
        "RMS error of the amplifier's clock relative to the others.",
        lambda a: None if a.clock_skew_us is None else a.clock_skew_us / 1e6,
    ),
    (
        "round_trip_seconds",
        "From the last request to its reply.",
        lambda a: a.statistics.round_trip_ms and a.statistics.round_trip_ms / 1e3,
    ),
)

_LINK_COUNTERS = {
    "frames_out": "Frames sent to an amplifier.",
    "frames_in": "Frames received from an amplifier.",
    "invalid_frames": "Frames with a wrong checksum, length, form or version.",
    "unexpected_frames": "Valid but unexpected frames.",
    "events": "Events sent by an amplifier.",
    "retries": "Repeated requests.",
    "timeouts": "Requests without a reply in time.",
    "refusals": "Requests refused by an amplifier.",
}


@dataclass
class _Metrics(Collector):
    """Metrics of a status."""

    status: StatusResult | None

    def collect(self) -> Iterator[Metric]:
        """Yield all metrics with a known value."""
        yield GaugeMetricFamily(
            "era_up", "Whether the daemon responds.", value=float(self.status is not None)
        )
        if self.status is None:
            return
        for kind, rows in (
            (GaugeMetricFamily, _gauges(self.status)),
            (CounterMetricFamily, _counters(self.status)),
        ):
            for name, text, values, labels in rows:
                family = kind(f"era_{name}", text, labels=labels)
                for key, value in values.items():
                    if value is not None:
                        family.add_metric(key, float(value))
                if family.samples:
                    yield family
        for name, text, latency in _histograms(self.status):
            if latency is not None:
                yield _histogram(f"era_{name}_seconds", text, latency)


def exposition(status: StatusResult | None) -> bytes:
    """Format a status in Prometheus' text format; only `era_up 0` without one."""
    return generate_latest(_Metrics(status))


def _gauges(status: StatusResult) -> list[_Row]:
    return [
        ("state", "1 for the current state.", _one_of(DaemonStateName, status.state), ("state",)),
        ("armed", "Whether a client holds the lease.", {(): status.armed_by is not None}, ()),
        (
            "assume_energised",
            "Whether a lost amplifier may still be playing.",
            {(): status.assume_energised},
            (),
        ),
        ("contacts", "Fingers on the plate.", {(): len(status.contacts)}, ()),
        ("uptime_seconds", "Time since the daemon started.", {(): status.uptime_s}, ()),
        (
            "promised_contrast_decibels",
            "Felt contrast that 90 % of plates within the rig's tolerances reach.",
            {(): status.promised_contrast_db},
            (),
        ),
        (
            "predicted_contrast_decibels",
            "Nominal felt contrast of the pattern.",
            {(): status.predicted_contrast_db},
            (),
        ),
        (
            "predicted_level_decibels",
            "Predicted level at the target.",
            {(): status.predicted_level_db_sl},
            (),
        ),
        (
            "layout",
            "1 for the layout in use.",
            {(name,): name == status.layout for name in status.layouts},
            ("layout",),
        ),
        (
            "touch_input_open",
            "Whether the input can deliver touches.",
            {(each.name,): each.state == "open" for each in status.inputs},
            ("input",),
        ),
        (
            "amplifier_report",
            "1 for each recent report of the amplifier.",
            {
                (each.name, kind): kind in {report.kind for report in each.reports}
                for each in status.amplifiers
                for kind in get_args(ReportKind)
            },
            ("amplifier", "kind"),
        ),
        *(
            (
                f"amplifier_{name}",
                text,
                {(each.name,): value_of(each) for each in status.amplifiers},
                ("amplifier",),
            )
            for name, text, value_of in _AMPLIFIER_GAUGES
        ),
    ]


def _counters(status: StatusResult) -> list[_Row]:
    return [
        (
            "clicks_too_late",
            "Short vibrations that came too late to be felt.",
            {(): status.clicks_too_late},
            (),
        ),
        (
            "rejected_touches",
            "Rejected touches and messages of touch sources.",
            {(reason,): count for reason, count in status.rejected_touches.items()},
            ("reason",),
        ),
        (
            "lost_events",
            "Events lost because clients read too slowly.",
            {(topic,): count for topic, count in status.lost_events.items()},
            ("topic",),
        ),
        *(
            (
                f"link_{name}",
                text,
                {(each.name,): getattr(each.statistics, name) for each in status.amplifiers},
                ("amplifier",),
            )
            for name, text in _LINK_COUNTERS.items()
        ),
    ]


def _histograms(status: StatusResult) -> list[tuple[str, str, LatencySummary | None]]:
    return [
        ("touch_to_wire", "From a touch to the last byte of the command.", status.latency_ms),
        (
            "lift_to_wire",
            "From a lift, or an end without a touch, to the last byte of the command.",
            status.lift_latency_ms,
        ),
    ]


def _one_of(states: Any, current: str) -> dict[tuple[str], bool]:
    """1 for the current one of several states, 0 for the others."""
    return {(state,): state == current for state in get_args(states)}


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
