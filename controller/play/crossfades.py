"""Cross-fades: improve the contents of fingers at rest, step by step.

Joint answers keep the frequencies that fingers feel, so the result depends on the order of arrival.
Once all fingers rest, playback cross-fades to the answer without kept frequencies. One content
changes at a time, so that other fingers feel little of the change. If only weights change, for
instance after a finger has left, the layer itself follows the same ramp. Every step keeps all
sounding frequencies, including the outgoing one, 30 Hz apart; if no order of steps can, playback
does not change. Between steps the promise is computed for the contents that play at the time.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from controller.play.intent import FADED_AFTER
from controller.play.joint_answers import SHORT_OF, Shape, answered, selection_of
from controller.play.layers import CROSSFADE, FALL_AFTER
from controller.play.selected_contents import NOTHING, Content, Question, Selection
from controller.play.shared_capabilities import PlaybackCapabilities
from controller.sources.touch import ContactKey
from model.answer.answer import APART_HZ, SAME_LEVEL, Answer
from model.answer.plan import worst_of
from model.answer.promise import with_tones
from model.arrays import NEARLY
from model.drive_modes import UNRESTRICTED
from model.table.table import LocalizationTable
from model.vibration import base_amplitudes

WORTH = 2.0
"""Gain in promised contrast [dB] of the worst finger that justifies other frequencies."""

WORTH_OF_WEIGHTS = 0.5
"""Gain in promised contrast [dB] of the worst finger that justifies other weights alone."""

RESTS_AFTER = 0.1
"""Fingers rest if no finger has come, left or moved further for this time [s]."""

CROSSFADE_INTERVAL = 0.4
"""Time [s] between two steps to a better answer, each of another finger."""

MIN_INTERVAL = 1.0
"""Time [s] from the last step to one answer to the first step to the next answer."""

_FADES_FOR = FALL_AFTER + CROSSFADE + FADED_AFTER  # s; contents that a step replaces

_SAME = 0.01  # difference between two drives that is not felt, relative to the largest amplitude

_Voices = Mapping[ContactKey, tuple[Content, ...]]
"""A content and its side bands, by the finger that owns it."""


def is_due(date: float, now: float) -> bool:
    """Whether a date [s] has come; an infinite date never comes."""
    return date <= now and date < math.inf


class Improvement:
    """The steps from the present contents to a better answer, and when to look for one [s]."""

    def __init__(self) -> None:
        self.rests_at = math.inf
        """When the fingers will have rested, so that a better answer can be looked for."""
        self.next_step_at = math.inf
        """When the next step is due."""
        self._steps: Sequence[Selection] = ()
        """The selections after each remaining step."""
        self._stepped_at = -math.inf
        """When the last step changed contents."""
        self._fading = NOTHING
        """The contents that this step replaced."""

    @property
    def due(self) -> float:
        """When the next step or the search for a better answer is due."""
        return min(self.rests_at, self.next_step_at)

    @property
    def next_step(self) -> Selection | None:
        """The selection after the next step; None if no step remains."""
        return self._steps[0] if self._steps else None

    def fading_at(self, now: float) -> Selection:
        """Return the contents that the last step replaced, until they have faded."""
        if now < self._stepped_at + _FADES_FOR:
            return self._fading
        return NOTHING

    def stop(self) -> None:
        """Drop the remaining steps, and do not look for a better answer."""
        self._steps = ()
        self.next_step_at = math.inf
        self.rests_at = math.inf

    def wait_for_rest(self, now: float) -> None:
        """Drop the remaining steps, and look for a better answer when fingers have rested."""
        self.stop()
        self.rests_at = max(now + RESTS_AFTER, self._stepped_at + MIN_INTERVAL)

    def start(self, steps: Sequence[Selection], now: float) -> None:
        """Start the steps to a better answer."""
        self._steps = steps
        self.next_step_at = now
        self.rests_at = math.inf

    def take_step(self, present: Selection, now: float) -> None:
        """Note that the next step is taken from the present selection."""
        step, *self._steps = self._steps
        if step.contents != present.contents:
            self._fading = _replaced_contents(present, step)
            self._stepped_at = now
        self.next_step_at = math.inf
        if self._steps:
            self.next_step_at = now + CROSSFADE_INTERVAL


def _replaced_contents(present: Selection, step: Selection) -> Selection:
    """Return a selection with the contents that a step ends, or plays at another frequency."""
    frequencies = {content.key: content.frequency for content in step.contents}
    replaced = list[Content]()
    for content in present.contents:
        is_kept = content.key in frequencies
        if not is_kept or frequencies[content.key] != content.frequency:
            replaced.append(content)
    return replace(present, contents=tuple(replaced))


@dataclass(frozen=True)
class Crossfades:
    """Finds the way from the contents that play to a better answer for the same fingers.

    question: has the lasting targets, whose fingers rest; shape: adds envelopes.
    """

    table: LocalizationTable
    question: Question
    capabilities: PlaybackCapabilities
    shape: Shape | None = None

    def steps(self) -> tuple[Selection, ...]:
        """Return the selection after each step; new contents are marked as cross-faded (`is_led`).

        Other frequencies must promise the worst finger 2 dB more, other weights alone 0.5 dB more,
        in both cases to the same fingers and at no lower level. The way ends with the last step
        that promises more. Without a better answer the only step is the present selection, if its
        promised contrast differs by 0.5 dB from the promise made while fingers moved. There is no
        step if no content plays.
        """
        if self.capabilities.drive_mode != UNRESTRICTED or not self.question.playing:
            return ()
        playing = _by_finger(self.question.playing.values())
        restated = tuple[Selection, ...]()
        for keeps in (False, True):
            goal = answered(
                self.table, self.question, self.question.lasting, self.capabilities, keeps=keeps
            )
            goal_voices = _by_finger(self._selection(goal, shape=self.shape).contents)
            is_same_service = _served(goal_voices) == _served(playing)
            if not is_same_service or len(goal.layers) != len(playing):
                continue
            present = self._answer_of(goal, playing)
            restated = self._restated(present, playing)
            changes = _changes(goal_voices, playing)
            if not _is_worth_it(goal, present, playing, changes):
                continue
            steps = self._in_order(goal, playing, changes)
            if steps:
                return steps
        return restated

    def _restated(self, present: Answer, playing: _Voices) -> tuple[Selection, ...]:
        """Return the present selection with its present promises; nothing if they are known."""
        known_promises = dict[ContactKey, float]()
        for content in self.question.playing.values():
            for felt in content.finger_sensations:
                known_promises[felt.contact.key] = felt.sensation.promised_contrast_db or 0.0
        selection = self._selection_of_playing(present, playing)
        for felt in selection.finger_sensations:
            promise = felt.sensation.promised_contrast_db or 0.0
            known_promise = known_promises.get(felt.contact.key, promise)
            if abs(promise - known_promise) >= WORTH_OF_WEIGHTS:
                return (selection,)
        return ()

    def _in_order(self, goal: Answer, playing: _Voices, changes: _Voices) -> tuple[Selection, ...]:
        """Return the selection after each step, the best content first; empty without an order.

        A content that can follow now never brings frequencies too near for a later one. It can use
        limits of the amplifiers that a later one needs; another order might get further then, but
        only this one is tried.
        """
        remaining = {**changes}
        steps = list[Selection]()
        promised_worst = -math.inf
        while remaining:
            answers = dict[ContactKey, Answer]()
            for key, voices in remaining.items():
                if self._may_follow(playing, key, voices):
                    answers[key] = self._answer_of(goal, {**playing, key: voices})
            if not answers:
                return ()
            contrasts = {key: worst_of(solution) for key, solution in answers.items()}
            best_key = max(contrasts, key=contrasts.__getitem__)
            playing = {**playing, best_key: remaining.pop(best_key)}
            worst = contrasts[best_key]
            if remaining or not steps or worst >= promised_worst + SAME_LEVEL:
                steps.append(self._selection_of_playing(answers[best_key], playing))
            promised_worst = worst
        return tuple(steps)

    def _may_follow(self, playing: _Voices, key: ContactKey, voices: tuple[Content, ...]) -> bool:
        """Whether a finger's content can be cross-faded to another one while all contents play.

        While both sound, they must be 30 Hz from all other contents and from each other, and within
        the limits of the amplifiers.
        """
        if not _is_tuned(playing[key], voices):
            contents = _all_of({**playing, key: voices})
        else:
            carriers = [contents[0] for contents in playing.values()]
            if not _is_apart(voices[0], carriers):
                return False
            contents = [*_all_of(playing), *voices]
        layers = [content.layer for content in contents]
        return self.capabilities.limits.factor_within(layers, self.table) >= 1 - NEARLY

    def _answer_of(self, goal: Answer, voices: _Voices) -> Answer:
        """Return an answer with the tones of contents that play together, and its promises."""
        rows = list[int]()
        drives = list[list[complex]]()
        owners = list[int]()
        for number, stream in enumerate(goal.contents.streams):
            owner, _ = self.question.lasting[stream.targets[0]]
            for content in voices[owner.key]:
                frequencies, bases = base_amplitudes(content.layer.excitation, self.table.eras)
                content_rows = self.table.rows_of(frequencies)
                relative_drives = bases / self.table.highest_drives[content_rows]
                rows += content_rows.tolist()
                drives += relative_drives.tolist()
                owners += [number] * len(frequencies)
        gains = np.ones(len(rows))
        return with_tones(self.table, goal, np.array(rows), drives, np.array(owners), gains)

    def _selection_of_playing(self, present: Answer, voices: _Voices) -> Selection:
        """Return the selection of contents that play together, with their sensations."""
        selection = self._selection(present)
        contents = list[Content]()
        for key, answered_voices in _by_finger(selection.contents).items():
            for content, answered_voice in zip(voices[key], answered_voices, strict=True):
                contents.append(replace(content, sensations=answered_voice.sensations))
        return replace(selection, contents=tuple(contents))

    def _selection(self, solution: Answer, *, shape: Shape | None = None) -> Selection:
        """Return the selection of an answer; its contents are marked as cross-faded."""
        targets = self.question.lasting
        selection = selection_of(self.table, self.question, solution, targets, shape=shape)
        contents = [replace(content, is_led=True) for content in selection.contents]
        return replace(selection, contents=tuple(contents))


def _by_finger(contents: Iterable[Content]) -> _Voices:
    """Return contents by finger, with side bands after their carrier."""
    voices = dict[ContactKey, tuple[Content, ...]]()
    for content in sorted(contents, key=lambda content: content.key.voice):
        key = content.key.finger
        voices[key] = (*voices.get(key, ()), content)
    return voices


def _all_of(voices: _Voices) -> list[Content]:
    """Return all contents and side bands."""
    all_contents = list[Content]()
    for contents in voices.values():
        all_contents += contents
    return all_contents


def _changes(goal: _Voices, playing: _Voices) -> _Voices:
    """Return the contents of a goal that feel different from the present contents."""
    return {key: voices for key, voices in goal.items() if _differ(voices, playing[key])}


def _served(voices: _Voices) -> dict[ContactKey, tuple[int, set[ContactKey]]]:
    """Return the number of voices and the contacts of each finger's content."""
    return {key: (len(contents), {*contents[0].contact_keys}) for key, contents in voices.items()}


