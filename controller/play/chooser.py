"""Chooser: choose the contents that answer a question, from a table, in a thread if necessary.

All lasting contents are chosen together by one answer of the table. Each short pulse is chosen
alone, with the stroke and the power that the lasting contents leave: all other fingers are quiet,
and its frequency is 30 Hz from all sounding frequencies if its band allows it. The lasting content
of its own finger continues. While a pulse plays, lasting contents are confined to the stroke and
power that it leaves.
"""

import asyncio
import logging
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import Enum, auto
from functools import partial
from typing import TypeAlias

from controller.play.crossfades import Crossfades
from controller.play.intent import FingerTarget, Target, Targets
from controller.play.joint_answers import (
    LIMITS_LEAVE_NOTHING,
    Shape,
    answered,
    selection_of,
)
from controller.play.selected_contents import TIME_LIMIT, Content, ContentKey, Question, Selection
from controller.play.shared_capabilities import PlaybackCapabilities
from model.answer.adjustments import scaled
from model.answer.answer import APART_HZ, Answer
from model.arrays import NEARLY
from model.errors import InputError
from model.table.record import SAME_FREQUENCY
from model.table.table import LocalizationTable
from registry.plugins import failure_text
from registry.threads import DaemonThreads

_USED_UP = "the vibrations of other fingers use the whole stroke; lift a finger"

_logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Chooser:
    """Chooses contents from a table; shape: adds envelopes to the contents of joint answers."""

    table: LocalizationTable
    shape: Shape | None = None

    def choose(
        self, question: Question, capabilities: PlaybackCapabilities
    ) -> tuple[Selection, ...]:
        """Return the selection of the lasting targets of a question, then one for each short pulse.

        For fingers at rest, return the selections on the way from the present contents to a better
        answer, step by step; nothing on any failure.
        """
        if question.is_rested:
            try:
                return Crossfades(self.table, question, capabilities, self.shape).steps()
            except Exception as error:
                _logger.error("loop: table failed, contents continue", exc_info=error)
                return ()
        selections = list[Selection]()
        active = [*question.kept]
        if question.lasting:
            lasting = self._choose_lasting(question, capabilities)
            selections.append(lasting)
            active.append(lasting)
        for finger in question.short:
            pulse = self._choose_pulse(question, finger, capabilities, active)
            active.append(pulse)
            selections.append(pulse.beside([question.fading], self.table))
        return tuple(selections)

    def _choose_lasting(self, question: Question, capabilities: PlaybackCapabilities) -> Selection:
        """Choose lasting contents, within the limits that active pulses leave.

        Contents that they replace fade at the same time, and use the limits like the pulses.
        """
        unlimited = self._choose(question, question.lasting, capabilities)
        pulses = contents_of(question.kept)
        if not pulses:
            return unlimited
        active = [*pulses]
        for key, content in question.playing.items():
            if key.finger in unlimited.target_keys and content not in pulses:
                active.append(content)  # fading
        active_layers = [content.layer for content in active]
        remaining = capabilities.left_by(active_layers, self.table)
        layers = [content.layer for content in unlimited.contents]
        if remaining.limits.factor_within(layers, self.table) >= 1 - NEARLY:
            return unlimited
        limited = self._choose(question, question.lasting, remaining)
        if not limited.contents:
            limited = question.silent(question.lasting, _USED_UP)
        return replace(limited, is_limited=True)

    def _choose_pulse(
        self,
        question: Question,
        finger: FingerTarget,
        capabilities: PlaybackCapabilities,
        active: Sequence[Selection],
    ) -> Selection:
        """Choose for a short pulse, while active selections play and other contents fade."""
        others = contents_of([*active, question.fading])
        remaining = capabilities
        if others:
            other_layers = [content.layer for content in others]
            remaining = capabilities.left_by(other_layers, self.table)
        raised = (_raised(finger, others),)
        frequencies = set[float]()
        for content in others:
            for tone in content.layer.excitation.values():
                frequencies.add(tone.frequency)
        return self._choose(
            question, (finger,), remaining, raised=raised, avoided_hz=[*frequencies]
        )

    def _choose(
        self,
        question: Question,
        targets: Targets,
        capabilities: PlaybackCapabilities,
        *,
        raised: Targets | None = None,
        avoided_hz: Sequence[float] = (),
    ) -> Selection:
        """Choose for targets within capabilities; any failure is their reason for silence.

        raised: the targets with the levels to request, if these differ; avoided_hz: frequencies
        that play at the same time.
        """
        try:
            return self._solve(question, targets, raised or targets, capabilities, avoided_hz)
        except InputError as error:
            reason = str(error)
        except Exception as error:
            _logger.error("loop: table failed, silencing its targets", exc_info=error)
            reason = failure_text(error)
        return question.silent(targets, reason)

    def _solve(
        self,
        question: Question,
        targets: Targets,
        requested: Targets,
        capabilities: PlaybackCapabilities,
        avoided_hz: Sequence[float],
    ) -> Selection:
        """Return the contents for targets, from the table's answer to their requested levels."""
        if question.takes_long and not targets[0].target.is_short:
            return self._solve_jointly(question, targets, capabilities)
        solution = answered(
            self.table,
            question,
            requested,
            capabilities,
            keeps=_is_level_change(targets, question.playing),
            avoided_hz=avoided_hz,
        )
        solution = _even_level(solution, requested[0].target)
        selection = selection_of(self.table, question, solution, targets, is_in_phase=False)
        if not avoided_hz:
            return selection
        return _among(question, selection, avoided_hz)

    def _solve_jointly(
        self, question: Question, targets: Targets, capabilities: PlaybackCapabilities
    ) -> Selection:
        """Return the contents for lasting targets, in phase with the contents that play."""
        solution = answered(self.table, question, targets, capabilities, now=question.now)
        return selection_of(self.table, question, solution, targets, shape=self.shape)


