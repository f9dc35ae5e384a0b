"""The way from what plays to a better answer, once all fingers rest: one content at a time.

What fingers feel depends on who came first, since a frequency that is felt is kept. The answer with
none kept is led to along cross-fades, a content after the other, so that others feel little of it;
where only weights change, as after a finger has left, along the same ramp within the layer. Each
step keeps 30 Hz between all that sounds at once, the old tone included; where no order of the
contents does, what plays is left. Between the steps the promise is that of what plays then.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from controller.play.capabilities import PlaybackCapabilities
from controller.play.content import Content, Selection, Targets
from controller.play.joint_answer import Shape, answered, selection_of
from controller.sources.contacts import Contact, ContactKey
from model.answer.answer import SAME_LEVEL, Answer
from model.answer.plan import worst_of
from model.answer.promise import with_tones
from model.answer.stimulus import APART_HZ
from model.arrays import NEARLY
from model.drive_modes import UNRESTRICTED
from model.table.table import LocalizationTable
from model.vibration import base_amplitudes

WORTH, WORTH_OF_WEIGHTS = 2.0, 0.5
"""How much more [dB] the worst finger must be promised for other frequencies, or weights alone."""

_SHORT_OF = 1.0  # dB; by which a finger may feel less of its own then
_SAME = 0.01  # of the largest amplitude of two drives: a difference that is not felt

_Voices = Mapping[ContactKey, tuple[Content, ...]]
"""What fingers feel: a content, and its side bands, by the finger whose content it is."""


@dataclass(frozen=True)
class Crossfades:
    """Finds the way from what plays to a better answer for the same fingers.

    targets, quiet: contacts where they rest; playing: what they feel, by finger and voice; shape:
    adds envelopes.
    """

    table: LocalizationTable
    targets: Targets
    quiet: Sequence[Contact]
    capabilities: PlaybackCapabilities
    playing: Mapping[tuple[ContactKey, int], Content]
    protected: frozenset[ContactKey] = frozenset()
    shape: Shape | None = None

    def steps(self) -> tuple[Selection, ...]:
        """What plays after each step, the content that is led to marked.

        Other frequencies must promise 2 dB more to the worst finger, other weights alone 0.5;
        either to the same fingers, and not more weakly. It ends where a step promises no more.
        Where nothing is better, what plays, if it promises another contrast where fingers rest by
        0.5 dB than it did on their ways.
        """
        if self.capabilities.drive_mode != UNRESTRICTED:
            return ()
        playing, same = _by_finger(self.playing.values()), tuple[Selection, ...]()
        for keeps in (False, True):
            goal = answered(
                self.table,
                self.targets,
                self.quiet,
                self.capabilities,
                before=self.playing,
                protected=self.protected,
                keeps=keeps,
            )
            found = _by_finger(self._selection(goal, shape=self.shape).contents)
            if _served(found) != _served(playing) or len(goal.layers) != len(playing):
                continue
            now = self._mixed(goal, playing)
            same = self._restated(now, playing)
            led = {key: each for key, each in found.items() if _differ(each, playing[key])}
            is_tuned = any(_is_tuned(playing[key], each) for key, each in led.items())
            gain = worst_of(goal) - worst_of(now)
            if gain < (WORTH if is_tuned else WORTH_OF_WEIGHTS) or _is_weaker(goal, now):
                continue
            if steps := self._in_order(goal, playing, led):
                return steps
        return same

    def _restated(self, now: Answer, playing: _Voices) -> tuple[Selection, ...]:
        """What plays with what it promises now; nothing if that has been said."""
        found, said = self._felt(now, playing), dict[ContactKey, float]()
        for content in self.playing.values():
            for each in content.predictions:
                said[each.contact.key] = each.promised_contrast_db or 0.0
        for each in found.predictions:
            promised = each.promised_contrast_db or 0.0
            if abs(promised - said.get(each.contact.key, promised)) >= WORTH_OF_WEIGHTS:
                return (found,)
        return ()

    def _in_order(self, goal: Answer, playing: _Voices, led: _Voices) -> tuple[Selection, ...]:
        """What plays after each step to contents, the best first; none where none may follow.

        One that may follow hinders no other after: no other order goes on where this one ends.
        """
        left, steps, before = {**led}, list[Selection](), -math.inf
        while left:
            options = []
            for key, voices in left.items():
                if self._may_follow(playing, key, voices):
                    after = {**playing, key: voices}
                    options.append((self._mixed(goal, after), key, after))
            if not options:
                return ()
            mixed, key, playing = max(options, key=lambda each: worst_of(each[0]))
            del left[key]
            if left or not steps or worst_of(mixed) >= before + SAME_LEVEL:
                steps.append(self._felt(mixed, playing))
            before = worst_of(mixed)
        return tuple(steps)

    def _may_follow(self, playing: _Voices, key: ContactKey, voices: tuple[Content, ...]) -> bool:
        """Whether a finger's content may be led to another beside all that plays.

        While both sound they are 30 Hz from all others and each other, and within the limits of the
        amplifiers.
        """
        beside = [one for each in playing.values() for one in each]
        if not _is_tuned(playing[key], voices):
            beside = [one for one in beside if one not in playing[key]]
        elif any(
            abs((voices[0].frequency or 0.0) - (each[0].frequency or 0.0)) < APART_HZ
            for each in playing.values()
        ):
            return False
        total = [one.layer for one in (*beside, *voices)]
        return self.capabilities.limits.factor_within(total, self.table) >= 1 - NEARLY

    def _mixed(self, goal: Answer, voices: _Voices) -> Answer:
        """The answer with the tones of contents that are felt together, and what these promise."""
        drives, owners = [], list[int]()
        rows, table = list[int](), self.table
        for number, stream in enumerate(goal.contents.streams):
            for one in voices[self.targets[stream.targets[0]][0].key]:
                frequencies, bases = base_amplitudes(one.layer.excitation, table.eras)
                at = table.rows_of(frequencies)
                rows += at.tolist()
                drives += (bases / table.highest_drives[at]).tolist()
                owners += [number] * len(frequencies)
        every = np.array(rows), drives, np.array(owners), np.ones(len(rows))
        return with_tones(table, goal, *every)

    def _felt(self, mixed: Answer, voices: _Voices) -> Selection:
        """What is felt of contents together, with what is predicted of them."""
        found = self._selection(mixed)
        contents = [
            replace(one, predictions=predicted.predictions)
            for key, each in _by_finger(found.contents).items()
            for one, predicted in zip(voices[key], each, strict=True)
        ]
        return replace(found, contents=tuple(contents))

    def _selection(self, found: Answer, *, shape: Shape | None = None) -> Selection:
        given = self.table, found, self.targets, self.quiet
        chosen = selection_of(*given, before=self.playing, shape=shape, protected=self.protected)
        led = [replace(each, is_led=True) for each in chosen.contents]
        return replace(chosen, contents=tuple(led))


def _by_finger(contents: Iterable[Content]) -> _Voices:
    found: dict[ContactKey, tuple[Content, ...]] = {}
    for each in sorted(contents, key=lambda one: one.key[1]):
        found[each.key[0]] = (*found.get(each.key[0], ()), each)
    return found


def _served(voices: _Voices) -> dict[ContactKey, tuple[int, set[ContactKey]]]:
    """How many voices the content of each finger has, and who feels it."""
    return {
        key: (len(each), {contact.key for contact, _ in each[0].targets})
        for key, each in voices.items()
    }


def _is_tuned(then: Sequence[Content], now: Sequence[Content]) -> bool:
    """Whether another frequency plays."""
    return [each.frequency for each in then] != [each.frequency for each in now]


def _differ(now: Sequence[Content], then: Sequence[Content]) -> bool:
    """Whether two contents of a finger are felt to differ by anyone."""
    if _is_tuned(then, now):
        return True
    for one, other in zip(now, then, strict=True):
        new, old = (
            {name: tone.phasor for name, tone in each.layer.excitation.items()}
            for each in (one, other)
        )
        least = _SAME * max(map(abs, (*new.values(), *old.values())))
        if any(abs(new.get(name, 0) - old.get(name, 0)) > least for name in {*new, *old}):
            return True
    return False


def _is_weaker(goal: Answer, now: Answer) -> bool:
    """Whether a finger feels clearly less of its own."""
    return any(
        new.promised_level_db_sl < old.promised_level_db_sl - _SHORT_OF
        for new, old in zip(goal.fingers, now.fingers, strict=True)
        if new.layer is not None
    )
