"""Bounds of what one channel plays, from the sets that it was given.

A set starts a lasting tone and fades every other one along its ramp. Its commit is known as an
interval; bounds hold for every time within it. Without a slew limit they decide only on the sum of
tones under envelopes.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import NamedTuple

from drivers.command import DriveCommand, Envelope

_FAR = math.inf
_NOTHING: frozenset[float] = frozenset()
_ROUNDING = 1e-9  # of full stroke; sums of floats


class Interval(NamedTuple):
    """A time [s] between two bounds."""

    earliest: float
    latest: float


_LONG_AGO = Interval(-_FAR, -_FAR)


@dataclass(slots=True)  # frozen, each takes three times as long to make, and every set makes many
class ChannelState:
    """Playback of a channel since a commit, at first silence: a lasting tone over fading ones.

    frequency [Hz] and path: of the lasting tone, its complex amplitudes in full strokes, `step` [s]
    apart; along a raised cosine between two unless is_shaped. first_low: lower bound of the first
    magnitude, of which path has the upper. commit: when it started. valid_for [s] after the commit:
    then it ends, along `ending` or the ramp. may_be_silent: whether it may not play at all.

    fading: upper bound of the sum of all fading magnitudes at the commit, which end within `fade`
    [s]; frequencies [Hz]: theirs; fading_slope [1/s]: rise of the level where fading tones of one
    frequency cease to cancel; fading_may_hold: whether they may follow an envelope within that
    time instead of the ramp.
    """

    frequency: float = 0.0
    path: tuple[complex, ...] = (0j, 0j)
    step: float = 0.0
    is_shaped: bool = False
    first_low: float = 0.0
    commit: Interval = _LONG_AGO
    fading: float = 0.0
    fade: float = 0.0
    frequencies: frozenset[float] = frozenset()
    fading_slope: float = 0.0
    valid_for: float = _FAR
    ending: Envelope | None = None
    may_be_silent: bool = False
    fading_may_hold: bool = False

    def low(self, when: Interval) -> float:
        """Lower bound of the level within an interval."""
        return self._low(*self._elapsed(when))

    def high(self, when: Interval) -> float:
        """Upper bound of the level within an interval."""
        return self._high(*self._elapsed(when))

    def levels(self, when: Interval) -> tuple[float, float]:
        """Bounds of the level within an interval."""
        start, end = self._elapsed(when)
        return self._low(start, end), self._high(start, end)

    def lasting_low(self, when: Interval) -> float:
        """Lower bound of the lasting tone alone, which fading ones may cancel."""
        return self._lasting_low(*self._elapsed(when))

    def _low(self, start: float, end: float) -> float:
        """Lower bound of the level between two times [s] since the commit."""
        lasting = self._lasting_low(start, end)
        if lasting > 0 and self.frequency in self.frequencies:
            lasting -= self.fading_at(start)
        return lasting if lasting > 0 else 0.0

    def _lasting_low(self, start: float, end: float) -> float:
        """See `lasting_low`, between two times [s] since the commit."""
        if end > self.valid_for or self.may_be_silent:
            return 0.0
        if not (self.is_shaped or self.path[0]):  # it rises from silence
            return abs(self.path[-1]) * _raised_cosine(start, self.step)
        lowest = _least_modulus(self._amplitudes(start, end))
        if self.first_low < abs(self.path[0]):
            first, *others = self.path
            if (first * others[0].conjugate()).real < 0:
                return 0.0
            weaker = replace(self, path=(_phase_factor(first) * self.first_low, *others))
            lowest = min(lowest, _least_modulus(weaker._amplitudes(start, end)))
        return lowest

    def _high(self, start: float, end: float) -> float:
        """Upper bound of the level between two times [s] since the commit."""
        # An envelope to silence ends by itself.
        length = math.inf if self.is_shaped and self.path[-1] == 0 else self.valid_for
        settled_after = self.settled_after
        if start >= settled_after and start >= self.valid_for + self.ending_time:
            return 0.0
        last = end if end < length else length
        first = start if start < last else last
        if self.is_shaped:
            highest = max(map(abs, self._amplitudes(first, last))) + self.fading_at(first)
        else:
            kept = self.fading_at(first) if self.fading_may_hold else 0.0
            both = abs(self.path[0]) + (0.0 if self.fading_may_hold else self.fading)
            reached = abs(self.path[-1])
            fraction = _raised_cosine(last if reached > both else first, self.step)
            highest = (1 - fraction) * both + fraction * reached + kept
        if self.ending is not None and end > self.valid_for:
            interrupted = abs(self.path[0]) if last < settled_after else 0.0  # fades by itself
            fading = self.fading_at(min(last, max(start, self.valid_for)))
            highest = max(highest, self._highest_knot + interrupted + fading)
        return highest

    @property
    def max_level(self) -> float:
        """Highest level from the commit to the end."""
        is_plain = not self.is_shaped and not self.fading_may_hold
        if is_plain and (self.ending is None or self.valid_for >= self.fade):
            return max(abs(self.path[0]) + self.fading, abs(self.path[-1]), self._highest_knot)
        highest = max(map(abs, self.path)) + self.fading
        if self.ending is not None and self.valid_for < self.settled_after:
            return highest + self._highest_knot
        return max(highest, self._highest_knot + self.fading)

    @property
    def ending_time(self) -> float:
        """Time [s] from the end of valid_for until silence."""
        if self.ending is None:
            return self.fade
        return max(self.fade, duration(self.ending))

    @property
    def settled_after(self) -> float:
        """Time [s] from the commit until only the lasting tone plays at its last amplitude."""
        along = self.step * (len(self.path) - 1)
        return along if along > self.fade else self.fade

    def fading_at(self, elapsed: float) -> float:
        """Upper bound of the fading tones a time [s] after the latest commit."""
        if not self.fading:
            return 0.0
        if self.fading_may_hold:
            return self.fading if elapsed < self.fade else 0.0
        return self.fading * (1 - _raised_cosine(elapsed, self.fade))

    def may_be_ending(self, when: Interval) -> bool:
        """Whether an envelope to silence may be running; longer ramps do not shorten it."""
        if self.ending is not None:
            start, end = self._elapsed(when)
            if self.valid_for <= end:
                return start < self.valid_for + self.ending_time
        ends_silent = self.is_shaped and self.path[-1] == 0
        return (ends_silent or self.fading_may_hold) and not self.is_settled(when)

    def is_settled(self, when: Interval) -> bool:
        """Whether only the lasting tone plays from the start of an interval."""
        return when.earliest - self.commit.latest >= self.settled_after

    def is_lasting(self, when: Interval) -> bool:
        """Whether the tone certainly lasts through an interval."""
        return self.path[-1] != 0 and self._elapsed(when)[1] < self.valid_for

    def lasting_range(self, when: Interval) -> tuple[float, float, complex] | None:
        """Bounds of the magnitude of the lasting tone, and its phase factor.

        None if its phase may change within the interval.
        """
        phase_factor = _phase_factor(self.path[-1])
        amplitudes = self._amplitudes(*self._elapsed(when))
        along = [(amplitude * phase_factor.conjugate()) for amplitude in amplitudes]
        if any(abs(one.imag) > 1e-9 or one.real < -1e-9 for one in along):
            return None
        lowest = min(one.real for one in along)
        if self.is_shaped and self.first_low < abs(self.path[0]):
            lowest = self.low(when)
        elif not self.is_shaped:
            # What played before may fade by itself, and sooner than the ramp.
            lowest = min(
                lowest, _raised_cosine(self._elapsed(when)[0], self.step) * abs(self.path[-1])
            )
        return max(0.0, lowest), max(one.real for one in along), phase_factor

    def frequencies_at(self, when: Interval) -> frozenset[float]:
        """Frequencies [Hz] of all tones that may play within an interval."""
        return self.bounds(when)[1]

    def bounds(self, when: Interval) -> tuple[float, frozenset[float]]:
        """Upper bound of the level within an interval, and frequencies [Hz] of what may play."""
        start, end = self._elapsed(when)
        high = self._high(start, end)
        found = _NOTHING
        if self.frequencies and self.fading_at(start) > 0:
            found = self.frequencies
        return high, found | {self.frequency} if high > 0 else found

    @property
    def envelope_slope(self) -> float:
        """Steepest rise [1/s] along the envelopes of its tone."""
        slopes = [steepest_rise(self.path) / self.step] if self.is_shaped else []
        if self.ending is not None:
            slopes.append(steepest_rise(_phasors(self.ending)) / self.ending.step)
        return max(slopes, default=0.0)

    def _elapsed(self, when: Interval) -> tuple[float, float]:
        """Shortest and longest time [s] since the commit."""
        earliest, latest = self.commit
        shortest = when.earliest - latest
        if shortest < 0:
            shortest = 0.0
        end = when.latest - earliest
        return shortest, end if end > shortest else shortest

    @property
    def _highest_knot(self) -> float:
        return max((knot.level for knot in self.ending.knots), default=0.0) if self.ending else 0.0

    def _amplitudes(self, start: float, end: float) -> tuple[complex, ...]:
        """Amplitudes of the lasting tone at two times [s] since the commit, and knots between."""
        if not self.is_shaped:
            first, last = self.path[0], self.path[-1]
            return tuple(
                first + (last - first) * _raised_cosine(time, self.step) for time in (start, end)
            )
        inner = [
            value for number, value in enumerate(self.path) if start < number * self.step < end
        ]
        return (self._shaped(start), *inner, self._shaped(end))

    def _shaped(self, elapsed: float) -> complex:
        position = elapsed / self.step
        if position >= len(self.path) - 1:
            return self.path[-1]
        before = int(position)
        here, there = self.path[before : before + 2]
        return here + (there - here) * (position - before)


def duration(envelope: Envelope) -> float:
    """Return the duration [s] of an envelope, to the amplitude after its last knot."""
    return envelope.step * (len(envelope.knots) + 1)


def steepest_rise(amplitudes: Sequence[complex]) -> float:
    """Return the highest rise of the magnitude between neighbours, per full transition.

    On the straight line from a to b the magnitude rises fastest at b, by |b| - |a| cos(angle).
    """
    if len(amplitudes) == 2:  # along a ramp
        a, b = amplitudes
        return abs(b) - (a * b.conjugate()).real / abs(b) if b else 0.0
    rises = (abs(b) - (a * b.conjugate()).real / abs(b) for a, b in pairwise(amplitudes) if b != 0)
    return max(rises, default=0.0)


def state_after(
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
    may_continue = falls_silent or (command.keep_phase and state.frequency == command.frequency)
    if may_continue and state.is_lasting(commit):
        continues = state.lasting_range(commit)
    low, high, phase_factor = continues or (0.0, 0.0, 1 + 0j)
    if continues is None:
        fading, others = state.bounds(commit)
    else:
        fading = state.fading_at(max(0.0, commit.earliest - state.commit.latest))
        others = state.frequencies if fading > 0 else frozenset()
    # Under an envelope what continues must be known; of an interrupted ramp it may be the new part.
    is_unknown = (
        shape is not None
        and (
            falls_silent
            or (command.keep_phase and command.frequency in state.frequencies_at(commit))
        )
        and not (continues and state.is_settled(commit))
    )
    if is_unknown:
        low, (high, others) = 0.0, state.bounds(commit)
        fading = high
        phase_factor = _phase_factor((*_phasors(shape), target)[0])  # the highest sum
    fading_slope = state.fading_slope
    if fading_slope and state.is_settled(commit):
        fading_slope = 0.0
    fading_may_hold = state.may_be_ending(commit)
    if fading_may_hold:
        fading = max(fading, state.max_level)
        fading_slope += state.envelope_slope
    fade = ramp
    if is_unknown and falls_silent:  # without a tone to end, earlier fades may go on
        fading_may_hold, fade = True, max(ramp, state.settled_after, state.ending_time)
    frequency = state.frequency if falls_silent else command.frequency
    step = shape.step if shape is not None else ramp
    following_knots = (*_phasors(shape), target)
    rise = steepest_rise((phase_factor * high, *following_knots))
    if low != high:
        rise = max(rise, steepest_rise((phase_factor * low, *following_knots)))
    interferes = any(following_knots) and frequency in others
    if interferes:
        rise += fading
    if is_unknown:
        rise += high
    slope = 0.0
    if rise > _ROUNDING:
        slope = (rise / step if step > 0 else math.inf) + fading_slope
    following = ChannelState(
        frequency=frequency,
        path=(phase_factor * high, *following_knots),
        step=step,
        is_shaped=shape is not None,
        first_low=low,
        commit=commit,
        fading=fading,
        fade=fade,
        frequencies=others,
        fading_slope=max(fading_slope, fading / ramp if interferes and ramp > 0 else 0.0),
        valid_for=valid_for or _FAR,
        ending=ending,
        fading_may_hold=fading_may_hold,
        may_be_silent=is_unknown,
    )
    if ending is not None:  # as at the end of valid_for; a later set is checked on its own
        reached = following._amplitudes(valid_for, valid_for)[-1] if valid_for else target
        slope = max(slope, steepest_rise((reached, *_phasors(ending))) / ending.step)
    return following, slope


def union_of(states: Sequence[ChannelState], when: Interval) -> ChannelState:
    """Return the bounds of a channel in any one of several states."""
    return ChannelState(
        fading=max(max(state.high(when), state.max_level) for state in states),
        step=_FAR,
        fade=_FAR,
        frequencies=frozenset().union(
            *(state.frequencies_at(when) | {state.frequency} for state in states)
        ),
        fading_slope=max(state.fading_slope for state in states),
        commit=when,
    )


def _raised_cosine(elapsed: float, ramp: float) -> float:
    """Progress 0..1 of a transition a time [s] after its start."""
    if elapsed >= ramp:
        return 1.0
    return (1 - math.cos(math.pi * elapsed / ramp)) / 2 if ramp < _FAR else 0.0


def _phasors(envelope: Envelope | None) -> tuple[complex, ...]:
    return () if envelope is None else tuple(knot.phasor for knot in envelope.knots)


def _phase_factor(amplitude: complex) -> complex:
    return amplitude / abs(amplitude) if amplitude else 1 + 0j


def _least_modulus(amplitudes: Sequence[complex]) -> float:
    """Return the least magnitude on the straight lines through amplitudes."""
    least = min(map(abs, amplitudes))
    for here, there in pairwise(amplitudes):
        along = there - here
        if along:
            fraction = -(here * along.conjugate()).real / abs(along) ** 2
            if 0 < fraction < 1:
                least = min(least, abs(here + along * fraction))
    return least
