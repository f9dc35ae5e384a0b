"""Limits of one amplifier, and the worst case of a set relative to them.

`wire_limits` combines the limits of the rig, the amplifier, its channels and this module to the
lowest of each. `Rounding` converts layers to wire integers: levels, frequencies and phases to the
nearest step, ramps upward, and `valid_for` never to 0, which would mean endless. It rejects values
that the wire cannot carry or the limits forbid. `Budget` enforces rate, on-time and duty.

`Bounds` gives the largest level, power and rise over all layers. A set starts at an unknown moment
within the next tenth of a second, so the voices are taken from `drivers.playing` after a
commit with that uncertainty. The magnitude of an amplitude moving on a line in the complex plane
is a convex function; therefore sums are largest where each transition is at one of its points.
"""

import math
from array import array
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import chain, pairwise, product, zip_longest
from operator import index
from typing import NamedTuple, TypeAlias

from drivers.errors import CommandError, CommandRefused
from drivers.playing import (
    SAME,
    AmplifierLayer,
    AmplifierTone,
    Playback,
    Voice,
    VoiceTransition,
    along,
    peak_of,
    steepest,
    voices_after,
)
from drivers.protocol.definition import QUANTITIES
from drivers.protocol.records import Values, WireQuantity
from drivers.protocol.sets import Command, LayerSet
from registry.limits import GuardLimits

_PER_RAMP, _PER_VALID_FOR = QUANTITIES["ramp"].per_unit, QUANTITIES["valid_for"].per_unit
_SILENCE: Sequence[complex] = (0j,)
_NONE: Sequence[LayerSet] = ()


class _Course(NamedTuple):
    """A voice and how it may change."""

    voice: Voice
    starts: Sequence[complex]
    """Possible starting amplitudes."""
    sets: Sequence[LayerSet] = ()
    """Sets of its layer; empty once the voice has ended."""
    is_new: bool = True
    """Whether any of these sets changes it."""
    is_late: bool = False
    """Whether that set waits for another one to end."""
    goes_on: bool = False
    """Whether it continues the voice of its frequency that the layer plays."""


