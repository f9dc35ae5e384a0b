"""What a set may lead to at the worst: level, power and rise of a channel over all its layers.

A set plays from an unknown moment in the next tenth of a second: the voices are those of
`drivers.playing.voices` after a commit that is that uncertain. Along a straight line in the complex
plane a magnitude is a convex function of the way, so that sums are largest where each transition
is at one of its points.
"""

import math
from collections.abc import Sequence
from itertools import chain, pairwise, product, zip_longest
from typing import NamedTuple

from drivers.playing.playback import Playback
from drivers.playing.voices import SAME, Transition, Voice, along, peak_of, steepest, voices_after
from drivers.protocol.definition import QUANTITIES
from drivers.protocol.sets import LayerSet

_PER_RAMP, _PER_VALID_FOR = QUANTITIES["ramp"].per_unit, QUANTITIES["valid_for"].per_unit
_SILENCE: Sequence[complex] = (0j,)
_NONE: Sequence[LayerSet] = ()


class _Course(NamedTuple):
    """A voice, and the amplitudes from which it may set out.

    sets: of its layer, unless it has ended; is_new: it is led by one, is_late: that waits, goes_on:
    as one voice with what the layer plays of its frequency.
    """

    voice: Voice
    starts: Sequence[complex]
    sets: Sequence[LayerSet] = ()
    is_new: bool = True
    is_late: bool = False
    goes_on: bool = False


