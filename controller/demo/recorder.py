"""Watches the control loop and the simulated plate, and makes a row of every touch."""

import asyncio
import math
from collections.abc import Callable, Coroutine, Mapping
from dataclasses import dataclass, field
from typing import Any

from controller.demo.far_end import BenchControl, FingerFelt
from controller.demo.measure import finger_level, measure, peak_contrast_db
from controller.demo.rows import Onset, Place, PlayedPattern, TouchRow
from controller.loop.observer import Applied, Observer, Silenced
from controller.loop.selection import Prediction
from controller.sources.contacts import Change, Contact, ContactKey
from drivers import clock
from drivers.errors import LinkError
from model.transients.measures import FIRST

# The last part of a pattern is judged: by then the plate has settled, if the pattern was held long
# enough, and a quarter of a second tells frequencies 10 Hz apart from each other.
WINDOW = 0.25
# From the last byte on the wire to the plate, and before the next command.
MARGIN = 0.005
# A finger that moves less than this [m] stays in one place for the plate's sensors; a trembling one
# would never be measured otherwise.
TREMBLE = 0.001


@dataclass
class _Touch:
    """A touch, with every pattern that was played for it."""

    contact: Contact
    quiet: Mapping[str, Place]
    until: float = math.inf
    patterns: list["_Playing"] = field(default_factory=list)
    reason: str = "another finger came down at the same moment and was the target"

    @property
    def is_lifted(self) -> bool:
        return self.until < math.inf


@dataclass
class _Playing:
    """A pattern from its commit to the next command [s], and what was felt meanwhile.

    touches: the targets that are still known; onset: what was felt in its first 100 ms.
    """

    applied: Applied
    touches: list[_Touch]
    until: float = math.inf
    felt: asyncio.Task[dict[str, FingerFelt]] | None = None
    onset: asyncio.Task[dict[str, FingerFelt]] | None = None

    @property
    def duration(self) -> float:
        return self.until - self.applied.time


class TouchRecorder:
    """Collects a row per touch: hand `observer` to the controller, await `finish` at the end.

    Times of rows count from `begin`. on_row is called with every row as soon as the touch was
    lifted and its pattern measured.
    """

    def __init__(self, bench: BenchControl, *, on_row: Callable[[TouchRow], None]) -> None:
        self.rows: list[TouchRow] = []
        self._problems: list[str] = []
        self._bench = bench
        self._on_row = on_row
        self._start = clock.now()
        self._touches: dict[ContactKey, _Touch] = {}
        self._playing: _Playing | None = None
        self._resting: dict[str, Place] = {}
        self._tasks: set[asyncio.Task[Any]] = set()

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

    def begin(self) -> None:
        """Say that the recorded touches begin to come."""
        self._start = clock.now()

    async def finish(self) -> None:
        """Wait until every touch that was lifted has its row.

        Raises LinkError where something went wrong meanwhile, with what was first.
        """
        while self._tasks:
            await asyncio.wait(self._tasks)
        if self._problems:
            raise LinkError(f"the demonstration did not run through: {self._problems[0]}")
        self.rows.sort(key=lambda row: row.time)

    def _contacts_changed(self, contacts: tuple[Contact, ...], change: Change) -> None:
        self._rest(contacts)
        for contact in change.down:
            others = [other for other in contacts if other.key != contact.key]
            self._touches[contact.key] = _Touch(contact, {_id(o): (o.x, o.y) for o in others})
        for contact in change.up:
            touch = self._touches.pop(contact.key)
            touch.until = clock.now()
            if self._playing is None or touch not in self._playing.touches:
                self._run(self._complete(touch))

    def _pattern_applied(self, applied: Applied) -> None:
        self._end_pattern(applied.time)
        found = (self._touches.get(felt.contact.key) for felt in applied.targets)
        self._playing = _Playing(applied, [touch for touch in found if touch is not None])
        for touch in self._playing.touches:
            touch.patterns.append(self._playing)
        if applied.from_rest and applied.quiet:
            self._playing.onset = self._run(self._feel_onset(self._playing))

    def _silenced(self, silenced: Silenced) -> None:
        self._end_pattern(silenced.time)
        for contact in silenced.targets:
            if touch := self._touches.get(contact.key):
                touch.reason = silenced.reason

    def _failed(self, problem: str) -> None:
        self._end_pattern(clock.now())
        self._problems.append(problem)

    def _end_pattern(self, now: float) -> None:
        """Close the pattern that is played and have its last part measured."""
        ended, self._playing = self._playing, None
        if ended is None:
            return
        ended.until = now
        settled = ended.applied.time + ended.applied.pattern.ramp
        since, until = max(settled, now - WINDOW) + MARGIN, now - MARGIN
        if since < until:
            ended.felt = self._run(self._bench.felt(since, until))
        for touch in ended.touches:
            if touch.is_lifted:
                self._run(self._complete(touch))

    async def _feel_onset(self, playing: _Playing) -> dict[str, FingerFelt]:
        """What fingers felt in the first 100 ms of a pattern; nothing if it was over before."""
        since = playing.applied.time
        await asyncio.sleep(max(0.0, since + FIRST + MARGIN - clock.now()))
        if playing.until < since + FIRST:
            return {}
        return await self._bench.felt(since, since + FIRST)

    def _rest(self, contacts: tuple[Contact, ...]) -> None:
        """Let the plate's sensors follow the fingers."""
        resting = {}
        for contact in contacts:
            place = (contact.x, contact.y)
            before = self._resting.get(_id(contact))
            resting[_id(contact)] = (
                before if before and math.dist(before, place) < TREMBLE else place
            )
        if resting != self._resting:
            self._resting = resting
            self._run(self._bench.place_fingers(resting))

    async def _complete(self, touch: _Touch) -> None:
        """Make the row of a lifted touch from the pattern that was played longest for it."""
        longest = max(touch.patterns, key=lambda playing: playing.duration, default=None)
        contact, quiet, together = touch.contact, touch.quiet, []
        if longest is not None:
            contact = _felt_of(touch, longest).contact
            together = [each.contact for each in longest.applied.targets]
            quiet = {_id(other): (other.x, other.y) for other in longest.applied.quiet}
        row = TouchRow(
            target_id=_id(contact),
            time=contact.since - self._start,
            until=touch.until - self._start,
            target=(contact.x, contact.y),
            together=tuple((each.x, each.y) for each in together if each.key != contact.key),
            quiet=quiet,
            played=await _played(touch, longest) if longest else None,
            reason=None if longest else touch.reason,
        )
        self.rows.append(row)
        self._on_row(row)

    def _run(self, work: Coroutine[Any, Any, Any]) -> asyncio.Task[Any]:
        task = asyncio.create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._finished)
        return task

    def _finished(self, task: asyncio.Task[Any]) -> None:
        self._tasks.discard(task)
        if not task.cancelled() and (error := task.exception()) is not None:
            self._problems.append(str(error))


