"""What a set may lead to at the worst: level, power and rise of a channel over all its layers.

A set plays from an unknown moment in the next tenth of a second, over what sounds then. Along a
straight line in the complex plane a magnitude is a convex function of the way, so that sums are
largest where each transition is at one of its points.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import chain, pairwise, product, starmap

from drivers.playback import Playback
from drivers.protocol.sets import Command, Envelope, LayerSet
from drivers.protocol.table import QUANTITIES
from drivers.voices import Voice, amplitude_of, amplitudes_of, peak_of, steepest

_PER_RAMP, _PER_STEP = QUANTITIES["ramp"].per_unit, QUANTITIES["envelope_step"].per_unit
_PER_FULL, _PER_HERTZ = QUANTITIES["level"].per_unit, QUANTITIES["frequency"].per_unit
_PER_VALID_FOR = QUANTITIES["valid_for"].per_unit


@dataclass(slots=True)
class Path:
    """Magnitudes after a commit, in full levels: at its start, then a step [s] apart until end [s].

    is_cosine: between the two along a raised cosine, else along straight lines.
    """

    step: float
    magnitudes: tuple[float, ...]
    end: float
    is_cosine: bool

    def along(self, times: Sequence[float]) -> list[float]:
        """Return upper bounds of the magnitude at times [s] after the commit."""
        between = len(self.magnitudes) - 1
        values = []
        for time in times:
            steps = time / self.step if self.step else math.inf
            if steps >= between:
                values.append(self.magnitudes[-1])
                continue
            index = int(steps)
            way = steps - index
            if self.is_cosine:
                way = (1 - math.cos(math.pi * way)) / 2
            values.append(self.magnitudes[index] * (1 - way) + self.magnitudes[index + 1] * way)
        return values


class ChannelBounds:
    """What a channel may play once layers are committed, between two times [s].

    all_layers: these and those that wait.
    steady: sum of the largest magnitudes of voices that the set does not change; paths: of those
    that it changes or starts; rise: of the level, at the most [full levels/s].
    """

    def __init__(
        self,
        playback: Playback,
        layers: Mapping[int, LayerSet],
        all_layers: Sequence[LayerSet],
        channel: int,
        time: float,
        *,
        until: float,
    ) -> None:
        self._playback, self._time = playback, time
        self._voices = playback.all_voices[channel]
        self.steady = 0.0
        self.paths: list[Path] = []
        self._rises: dict[float, list[tuple[float, float]]] = {}  # by frequency: rise, change
        continued: set[int] = set()
        for voice in self._voices:
            one = layers.get(voice.layer)
            command = None if one is None else _command_of(one, channel)
            # A layer may have begun to end by itself when the set comes.
            ends_soon = playback.end_of(voice.layer) <= until
            if one is None or one.after or voice.has_ended or ends_soon:
                self._keep(voice, one)
            elif command is not None and voice.is_continued_by(command):
                continued.add(voice.layer)
                self._lead(voice.frequency, voice.transition.points(time), one, command)
            else:
                skips = command is not None and (command.is_driven or command.skip_ending)
                self._fade(voice, one, None if skips else voice.ending)
        for one in all_layers:
            command = _command_of(one, channel)
            if command is None or not command.is_driven:
                continue
            if one.after:
                self._lead_later(one, command)
            elif one.layer not in continued:
                self._lead(command.frequency / _PER_HERTZ, (0j,), one, command)

    @property
    def rise(self) -> float:
        """Steepest rise of the level [full levels/s]; of one frequency also by interference."""
        steepest = 0.0
        for several in self._rises.values():
            if len(several) == 1:
                steepest += several[0][0]
            else:
                steepest += sum([change for _, change in several])
        return steepest

    def along(self, times: Sequence[float]) -> list[list[float]]:
        """Return upper bounds at times [s] after the commit: what is steady, and each path."""
        return [[self.steady] * len(times), *[path.along(times) for path in self.paths]]

    def _keep(self, voice: Voice, one: LayerSet | None) -> None:
        """Add a voice that the set does not change, but for a layer that may let it fade later."""
        transition, time = voice.transition, self._time
        self.steady += voice.peak(time)
        change = transition.slope(time) if transition.end > time else 0.0
        ways = [(change if transition.last or transition.knots else 0.0, change)]
        points = transition.points(time)
        if not voice.has_ended:
            # A layer without `valid_for` ends by a set alone, which has a ramp of its own.
            is_endless = self._playback.end_of(voice.layer) == math.inf
            ramp = math.inf if is_endless else self._playback.ramp_of(voice.layer)
            ways.append(_steepest_from(points, voice.ending, 0j, ramp))
        # Also where it does not change: another voice of its frequency may cease to cancel it.
        self._note(voice.frequency, *ways)
        if one is not None and not voice.has_ended:
            self._note(voice.frequency, _steepest_from(points, None, 0j, one.ramp / _PER_RAMP))

    def _fade(self, voice: Voice, one: LayerSet, ending: Envelope | None) -> None:
        """Add a voice that falls silent, along its ending or the ramp of the set."""
        starts = voice.transition.points(self._time)
        self._note(voice.frequency, _steepest_from(starts, ending, 0j, one.ramp / _PER_RAMP))
        self._add_path(starts, ending, 0.0, one.ramp / _PER_RAMP)

    def _lead(
        self, frequency: float, starts: Sequence[complex], one: LayerSet, command: Command
    ) -> None:
        """Add a voice that a command leads from one of some amplitudes; its ending may follow."""
        self._note_way(frequency, starts, one, command)
        ending, last = peak_of(command.ending), command.level / _PER_FULL
        path = self._add_path(starts, command.onset, max(last, ending), one.ramp / _PER_RAMP)
        if one.valid_for and one.valid_for / _PER_VALID_FOR < path.end:  # it may begin amid
            path.magnitudes = tuple(max(each, ending) for each in path.magnitudes)

    def _add_path(
        self, starts: Sequence[complex], onset: Envelope | None, last: float, ramp: float
    ) -> Path:
        """Add the way along an envelope, or a ramp [s] without one, to a magnitude."""
        between = map(abs, amplitudes_of(onset))
        magnitudes = (max(map(abs, starts)), *between, last)
        step, steps = ramp if onset is None else onset.step / _PER_STEP, len(magnitudes) - 1
        path = Path(step, magnitudes, step * steps, steps == 1)
        self.paths.append(path)
        return path

    def _lead_later(self, one: LayerSet, command: Command) -> None:
        """Add a command that starts at another time, with the largest that it may reach.

        It may continue a voice of its layer from wherever that is then, or let it fade.
        """
        frequency = command.frequency / _PER_HERTZ
        starts = [0j]
        for voice in self._voices:
            if voice.layer == one.layer and not voice.has_ended:
                points = voice.transition.points(self._time)
                self._note(voice.frequency, _steepest_from(points, None, 0j, one.ramp / _PER_RAMP))
                starts += points if voice.frequency == frequency else ()
        self._note_way(frequency, starts, one, command)
        self.steady += max(*map(abs, _course(command)), peak_of(command.ending))

    def _note_way(
        self, frequency: float, starts: Sequence[complex], one: LayerSet, command: Command
    ) -> None:
        """Note how fast a command leads, and its ending from wherever it is by then."""
        course = _course(command)
        ways = [_steepest_from(starts, command.onset, course[-1], one.ramp / _PER_RAMP)]
        if command.ending is not None:
            ways.append(_steepest_from((*starts, *course), command.ending, 0j, math.inf))
        self._note(frequency, *ways)

    def _note(self, frequency: float, *ways: tuple[float, float]) -> None:
        """Note the steepest rise and the fastest change of a voice, by one of some ways."""
        rises, changes = zip(*ways, strict=True)
        self._rises.setdefault(frequency, []).append((max(rises), max(changes)))


def worst(channels: Sequence[ChannelBounds]) -> tuple[list[float], float]:
    """Return the largest level of each channel and the largest sum of their squares.

    Between two points all magnitudes are convex functions of the way, and so are their sums where
    all go the same way; else each may be at either end.
    """
    paths = [path for channel in channels for path in channel.paths]
    moments = {path.step * index for path in paths for index in range(len(path.magnitudes))}
    times = sorted(moments | {0.0})
    bounds = [channel.along(times) for channel in channels]
    levels: list[list[float]] = [[*map(sum, zip(*each, strict=True))] for each in bounds]
    for index in _of_several_ways(paths, times):
        for level, each in zip(levels, bounds, strict=True):
            level.append(sum([max(values[index : index + 2]) for values in each]))
    return [*map(max, levels)], max(starmap(math.hypot, zip(*levels, strict=True))) ** 2


def _of_several_ways(paths: Sequence[Path], times: Sequence[float]) -> list[int]:
    """Return the intervals between times in which not all paths go the same way, by index."""
    ways = [(path.end, path.step if path.is_cosine else None) for path in paths]
    if len({way for _, way in ways}) < 2:
        return []
    since = enumerate(times[:-1])
    return [index for index, time in since if len({way for end, way in ways if time < end}) > 1]


def all_bounds(
    playback: Playback, layers: Sequence[LayerSet], time: float, *, until: float
) -> list[ChannelBounds]:
    """Return what each channel may play if layers are committed between two times [s]."""
    named = {one.layer: one for one in layers if not one.renew}
    every = (*named.values(), *playback.waiting)
    return [
        ChannelBounds(playback, named, every, channel, time, until=until)
        for channel in range(playback.channels)
    ]


def _command_of(one: LayerSet, channel: int) -> Command | None:
    for each in one.commands:
        if each.channel == channel:
            return each
    return None


def _steepest_from(
    starts: Sequence[complex], envelope: Envelope | None, last: complex, ramp: float
) -> tuple[float, float]:
    """Return the steepest rise and the fastest change from any of some amplitudes to a last one.

    Along an envelope, or a ramp [s] without one.
    """
    knots = amplitudes_of(envelope)
    course = (*knots, last)
    ways = chain(product(starts, course[:1]), pairwise(course))
    step = ramp if envelope is None else envelope.step / _PER_STEP
    return steepest(ways, step, is_cosine=not knots)


def _course(command: Command) -> tuple[complex, ...]:
    """Return the amplitudes through which a command leads, the last one lasting."""
    return (*amplitudes_of(command.onset), amplitude_of(command.level, command.phase))
