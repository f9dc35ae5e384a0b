"""API messages about the state of the daemon and its features.

`EventPublisher` keeps the latest reports and sends every change to the subscribers of its topic.
`hello_result` and `effects_result` describe the features available to a client.
`LatencyStatistics` summarizes the latencies of touches.
"""

import asyncio
import contextlib
import logging
from bisect import bisect_left
from collections.abc import Mapping, Sequence
from functools import partial
from importlib.metadata import version

import numpy as np

from controller.api.hub import Hub
from controller.api.methods import (
    AmplifiersEvent,
    EffectsResult,
    HelloResult,
    InputsEvent,
    LatencyEvent,
    LinkEvent,
    LogEvent,
    SilenceEvent,
    StateEvent,
    StrengthResult,
)
from controller.api.schema import (
    API_VERSION,
    STATE_WORDS,
    AmplifierStatus,
    EffectDescription,
    EraPosition,
    LatencySummary,
    RigSummary,
    TableSummary,
)
from controller.daemon.amplifier_messages import amplifier_statuses
from controller.daemon.config import DaemonConfig
from controller.daemon.layouts import LayoutChoice, TouchInputs
from controller.daemon.plate_view import PlateView
from controller.effects.layout import SurfaceLayout
from controller.effects.strengths import UNNAMED
from controller.operation.operation_states import DaemonState, Operation
from controller.operation.reopening import LinkChange
from controller.operation.supervisor import Supervisor
from controller.play.reports import PlayReport
from controller.sources.touch import Change, Contact, ContactKey
from drivers.host.amplifier import Amplifier
from drivers.protocol.definition import READINGS
from model.table.table import LocalizationTable
from registry import threads

_MAX_MESSAGE = 1000
"""Longest message of a log record that is sent [characters]."""

BUCKETS_MS = (0.25, 0.5, 0.75, 1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 7.5, 10.0, 15.0, 20.0, 50.0, 100.0)
"""Upper edges of the histogram of latencies [ms]."""
_WINDOW = 10_000  # latencies used for the percentiles

_logger = logging.getLogger(__name__)


class EventPublisher:
    """Keeps the state of the plate up to date and sends every change to subscribed clients.

    It observes the supervisor, the control loop, the surface layouts and the touch inputs.
    """

    def __init__(
        self, supervisor: Supervisor, *, layouts: LayoutChoice, touch_inputs: TouchInputs
    ) -> None:
        self.view = PlateView(layouts.player.effect_of, why_not=self._why_not)
        self._supervisor = supervisor
        self._layouts = layouts
        self._touch_inputs = touch_inputs
        self._player = layouts.player
        self.latencies = LatencyStatistics()  # touches only
        self.lift_latencies = LatencyStatistics()
        self._last_link_message = ""
        self._loop = asyncio.get_running_loop()
        self.hub = Hub(
            {
                "state": self._state_event,
                "contacts": self.view.contacts_event,
                "pattern": self.view.pattern_event,
                "silence": self.view.silence_event,
                "amplifiers": lambda: AmplifiersEvent(amplifiers=self.amplifiers()),
                "latency": lambda: LatencyEvent(latency_ms=self.latencies.summary()),
                "layout": layouts.event,
                "inputs": self.inputs,
                "strength": self.strengths,
            },
            clock=threads.now,
        )

        supervisor.current.observers.append(self._state_changed)
        supervisor.link_observers.append(self._link_changed)
        loop = supervisor.controller.cycle.observers
        loop.contacts_changed.append(self._contacts_changed)
        loop.reported.append(self._reported)
        loop.refused.append(self._refused)
        layouts.observers.append(self._layout_changed)
        touch_inputs.observers.append(self._inputs_changed)

    def amplifiers(self) -> list[AmplifierStatus]:
        """Describe all amplifiers from their last statuses."""
        controller = self._supervisor.controller
        return amplifier_statuses(
            controller.amplifiers,
            controller.urls,
            are_open=controller.group.is_open,
            lost=self._supervisor.operation.lost,
            what_may_play=self._supervisor.reopening.what_may_play,
            clock_errors=controller.group.clock_errors,
            targets=self.view.targets,
        )

    def inputs(self) -> InputsEvent:
        """Return the state of the touch inputs."""
        return self._touch_inputs.event

    def _state_event(self) -> StateEvent:
        operation = self._supervisor.operation
        return _transition_event(operation, operation)

    def _layout_changed(self) -> None:
        self.hub.publish("layout", self._layouts.event)

    def _inputs_changed(self) -> None:
        self.hub.publish("inputs", self.inputs)

    def _state_changed(self, old: Operation, new: Operation) -> None:
        """Publish a transition of the daemon, and the resulting silence.

        Nothing plays outside OPERATION_ENABLED. The control loop does not report silence that
        another part of the daemon has caused.
        """
        self.hub.publish("state", lambda: _transition_event(old, new))
        if new.state is DaemonState.OPERATION_ENABLED:
            return
        was_playing = self.view.applied is not None
        self.view.report = None
        if was_playing:
            contacts = self.view.contact_statuses()
            silence = SilenceEvent(contacts=contacts, reason=new.cause, latency_ms=None)
            self.hub.publish("silence", lambda: silence)

    def _why_not(self, key: ContactKey) -> str:
        """Return why a contact feels no effect of its own, if the loop has not reported it."""
        operation = self._supervisor.operation
        if operation.state is not DaemonState.OPERATION_ENABLED:
            return f"{STATE_WORDS[operation.state]}: {operation.next_step or operation.cause}"
        if operation.degraded:
            return f"{operation.cause}; {operation.remedy}"
        return self._player.why_not(key)

    def _link_changed(self, change: LinkChange, lost: Sequence[str], message: str) -> None:
        """Publish that the link to amplifiers was degraded, restored, lost, retried or reopened."""
        if change == "retry" and message != self._last_link_message:
            _logger.warning("link: retrying: %s", message, extra={"topic": "link"})
        self._last_link_message = message
        remedy = self._supervisor.operation.remedy
        event = LinkEvent(
            event=change,
            amplifier=lost[0] if len(lost) == 1 else None,
            message=message,
            remedy=None if change in ("restored", "reopened") else remedy,
        )
        self.hub.publish("link", lambda: event)

    def logged(self, record: logging.LogRecord) -> None:
        """Publish a log record, from any thread.

        A record marked with a topic is left out, because an event of that topic reports it.
        """
        if hasattr(record, "topic"):
            return
        level = record.levelname.lower()
        if record.levelno >= logging.ERROR:
            level = "error"
        message = record.getMessage()[:_MAX_MESSAGE]
        # File names can contain bytes that are not valid text.
        valid_message = message.encode(errors="backslashreplace").decode()
        event = {
            "level": level,
            "message": valid_message,
            "cause": getattr(record, "cause", None),
            "remedy": getattr(record, "remedy", None),
        }
        make = partial(LogEvent.model_validate, event)
        with contextlib.suppress(RuntimeError):  # the loop may be closed
            self._loop.call_soon_threadsafe(self.hub.publish, "log", make)

    def strengths(self) -> StrengthResult:
        """Return the strengths of all known touch sources, clients and regions."""
        strengths = self._player.strengths
        names = set(strengths.sources)
        for touch_input in self.inputs().inputs:
            names.add(touch_input.name)
        for _, client in strengths.clients:
            if not UNNAMED.fullmatch(client):
                names.add(client)
        for region in self._player.layout.regions:
            names.add(region.name)
        default_gains = dict.fromkeys(sorted(names), 0.0)
        return StrengthResult(strengths={**default_gains, **strengths.gains_db})

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
        if report.latency is not None:
            latencies = self.latencies if report.is_touch else self.lift_latencies
            latencies.add(report.latency)
        if report.contents:
            self.hub.publish("pattern", self.view.pattern_event)
        else:
            self.hub.publish("silence", self.view.silence_event)