class Bounds:
    """What channels may play if layers are committed at any moment between two times [s]."""

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
        """Return the course of a voice that waits: it may start anywhere on an old one's way."""
        name = voice.layer, voice.frequency
        continued = [old.transition for old in olds if (old.layer, old.frequency) == name]
        points = [(0j,), *(way.points(self._since) for way in continued)]
        return _Course(voice, [*chain(*points)], is_late=True)

    def _course(self, old: Voice | None, voice: Voice) -> _Course:
        """Return the course of a voice after all sets; old: that before, None for a new one."""
        starts, sets, is_new = _SILENCE, self._of_layer.get(voice.layer, _NONE), True
        if old is not None:
            starts = old.transition.points(self._since)
            is_new = old.transition is not voice.transition
            # A voice that is falling silent goes on so if that ends before a fade would.
            latest = voice.transition.end + self._half + SAME
            is_fading = is_new and voice.has_ended and not voice.transition.knots
            if is_fading and not old.transition.last and old.transition.end <= latest:
                voice, is_new = old, False
            sets = _NONE if old.has_ended else sets
        return _Course(voice, starts, sets, is_new)

    def worst(self) -> tuple[list[float], float]:
        """Return the largest level of each channel, and the largest sum of their squares.

        Between two points each magnitude is a convex function of the way. So is their sum while all
        follow the same way; otherwise each may be at either of its ends.
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
        """Return the steepest rise of a level [full levels/s]; equal frequencies may beat."""
        rises: dict[float, list[tuple[float, float]]] = {}  # by frequency: rise, change
        for course in self._courses[channel]:
            of_voice = rises.setdefault(course.voice.frequency, [])
            of_voice.append(self._steepest(course))
            for one in course.sets:
                if one.after or not course.is_new:  # it may fade along the ramp of that set later
                    of_voice.append(
                        _steepest_of(course.starts, along(None, 0.0, one.ramp / _PER_RAMP, 0j, 0j))
                    )
        steepest_rise = 0.0
        for several in rises.values():
            is_alone = len(several) == 1
            steepest_rise += several[0][0] if is_alone else sum([each for _, each in several])
        return steepest_rise

    def _steepest(self, course: _Course) -> tuple[float, float]:
        """Return the steepest rise and the fastest change of a voice, including its ending."""
        voice, starts, way = course.voice, course.starts, course.voice.transition
        if course.is_new:
            ways = [_steepest_of(starts, way)]
            starts = (*starts, *way.knots, way.last)
        else:
            # A steady voice counts too: another voice of its frequency may cease to cancel it.
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


def _magnitudes(course: _Course) -> VoiceTransition:
    """Return the way of a voice in magnitudes; its ending may begin before the way is over."""
    voice, way = course.voice, course.voice.transition
    ending = 0.0 if voice.has_ended else peak_of(voice.ending)
    first, *knots, last = map(abs, (way.first, *way.knots, way.last))
    last = max(last, ending)
    duration = (way.end - way.start) * _PER_VALID_FOR
    if any(0 < one.valid_for < duration for one in course.sets):
        first, knots = max(first, ending), [max(each, ending) for each in knots]
    return VoiceTransition(way.start, way.step, first, last, way.end, tuple(knots))


def _of_several_ways(ways: Sequence[VoiceTransition], times: Sequence[float]) -> list[int]:
    """Return the indices of the intervals between times in which not all follow the same way."""
    kinds = {(way.end, None if way.knots else way.step) for way in ways}
    if len(kinds) < 2:
        return []
    since = enumerate(times[:-1])
    return [at for at, time in since if len({kind for end, kind in kinds if time < end}) > 1]


def _steepest_of(starts: Sequence[complex], way: VoiceTransition) -> tuple[float, float]:
    """Return the steepest rise and the fastest change of a transition from these amplitudes."""
    course = (*way.knots, way.last)
    ways = (*product(starts, course[:1]), *pairwise(course))
    return steepest(ways, way.step, is_cosine=not way.knots)


FREQUENCY_FLOOR = 10.0
"""Lowest frequency [Hz]; below it a plate on springs moves as a rigid body, and nothing is felt."""
RATE_CEILING = 2000.0
"""Sets a second; no wire carries more, so a higher rate can only be a runaway loop."""
DUTY_WINDOW = 10.0
"""Window of the duty limit [s]; it is short against an amplifier's thermal time constant."""
COMMIT_DELAY = 0.1
"""Longest time from sending a set until it plays [s]: three attempts of 30 ms each."""
_RATE_WINDOW = 1.0  # s
_SLACK = 1e-6  # of a step, for sums of floats

VibrationSpan: TypeAlias = tuple[float | None, float]
"""Earliest start [s] of a vibration, None without a vibration, and its latest end [s]."""


@dataclass(frozen=True, slots=True)
class WireLimits:
    """Limits of a set: frequencies and levels in wire integers, slew, and power.

    slew and power: see `GuardLimits`.
    """

    frequency_min: int
    frequency_max: int
    level: int
    slew: float
    power: float


