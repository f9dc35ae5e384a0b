"""API messages about the state of the daemon, the plate and its amplifiers.

`EventPublisher` keeps the latest reports and sends every change to the subscribers of its topic.
`PlateView` describes the fingers and their playback, `amplifier_statuses` the amplifiers,
`hello_result` and `effects_result` the features available to a client. `LatencyStatistics`
summarises the latencies of touches.
"""

import asyncio
import contextlib
import logging
import math
from bisect import bisect_left
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from importlib.metadata import version
from typing import Any

import numpy as np

from controller.api.methods import (
    AmplifiersEvent,
    ContactsEvent,
    EffectsResult,
    HelloResult,
    InputsEvent,
    LatencyEvent,
    LinkEvent,
    LogEvent,
    PatternEvent,
    SilenceEvent,
    StateEvent,
    StrengthResult,
)
from controller.api.schema import (
    API_VERSION,
    STATE_WORDS,
    AmplifierReport,
    AmplifierSilence,
    AmplifierStatus,
    ContactStatus,
    EffectDescription,
    EraPosition,
    LatencySummary,
    LinkCounters,
    PlayedTone,
    RigSummary,
    TableSummary,
    Topic,
)
from controller.api.server import Hub
from controller.daemon.config import DaemonConfig
from controller.daemon.layouts import LayoutChoice
from controller.effects.layout import SurfaceLayout
from controller.effects.strengths import UNNAMED
from controller.operation.operation_states import DaemonState, Loss, Operation
from controller.operation.supervisor import LinkChange
from controller.play.intent import BEING_CHOSEN, NO_CONTACTS, FingerSensation, leaks_db_sl
from controller.play.loop import Observers, PlayReport
from controller.play.routing import Drive
from controller.sources.touch import Change, Contact, ContactKey
from drivers.host.amplifier import Amplifier
from drivers.host.clock import REPORT_LIFE, REPORTS, ReportKind
from drivers.host.joint_sets import is_lost
from drivers.host.ledger import StopOutcome
from drivers.host.line import LinkStatistics
from drivers.protocol.definition import FAULTS, QUANTITIES, READINGS, STATES, has_flag, name_of
from model.answer.answer import is_felt
from model.table.table import LocalizationTable
from registry import threads

_MAX_MESSAGE = 1000
"""Longest message of a log record that is sent [characters]."""

_LEVEL = QUANTITIES["level"]

_logger = logging.getLogger(__name__)


