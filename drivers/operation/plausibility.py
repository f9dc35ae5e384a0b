"""Comparison of an amplifier's reports with its requests.

Tolerances are the amplifier's own steps. Levels are compared at any time, also while they change:
they must be within the bounds of a transition whose commit is known as an interval.
"""

import math
from collections.abc import Iterator
from dataclasses import replace

from drivers.command import DriveCommand
from drivers.errors import CommandRefused
from drivers.guard import SafeCommandSet
from drivers.guard.channel_state import ChannelState, Interval
from drivers.guard.record import states_after
from drivers.protocol.definition import PROTOCOL, WireQuantity
from drivers.protocol.messages import (
    MEASURING_ERROR,
    Achieved,
    AmplifierState,
    Capabilities,
    Feature,
    Status,
)

MAX_CONTRADICTIONS = 2
"""Contradictions in a row that are a fault; a single one may be a moment between two sets."""

CYCLE = 0.002
"""Longest lag [s] of playback and reports behind a commit."""

_WEAK = 0.25  # largest measuring error, relative to a weak level
_ROUNDING = 1e-9
_Q = PROTOCOL.quantities
_WATCHDOG_ERROR = PROTOCOL.reaction + _Q.watchdog_left.step  # s


class PlausibilityCheck:
    """Compares every Status and Achieved of one armed amplifier with its requests.

    name: of the amplifier, in messages. Times [s] are of the host's clock: sent_at of the request,
    now of its reply. Two contradictions in a row raise CommandRefused with the reason; an Achieved
    that contradicts its set counts again with each Status until the next set.
    """

    def __init__(self, capabilities: Capabilities, name: str = "the amplifier") -> None:
        self._capabilities = capabilities
        self._name = name
        self._level_step = max(_Q.level.step, capabilities.level_step)
        is_measured = Feature.LEVELS_MEASURED in capabilities.features
        self._measuring_error = MEASURING_ERROR if is_measured else 0.0
        self._states: tuple[ChannelState, ...] = ()  # empty: unknown
        self._known: tuple[ChannelState, ...] = ()  # before the first unconfirmed set
        self._unconfirmed: set[int] = set()  # tokens
        # What each channel may play, while its state is unknown [Hz].
        self._frequencies: list[set[float]] = [set() for _ in range(capabilities.channels)]
        self._fade = 0.0  # s; the longest fade while states are unknown
        self._tokens: set[int] = set()  # that may be active; empty: unknown
        self._watchdog: float | None = None
        self._fed: Interval | None = None
        self._achieved_problem: str | None = None
        self._contradictions = 0
        self._was_about_level = False  # the last contradiction
        self._stalled_watchdog_count = 0  # statuses in a row in which it did not run down

    def expect_armed(self, watchdog: float, *, sent_at: float, now: float) -> None:
        """Expect silence and a full watchdog [s] after an Arm was confirmed."""
        self._states = (ChannelState(),) * self._capabilities.channels
        self._tokens = {0}
        has_watchdog = Feature.WATCHDOG in self._capabilities.features
        self._watchdog = _Q.watchdog.quantise(watchdog) if has_watchdog else None
        self._fed = Interval(sent_at, now)
        self._achieved_problem = None
        self._contradictions = self._stalled_watchdog_count = 0

    def forget(self, requested: SafeCommandSet) -> None:
        """Expect no levels: until a set that is sent is confirmed it may play or not."""
        if self._states:
            self._known = self._states
            self._frequencies = [{state.frequency, *state.frequencies} for state in self._states]
            self._fade = max(state.settled_after for state in self._states)
        self._unconfirmed.add(requested.token)
        self._fade = max(self._fade, requested.settled_after)
        for command in requested.commands:
            self._frequencies[command.channel].add(command.frequency)
        self._states = ()
        if self._tokens:
            self._tokens.add(requested.token)

    def expect(self, requested: SafeCommandSet, *, sent_at: float, now: float) -> None:
        """Expect a set that was confirmed; sent_at [s]: before its commit."""
        when = Interval(sent_at, now + CYCLE)
        slots = requested.record.slots
        if self._known and self._unconfirmed <= {requested.token}:
            self._states, _ = states_after(self._known, requested, when, slots)
        else:
            unknown, _ = states_after(self._unknown_states(when), requested, when, slots)
            # Where there are endings, earlier fades may go on beside them.
            fade = max(self._fade, requested.settled_after) if slots else requested.ramp
            self._states = tuple(_with_longer_fade(state, fade) for state in unknown)
        self._known, self._unconfirmed = (), set()
        self._tokens = {requested.token}
        self._fed = Interval(sent_at, now)

    def check_achieved(self, requested: SafeCommandSet, achieved: Achieved) -> None:
        """Compare an achieved set with the requested one."""
        self._achieved_problem = next(self._achieved_problems(requested, achieved), None)
        if self._achieved_problem is not None:
            self._contradictions += 1
            self._was_about_level = False
            self._raise_if_fault(self._contradictions, self._achieved_problem)

    def check_status(
        self,
        status: Status,
        *,
        sent_at: float,
        now: float,
        feeds: bool = False,
    ) -> None:
        """Compare a status with the requests; feeds: whether its request fed the watchdog.

        Right after a commit hardly any level is a contradiction, so agreement then does not reset
        the count of level contradictions. Raises CommandRefused at once for an amplifier that is
        no longer enabled.
        """
        if status.state is not AmplifierState.OPERATION_ENABLED:
            raise CommandRefused(
                f"{self._name}: state must be OPERATION_ENABLED, got {status.state.name} with "
                f"fault {status.fault.name}; once the cause is gone, clear and arm again"
            )
        when = Interval(sent_at, now)
        problem = (
            self._watchdog_problem(status, when, feeds=feeds)
            or next(self._other_problems(status), None)
            or self._achieved_problem
        )
        level_problem = next(self._level_problems(status, when), None)
        if problem or level_problem:
            self._contradictions += 1
            self._was_about_level = problem is None
        elif not self._was_about_level or self._shows_levels(when):
            self._contradictions = 0
        problem = problem or level_problem
        self._raise_if_fault(self._contradictions, problem)

    def check_running(self, status: Status, *, sent_at: float, last_fed_at: float) -> None:
        """Compare the watchdog with the time since it may have been fed last, if it is long enough.

        status: of a request that does not feed it.
        """
        if self._watchdog is None or self._fed is None:
            return
        elapsed = sent_at - max(last_fed_at, self._fed.latest)
        if elapsed <= 2 * _WATCHDOG_ERROR:
            return
        highest = self._watchdog - elapsed + _WATCHDOG_ERROR
        is_standing = status.watchdog_left > highest
        self._stalled_watchdog_count = self._stalled_watchdog_count + 1 if is_standing else 0
        self._raise_if_fault(
            self._stalled_watchdog_count,
            f"watchdog left must be at most {highest:.3f} s {elapsed:.3f} s after it was fed, got "
            f"{status.watchdog_left:.3f} s",
        )

    def _watchdog_problem(self, status: Status, when: Interval, *, feeds: bool) -> str | None:
        """Describe an impossible time that is left; notes that the watchdog was fed."""
        if self._watchdog is None or self._fed is None:
            return None
        full = self._watchdog + _WATCHDOG_ERROR
        lowest = self._watchdog - (when.latest - self._fed.earliest) - _WATCHDOG_ERROR
        highest = full
        if feeds:
            just_fed = self._watchdog - (when.latest - when.earliest) - _WATCHDOG_ERROR
            if just_fed <= status.watchdog_left <= full:
                self._fed = when
                return None
            # On CAN the frame that feeds it may be lost, and it runs on.
            highest = full - (when.earliest - self._fed.latest)
        if lowest <= status.watchdog_left <= highest:
            return None
        return (
            f"watchdog left must be {max(0.0, lowest):.3f} to {full:.3f} s, got "
            f"{status.watchdog_left:.3f} s"
        )

    def _unknown_states(self, when: Interval) -> tuple[ChannelState, ...]:
        """Return states of channels that may play any level until a set replaces it."""
        return tuple(
            ChannelState(
                fading=self._capabilities.level_max,
                step=math.inf,
                fade=math.inf,
                frequencies=frozenset(frequencies),
                commit=when,
            )
            for frequencies in self._frequencies
        )

    def _achieved_problems(self, requested: SafeCommandSet, achieved: Achieved) -> Iterator[str]:
        if (achieved.token, achieved.commands) == (requested.token, requested.commands):
            return  # to the step
        if achieved.token != requested.token:
            yield f"token achieved must be {requested.token}, got {achieved.token}"
        commands = {command.channel: command for command in requested.commands}
        played = {command.channel: command for command in achieved.commands}
        can = self._capabilities
        for channel in sorted(commands.keys() | played.keys()):
            silent = DriveCommand(channel, 0.0, 0.0)
            one, other = commands.get(channel, silent), played.get(channel, silent)
            compared = [("level", one.level, other.level, _tolerance(_Q.level, can.level_step))]
            if one.level > 0:
                phase = math.remainder(other.phase - one.phase, 360.0)
                compared += [
                    (
                        "frequency",
                        one.frequency,
                        other.frequency,
                        _tolerance(_Q.frequency, can.frequency_step),
                    ),
                    ("onset", one.onset, other.onset, 0.0),
                    ("ending", one.ending, other.ending, 0.0),
                ]
                if Feature.PHASE in can.features:
                    step = _tolerance(_Q.phase, can.phase_step)
                    compared.append(("phase", one.phase, one.phase + phase, step))
            for name, expected, got, tolerance in compared:
                if not abs(got - expected) <= tolerance + _ROUNDING:
                    yield f"{name} achieved on channel {channel} must be {expected:g}, got {got:g}"

    def _other_problems(self, status: Status) -> Iterator[str]:
        if not status.high_voltage:
            yield "high voltage must be on, got off"
        if self._tokens and status.token not in self._tokens:
            possible = " or ".join(map(str, sorted(self._tokens)))
            yield f"playing set must be {possible}, got {status.token}"

    def _level_problems(self, status: Status, when: Interval) -> Iterator[str]:
        step, measuring_error = self._level_step, self._measuring_error
        tolerance = 2 * step
        has_exact_fades = self._capabilities.has_exact_fades
        for channel, (state, level) in enumerate(zip(self._states, status.levels, strict=False)):
            if not (has_exact_fades or state.is_settled(when)):
                continue
            low, high = state.levels(when)
            # Fading tones may cancel the lasting one, but not to zero twice in a row.
            if level == 0 and state.lasting_low(when) > 0.75 * step:
                yield f"level of channel {channel} must be above 0, got 0"
            if measuring_error:
                low -= min(measuring_error, _WEAK * low)
                high += min(measuring_error, _WEAK * high)
            if not low - tolerance <= level <= high + tolerance:
                expected = f"{max(0.0, low - tolerance):.4g} to {high + tolerance:.4g}"
                yield f"level of channel {channel} must be {expected}, got {level:g}"

    def _shows_levels(self, when: Interval) -> bool:
        """Whether every channel that plays must report a level."""
        return bool(self._states) and all(
            not state.is_lasting(when) or state.lasting_low(when) > 0 for state in self._states
        )

    def _raise_if_fault(self, contradictions: int, problem: str | None) -> None:
        if contradictions >= MAX_CONTRADICTIONS:
            raise CommandRefused(
                f"{self._name} contradicts its requests: {problem}; look for a derated or "
                "broken channel, an exchanged cable or firmware, then clear and arm again"
            )


def _with_longer_fade(state: ChannelState, lasts: float) -> ChannelState:
    """Return a state whose fading tones may last for a time [s], as along an ending."""
    if lasts <= state.fade:
        return state
    return replace(state, fade=lasts, fading_may_hold=True)


def _tolerance(quantity: WireQuantity, step: float) -> float:
    """Return the rounding error of an amplifier with a step, and of the wire."""
    return (step + quantity.step) / 2
