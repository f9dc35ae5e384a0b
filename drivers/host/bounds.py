"""What a set may lead to at the worst: level, power and rise of a channel over all its layers.

A set plays from an unknown moment in the next tenth of a second, over what sounds then. Along a
straight line in the complex plane a magnitude is a convex function of the way, so that sums are
largest where each transition is at one of its points.
"""

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

from drivers.playback import Playback
from drivers.protocol.sets import Command, Envelope, LayerSet
from drivers.protocol.table import QUANTITIES
from drivers.transition import Transition, amplitude_of, amplitudes_of, steepest
from drivers.voices import Voice

_RAMP, _STEP, _LEVEL = QUANTITIES["ramp"], QUANTITIES["envelope_step"], QUANTITIES["level"]
_FREQUENCY, _VALID_FOR = QUANTITIES["frequency"], QUANTITIES["valid_for"]


@dataclass(frozen=True, slots=True)
class Path:
    """Magnitudes after a commit, in full levels: at its start, then a step [s] apart.

    is_cosine: between the two along a raised cosine, else along straight lines.
    """

    step: float
    magnitudes: tuple[float, ...]
    is_cosine: bool

    @property
    def times(self) -> tuple[float, ...]:
        """Times of the magnitudes [s] after the commit."""
        return tuple([self.step * index for index in range(len(self.magnitudes))])

    def at(self, time: float) -> float:
        """Return an upper bound of the magnitude at a time [s] after the commit."""
        steps = time / self.step if self.step else math.inf
        if steps >= len(self.magnitudes) - 1:
            return self.magnitudes[-1]
        index = int(steps)
        way = steps - index
        if self.is_cosine:
            way = (1 - math.cos(math.pi * way)) / 2
        return self.magnitudes[index] * (1 - way) + self.magnitudes[index + 1] * way