class Bounds:
    """What channels may play once layers are committed between two times [s]."""

    def __init__(
        self, playback: Playback, layers: Sequence[LayerSet], since: float, until: float
    ) -> None:
        self._playback, self._since = playback, since
        self._middle, self._half = (since + until) / 2, (until - since) / 2
        named = [one for one in layers if not one.renew]
        over = {one.layer for one in named if playback.end_of(one.layer) <= until}
        every = (*named, *playback.waiting)
        self._of_layer: dict[int, list[LayerSet]] = {}
        for one in every:
            self._of_layer.setdefault(one.layer, []).append(one)
        before = playback.all_voices
        after, self._courses = [*before], [list[_Course]() for _ in before]
        for one in every:
            commands, ramp = {each.channel: each for each in one.commands}, one.ramp / _PER_RAMP
            is_over = one.layer in over  # it may have begun to end when the set comes
            earlier, half = (
                ([()] * len(before), 0.0) if one.after or is_over else (after, self._half)
            )
            played = voices_after(earlier, one.layer, commands, self._middle, ramp, half)
            for channel, voices in enumerate(played):
                if one.after:
                    goes_on = bool(voices) and commands[channel].keep_phase and not is_over
                    self._courses[channel] += [
                        self._late(each, before[channel])._replace(goes_on=goes_on)
                        for each in voices
                    ]
                else:
                    after[channel] = (*after[channel], *voices) if is_over else voices
        for courses, olds, voices in zip(self._courses, before, after, strict=True):
            courses += [self._course(old, each) for old, each in zip_longest(olds, voices)]

    def _late(self, voice: Voice, olds: Sequence[Voice]) -> _Course:
        """Return a voice that waits, from wherever one of the old that it continues is then."""
        name = voice.layer, voice.frequency
        continued = [old.transition for old in olds if (old.layer, old.frequency) == name]
        points = [(0j,), *(way.points(self._since) for way in continued)]
        return _Course(voice, [*chain(*points)], is_late=True)

    def _course(self, old: Voice | None, voice: Voice) -> _Course:
        """Return a voice once all sets play; old: as which it has played, None for a new one."""
        starts, sets, is_new = _SILENCE, self._of_layer.get(voice.layer, _NONE), True
        if old is not None:
            starts = old.transition.points(self._since)
            is_new = old.transition is not voice.transition
            # One that falls silent by itself goes on if it is silent before a fade would end.
            latest = voice.transition.end + self._half + SAME
            is_fading = is_new and voice.has_ended and not voice.transition.knots
            if is_fading and not old.transition.last and old.transition.end <= latest:
                voice, is_new = old, False
            sets = _NONE if old.has_ended else sets
        return _Course(voice, starts, sets, is_new)

    def worst(self) -> tuple[list[float], float]:
        """Return the largest level of each channel and the largest sum of their squares.

        Between two points all magnitudes are convex functions of the way, and so are their sums
        where all go the same way; else each may be at either end.
        """
        steady, ways = [0.0] * len(self._courses), []
        going_on = dict[tuple[int, int, float], float]()
        for channel, courses in enumerate(self._courses):
            for course in courses:
                voice = course.voice
                name = channel, voice.layer, voice.frequency
                if course.is_new and not course.is_late:
                    ways.append((channel, _magnitudes(course)))
                elif course.goes_on or not (course.is_late or voice.has_ended):
                    going_on[name] = max(going_on.get(name, 0.0), voice.peak(self._since))
                else:
                    steady[channel] += voice.peak(self._since)
        for (channel, _, _), peak in going_on.items():
            steady[channel] += peak
        moments = {way.start + way.step * at for _, way in ways for at in range(len(way.knots) + 2)}
        times = sorted(moments | {self._middle})
        levels = [[level] * len(times) for level in steady]
        mixed = _of_several_ways([way for _, way in ways], times)
        for level, of_channel in zip(levels, steady, strict=True):
            level += [of_channel] * len(mixed)
        for channel, way in ways:
            values = [abs(way.at(time)) for time in times]
            values += [max(values[index : index + 2]) for index in mixed]
            levels[channel] = [*map(float.__add__, levels[channel], values)]
        power = max(sum(level * level for level in each) for each in zip(*levels, strict=True))
        return [*map(max, levels)], power

    def rise(self, channel: int) -> float:
        """Return the steepest rise of a level [full levels/s]; of one frequency also by beats."""
        rises: dict[float, list[tuple[float, float]]] = {}  # by frequency: rise, change
        for course in self._courses[channel]:
            of_voice = rises.setdefault(course.voice.frequency, [])
            of_voice.append(self._steepest(course))
            for one in course.sets:
                if one.after or not course.is_new:  # it may fade along that ramp, at another time
                    of_voice.append(
                        _steepest_of(course.starts, along(None, 0.0, one.ramp / _PER_RAMP, 0j, 0j))
                    )
        steepest_rise = 0.0
        for several in rises.values():
            is_alone = len(several) == 1
            steepest_rise += several[0][0] if is_alone else sum([each for _, each in several])
        return steepest_rise

    def _steepest(self, course: _Course) -> tuple[float, float]:
        """Return the steepest rise and the fastest change of a voice, and of its ending."""
        voice, starts, way = course.voice, course.starts, course.voice.transition
        if course.is_new:
            ways = [_steepest_of(starts, way)]
            starts = (*starts, *way.knots, way.last)
        else:
            # Also where it does not change: another voice of its frequency may cease to cancel it.
            change = way.slope(self._since) if way.end > self._since else 0.0
            ways = [(change if way.last or way.knots else 0.0, change)]
        if not voice.has_ended:
            if voice.ending is not None:
                ways.append(_steepest_of(starts, along(voice.ending, 0.0, 0.0, 0j, 0j)))
            elif not course.is_new and self._playback.end_of(voice.layer) < math.inf:
                ramp = self._playback.ramp_of(voice.layer)
                ways.append(_steepest_of(starts, along(None, 0.0, ramp, 0j, 0j)))
        rises, changes = zip(*ways, strict=True)
        return max(rises), max(changes)


def _magnitudes(course: _Course) -> Transition:
    """Return the way of a voice in magnitudes; its ending follows, or may begin amid it."""
    voice, way = course.voice, course.voice.transition
    ending = 0.0 if voice.has_ended else peak_of(voice.ending)
    first, *knots, last = map(abs, (way.first, *way.knots, way.last))
    last = max(last, ending)
    duration = (way.end - way.start) * _PER_VALID_FOR
    if any(0 < one.valid_for < duration for one in course.sets):
        first, knots = max(first, ending), [max(each, ending) for each in knots]
    return Transition(way.start, way.step, first, last, way.end, tuple(knots))


def _of_several_ways(ways: Sequence[Transition], times: Sequence[float]) -> list[int]:
    """Return the intervals between times in which not all go the same way, by index."""
    kinds = {(way.end, None if way.knots else way.step) for way in ways}
    if len(kinds) < 2:
        return []
    since = enumerate(times[:-1])
    return [at for at, time in since if len({kind for end, kind in kinds if time < end}) > 1]


def _steepest_of(starts: Sequence[complex], way: Transition) -> tuple[float, float]:
    """Return the steepest rise and the fastest change along a way from any of some amplitudes."""
    course = (*way.knots, way.last)
    ways = (*product(starts, course[:1]), *pairwise(course))
    return steepest(ways, way.step, is_cosine=not way.knots)