class EventPublisher:
    """Keeps the state of the plate up to date and sends every change to subscribed clients.

    operation, amplifiers, inputs: return the current state of the daemon, of its amplifiers and of
        its touch inputs.
    layouts: the surface layouts of the daemon.
    """

    def __init__(
        self,
        *,
        operation: Callable[[], Operation],
        amplifiers: Callable[[], list[AmplifierStatus]],
        layouts: LayoutChoice,
        inputs: Callable[[], InputsEvent],
    ) -> None:
        self.view = PlateView(layouts.player.effect_of, why_not=self._why_not)
        self._player = layouts.player
        self.latencies = LatencyStatistics()  # touches only
        self.lift_latencies = LatencyStatistics()
        self.amplifiers = amplifiers
        self.inputs = inputs
        self._operation = operation
        self._last_link_message = ""
        self._loop = asyncio.get_running_loop()
        self.hub = Hub(
            {
                "state": lambda: _state_event(operation(), operation()),
                "contacts": self.view.contacts_event,
                "pattern": self.view.pattern_event,
                "silence": self.view.silence_event,
                "amplifiers": lambda: AmplifiersEvent(amplifiers=amplifiers()),
                "latency": lambda: LatencyEvent(latency_ms=self.latencies.summary()),
                "layout": layouts.event,
                "inputs": inputs,
                "strength": self.strengths,
            },
            clock=threads.now,
        )

    def observe(self, loop: Observers) -> None:
        """Subscribe to the reports of the control loop."""
        loop.contacts_changed.append(self._contacts_changed)
        loop.reported.append(self._reported)
        loop.refused.append(self._refused)

    def state_changed(self, old: Operation, new: Operation) -> None:
        """Publish a transition of the daemon, and the resulting silence.

        Nothing plays outside OPERATION_ENABLED. The control loop does not report silence that
        another part of the daemon has caused.
        """
        self.hub.publish("state", lambda: _state_event(old, new))
        if new.state is DaemonState.OPERATION_ENABLED:
            return
        was_playing, self.view.report = self.view.applied is not None, None
        if was_playing:
            silence = SilenceEvent(
                contacts=self.view.contact_statuses(),
                reason=new.cause,
                latency_ms=None,
            )
            self.hub.publish("silence", lambda: silence)

    def _why_not(self, key: ContactKey) -> str:
        """Return why a contact feels no effect of its own, if the loop has not reported it."""
        operation = self._operation()
        if operation.state is not DaemonState.OPERATION_ENABLED:
            return f"{STATE_WORDS[operation.state]}: {operation.next_step or operation.cause}"
        if operation.degraded:
            return f"{operation.cause}; {operation.remedy}"
        return self._player.why_not(key)

    def link_changed(self, change: LinkChange, lost: Sequence[str], message: str) -> None:
        """Publish that the link to amplifiers was degraded, restored, lost, retried or reopened."""
        if change == "retry" and message != self._last_link_message:
            _logger.warning("link: retrying: %s", message, extra={"topic": "link"})
        self._last_link_message = message
        event = LinkEvent(
            event=change,
            amplifier=lost[0] if len(lost) == 1 else None,
            message=message,
            remedy=None if change in ("restored", "reopened") else self._operation().remedy,
        )
        self.hub.publish("link", lambda: event)

    def logged(self, record: logging.LogRecord) -> None:
        """Publish a log record, from any thread.

        A record marked with a topic is left out, because an event of that topic reports it.
        """
        if hasattr(record, "topic"):
            return
        event = {
            "level": "error" if record.levelno >= logging.ERROR else record.levelname.lower(),
            # File names can contain bytes that are not valid text.
            "message": record.getMessage()[:_MAX_MESSAGE]
            .encode(errors="backslashreplace")
            .decode(),
            "cause": getattr(record, "cause", None),
            "remedy": getattr(record, "remedy", None),
        }
        make = partial(LogEvent.model_validate, event)
        with contextlib.suppress(RuntimeError):  # the loop may be closed
            self._loop.call_soon_threadsafe(self.hub.publish, "log", make)

    def strengths(self) -> StrengthResult:
        """Return the strengths of all known touch sources, clients and regions."""
        known, inputs = self._player.strengths, [each.name for each in self.inputs().inputs]
        clients = [name for _, name in known.clients if not UNNAMED.fullmatch(name)]
        regions = [each.name for each in self._player.layout.regions]
        names = sorted({*inputs, *known.sources, *clients, *regions})
        return StrengthResult(strengths={**dict.fromkeys(names, 0.0), **known.gains_db})

    def _refused(self, reason: str) -> None:
        _logger.warning("refused: %s", reason)

    def _contacts_changed(self, contacts: tuple[Contact, ...], change: Change) -> None:
        self.view.contacts = contacts
        self.hub.publish("contacts", self.view.contacts_event)

    def _reported(self, report: PlayReport) -> None:
        """Publish the contents that play, or silence, and count the latency.

        Latencies of touches are counted separately.
        """
        self.view.report = report
        topic: Topic = "pattern" if report.contents else "silence"
        if report.latency is not None:
            latencies = self.latencies if report.is_touch else self.lift_latencies
            latencies.add(report.latency)
        event = self.view.pattern_event if topic == "pattern" else self.view.silence_event
        self.hub.publish(topic, event)


def _state_event(old: Operation, new: Operation) -> StateEvent:
    return StateEvent(
        old=old.state.value,
        new=new.state.value,
        cause=new.cause,
        remedy=new.remedy,
        epoch=new.epoch,
    )


