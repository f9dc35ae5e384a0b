"""Observes the control loop and the simulated plate, and makes a row of every touch."""

import asyncio
import math
from collections.abc import Callable, Coroutine, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from controller.demo.far_end import SimulatedPlate
from controller.demo.touch_row import (
    FingerVibration,
    Position,
    TouchRow,
    felt_contrast_db,
    peak_contrast_db,
    steady_contrast_db,
)
from controller.loop.observer import Applied, Observer, Silenced
from controller.loop.selection import Prediction
from controller.sources.contacts import Change, Contact, ContactKey
from drivers import clock
from drivers.errors import LinkError
from model.transients.measures import ONSET_WINDOW

STEADY_WINDOW = 0.25
"""Length [s] of the measured end of a pattern: settled, and it separates tones 10 Hz apart."""

MARGIN = 0.005
"""Time [s] from the last byte on the wire to the plate, and before the next command."""

RESPONSE = 0.5
"""Longest time [s] on a busy machine from a change of fingers to the reply to what it led to."""

STEADY_DURATION = 0.4
"""Shortest pattern [s] that counts as steady; the plate rings for 50 ms to 1 s."""

_NOT_THE_TARGET = "another finger came down at the same moment and was the target"

MIN_MOVEMENT = 0.001
"""Movement [m] below which a finger's sensor stays in place, so that its window is not broken."""


@dataclass
class _Touch:
    """A touch and the patterns that were played for it."""

    contact: Contact
    quiet: Mapping[str, Position]
    until: float = math.inf
    patterns: list["_Playing"] = field(default_factory=list)
    reason: str | None = None


@dataclass
class _Playing:
    """A pattern from its commit to the next command [s], with its measurements.

    touches: its targets; steady, onset: vibration by finger over its end and its first 100 ms.
    """

    applied: Applied
    touches: list[_Touch]
    until: float = math.inf
    steady: asyncio.Task[dict[str, FingerVibration]] | None = None
    onset: asyncio.Task[dict[str, FingerVibration]] | None = None

    @property
    def duration(self) -> float:
        return self.until - self.applied.time


