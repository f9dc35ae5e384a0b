"""The daemon's status as Prometheus metrics.

`exposition` formats a status. `_Families` collects the metrics; each function below adds a group.
A metric without a known value is left out.
"""

from collections.abc import Iterator, Mapping, Sequence
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
from drivers.host.statuses import ReportKind
from drivers.protocol.definition import READINGS

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

_AMPLIFIER_GAUGES = {
    "degraded": "Whether the amplifier does not reply but may still play.",
    "lost": "Whether the link to the amplifier is lost.",
    "fault": "Whether the amplifier reports a fault.",
    "high_voltage": "Whether high voltage is on.",
    **{item.metric: f"{item.label.capitalize()} {item.meaning}." for item in READINGS},
    "reply_age_seconds": "Time since the last reply.",
    "clock_skew_seconds": "RMS error of the amplifier's clock relative to the others.",
    "round_trip_seconds": "Time from the last request to its reply.",
}

_Labelled: TypeAlias = Mapping[Any, float | None]
"""Values of a metric, by the tuple of its label values."""


def exposition(status: StatusResult | None) -> bytes:
    """Format a status in Prometheus' text format; only `era_up 0` without one."""
    families = _Families()
    families.gauge("up", "Whether the daemon responds.", status is not None)
    if status is not None:
        _add_state(families, status)
        _add_amplifiers(families, status.amplifiers)
        _add_counters(families, status)
        _add_latencies(families, status)
    return generate_latest(families)


class _Families(Collector):
    """Metric families in the order of their addition."""

    def __init__(self) -> None:
        self._families: list[Metric] = []

    def collect(self) -> Iterator[Metric]:
        """Yield all families."""
        yield from self._families

    def gauge(self, name: str, meaning: str, value: float | None) -> None:
        """Add a gauge without labels."""
        self.gauges(name, meaning, (), {(): value})

    def gauges(self, name: str, meaning: str, labels: Sequence[str], values: _Labelled) -> None:
        """Add a gauge for each combination of label values."""
        self._add(GaugeMetricFamily(f"era_{name}", meaning, labels=labels), values)

    def counters(self, name: str, meaning: str, labels: Sequence[str], values: _Labelled) -> None:
        """Add a counter for each combination of label values."""
        self._add(CounterMetricFamily(f"era_{name}", meaning, labels=labels), values)

    def histogram(self, name: str, meaning: str, latency: LatencySummary | None) -> None:
        """Add a histogram in seconds, without its unknown sum."""
        if latency is None:
            return
        buckets = []
        total = 0
        for edge_ms, count in latency.histogram:
            total += count
            buckets.append((f"{edge_ms / 1e3:g}", float(total)))
        # The last count includes values above the last edge.
        buckets[-1] = ("+Inf", float(total))
        family = HistogramMetricFamily(f"era_{name}", meaning, buckets=buckets, sum_value=None)
        self._families.append(family)

    def _add(self, family: GaugeMetricFamily | CounterMetricFamily, values: _Labelled) -> None:
        for labels, value in values.items():
            if value is not None:
                family.add_metric(labels, float(value))
        if family.samples:
            self._families.append(family)


def _add_state(families: _Families, status: StatusResult) -> None:
    """Add the state of the daemon, its fingers, layouts and touch inputs."""
    states = {(state,): state == status.state for state in get_args(DaemonStateName)}
    families.gauges("state", "1 for the current state.", ("state",), states)
    is_armed = status.armed_by is not None
    families.gauge("armed", "Whether a client holds the lease.", is_armed)
    families.gauge(
        "assume_energised",
        "Whether a lost amplifier may still be playing.",
        status.assume_energised,
    )
    families.gauge("contacts", "Fingers on the plate.", len(status.contacts))
    families.gauge("uptime_seconds", "Time since the daemon started.", status.uptime_s)
    families.gauge(
        "promised_contrast_decibels",
        "Felt contrast that 90 % of plates within the rig's tolerances reach.",
        status.promised_contrast_db,
    )
    families.gauge(
        "predicted_contrast_decibels",
        "Nominal felt contrast of the pattern.",
        status.predicted_contrast_db,
    )
    families.gauge(
        "predicted_level_decibels",
        "Predicted level at the target.",
        status.predicted_level_db_sl,
    )
    layouts = {(name,): name == status.layout for name in status.layouts}
    families.gauges("layout", "1 for the layout in use.", ("layout",), layouts)
    open_inputs = {(source.name,): source.state == "open" for source in status.inputs}
    families.gauges(
        "touch_input_open", "Whether the input can deliver touches.", ("input",), open_inputs
    )


def _add_amplifiers(families: _Families, amplifiers: Sequence[AmplifierStatus]) -> None:
    """Add the reports and readings of amplifiers."""
    reports = {}
    for amplifier in amplifiers:
        reported = [report.kind for report in amplifier.reports]
        for kind in get_args(ReportKind):
            reports[amplifier.name, kind] = kind in reported
    families.gauges(
        "amplifier_report",
        "1 for each recent report of the amplifier.",
        ("amplifier", "kind"),
        reports,
    )
    values = {amplifier.name: _amplifier_values(amplifier) for amplifier in amplifiers}
    for name, meaning in _AMPLIFIER_GAUGES.items():
        by_amplifier = {(amplifier,): values[amplifier][name] for amplifier in values}
        families.gauges(f"amplifier_{name}", meaning, ("amplifier",), by_amplifier)


def _amplifier_values(amplifier: AmplifierStatus) -> dict[str, float | None]:
    """Return the values of the gauges of an amplifier, by name."""
    values: dict[str, float | None] = {
        "degraded": amplifier.degraded,
        "lost": amplifier.lost,
        "fault": None if amplifier.fault is None else amplifier.fault != "NONE",
        "high_voltage": amplifier.high_voltage,
        "reply_age_seconds": amplifier.reply_age_s,
        "clock_skew_seconds": _divided(amplifier.clock_skew_us, 1e6),
        "round_trip_seconds": _divided(amplifier.statistics.round_trip_ms, 1e3),
    }
    for reading in READINGS:
        values[reading.metric] = getattr(amplifier, reading.key)
    return values


def _divided(value: float | None, divisor: float) -> float | None:
    return None if value is None else value / divisor


def _add_counters(families: _Families, status: StatusResult) -> None:
    """Add the counters of touches, lost events and links."""
    families.counters(
        "clicks_too_late",
        "Short vibrations that came too late to be felt.",
        (),
        {(): status.clicks_too_late},
    )
    families.counters(
        "rejected_touches",
        "Rejected touches and messages of touch sources.",
        ("reason",),
        {(reason,): count for reason, count in status.rejected_touches.items()},
    )
    families.counters(
        "lost_events",
        "Events lost because clients read too slowly.",
        ("topic",),
        {(topic,): count for topic, count in status.lost_events.items()},
    )
    for name, meaning in _LINK_COUNTERS.items():
        counts = {
            (amplifier.name,): getattr(amplifier.statistics, name)
            for amplifier in status.amplifiers
        }
        families.counters(f"link_{name}", meaning, ("amplifier",), counts)


def _add_latencies(families: _Families, status: StatusResult) -> None:
    """Add the histograms of latencies."""
    families.histogram(
        "touch_to_wire_seconds",
        "Time from a touch to the last byte of the command.",
        status.latency_ms,
    )
    families.histogram(
        "lift_to_wire_seconds",
        "Time from a lift, or from the end of an effect, to the last byte of the command.",
        status.lift_latency_ms,
    )