_Future: TypeAlias = "asyncio.Future[tuple[Selection, ...]]"


class ChoicePhase(Enum):
    """The progress of a choice in the thread."""

    IDLE = auto()
    """The thread has no question."""
    COMPUTING = auto()
    """The thread works on a question."""
    DONE = auto()
    """The thread has chosen; the choice has not been taken yet."""
    OVERDUE = auto()
    """The thread works on a question after the time limit; silence has not been taken yet."""
    GIVEN_UP = auto()
    """Silence has been taken, but the thread still works; its choice will be dropped."""


class ChoiceThread:
    """Makes one choice at a time in a thread, and gives it up after `TIME_LIMIT` (1 s).

    The thread cannot be ended while it works. Until a choice that was given up has ended, every
    other choice is silence. arrived: called when a choice can be taken, and when a choice that was
    given up has ended.
    """

    def __init__(self, arrived: Callable[[], None]) -> None:
        self._arrived = arrived
        self._threads = DaemonThreads()
        self._phase = ChoicePhase.IDLE
        self._future: _Future | None = None
        self.pending: Question | None = None
        """The question whose selections have not been taken yet; None without any."""

    @property
    def is_given_up(self) -> bool:
        """Whether the thread still works on a choice that was given up."""
        return self._phase is ChoicePhase.GIVEN_UP

    def start(
        self, chooser: Chooser, question: Question, capabilities: PlaybackCapabilities
    ) -> tuple[Selection, ...] | None:
        """Start a choice; return silence instead while a choice that was given up still works.

        No choice may be pending. Raises RuntimeError if the thread cannot start.
        """
        if self.is_given_up:
            return question.given_up()
        loop = asyncio.get_running_loop()
        choose = partial(chooser.choose, question, capabilities)
        future = loop.run_in_executor(self._threads, choose)
        self._future = future
        self._phase = ChoicePhase.COMPUTING
        self.pending = question
        future.add_done_callback(self._note_done)
        loop.call_later(TIME_LIMIT, self._note_time_limit, future)
        return None

    def take(self) -> tuple[Selection, ...] | None:
        """Return the selections for the pending question, once; None before they are chosen.

        A choice that takes too long is given up: its targets are silent.
        """
        question = self.pending
        if self._phase is ChoicePhase.DONE and self._future is not None:
            self._phase = ChoicePhase.IDLE
            self.pending = None
            return self._future.result()
        if self._phase is ChoicePhase.OVERDUE and question is not None:
            self._phase = ChoicePhase.GIVEN_UP
            self.pending = None
            return question.given_up()
        return None

    def _note_time_limit(self, future: _Future) -> None:
        """Note that the time limit of a choice has passed, unless it is done."""
        if not future.done():
            _logger.warning("loop: answer given up, still computed after %g s", TIME_LIMIT)
            self._phase = ChoicePhase.OVERDUE
            self._arrived()

    def _note_done(self, future: _Future) -> None:
        """Note that the thread has ended a choice."""
        if self._phase is ChoicePhase.GIVEN_UP:
            self._phase = ChoicePhase.IDLE
            future.exception()  # retrieved, so that asyncio does not log it
        else:
            self._phase = ChoicePhase.DONE
        self._arrived()


def _is_level_change(targets: Targets, playing: Mapping[ContentKey, Content]) -> bool:
    """Whether only the level of a single target changes, and that level is not raised."""
    ((contact, target),) = targets
    content = playing.get(ContentKey(contact.key, target.voice))
    if content is None or target.level_db_sl is None:
        return False
    if target.pulse is not None and target.pulse.is_raised:
        return False
    former_target = content.target
    with_new_level = replace(former_target, level_db_sl=target.level_db_sl)
    return target == with_new_level and target != former_target


def _even_level(solution: Answer, target: Target) -> Answer:
    """Return an answer whose level within a band is the same at every position of the finger.

    The level exceeds the promise by a margin for other plates, which differs between positions.
    """
    is_raised = target.pulse is not None and target.pulse.is_raised
    if target.level_db_sl is None or target.band is None or is_raised or not solution.layers:
        return solution
    excess = solution.fingers[0].level_db_sl - target.level_db_sl
    if excess <= 0:
        return solution
    return scaled(solution, -excess)


def _raised(finger: FingerTarget, others: Iterable[Content]) -> FingerTarget:
    """Return the target of a short pulse, raised to its minimum above other contents there."""
    contact, target = finger
    level = target.level_db_sl
    if level is None or target.above_db is None:
        return finger
    for content in others:
        for felt in content.finger_sensations:
            if felt.contact.key == contact.key:
                level = max(level, felt.sensation.level_db_sl + target.above_db)
    return FingerTarget(contact, replace(target, level_db_sl=level))


def _among(question: Question, selection: Selection, frequencies: Sequence[float]) -> Selection:
    """Return the selection for a pulse among vibrations of some frequencies [Hz].

    The pulse is mixed if any of these frequencies is nearer than 30 Hz.
    """
    if not selection.contents:
        if selection.reason == LIMITS_LEAVE_NOTHING:
            return question.silent(selection.targets, _USED_UP)
        return selection
    (content,) = selection.contents
    frequency = content.frequency or 0.0
    nearest = min([abs(frequency - avoided) for avoided in frequencies])
    if nearest >= APART_HZ - SAME_FREQUENCY:
        return selection
    mixed = replace(content, is_apart=False).with_sensations(content.sensations)
    return replace(selection, contents=(mixed,))


def contents_of(selections: Iterable[Selection]) -> list[Content]:
    """Return the contents of several selections."""
    contents = list[Content]()
    for selection in selections:
        contents += selection.contents
    return contents
