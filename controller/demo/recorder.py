"""Recording of the demonstration: a row for every touch on the simulated plate.

`TouchRecorder` observes the control loop, measures the vibration of each pattern, and makes a
`TouchRow` of each touch.
"""

import asyncio
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import TypeAlias

from controller.demo.simulated_plate import FingerVibration, SimulatedPlate
from controller.demo.touch_rows import TouchRow, position_of, sensor_id, with_values
from controller.play.reports import Observers, PlayReport
from controller.sources.touch import Change, Contact, ContactKey
from model.answer.answer import HELD_BACK
from model.arrays import Point
from model.quantities import counted
from registry import threads
from registry.virtual_time import VirtualTimeLoop

STEADY_WINDOW = 0.25
"""Time [s] over which a pattern is measured: settled, and it separates tones 10 Hz apart.

It is the end of the longest time in which no finger lands, moves or lifts.
"""

_MARGIN = 0.005
"""Time [s] from the last byte on the wire to the plate, and before the next command."""

STEADY_DURATION = 0.4
"""Shortest pattern [s] that counts as steady; the plate rings for 50 ms to 1 s."""

_MAX_DELAY = STEADY_DURATION - STEADY_WINDOW
"""Delay [s] of a pattern or of a finger's sensor from which a steady window may contain it."""

Measured: TypeAlias = asyncio.Task[dict[str, FingerVibration]]

_NOT_THE_TARGET = "another finger came down at the same moment and was the target"

MIN_MOVEMENT = 0.001
"""Movement [m] below which a finger's sensor stays in place, so that its window is not broken."""


@dataclass(eq=False)
class _Touch:
    """A touch and the patterns that were played for it."""

    contact: Contact
    quiet: Mapping[str, Point]
    until: float = math.inf
    patterns: list["_PlayedPattern"] = field(default_factory=list)
    reason: str | None = None


@dataclass(eq=False)
class _PlayedPattern:
    """A pattern from its commit to the next command [s], with its measurements."""

    applied: PlayReport
    touches: Sequence[_Touch]
    """Touches that feel a content."""
    until: float = math.inf
    steady: Measured | None = None
    """Vibration by finger over the longest time in which no finger moved."""

    @property
    def duration(self) -> float:
        return self.until - self.applied.time


