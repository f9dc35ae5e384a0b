"""Bounds of what one channel plays, from the sets that it was given.

A set starts a tone that lasts, and lets every other one fade along its ramp. The commit of a set is
known as an interval, and so is everything derived from it: bounds hold whatever the true moment is.
Without limits on slew these bounds decide nothing but the sum of tones under envelopes.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

from drivers.command import DriveCommand, Envelope

_FAR = math.inf
_ROUNDING = 1e-9  # of full stroke; sums of floats


@dataclass(frozen=True, slots=True)
class Interval:
    """A moment between two times [s]."""

    earliest: float
    latest: float


@dataclass(frozen=True, slots=True)
class ChannelState:
    """Playback of a channel since a commit, at first silence.

    frequency [Hz] and path: of the tone that lasts, its complex amplitudes in full strokes, `step`
    [s] apart; along a raised cosine between two if not is_shaped. begin_low: least magnitude of the
    first amplitude, of which path holds the highest. commit: when it started. rest: highest sum of
    all other magnitudes at the commit, which fade within `fade` [s]; frequencies [Hz]: theirs.
    kept_slope [1/s]: how fast tones of one frequency that fade may uncover each other. valid_for
    [s] after the commit: then the tone ends, along `ending` or the ramp. may_be_silent: whether
    the tone may not play at all. keeps_rest: whether others may follow an envelope that ends within
    the ramp instead of the ramp.
    """

    frequency: float = 0.0
    path: tuple[complex, ...] = (0j, 0j)
    step: float = 0.0
    is_shaped: bool = False
    begin_low: float = 0.0
    commit: Interval = Interval(-_FAR, -_FAR)
    rest: float = 0.0
    fade: float = 0.0
    frequencies: frozenset[float] = frozenset()
    kept_slope: float = 0.0
    valid_for: float = _FAR
    ending: Envelope | None = None
    may_be_silent: bool = False
    keeps_rest: bool = False

    def low(self, when: Interval) -> float:
        """Lower bound of the level within an interval."""
        rest = 0.0
        if self.frequency in self.frequencies:
            rest = self.rest_at(self._elapsed(when)[0])
        return max(0.0, self.own_low(when) - rest)

    def own_low(self, when: Interval) -> float:
        """Lower bound of the level of the lasting tone alone, which others may cancel."""
        begin, end = self._elapsed(when)
        if end > self.valid_for or self.may_be_silent:
            return 0.0
        lowest = _least_modulus(self._amplitudes(begin, end))
        if self.begin_low < abs(self.path[0]):
            first, *others = self.path
            if (first * others[0].conjugate()).real < 0:
                return 0.0
            weaker = replace(self, path=(_direction(first) * self.begin_low, *others))
            lowest = min(lowest, _least_modulus(weaker._amplitudes(begin, end)))
        return lowest

    def high(self, when: Interval) -> float:
        """Upper bound of the level within an interval."""
        begin, end = self._elapsed(when)
        # An envelope to silence ends by itself.
        length = math.inf if self.is_shaped and self.path[-1] == 0 else self.valid_for
        if begin >= self.valid_for + self.ending_time and begin >= self.settled_after:
            return 0.0
        last = min(end, length)
        first = min(begin, last)
        if self.is_shaped:
            highest = max(map(abs, self._amplitudes(first, last))) + self.rest_at(first)
        else:
            kept = self.rest_at(first) if self.keeps_rest else 0.0
            both = abs(self.path[0]) + (0.0 if self.keeps_rest else self.rest)
            shares = (self._share(first), self._share(last))
            highest = max((1 - share) * both + share * abs(self.path[-1]) for share in shares)
            highest += kept
        if self.ending is not None and end > self.valid_for:
            begun = abs(self.path[0]) if last < self.settled_after else 0.0  # fades on its own
            highest = max(highest, self._highest_knot + begun + self.rest_at(last))
        return highest

    @property
    def worst(self) -> float:
        """Highest level from the commit to the end."""
        is_plain = not self.is_shaped and not self.keeps_rest
        if is_plain and (self.ending is None or self.valid_for >= self.fade):
            return max(abs(self.path[0]) + self.rest, abs(self.path[-1]), self._highest_knot)
        highest = max(map(abs, self.path)) + self.rest
        if self.ending is not None and self.valid_for < self.settled_after:
            return highest + self._highest_knot
        return max(highest, self._highest_knot + self.rest)

    @property
    def ending_time(self) -> float:
        """Time [s] from the end of valid_for until silence."""
        if self.ending is None:
            return self.fade
        return max(self.fade, duration(self.ending))

    @property
    def settled_after(self) -> float:
        """Time [s] from the commit until only the lasting tone plays at its last amplitude."""
        return max(self.step * (len(self.path) - 1), self.fade)

    def rest_at(self, elapsed: float) -> float:
        """Upper bound of the other tones a time [s] after the latest commit."""
        if self.keeps_rest:
            return self.rest if elapsed < self.fade else 0.0
        return self.rest * (1 - _raised_cosine(elapsed, self.fade))

    def may_be_kept(self, when: Interval) -> bool:
        """Whether an envelope to silence may be under way, which longer ramps do not cut short."""
        begin, end = self._elapsed(when)
        if self.ending is not None and self.valid_for <= end:
            return begin < self.valid_for + self.ending_time
        ends_silent = self.is_shaped and self.path[-1] == 0
        return (ends_silent or self.keeps_rest) and not self.is_settled(when)

    def is_settled(self, when: Interval) -> bool:
        """Whether from the begin of an interval only the lasting tone plays."""
        return when.earliest - self.commit.latest >= self.settled_after

    def is_lasting(self, when: Interval) -> bool:
        """Whether the tone certainly lasts through an interval."""
        return self.path[-1] != 0 and self._elapsed(when)[1] < self.valid_for

    def present(self, when: Interval) -> tuple[float, float, complex] | None:
        """Least and highest magnitude of the lasting tone, and its direction.

        None if its phase may change within the interval.
        """
        direction = _direction(self.path[-1])
        amplitudes = self._amplitudes(*self._elapsed(when))
        along = [(amplitude * direction.conjugate()) for amplitude in amplitudes]
        if any(abs(one.imag) > 1e-9 or one.real < -1e-9 for one in along):
            return None
        lowest = min(one.real for one in along)
        if self.is_shaped and self.begin_low < abs(self.path[0]):
            lowest = self.low(when)
        elif not self.is_shaped:
            # What played before may fade on its own, and sooner than the ramp.
            lowest = min(lowest, self._share(self._elapsed(when)[0]) * abs(self.path[-1]))
        return max(0.0, lowest), max(one.real for one in along), direction

    def sounding(self, when: Interval) -> frozenset[float]:
        """Frequencies [Hz] of all tones that may play within an interval."""
        begin, _ = self._elapsed(when)
        found = set(self.frequencies) if self.rest_at(begin) > 0 else set()
        if self.high(when) > 0:
            found.add(self.frequency)
        return frozenset(found)

    @property
    def envelope_slope(self) -> float:
        """Steepest rise [1/s] along the envelopes of its tone."""
        slopes = [steepest_rise(self.path) / self.step] if self.is_shaped else []
        if self.ending is not None:
            slopes.append(steepest_rise(_phasors(self.ending)) / self.ending.step)
        return max(slopes, default=0.0)

    def _elapsed(self, when: Interval) -> tuple[float, float]:
        """Shortest and longest time [s] since the commit."""
        shortest = max(0.0, when.earliest - self.commit.latest)
        return shortest, max(shortest, when.latest - self.commit.earliest)

    def _share(self, elapsed: float) -> float:
        return _raised_cosine(elapsed, self.step)

    @property
    def _highest_knot(self) -> float:
        return max((knot.level for knot in self.ending.knots), default=0.0) if self.ending else 0.0

    def _amplitudes(self, begin: float, end: float) -> tuple[complex, ...]:
        """Amplitudes of the lasting tone at two times [s] since the commit, and knots between."""
        if not self.is_shaped:
            first, last = self.path[0], self.path[-1]
            return tuple(first + (last - first) * self._share(time) for time in (begin, end))
        inner = [
            value for number, value in enumerate(self.path) if begin < number * self.step < end
        ]
        return (self._shaped(begin), *inner, self._shaped(end))

    def _shaped(self, elapsed: float) -> complex:
        place = elapsed / self.step
        if place >= len(self.path) - 1:
            return self.path[-1]
        before = int(place)
        here, there = self.path[before : before + 2]
        return here + (there - here) * (place - before)


def duration(envelope: Envelope) -> float:
    """Return the duration [s] of an envelope, to the amplitude after its last knot."""
    return envelope.step * (len(envelope.knots) + 1)


def steepest_rise(amplitudes: Sequence[complex]) -> float:
    """Return the highest rise of the magnitude between neighbours, per full transition.

    On the straight line from a to b the magnitude rises fastest at b, by |b| - |a| cos(angle).
    """
    rises = (abs(b) - (a * b.conjugate()).real / abs(b) for a, b in pairwise(amplitudes) if b != 0)
    return max(rises, default=0.0)


def followed_by(
    state: ChannelState,
    command: DriveCommand,
    commit: Interval,
    *,
    ramp: float,
    valid_for: float,
    onset: Envelope | None,
    ending: Envelope | None,
) -> tuple[ChannelState, float]:
    """Return the state after a command, and the highest mean slope [1/s] of its rise.

    commit: when it is carried out; onset, ending: the envelopes in the slots of the command. Where
    a rise takes no time the slope is infinite.
    """
    target = command.phasor
    falls_silent = target == 0 and onset is None
    shape = onset
    if falls_silent and not command.skip_ending:
        shape = state.ending
    continues = None
    if state.is_lasting(commit) and (
        falls_silent or (command.keep_phase and state.frequency == command.frequency)
    ):
        continues = state.present(commit)
    low, high, direction = continues or (0.0, 0.0, 1 + 0j)
    if continues is None:
        rest, others = state.high(commit), state.sounding(commit)
    else:
        rest = state.rest_at(max(0.0, commit.earliest - state.commit.latest))
        others = state.frequencies if rest > 0 else frozenset()
    # Under an envelope what continues must be known; of an interrupted ramp it may be the new part.
    is_unknown = (
        shape is not None
        and (falls_silent or (command.keep_phase and command.frequency in state.sounding(commit)))
        and not (continues and state.is_settled(commit))
    )
    if is_unknown:
        low, high = 0.0, state.high(commit)
        rest, others = high, state.sounding(commit)
        direction = _direction((*_phasors(shape), target)[0])  # the highest sum
    kept_slope = 0.0 if state.is_settled(commit) else state.kept_slope
    keeps_rest = state.may_be_kept(commit)
    if keeps_rest:
        rest = max(rest, state.worst)
        kept_slope += state.envelope_slope
    fade = ramp
    if is_unknown and falls_silent:  # without a tone to end, earlier fades may go on
        keeps_rest, fade = True, max(ramp, state.settled_after, state.ending_time)
    frequency = state.frequency if falls_silent else command.frequency
    step = shape.step if shape is not None else ramp
    following_knots = (*_phasors(shape), target)
    rise = max(steepest_rise((direction * m, *following_knots)) for m in (low, high))
    interferes = any(following_knots) and frequency in others
    if interferes:
        rise += rest
    if is_unknown:
        rise += high
    slope = 0.0
    if rise > _ROUNDING:
        slope = (rise / step if step > 0 else math.inf) + kept_slope
    following = ChannelState(
        frequency=frequency,
        path=(direction * high, *following_knots),
        step=step,
        is_shaped=shape is not None,
        begin_low=low,
        commit=commit,
        rest=rest,
        fade=fade,
        frequencies=others,
        kept_slope=max(kept_slope, rest / ramp if interferes and ramp > 0 else 0.0),
        valid_for=valid_for or _FAR,
        ending=ending,
        keeps_rest=keeps_rest,
        may_be_silent=is_unknown,
    )
    if ending is not None:  # as at the end of valid_for; a later set is checked on its own
        reached = following._amplitudes(valid_for, valid_for)[-1] if valid_for else target
        slope = max(slope, steepest_rise((reached, *_phasors(ending))) / ending.step)
    return following, slope


def unknown_between(states: Sequence[ChannelState], when: Interval) -> ChannelState:
    """Return the state of a channel that plays one of several, it is not known which."""
    return ChannelState(
        rest=max(max(state.high(when), state.worst) for state in states),
        step=_FAR,
        fade=_FAR,
        frequencies=frozenset().union(
            *(state.sounding(when) | {state.frequency} for state in states)
        ),
        kept_slope=max(state.kept_slope for state in states),
        commit=when,
    )


def _raised_cosine(elapsed: float, ramp: float) -> float:
    """Share 0..1 of a transition a time [s] after its begin."""
    if elapsed >= ramp:
        return 1.0
    return (1 - math.cos(math.pi * elapsed / ramp)) / 2 if math.isfinite(ramp) else 0.0


def _phasors(envelope: Envelope | None) -> tuple[complex, ...]:
    return tuple(knot.phasor for knot in envelope.knots) if envelope is not None else ()


def _direction(amplitude: complex) -> complex:
    return amplitude / abs(amplitude) if amplitude else 1 + 0j


def _least_modulus(amplitudes: Sequence[complex]) -> float:
    """Return the least magnitude on the straight lines through amplitudes."""
    least = min(map(abs, amplitudes))
    for here, there in pairwise(amplitudes):
        along = there - here
        if along:
            share = -(here * along.conjugate()).real / abs(along) ** 2
            if 0 < share < 1:
                least = min(least, abs(here + along * share))
    return least