@dataclass
class PlateView:
    """The contacts on the plate and the last report of their playback."""

    effect_of: Callable[[ContactKey], str | None]
    """Returns the effect that plays for a contact."""
    contacts: tuple[Contact, ...] = ()
    report: PlayReport | None = None
    """The last report of the control loop.

    None before the first one, and after another part of the daemon has silenced the plate.
    """
    why_not: Callable[[ContactKey], str] = lambda key: ""
    """Returns why a contact feels nothing if the report gives no reason; "" if it should feel."""

    @property
    def applied(self) -> PlayReport | None:
        """The report of the pattern that plays; None while nothing plays."""
        return self.report if self.report and self.report.contents else None

    def contact_statuses(self) -> list[ContactStatus]:
        """Describe all contacts with their roles."""
        return self._statuses(self.contacts)

    @property
    def silence_reason(self) -> str | None:
        """Why nothing plays for the current contacts; None while a pattern plays."""
        if self.applied is not None:
            return None
        reasons = dict.fromkeys(each.held_back for each in self.contact_statuses())
        return "; ".join(filter(None, reasons)) or NO_CONTACTS

    def _statuses(self, contacts: Iterable[Contact]) -> list[ContactStatus]:
        report, reason = self.report, ""
        if report and not report.targets:  # for instance after a failure
            reason = report.reason
        known = {(each.key, each.since) for each in report.contacts} if report and reason else ()
        return [
            _contact_status(
                each,
                report,
                self.effect_of(each.key),
                why_not=self.why_not(each.key)
                or (reason if (each.key, each.since) in known else BEING_CHOSEN),
            )
            for each in contacts
        ]

    def statuses_now(self, table: LocalizationTable) -> list[ContactStatus]:
        """Describe all contacts with roles, and crosstalk at their current positions."""
        statuses = self.contact_statuses()
        if self.applied is None:
            return statuses
        contents = [each.content for each in self.applied.contents.values() if each.drive]
        leaks = leaks_db_sl(table, contents, self.contacts)
        return [
            status.model_copy(update={"leak_db_sl": _finite(leaks[contact.key])})
            for status, contact in zip(statuses, self.contacts, strict=True)
        ]

    @property
    def targets(self) -> list[str]:
        """The current targets, each as source and number."""
        keys = [each.contact.key for each in self.applied.targets] if self.applied else []
        return [f"{key.source} {key.id}" for key in keys]

    def contacts_event(self) -> ContactsEvent:
        """Return the event of topic `contacts`."""
        return ContactsEvent(contacts=self.contact_statuses())

    def pattern_event(self) -> PatternEvent | None:
        """Return the event of topic `pattern`; None while nothing plays."""
        applied = self.applied
        if applied is None:
            return None
        return PatternEvent(
            contacts=self._statuses(applied.contacts),
            **playing_of(applied),
            latency_ms=None if applied.latency is None else 1e3 * applied.latency,
        )

    def silence_event(self) -> SilenceEvent | None:
        """Return the event of topic `silence`; None while something plays or before a decision."""
        silenced = self.report
        if silenced is None or silenced.contents:
            return None
        return SilenceEvent(
            contacts=self._statuses(silenced.contacts),
            reason=silenced.reason,
            latency_ms=None if silenced.latency is None else 1e3 * silenced.latency,
        )


def _contact_status(
    contact: Contact, report: PlayReport | None, effect: str | None, *, why_not: str
) -> ContactStatus:
    """Describe a contact, its predicted sensation and its effect.

    why_not: reason if it is not a target of the report.
    """
    status: dict[str, object] = {
        "source": contact.key.source,
        "id": contact.key.id,
        "x_m": contact.x,
        "y_m": contact.y,
        "effect": effect,
        "load": contact.load,
        "held_back": why_not,
    }
    if report is not None:
        for felt in report.targets:
            # A report can be older than a new finger with the same number.
            if (felt.contact.key, felt.contact.since) == (contact.key, contact.since):
                status |= {"role": "target", **_figures(felt)}
    if report and any(each.key == contact.key for each in report.quiet):
        levels = report.quiet_levels.get(contact.key, ())
        highest = max(levels, default=None)
        status |= {
            "role": "quiet",
            "foreign_level_db_sl": _finite(highest),
            "rig_foreign_level_db_sl": _finite(levels[0]) if levels else None,
            "is_foreign_felt": is_felt(highest),
        }
    if contact.why_load_alone:
        role = "hand" if contact.is_hand else "surplus"
        status |= {"role": role, "held_back": contact.why_load_alone, "is_foreign_felt": False}
    return ContactStatus.model_validate(status)