def _is_worth_it(goal: Answer, present: Answer, playing: _Voices, changes: _Voices) -> bool:
    """Whether an answer promises the worst finger clearly more, and no finger a lower level."""
    required_gain = WORTH_OF_WEIGHTS
    for key, voices in changes.items():
        if _is_tuned(playing[key], voices):
            required_gain = WORTH
    gain = worst_of(goal) - worst_of(present)
    return gain >= required_gain and not _is_weaker(goal, present)


def _is_apart(content: Content, neighbors: Iterable[Content]) -> bool:
    """Whether a content is at least 30 Hz from all others."""
    frequency = content.frequency or 0.0
    distances = [abs(frequency - (neighbor.frequency or 0.0)) for neighbor in neighbors]
    return min(distances, default=APART_HZ) >= APART_HZ


def _is_tuned(playing: Sequence[Content], goal: Sequence[Content]) -> bool:
    """Whether the frequencies of two contents and their side bands differ."""
    playing_frequencies = [content.frequency for content in playing]
    goal_frequencies = [content.frequency for content in goal]
    return playing_frequencies != goal_frequencies


def _differ(goal: Sequence[Content], playing: Sequence[Content]) -> bool:
    """Whether a finger feels a difference between two contents and their side bands."""
    if _is_tuned(playing, goal):
        return True
    for new_content, old_content in zip(goal, playing, strict=True):
        new_phasors = _phasors(new_content)
        old_phasors = _phasors(old_content)
        phasors = [*new_phasors.values(), *old_phasors.values()]
        tolerance = _SAME * max(map(abs, phasors))
        for name in {*new_phasors, *old_phasors}:
            change = new_phasors.get(name, 0) - old_phasors.get(name, 0)
            if abs(change) > tolerance:
                return True
    return False


def _phasors(content: Content) -> dict[str, complex]:
    """Return the complex amplitude of each ERA [m]."""
    return {name: tone.phasor for name, tone in content.layer.excitation.items()}


def _is_weaker(goal: Answer, present: Answer) -> bool:
    """Whether a finger with a content feels a clearly lower level."""
    for new, old in zip(goal.fingers, present.fingers, strict=True):
        loss = old.promised_level_db_sl - new.promised_level_db_sl
        if new.layer is not None and loss > SHORT_OF:
            return True
    return False