class ChannelBounds:
    """What a channel may play once a set is committed, from a time on [s].

    steady: sum of the largest magnitudes of voices that the set does not change; paths: of those
    that it changes or starts; rise: of the level, at the most [full levels/s].
    """

    def __init__(
        self,
        voices: Sequence[Voice],
        layers: Mapping[int, LayerSet],
        waiting: Sequence[LayerSet],
        channel: int,
        time: float,
        *,
        ramps: Mapping[int, float],
        ending_soon: Collection[int],
    ) -> None:
        self._ramps = ramps
        self.steady = 0.0
        self.paths: list[Path] = []
        self._rises: dict[float, list[tuple[float, float]]] = {}  # by frequency: rise, change
        commands = {
            number: next((each for each in one.commands if each.channel == channel), None)
            for number, one in layers.items()
        }
        for one in waiting:
            for waits in one.commands:
                if waits.channel == channel and waits.is_driven:
                    self._add_later(one, waits, voices, time)
        continued: set[int] = set()
        for voice in voices:
            is_kept = voice.layer not in layers or layers[voice.layer].after
            if voice.has_ended or is_kept or voice.layer in ending_soon:
                self.steady += max(voice.transition.peak(time), _peak(voice.ending))
                self._note_change(voice, time)
                if voice.layer in layers and not voice.has_ended:
                    ramp = _RAMP.from_wire(layers[voice.layer].ramp)
                    highest = voice.transition.peak(time)
                    self._note(voice.frequency, (highest, 0j), ramp, is_cosine=True)
                continue
            one, command = layers[voice.layer], commands[voice.layer]
            if command is not None and voice.is_continued_by(command):
                continued.add(voice.layer)
                self._continue(voice, one, command, time)
            else:
                self._fade(voice, one, command, time)
        for number, command in commands.items():
            if command is None or not command.is_driven or number in continued:
                continue
            if layers[number].after:
                self._add_later(layers[number], command, voices, time)
            else:
                self._start(layers[number], command)

    @property
    def rise(self) -> float:
        """Steepest rise of the level [full levels/s]; of one frequency also by interference."""
        return sum(
            several[0][0] if len(several) == 1 else sum(change for _, change in several)
            for several in self._rises.values()
        )

    def at(self, time: float) -> float:
        """Return the level at a time [s] after the commit, at the most."""
        return self.steady + sum([path.at(time) for path in self.paths])

    def within(self, since: float, until: float) -> float:
        """Return the level between two times [s] after the commit, at the most."""
        return self.steady + sum([max(path.at(since), path.at(until)) for path in self.paths])

    def _continue(self, voice: Voice, one: LayerSet, command: Command, time: float) -> None:
        course = _course(command)
        starts = _points(voice.transition, time)
        farthest = max(starts, key=lambda start: abs(course[0] - start))
        step, is_cosine = _way(one, command)
        self.paths.append(_path(max(map(abs, starts)), one, command, step))
        self._note(voice.frequency, (farthest, *course), step, is_cosine=is_cosine)
        self._note_ending(voice.frequency, command, starts)

    def _fade(self, voice: Voice, one: LayerSet, command: Command | None, time: float) -> None:
        starts = _points(voice.transition, time)
        highest = max(starts, key=abs)
        ending = voice.ending
        skips = command is not None and (command.is_driven or command.skip_ending)
        if ending is not None and not skips:
            step, points = _STEP.from_wire(ending.step), (highest, *amplitudes_of(ending), 0j)
            is_cosine = not ending.knots
        else:
            step, points, is_cosine = _RAMP.from_wire(one.ramp), (highest, 0j), True
        self.paths.append(Path(step, tuple(map(abs, points)), is_cosine))
        self._note(voice.frequency, points, step, is_cosine=is_cosine)

    def _start(self, one: LayerSet, command: Command) -> None:
        frequency = _FREQUENCY.from_wire(command.frequency)
        step, is_cosine = _way(one, command)
        self.paths.append(_path(0.0, one, command, step))
        self._note(frequency, (0j, *_course(command)), step, is_cosine=is_cosine)
        self._note_ending(frequency, command, (0j,))

    def _add_later(
        self, one: LayerSet, command: Command, voices: Sequence[Voice], time: float
    ) -> None:
        """Add a command that starts at another time, with the largest that it may reach.

        It may continue a voice of its layer from wherever that is then, or let it fade.
        """
        frequency, course = command.frequency / _FREQUENCY.per_unit, _course(command)
        starts = [0j]
        for voice in voices:
            if voice.layer == one.layer and not voice.has_ended:
                points = _points(voice.transition, time)
                faded = (max(points, key=abs), 0j)
                self._note(voice.frequency, faded, _RAMP.from_wire(one.ramp), is_cosine=True)
                starts += points if voice.frequency == frequency else ()
        farthest = max(starts, key=lambda start: abs(course[0] - start))
        step, is_cosine = _way(one, command)
        self.steady += max(*map(abs, course), _peak(command.ending))
        self._note(frequency, (farthest, *course), step, is_cosine=is_cosine)
        self._note_ending(frequency, command, starts)

    def _note_ending(self, frequency: float, command: Command, starts: Sequence[complex]) -> None:
        """Note the ending of a command, which may rise, from wherever its way is by then."""
        if command.ending is None:
            return
        for start in (*starts, *_course(command)):
            rise, change = _steepest_of_ending(start, command.ending)
            before = self._rises[frequency].pop()
            self._rises[frequency].append((max(before[0], rise), max(before[1], change)))

    def _note_change(self, voice: Voice, time: float) -> None:
        """Note a voice that the set does not change."""
        transition, rise, change = voice.transition, 0.0, 0.0
        if transition.end > time:
            change = transition.slope(time)
            rise = 0.0 if transition.last == 0 and not transition.knots else change
        if voice.ending is None and not voice.has_ended:
            ends = (transition.peak(time), 0j), self._ramps[voice.layer]
            change = max(change, steepest(*ends, is_cosine=True)[1])
        if voice.ending is not None and not voice.has_ended:
            for start in _points(transition, time):
                ending = _steepest_of_ending(start, voice.ending)
                rise, change = max(rise, ending[0]), max(change, ending[1])
        # Also where it does not change: another voice of its frequency may cease to cancel it.
        self._rises.setdefault(voice.frequency, []).append((rise, change))

    def _note(
        self, frequency: float, points: Sequence[complex], step: float, *, is_cosine: bool
    ) -> None:
        self._rises.setdefault(frequency, []).append(steepest(points, step, is_cosine=is_cosine))


def worst(channels: Sequence[ChannelBounds]) -> tuple[list[float], float]:
    """Return the largest level of each channel and the largest sum of their squares.

    Between two points all magnitudes are convex functions of the way, and so are their sums where
    all go the same way; else each may be at either end.
    """
    paths = [path for channel in channels for path in channel.paths]
    times = sorted({at for path in paths for at in path.times} | {0.0})
    corners = [[channel.at(time) for channel in channels] for time in times]
    for since, until in pairwise(times):
        ways = {path.step if path.is_cosine else None for path in paths if since < path.times[-1]}
        if len(ways) > 1:
            corners.append([channel.within(since, until) for channel in channels])
    levels = [max(each) for each in zip(*corners, strict=True)]
    return levels, max(sum(level**2 for level in each) for each in corners)