def _figures(felt: FingerSensation) -> dict[str, object]:
    """Return the figures of a target's sensation, by the keys of its status."""
    sensation = felt.sensation
    return {
        "feels": felt.content_name,
        "level_db_sl": _finite(felt.level_db_sl),
        "promised_contrast_db": _finite(sensation.promised_contrast_db),
        "contrast_db": _finite(sensation.contrast_db),
        "verdict": sensation.verdict,
        "frequency_hz": felt.frequency,
        "foreign_level_db_sl": _finite(sensation.foreign_level_db_sl),
        "rig_foreign_level_db_sl": _finite(sensation.rig_foreign_level_db_sl),
        "is_foreign_felt": sensation.is_foreign_felt,
        "held_back": felt.held_back,
    }


def playing_of(applied: PlayReport | None) -> dict[str, Any]:
    """Return the values of `PatternFields`: the tones of a pattern and its figures."""
    drive = dict[str, PlayedTone]()
    layers = dict[str, dict[str, PlayedTone]]()
    felt: FingerSensation | None = None
    if applied is not None:
        drive = _played_tones(applied.drive)
        felt = applied.felt
        for number, slot in applied.contents.items():
            layers[str(number)] = _played_tones(slot.drive)
    figures: dict[str, float | None] = dict.fromkeys(
        ("promised_contrast_db", "predicted_contrast_db", "predicted_level_db_sl")
    )
    if felt is not None:
        figures = {
            "promised_contrast_db": _finite(felt.sensation.promised_contrast_db),
            "predicted_contrast_db": _finite(felt.sensation.contrast_db),
            "predicted_level_db_sl": _finite(felt.sensation.level_db_sl),
        }
    return {"drive": drive, "layers": layers, **figures}


def _played_tones(drive: Drive) -> dict[str, PlayedTone]:
    """Describe the tones of a layer by ERA."""
    return {
        era: PlayedTone(frequency_hz=tone.frequency, level=tone.level, phase_deg=tone.phase)
        for era, tone in drive.items()
    }


def _finite(value: float | None) -> float | None:
    """Return a finite value unchanged; None for infinity and NaN, which JSON lacks."""
    return value if value is not None and abs(value) < float("inf") else None


def amplifier_statuses(
    amplifiers: Mapping[str, Amplifier],
    urls: Mapping[str, str],
    *,
    are_open: bool,
    lost: Loss | None,
    what_may_play: Callable[[str], StopOutcome],
    clock_errors: Mapping[str, float],
    targets: Sequence[str] = (),
) -> list[AmplifierStatus]:
    """Describe all amplifiers by their last statuses, without sending a request.

    are_open: whether all are open together; otherwise their last statuses are outdated.
    lost: the loss after which the other amplifiers were closed.
    what_may_play: returns the possible output of an amplifier that does not reply, by name.
    clock_errors: RMS errors of the clocks [s]; see `Group`.
    targets: the fingers that currently feel something.
    """
    now, statuses = threads.now(), []
    for name, url in urls.items():
        status = status_at = serial_number = None
        is_degraded, counts = False, LinkStatistics()
        reports: list[AmplifierReport] = []
        if (amplifier := amplifiers.get(name)) is not None:
            is_known = are_open and not is_lost(amplifier)
            status = amplifier.status if is_known else None
            is_degraded = is_known and amplifier.silence_cause is not None
            status_at = amplifier.status_at
            serial_number = amplifier.identity.get("serial_number")
            reports = [
                _report(kind, targets)
                for kind, at in amplifier.reported_at.items()
                if at > now - REPORT_LIFE
            ]
            counts = amplifier.statistics
        readings: dict[str, Any] = {
            each.key: each.in_unit(status) if status else None for each in READINGS
        }
        counters = {
            key: getattr(counts, key)
            for key in LinkCounters.model_fields.keys() - {"round_trip_ms"}
        }
        round_trip, clock_error = counts.last_round_trip, clock_errors.get(name, math.inf)
        has_clock_error = status and len(urls) > 1 and clock_error < math.inf
        closed_with_lost = lost is not None and bool(lost.names) and name not in lost.names
        statuses.append(
            AmplifierStatus(
                name=name,
                url=url,
                serial_number=serial_number,
                state=name_of(STATES, status["state"]) if status else None,
                fault=name_of(FAULTS, status["fault"]) if status else None,
                levels=[_LEVEL.from_wire(level) for level in status["levels"]] if status else [],
                high_voltage=has_flag(status, "high_voltage") if status else None,
                **readings,
                reply_age_s=None if status_at is None else max(0.0, now - status_at),
                clock_skew_us=1e6 * clock_error if has_clock_error else None,
                degraded=is_degraded,
                lost=status is None and not closed_with_lost,
                closed_with_lost=status is None and closed_with_lost,
                reports=reports,
                silence=AmplifierSilence(**what_may_play(name).rows(now))
                if status is None or is_degraded
                else None,
                statistics=LinkCounters(
                    **counters, round_trip_ms=None if round_trip is None else 1e3 * round_trip
                ),
            )
        )
    return statuses