class TouchRecorder:
    """Collects a row per touch: pass `observer` to the controller and await `finish` at the end.

    Times of rows count from `start`. on_row is called with each row once the touch was lifted and
    its pattern measured.
    """

    def __init__(self, plate: SimulatedPlate, *, on_row: Callable[[TouchRow], None]) -> None:
        self.rows: list[TouchRow] = []
        self._errors: list[str] = []
        self._plate = plate
        self._on_row = on_row
        self._start = clock.now()
        self._touches: dict[ContactKey, _Touch] = {}
        self._playing: _Playing | None = None
        self._changed_at = -math.inf  # when a finger landed or lifted last
        self._sensors: dict[str, Position] = {}
        self._loads: dict[str, float] = {}
        self._tasks: set[asyncio.Task[Any]] = set()
        self._lifted = asyncio.Event()
        self._lifted.set()

    @property
    def observer(self) -> Observer:
        """The callbacks for the control loop."""
        return Observer(
            contacts_changed=self._contacts_changed,
            pattern_applied=self._pattern_applied,
            silenced=self._silenced,
            refused=self._failed,
            link_lost=self._failed,
            source_failed=self._failed,
        )

    async def all_lifted(self) -> None:
        """Wait until no finger is on the plate."""
        await self._lifted.wait()

    def start(self) -> None:
        """Set the start of the recording to now."""
        self._start = clock.now()

    def recovered(self) -> None:
        """Note that the amplifiers are armed again: errors so far do not abort the demonstration.

        The touches that they have spoiled say so.
        """
        self._errors.clear()

    async def finish(self) -> None:
        """Wait for the rows of all lifted touches; raises LinkError with the first error."""
        while self._tasks:
            await asyncio.wait(self._tasks)
        if self._errors:
            raise LinkError(f"demonstration aborted: {self._errors[0]}")
        self.rows.sort(key=lambda row: row.time_s)

    def _contacts_changed(self, contacts: tuple[Contact, ...], change: Change) -> None:
        self._move_sensors(contacts)
        if change.down or change.up:
            self._changed_at = clock.now()
        for contact in change.down:
            others = {_id(other): (other.x, other.y) for other in contacts if other != contact}
            touch = self._touches[contact.key] = _Touch(contact, others)
            if self._errors:
                touch.reason = _cause(self._errors[0])
        if contacts:
            self._lifted.clear()
        else:
            self._lifted.set()
        for contact in change.up:
            touch = self._touches.pop(contact.key)
            touch.until = clock.now()
            if self._playing is None or touch not in self._playing.touches:
                self._run(self._add_row(touch))

    def _pattern_applied(self, applied: Applied) -> None:
        self._end_pattern(applied.time)
        found = (self._touches.get(felt.contact.key) for felt in applied.targets)
        self._playing = _Playing(applied, [touch for touch in found if touch is not None])
        for touch in self._playing.touches:
            touch.patterns.append(self._playing)
        for touch in self._touches.values():
            touch.reason = touch.reason or _NOT_THE_TARGET
        if applied.from_rest and applied.quiet:
            self._playing.onset = self._run(self._measure_onset(self._playing))

    def _silenced(self, silenced: Silenced) -> None:
        self._end_pattern(silenced.time)
        for contact in silenced.targets:
            if touch := self._touches.get(contact.key):
                touch.reason = silenced.reason

    def _failed(self, error: str) -> None:
        since = -math.inf if self._playing is None else self._playing.applied.time
        self._end_pattern(clock.now())
        self._errors.append(error)
        for touch in self._touches.values():
            if touch.contact.since > since:
                touch.reason = _cause(self._errors[0])

    def _end_pattern(self, now: float) -> None:
        """Close the playing pattern and measure its end."""
        ended, self._playing = self._playing, None
        if ended is None:
            return
        ended.until = now
        settled = ended.applied.time + ended.applied.pattern.ramp
        # Its end is reported with the reply to what ended it: a finger that lifted is the end.
        end = self._changed_at if now - RESPONSE < self._changed_at < now else now
        since, until = max(settled, end - STEADY_WINDOW) + MARGIN, end - MARGIN
        if since < until:
            ended.steady = self._run(self._plate.vibration(since, until))
        for touch in ended.touches:
            if touch.until < math.inf:
                self._run(self._add_row(touch))

    async def _measure_onset(self, playing: _Playing) -> dict[str, FingerVibration]:
        """Vibration over the first 100 ms of a pattern; empty if it ended earlier."""
        since = playing.applied.time
        await asyncio.sleep(max(0.0, since + ONSET_WINDOW + MARGIN - clock.now()))
        if playing.until < since + ONSET_WINDOW:
            return {}
        return await self._plate.vibration(since, since + ONSET_WINDOW)

    def _move_sensors(self, contacts: tuple[Contact, ...]) -> None:
        """Make the plate's sensors follow the fingers."""
        sensors = {}
        for contact in contacts:
            position = (contact.x, contact.y)
            before = self._sensors.get(_id(contact), (math.inf, math.inf))
            is_at_rest = math.dist(before, position) < MIN_MOVEMENT
            sensors[_id(contact)] = before if is_at_rest else position
        loads = {_id(contact): contact.load for contact in contacts}
        if sensors != self._sensors or loads != self._loads:
            self._sensors, self._loads = sensors, loads
            self._run(self._plate.place_fingers(sensors, loads))

    async def _add_row(self, touch: _Touch) -> None:
        """Make the row of a lifted touch from the pattern that played longest for it."""
        contact = touch.contact
        row = TouchRow(
            target_id=_id(contact),
            time_s=contact.since - self._start,
            until_s=touch.until - self._start,
            targets_m=[(contact.x, contact.y)],
            quiet=touch.quiet,
            reason=touch.reason or "no vibration was confirmed before it lifted",
        )
        if touch.patterns:
            row = await _played(touch, row)
        self.rows.append(row)
        self._on_row(row)

    def _run(self, work: Coroutine[Any, Any, Any]) -> asyncio.Task[Any]:
        task = asyncio.create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._task_done)
        return task

    def _task_done(self, task: asyncio.Task[Any]) -> None:
        self._tasks.discard(task)
        if not task.cancelled() and (error := task.exception()) is not None:
            self._errors.append(str(error))