def wire_limits(configured: GuardLimits, capabilities: Values) -> WireLimits:
    """Combine configured limits with the limits of an amplifier and its channels.

    If the channels differ, the lowest limit applies to all, because a pattern needs all channels.
    Raises CommandError for non-numeric limits, or limits that leave nothing to play.
    """
    for name in ("frequency_min", "frequency_max", "level"):
        if not math.isfinite(value := getattr(configured, name)):
            raise CommandError(f"{name} of the limits must be a finite number, got {value}")
    for name in ("slew", "power", "on_time", "duty", "rate"):
        if not (value := getattr(configured, name)) > 0:
            raise CommandError(f"{name} limit must be positive, got {value:g}")
    reported = [capabilities, *capabilities["limits"]]
    frequency, level = QUANTITIES["frequency"], QUANTITIES["level"]
    lowest = max(FREQUENCY_FLOOR, configured.frequency_min)
    limits = WireLimits(
        max(-_whole_steps(-lowest, frequency), *(each["frequency_min"] for each in reported)),
        min(
            _whole_steps(configured.frequency_max, frequency),
            *(each["frequency_max"] for each in reported),
        ),
        min(
            _whole_steps(min(configured.level, 1.0), level),
            *(each["level_max"] for each in reported),
        ),
        configured.slew,
        configured.power,
    )
    if limits.frequency_min > limits.frequency_max:
        low, high = (
            frequency.from_wire(end) for end in (limits.frequency_min, limits.frequency_max)
        )
        raise CommandError(
            f"limits of rig and amplifier must leave a frequency range, got {low:g} to {high:g} "
            "Hz; widen limits.frequency in the rig file or use another amplifier"
        )
    if limits.level < 0:
        raise CommandError(f"level limit must be at least 0, got {configured.level:g}")
    return limits


def _whole_steps(value: float, quantity: WireQuantity) -> int:
    """Round a value down to a step of the wire."""
    return math.floor(value * quantity.per_unit + _SLACK)


TOLERANCE = 1 + 1e-9
"""Tolerance factor of a limit for rounding of sums."""
_LEVEL, _PHASE = QUANTITIES["level"], QUANTITIES["phase"]
_RAMP, _VALID_FOR = QUANTITIES["ramp"], QUANTITIES["valid_for"]
_FREQUENCY = QUANTITIES["frequency"]
_VALID_FOR_MAX = _VALID_FOR.high
_NO_KNOTS = ((0, 0),)


