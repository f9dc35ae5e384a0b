"""Publishes what happens in the daemon to its clients, and keeps the current state of it."""

import asyncio
import contextlib
import logging
from bisect import bisect_left
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Literal

import numpy as np

from controller.api.amplifier_status import AmplifierStatus
from controller.api.methods import StrengthResult
from controller.api.schema import (
    STATE_WORDS,
    LatencySummary,
    LearningStatus,
    LearningSummary,
    PlateEvent,
)
from controller.api.server import (
    AmplifiersEvent,
    Hub,
    InputsEvent,
    LatencyEvent,
    LinkEvent,
    LogEvent,
    SilenceEvent,
    StateEvent,
)
from controller.daemon.layouts import LayoutChoice
from controller.daemon.messages import PlateView, plate_event
from controller.effects.strengths import UNNAMED
from controller.learning.learning import Learning
from controller.operation.operator import LinkChange
from controller.operation.states import DaemonState, Operation
from controller.play.observer import Observers, PlayReport, SilenceReport
from controller.sources.contacts import Change, Contact, ContactKey
from registry import threads

_MAX_MESSAGE = 1000  # characters

_logger = logging.getLogger(__name__)


class EventPublisher:
    """Keeps the current state of the plate and publishes every change at `hub`.

    operation: of the plate; amplifiers: their statuses; layouts: of the surface; inputs: state of
    the touch inputs; learning: what learns the plate, None where nothing is to be learned; noted:
    called with a record of each change of contacts and each decision.
    """

    def __init__(
        self,
        *,
        operation: Callable[[], Operation],
        amplifiers: Callable[[], list[AmplifierStatus]],
        layouts: LayoutChoice,
        inputs: Callable[[], InputsEvent],
        learning: Callable[[], Learning | None],
        noted: Callable[[Mapping[str, object]], object],
    ) -> None:
        self.view = PlateView(layouts.player.effect_of, why_not=self._why_not)
        self._player = layouts.player
        self.latencies = LatencyStatistics()  # of touches alone
        self.lift_latencies = LatencyStatistics()
        self.learning_latencies = LatencyStatistics()
        self._learning = learning
        self._noted = noted
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
                "plate": self._plate_event,
                "inputs": inputs,
                "strength": self.strengths,
            },
            clock=threads.now,
        )

    def observe(self, loop: Observers) -> None:
        """Publish what the control loop reports."""
        loop.contacts_changed.append(self._contacts_changed)
        loop.pattern_applied.append(partial(self._reported, "pattern"))
        loop.silenced.append(partial(self._reported, "silence"))
        loop.refused.append(self._refused)

    def state_changed(self, old: Operation, new: Operation) -> None:
        """Publish a transition; outside OPERATION_ENABLED nothing plays, because of the state."""
        self.hub.publish("state", lambda: _state_event(old, new))
        if new.state is DaemonState.OPERATION_ENABLED:
            return
        # The control loop does not report the end of what others have silenced.
        was_playing, self.view.report = self.view.applied is not None, None
        if was_playing:
            silence = SilenceEvent(
                contacts=self.view.contact_statuses(),
                reason=new.cause,
                latency_ms=None,
            )
            self.hub.publish("silence", lambda: silence)

    def _why_not(self, key: ContactKey) -> str:
        """Why a contact feels nothing of its own that the control loop has not reported."""
        operation = self._operation()
        if operation.state is not DaemonState.OPERATION_ENABLED:
            return f"{STATE_WORDS[operation.state]}: {operation.next_step or operation.cause}"
        if operation.degraded:
            return f"{operation.cause}; {operation.remedy}"
        return self._player.why_not(key)

    def plate_changed(self, status: LearningStatus) -> None:
        """Publish what has happened to the plate, or to learning it."""
        self.hub.publish("plate", lambda: plate_event(status))

    def link_changed(self, change: LinkChange, lost: Sequence[str], message: str) -> None:
        """Publish that the link to amplifiers was degraded, lost, retried or opened again."""
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
        """Publish a log record from any thread, unless it is marked with another topic."""
        if hasattr(record, "topic"):
            return
        event = {
            "level": "error" if record.levelno >= logging.ERROR else record.levelname.lower(),
            # file names may contain bytes that are not valid text
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
        """The strengths of all touch sources, clients and regions that are known."""
        known, inputs = self._player.strengths, [each.name for each in self.inputs().inputs]
        clients = [name for _, name in known.clients() if not UNNAMED.fullmatch(name)]
        regions = [each.name for each in self._player.layout.regions]
        names = sorted({*inputs, *known.sources, *clients, *regions})
        return StrengthResult(strengths={**dict.fromkeys(names, 0.0), **known.gains_db})

    def learning_summary(self) -> LearningSummary | None:
        """What is learned of the plate; None where nothing is to be."""
        learning = self._learning()
        if learning is None:
            return None
        at = learning.estimated_at
        return LearningSummary(
            **learning.status.model_dump(),
            last_estimate_s=None if at is None else max(0.0, threads.now() - at),
            latency_ms=self.learning_latencies.summary(),
        )

    def _plate_event(self) -> PlateEvent | None:
        learning = self._learning()
        return None if learning is None else plate_event(learning.status)

    def _refused(self, reason: str) -> None:
        self._noted({"time_s": threads.now(), "refused": reason})
        _logger.warning("refused: %s", reason)

    def _contacts_changed(self, contacts: tuple[Contact, ...], change: Change) -> None:
        self.view.contacts = contacts
        self._noted({"time_s": threads.now(), "contacts": contacts})
        self.hub.publish("contacts", self.view.contacts_event)

    def _reported(
        self, topic: Literal["pattern", "silence"], report: PlayReport | SilenceReport
    ) -> None:
        """Publish what plays, or silence; count its latency as one of touches, or of the rest."""
        self.view.report = report
        why = report.reason if isinstance(report, SilenceReport) else ""
        self._noted({"time_s": report.time, topic: report.targets, "reason": why})
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


BUCKETS_MS = (0.25, 0.5, 0.75, 1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 7.5, 10.0, 15.0, 20.0, 50.0, 100.0)
_WINDOW = 10_000


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
            # inverted_cdf returns a value that occurred
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