def plain_bounds(
    playback: Playback, layers: Sequence[LayerSet], time: float, *, until: float
) -> tuple[list[float], list[float]] | None:
    """Return levels of all channels before and after a cross-fade along one ramp.

    Between the two they are convex, and so are sums of their squares, so that `worst` is at one of
    the ends. None where envelopes, several ramps or ends of layers make it less plain.
    """
    ramp, may_end = layers[0].ramp, playback.next_due <= until
    if playback.next_due < math.inf and playback.waiting:
        return None
    named: list[int] = []
    after = [0.0] * playback.channels
    for one in layers:
        if one.ramp != ramp or one.after or (may_end and playback.end_of(one.layer) <= until):
            return None
        if not one.renew:
            named.append(one.layer)
        for command in one.commands:
            if command.onset is not None or command.ending is not None:
                return None
            after[command.channel] += command.level / _LEVEL.per_unit
    before = [0.0] * playback.channels
    for channel, voices in enumerate(playback.all_voices):
        for voice in voices:
            transition = voice.transition
            if transition.knots or voice.ending is not None:
                return None
            peak = abs(transition.last)
            if transition.first and time < transition.end:
                peak = max(peak, abs(transition.first))
            before[channel] += peak
            if voice.has_ended or voice.layer not in named:
                after[channel] += peak
    return before, after


def all_bounds(
    playback: Playback, layers: Sequence[LayerSet], time: float, *, until: float
) -> list[ChannelBounds]:
    """Return what each channel may play if layers are committed between two times [s]."""
    named = {one.layer: one for one in layers if not one.renew}
    # They may have begun to end by themselves when the set comes.
    ending_soon = [number for number in named if playback.end_of(number) <= until]
    audible = {voice.layer for voices in playback.all_voices for voice in voices}
    # A layer without `valid_for` ends by a set alone, which silences along a ramp of its own.
    ramps = {
        number: playback.ramp_of(number) if playback.end_of(number) < math.inf else math.inf
        for number in audible
    }
    return [
        ChannelBounds(
            *(voices, named, playback.waiting, channel, time),
            ramps=ramps,
            ending_soon=ending_soon,
        )
        for channel, voices in enumerate(playback.all_voices)
    ]


def _steepest_of_ending(first: complex, ending: Envelope) -> tuple[float, float]:
    points = (first, *amplitudes_of(ending), 0j)
    return steepest(points, _STEP.from_wire(ending.step), is_cosine=not ending.knots)


def _peak(envelope: Envelope | None) -> float:
    return max(map(abs, amplitudes_of(envelope)), default=0.0)


def _course(command: Command) -> tuple[complex, ...]:
    """Return the amplitudes through which a command leads, the last one lasting."""
    return (*amplitudes_of(command.onset), amplitude_of(command.level, command.phase))


def _path(first: float, one: LayerSet, command: Command, step: float) -> Path:
    """Return the magnitudes of a command from a first one on; the last covers its ending.

    An ending that may begin amid the way is covered all along.
    """
    *others, last = map(abs, _course(command))
    ending = _peak(command.ending)
    path = Path(step, (first, *others, max(last, ending)), is_cosine=not others)
    if one.valid_for and _VALID_FOR.from_wire(one.valid_for) < path.times[-1]:
        magnitudes = tuple(max(each, ending) for each in path.magnitudes)
        return Path(step, magnitudes, path.is_cosine)
    return path


def _way(one: LayerSet, command: Command) -> tuple[float, bool]:
    """Return the step [s] of a command's onset or ramp, and whether it is a raised cosine."""
    if command.onset is None:
        return _RAMP.from_wire(one.ramp), True
    return _STEP.from_wire(command.onset.step), not command.onset.knots


def _points(transition: Transition, time: float) -> tuple[complex, ...]:
    """Return points between which the amplitude is from a time [s] on."""
    if time >= transition.end:
        return (transition.last,)
    passed = int((time - transition.start) / transition.step) if transition.knots else 0
    return (transition.at(time), *transition.knots[passed:], transition.last)