async def _played(touch: _Touch, longest: _Playing) -> PlayedPattern:
    """The longest pattern of a touch as it was felt; latency and onset are those of its first."""
    applied, first = longest.applied, touch.patterns[0]
    predicted = _felt_of(touch, longest)
    felt = await longest.felt if longest.felt else {}
    target = felt.get(_id(predicted.contact))
    others = [felt[_id(contact)] for contact in applied.quiet if _id(contact) in felt]
    return PlayedPattern(
        pattern=applied.pattern,
        predicted_level_db_sl=predicted.level_db_sl,
        predicted_contrast_db=predicted.contrast_db,
        onset=await _onset(touch, first),
        drive={
            era: {
                "frequency_hz": command.frequency,
                "level": command.level,
                "phase_deg": command.phase,
            }
            for era, command in applied.drive.items()
        },
        latency=first.applied.latency,
        duration=longest.duration,
        measured=measure(target, others) if target and len(others) == len(applied.quiet) else None,
        levels={id: finger_level(finger) for id, finger in felt.items()},
    )


async def _onset(touch: _Touch, first: _Playing) -> Onset:
    """The first 100 ms of the first pattern of a touch."""
    applied = first.applied
    felt = await first.onset if first.onset else {}
    target = felt.get(_id(touch.contact))
    others = [felt[_id(contact)] for contact in applied.quiet if _id(contact) in felt]
    is_felt = target is not None and others and len(others) == len(applied.quiet)
    return Onset(
        is_shaped=bool(applied.pattern.onset),
        predicted_contrast_db=applied.transient_contrast_db,
        measured_contrast_db=peak_contrast_db(target, others) if target and is_felt else None,
    )


def _felt_of(touch: _Touch, playing: _Playing) -> Prediction:
    """What a touch was predicted to feel of a pattern that was played for it."""
    return next(felt for felt in playing.applied.targets if felt.contact.key == touch.contact.key)


def _id(contact: Contact) -> str:
    """A contact's id on the bench."""
    return f"{contact.key.source}#{contact.key.id}"