class Rounding:
    """Rounds layers for one amplifier; capabilities: values of its record."""

    def __init__(self, limits: WireLimits, capabilities: Values) -> None:
        self._limits, self._can = limits, capabilities
        self._channels: int = capabilities["channels"]
        self._layers: int = capabilities["layers"]
        self._ramp_max = _RAMP.from_wire(capabilities["ramp_max"])
        self.achieved: dict[tuple[int, int], int] = {}
        """Frequency that the amplifier plays in place of another one, by channel and frequency."""

    def layers(self, layers: Sequence[AmplifierLayer]) -> tuple[LayerSet, ...]:
        """Return layers in integers of the wire; raises CommandRefused with channel and reason."""
        rounded: list[LayerSet] = []
        numbers: list[int] = []
        for layer in layers:
            number, ramp, valid_for = index(layer.number), layer.ramp, layer.valid_for
            if not 0 <= number < self._layers:
                raise CommandRefused(f"layer must be 0 to {self._layers - 1}, got {number!r}")
            if not 0 <= ramp <= self._ramp_max:  # nor NaN
                raise CommandRefused(f"ramp must be 0 to {self._ramp_max:g} s, got {ramp!r} s")
            if not 0 <= valid_for <= _VALID_FOR_MAX:
                raise CommandRefused(
                    f"valid_for must be 0 to {_VALID_FOR_MAX:g} s, got {valid_for!r} s"
                )
            if layer.renew and (layer.tones or layer.after):
                raise CommandRefused("renew must be without tones and after")
            if layer.after and not layer.tones:
                raise CommandRefused("after must be with tones")
            commands = self._commands(layer.tones)
            rounded.append(
                LayerSet(
                    number,
                    min(math.ceil(ramp * _RAMP.per_unit - _SLACK), self._can["ramp_max"]),
                    max(round(valid_for * _VALID_FOR.per_unit), 1) if valid_for else 0,
                    tuple(commands.values()),
                    bool(layer.after),
                    bool(layer.renew),
                )
            )
            numbers.append(number)
        if len(set(numbers)) < len(numbers):
            raise CommandRefused(f"a set must have each layer once, got {numbers}")
        return tuple(rounded)

    def _commands(self, tones: Sequence[AmplifierTone]) -> dict[int, Command]:
        """Return the commands of tones by channel; it runs with each set, so it makes few calls."""
        limits, commands, shaped = self._limits, dict[int, Command](), list[AmplifierTone]()
        for tone in tones:
            channel, level, onset = index(tone.channel), tone.level, tone.onset
            if not 0 <= channel < self._channels:
                raise CommandRefused(
                    f"channel must be 0 to {self._channels - 1}, got {channel!r}", channel=channel
                )
            if channel in commands:
                raise refused(channel, "must occur once in a layer")
            if not 0 <= level * _LEVEL.per_unit < limits.level + 0.5:  # a step of the wire; nor NaN
                raise self._level_refused(channel, "level", level)
            if not (math.isfinite(tone.frequency) and math.isfinite(tone.phase)):
                values = f"{tone.frequency!r} Hz and {tone.phase!r} degrees"
                raise refused(channel, f"frequency and phase must be finite numbers, got {values}")
            frequency = round(tone.frequency * _FREQUENCY.per_unit)
            if level == 0 and onset is None:
                frequency = limits.frequency_min
            if not limits.frequency_min <= frequency <= limits.frequency_max:
                low, high = map(_FREQUENCY.from_wire, (limits.frequency_min, limits.frequency_max))
                raise refused(
                    channel, f"frequency must be {low:g} to {high:g} Hz, got {tone.frequency:g} Hz"
                )
            phase = round(tone.phase * _PHASE.per_unit)
            if not _PHASE.minimum <= phase <= _PHASE.maximum:
                phase = _PHASE.to_wire(float(tone.phase))
            commands[channel] = Command(
                channel,
                self.achieved.get((channel, frequency), frequency),
                min(round(level * _LEVEL.per_unit), limits.level),
                phase,
                bool(tone.keep_phase),
                bool(tone.skip_ending),
                onset,
                tone.ending,
            )
            if onset is not None or tone.ending is not None:
                shaped.append(tone)
        if shaped:
            self._check_envelopes(shaped)
        return commands

    def _level_refused(self, channel: int, name: str, level: float) -> CommandRefused:
        highest = self._limits.level / _LEVEL.per_unit
        return refused(channel, f"{name} must be 0 to {highest:g}, got {level!r}")

    def _check_envelopes(self, tones: Sequence[AmplifierTone]) -> None:
        """Raise CommandRefused for an envelope of a tone that is not allowed."""
        low, high = self._can["envelope_step_min"], self._can["envelope_step_max"]
        limit = self._can["knots"]
        for tone in tones:
            for shape in (tone.onset, tone.ending):
                if shape is None:
                    continue
                if not low <= (step := shape.step) <= high:
                    raise refused(
                        tone.channel,
                        f"step of an envelope must be {low} to {high} (0.1 ms), got {step}",
                    )
                if (count := len(shape.knots)) > limit:
                    raise refused(
                        tone.channel, f"knots of an envelope must be at most {limit}, got {count}"
                    )
                try:
                    levels, phases = zip(*(shape.knots or _NO_KNOTS), strict=True)
                    array("q", (*levels, *phases))  # raises for numbers that are no integers
                except (TypeError, ValueError) as error:
                    raise refused(
                        tone.channel, f"knots of an envelope must be pairs of integers: {error}"
                    ) from error
                if not 0 <= min(levels) <= (peak := max(levels)) <= self._limits.level:
                    raise self._level_refused(
                        tone.channel, "level of a knot", peak / _LEVEL.per_unit
                    )
                if not _PHASE.minimum <= min(phases) <= max(phases) <= _PHASE.maximum:
                    raise refused(tone.channel, "phase of a knot must be -180 to 179.99 degrees")


def refused(channel: int, text: str) -> CommandRefused:
    """Return the error of a channel that must not play something; text: why, as `X must be Y`."""
    return CommandRefused(f"channel {channel}: {text}", channel=channel)