def _report(kind: ReportKind, targets: Sequence[str]) -> AmplifierReport:
    """Describe a report of an amplifier.

    Limited levels are felt by every target, so the cause names all targets.
    """
    cause, remedy = REPORTS[kind]
    if kind == "limited" and targets:
        cause += f", and fingers feel less than promised: {', '.join(targets)}"
    return AmplifierReport(kind=kind, cause=cause, remedy=remedy)


def hello_result(
    config: DaemonConfig,
    table: LocalizationTable,
    amplifiers: Mapping[str, Amplifier],
    *,
    drive_mode: str,
    layout: dict[str, object] | None,
) -> HelloResult:
    """Describe rig, table and layout of the daemon."""
    rig = config.rig
    return HelloResult(
        api_version=API_VERSION,
        software_version=version("era-haptics"),
        rig=RigSummary(
            length_m=rig.plate.length,
            width_m=rig.plate.width,
            eras=[
                EraPosition(
                    name=era.name,
                    x_m=era.x,
                    y_m=era.y,
                    amplifier=rig.wiring[era.name].amplifier,
                    channel=rig.wiring[era.name].number,
                )
                for era in rig.eras
            ],
            simulated=any(
                "simulated" in each.identity.get("product", "") for each in amplifiers.values()
            ),
            frequency_hz=[rig.limits.frequency_min, rig.limits.frequency_max],
        ),
        table=TableSummary(
            fingerprint=table.fingerprint,
            mode=drive_mode,
            frequencies_hz=[float(each) for each in table.frequencies],
            cells_x=table.grid.nx,
            cells_y=table.grid.ny,
        ),
        rig_text=config.rig_text,
        layout=layout,
        readings={
            each.key: (each.label.capitalize(), each.quantity.unit, each.decimals)
            for each in READINGS
            if "page" in each.views
        },
    )


def effects_result(layout: SurfaceLayout) -> EffectsResult:
    """Describe the effects of a layout that can be requested by name."""
    return EffectsResult(
        effects=[
            EffectDescription(
                name=name,
                kind=effect.kind,
                description=(type(effect).__doc__ or "").partition("\n")[0],
                parameters=effect.model_dump(mode="json"),
            )
            for name, effect in sorted(layout.effects.items())
        ]
    )


BUCKETS_MS = (0.25, 0.5, 0.75, 1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 7.5, 10.0, 15.0, 20.0, 50.0, 100.0)
"""Upper edges of the histogram of latencies [ms]."""
_WINDOW = 10_000  # latencies used for the percentiles


class LatencyStatistics:
    """Accumulates latencies [s]."""

    def __init__(self) -> None:
        self._counts = [0] * len(BUCKETS_MS)
        self._recent_ms = np.zeros(_WINDOW)
        self._count = 0

    def add(self, latency: float) -> None:
        """Add one latency [s]."""
        milliseconds = 1e3 * latency
        self._counts[min(bisect_left(BUCKETS_MS, milliseconds), len(BUCKETS_MS) - 1)] += 1
        self._recent_ms[self._count % _WINDOW] = milliseconds
        self._count += 1

    def summary(self) -> LatencySummary:
        """Return count, percentiles [ms] and histogram."""
        quantiles: list[float | None] = [None, None, None]
        if self._count:
            recent = self._recent_ms[: self._count]
            # inverted_cdf returns a measured value
            found = np.quantile(recent, [0.5, 0.99, 0.999], method="inverted_cdf")
            quantiles = [float(value) for value in found]
        median, p99, p999 = quantiles
        return LatencySummary(
            count=self._count,
            median=median,
            p99=p99,
            p999=p999,
            histogram=list(zip(BUCKETS_MS, self._counts, strict=True)),
        )