def _transition_event(old: Operation, new: Operation) -> StateEvent:
    return StateEvent(
        old=old.state.value,
        new=new.state.value,
        cause=new.cause,
        remedy=new.remedy,
        epoch=new.epoch,
    )


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
    eras = []
    for era in rig.eras:
        channel = rig.wiring[era.name]
        eras.append(
            EraPosition(
                name=era.name,
                x_m=era.x,
                y_m=era.y,
                amplifier=channel.amplifier,
                channel=channel.number,
            )
        )
    products = [amplifier.identity.get("product", "") for amplifier in amplifiers.values()]
    readings = {}
    for reading in READINGS:
        if "page" in reading.views:
            label = reading.label.capitalize()
            readings[reading.key] = (label, reading.quantity.unit, reading.decimals)
    return HelloResult(
        api_version=API_VERSION,
        software_version=version("era-haptics"),
        rig=RigSummary(
            length_m=rig.plate.length,
            width_m=rig.plate.width,
            eras=eras,
            simulated=any("simulated" in product for product in products),
            frequency_hz=[rig.limits.frequency_min, rig.limits.frequency_max],
        ),
        table=TableSummary(
            fingerprint=table.fingerprint,
            mode=drive_mode,
            frequencies_hz=table.frequencies.tolist(),
            cells_x=table.grid.nx,
            cells_y=table.grid.ny,
        ),
        rig_text=config.rig_text,
        layout=layout,
        readings=readings,
    )


def effects_result(layout: SurfaceLayout) -> EffectsResult:
    """Describe the effects of a layout that can be requested by name."""
    descriptions = []
    for name, effect in sorted(layout.effects.items()):
        summary, _, _ = (type(effect).__doc__ or "").partition("\n")
        descriptions.append(
            EffectDescription(
                name=name,
                kind=effect.kind,
                description=summary,
                parameters=effect.model_dump(mode="json"),
            )
        )
    return EffectsResult(effects=descriptions)


class LatencyStatistics:
    """Accumulates latencies [s]."""

    def __init__(self) -> None:
        self._counts = [0] * len(BUCKETS_MS)
        self._recent_ms = np.zeros(_WINDOW)
        self._count = 0

    def add(self, latency: float) -> None:
        """Add one latency [s]."""
        milliseconds = 1e3 * latency
        bucket = bisect_left(BUCKETS_MS, milliseconds)
        self._counts[min(bucket, len(BUCKETS_MS) - 1)] += 1
        self._recent_ms[self._count % _WINDOW] = milliseconds
        self._count += 1

    def summary(self) -> LatencySummary:
        """Return count, percentiles [ms] and histogram."""
        quantiles: list[float | None] = [None, None, None]
        if self._count:
            recent = self._recent_ms[: self._count]
            # inverted_cdf returns a measured value
            measured = np.quantile(recent, [0.5, 0.99, 0.999], method="inverted_cdf")
            quantiles = measured.tolist()
        median, p99, p999 = quantiles
        return LatencySummary(
            count=self._count,
            median=median,
            p99=p99,
            p999=p999,
            histogram=list(zip(BUCKETS_MS, self._counts, strict=True)),
        )