class Budget:
    """Counts the sets that were sent, and how long they may have vibrated; times are in s."""

    def __init__(self, limits: GuardLimits) -> None:
        self._limits, self._rate = limits, min(limits.rate, RATE_CEILING)
        self.is_unlimited = limits.on_time == math.inf and limits.duty >= 1
        self._duty_time = limits.duty * DUTY_WINDOW if limits.duty < 1 else math.inf
        allowed = max(1, int(self._rate * _RATE_WINDOW))
        # Sets that were delayed on their way arrive closer together than they were sent.
        self._window = max(_RATE_WINDOW, allowed / self._rate) + COMMIT_DELAY
        self._sent: deque[float] = deque(maxlen=allowed)
        self._vibrations: deque[tuple[float, float]] = deque()  # ended ones: start, end
        self._start: float | None = None  # earliest start of the current one
        self._end = 0.0  # its latest end

    def remaining(self, now: float, *, fade: float, delay: float) -> float:
        """Return the longest valid_for [s] of a vibration that is sent now; infinite if unlimited.

        fade: how long it takes to end after that [s]. delay: longest time until it plays [s], while
        the current vibration goes on. Raises CommandRefused if no time is left or the rate is
        exceeded.
        """
        if len(self._sent) == self._sent.maxlen and now < self._sent[0] + self._window:
            raise CommandRefused(
                f"rate must be at most {self._rate:g} command sets a second; send fewer, "
                "the limit stops runaway loops",
                until=self._sent[0] + self._window,
            )
        if self.is_unlimited:
            return math.inf
        is_vibrating = self._start is not None and now < self._end
        spent = fade + (delay if is_vibrating else 0.0)
        used = now - self._start if is_vibrating and self._start is not None else 0.0
        return min(
            _left("on-time limit", used, self._limits.on_time, spent),
            _left(f"duty limit over {DUTY_WINDOW:g} s", self._used(now), self._duty_time, spent),
        )

    def fade_left(self, now: float) -> float:
        """Return how long the current vibration may fade [s] if silence is sent now."""
        if self._start is None or now >= self._end:
            return math.inf
        used = max(self._used(now) - self._duty_time, now - self._start - self._limits.on_time)
        return max(0.0, -used - COMMIT_DELAY)

    def sent(self, now: float, *, lasts: float) -> VibrationSpan | None:
        """Note a set that vibrates for `lasts` [s] at most; returns the vibration before it."""
        self._sent.append(now)
        if self.is_unlimited:
            return None
        self._close(now)
        before = self._start, self._end
        if self._start is None:
            self._start, self._end = now, now
        self._end = max(self._end, now + COMMIT_DELAY + lasts)
        return before

    def restore(self, before: VibrationSpan | None) -> None:
        """Note that the set that was sent last was refused; before: what `sent` returned."""
        if before is not None:
            self._start, self._end = before

    def confirm(self, sent_at: float, now: float, *, end: float) -> None:
        """Note that the set sent at a time [s] plays, and when it ends at the latest [s]."""
        self._close(now)
        if self._start is None and now < end:
            self._start = sent_at
        self._end = end

    def _close(self, now: float) -> None:
        """Store the current vibration once it has ended."""
        if self._start is not None and self._end <= now:
            self._vibrations.append((self._start, self._end))
            self._start = None
        while self._vibrations and self._vibrations[0][1] < now - DUTY_WINDOW:
            self._vibrations.popleft()

    def _used(self, now: float) -> float:
        """Return the time of vibration within the window that ends now [s]."""
        opened = now - DUTY_WINDOW
        current = () if self._start is None else ((self._start, min(now, self._end)),)
        spans = [end - max(start, opened) for start, end in (*self._vibrations, *current)]
        return sum((max(0.0, span) for span in spans), start=0.0)


def _left(name: str, used: float, limit: float, spent: float) -> float:
    """Return how much time is left of a limit [s]; raises CommandRefused if none is."""
    left = limit - used - spent
    if left <= 0:
        raise CommandRefused(
            f"{name} of {limit:.3g} s reached ({used:.3g} s used, {spent:.3g} s to end); pause the "
            "vibration"
        )
    return left