async def _played(touch: _Touch, row: TouchRow) -> TouchRow:
    """The row with the longest pattern of a touch; latency and onset are of its first one."""
    main_part = max(touch.patterns, key=lambda playing: playing.duration)
    first, applied = touch.patterns[0], main_part.applied
    predicted = _prediction(touch, main_part)
    vibration = await main_part.steady if main_part.steady else {}
    target, quiet = _fingers(vibration, predicted.contact, applied)
    onset = await first.onset if first.onset else {}
    onset_target, onset_quiet = _fingers(onset, touch.contact, first.applied)
    contacts = [each.contact for each in applied.targets if each is not predicted]
    return replace(
        row,
        reason=None,
        target_id=_id(predicted.contact),
        targets_m=[(each.x, each.y) for each in (predicted.contact, *contacts)],
        quiet={_id(other): (other.x, other.y) for other in applied.quiet},
        drive={
            era: {"frequency_hz": each.frequency, "level": each.level, "phase_deg": each.phase}
            for era, each in applied.drive.items()
        },
        mode=applied.pattern.drive_mode,
        shaped_onset=bool(first.applied.pattern.onset),
        latency_ms=1000 * first.applied.latency,
        played_s=main_part.duration,
        steady=main_part.duration >= STEADY_DURATION,
        predicted_felt_contrast_db=applied.pattern.felt_contrast_db,
        robust_felt_contrast_db=applied.pattern.robust_felt_contrast_db,
        measured_felt_contrast_db=felt_contrast_db(target, quiet) if target else None,
        predicted_contrast_db=predicted.contrast_db,
        robust_contrast_db=applied.pattern.robust_contrast_db,
        measured_contrast_db=steady_contrast_db(target, quiet) if target else None,
        predicted_transient_contrast_db=first.applied.transient_contrast_db,
        measured_transient_contrast_db=(
            peak_contrast_db(onset_target, onset_quiet) if onset_target and onset_quiet else None
        ),
        predicted_level_db_sl=predicted.level_db_sl,
        measured_level_db_sl=target.level_db_sl if target else None,
        pattern=applied.pattern,
        levels_db_sl={id: finger.level_db_sl for id, finger in vibration.items()},
    )


def _fingers(
    vibration: Mapping[str, FingerVibration], contact: Contact, applied: Applied
) -> tuple[FingerVibration | None, list[FingerVibration]]:
    """Vibration of a target and of the quiet fingers; no target unless all were measured."""
    target = vibration.get(_id(contact))
    quiet = [vibration[_id(each)] for each in applied.quiet if _id(each) in vibration]
    is_complete = (
        target is not None and len(target.frequencies) and len(quiet) == len(applied.quiet)
    )
    return (target, quiet) if is_complete else (None, [])


def _prediction(touch: _Touch, playing: _Playing) -> Prediction:
    """Prediction for a touch under a pattern that played for it."""
    return next(felt for felt in playing.applied.targets if felt.contact.key == touch.contact.key)


def _cause(error: str) -> str:
    """What an error states, without its remedy."""
    return error.partition("; ")[0]


def _id(contact: Contact) -> str:
    """The id of a contact's sensor on the plate."""
    return f"{contact.key.source}#{contact.key.id}"