class TouchRecorder:
    """Collects a row per touch: pass `observe` to the daemon.

    tasks: group of the tasks that measure and make rows; once it has ended, all rows are made.
    on_row: called with each row once the touch was lifted and its pattern measured.
    Times of rows count from `start`.
    """

    def __init__(
        self,
        plate: SimulatedPlate,
        tasks: asyncio.TaskGroup,
        *,
        on_row: Callable[[TouchRow], None],
    ) -> None:
        self.rows: list[TouchRow] = []
        self.touches: dict[ContactKey, _Touch] = {}
        """Current touches."""
        self.rejected_sets = 0
        """Number of sets that an amplifier or its ledger has rejected."""
        self.worst_delay = 0.0
        """Longest time [s] from a touch to its pattern, or for the plate's sensors to follow."""
        self._plate = plate
        self._tasks = tasks
        self._on_row = on_row
        self._start = threads.now()
        self._playing: _PlayedPattern | None = None
        self._changes: list[float] = []  # s; when fingers landed, moved or lifted
        self._sensors: dict[str, Point] = {}  # positions [m] on the plate, by id
        self._loads: dict[str, float] = {}  # by id

    def observe(self, loop: Observers) -> None:
        """Observe the reports of the control loop."""
        loop.contacts_changed.append(self._contacts_changed)
        loop.reported.append(self._reported)
        loop.refused.append(self._set_rejected)

    def why_void(self) -> str | None:
        """Return why a real-time run is void; None if it is valid."""
        if self.worst_delay > _MAX_DELAY:
            delay_ms = 1000 * self.worst_delay
            return f"a reaction took {delay_ms:.0f} ms, more than {1000 * _MAX_DELAY:.0f} ms"
        if self.rejected_sets:
            return f"amplifiers rejected {counted(self.rejected_sets, 'set')}"
        return None

    def start(self) -> None:
        """Set the start of the recording to now."""
        self._start = threads.now()

    def _contacts_changed(self, contacts: tuple[Contact, ...], change: Change) -> None:
        self._move_sensors(contacts)
        if change.down or change.up:
            self._changes.append(threads.now())
        for contact in change.down:
            quiet = {}
            for other_contact in contacts:
                if other_contact != contact:
                    quiet[sensor_id(other_contact)] = position_of(other_contact)
            self.touches[contact.key] = _Touch(contact, quiet)
        for contact in change.up:
            touch = self.touches.pop(contact.key)
            touch.contact = contact
            touch.until = threads.now()
            self._complete(touch)

    def _reported(self, applied: PlayReport) -> None:
        self._end_pattern(applied.time)
        if applied.contents:
            for touch in self.touches.values():
                touch.reason = touch.reason or _NOT_THE_TARGET
        touches = []
        for felt in applied.targets:
            feeling_touch = self.touches.get(felt.contact.key)
            if feeling_touch is None:
                continue  # lifted meanwhile
            if felt.sensation.verdict == HELD_BACK:
                feeling_touch.reason = applied.reason or felt.held_back
            else:
                touches.append(feeling_touch)
        if not touches:
            return
        pattern = _PlayedPattern(applied, touches)
        self._playing = pattern
        self._note_delay(applied.latency or 0.0)
        for touch in touches:
            touch.patterns.append(pattern)

    def _end_pattern(self, now: float) -> None:
        """Close the playing pattern and measure its end."""
        pattern = self._playing
        if pattern is None:
            return
        self._playing = None
        pattern.until = now
        # The report comes with the reply to the next command, some time after the fingers changed.
        settled_at = pattern.applied.time + pattern.applied.layer.ramp
        self._changes = [change for change in self._changes if settled_at < change < now]
        intervals = pairwise([settled_at, *self._changes, now])
        start, end = max(intervals, key=lambda interval: interval[1] - interval[0])
        since = max(start, end - STEADY_WINDOW) + _MARGIN
        until = end - _MARGIN
        if since < until:
            pattern.steady = self._tasks.create_task(self._plate.vibration(since, until))
        for touch in pattern.touches:
            self._complete(touch)

    def _complete(self, touch: _Touch) -> None:
        """Make the row of a touch once it is lifted and nothing plays for it."""
        is_playing = self._playing is not None and touch in self._playing.touches
        if touch.until < math.inf and not is_playing:
            self._tasks.create_task(self._add_row(touch))

    def _move_sensors(self, contacts: tuple[Contact, ...]) -> None:
        """Make the plate's sensors follow the fingers."""
        sensors: dict[str, Point] = {}
        loads: dict[str, float] = {}
        has_moved = False
        for contact in contacts:
            id = sensor_id(contact)
            loads[id] = contact.load
            sensors[id] = position_of(contact)
            last_position = self._sensors.get(id)
            if last_position is None:
                continue
            if math.dist(last_position, sensors[id]) < MIN_MOVEMENT:
                sensors[id] = last_position
            else:
                has_moved = True
        if has_moved:
            self._changes.append(threads.now())
        if sensors != self._sensors or loads != self._loads:
            self._sensors, self._loads = sensors, loads
            self._tasks.create_task(self._place_sensors(sensors, loads))

    async def _place_sensors(
        self, sensors: Mapping[str, Point], loads: Mapping[str, float]
    ) -> None:
        """Place the plate's sensors and note how long that took."""
        started_at = threads.now()
        await self._plate.place_fingers(sensors, loads)
        self._note_delay(threads.now() - started_at)

    def _note_delay(self, delay: float) -> None:
        self.worst_delay = max(self.worst_delay, delay)

    def _set_rejected(self, reason: str) -> None:
        self.rejected_sets += 1

    async def _add_row(self, touch: _Touch) -> None:
        """Make the row of a lifted touch."""
        contact = touch.contact
        row = TouchRow(
            target_id=sensor_id(contact),
            time_s=contact.since - self._start,
            until_s=touch.until - self._start,
            targets_m=[position_of(contact)],
            quiet=touch.quiet,
            reason=touch.reason or "no vibration was confirmed before it lifted",
        )
        if touch.patterns:
            row = await _with_pattern(row, touch)
        self.rows.append(row)
        self._on_row(row)


async def _with_pattern(row: TouchRow, touch: _Touch) -> TouchRow:
    """Complete a row with the touch's last steady pattern with the most contents.

    If none of these is steady, the longest one is used. All
    fingers of a pattern use the same pattern, so that their rows refer to the same moment. The
    latency is measured for the touch's first pattern.
    """
    pattern = max(touch.patterns, key=_significance)
    latency = touch.patterns[0].applied.latency
    if isinstance(asyncio.get_running_loop(), VirtualTimeLoop):
        latency = None
    vibration: Mapping[str, FingerVibration] = {}
    if pattern.steady is not None:
        vibration = await pattern.steady
    row = replace(
        row,
        reason=None,
        latency_ms=None if latency is None else 1000 * latency,
        played_s=pattern.duration,
        steady=pattern.duration >= STEADY_DURATION,
    )
    return with_values(row, pattern.applied, touch.contact.key, vibration)


def _significance(pattern: _PlayedPattern) -> tuple[int, float, float]:
    """Order of patterns: by contents, then by steadiness, then by time."""
    report = pattern.applied
    return len(report.contents), min(pattern.duration, STEADY_DURATION), report.time
