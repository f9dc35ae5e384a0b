"""The ledger of an amplifier: the sets sent, confirmed and possibly playing.

Only the ledger makes the sets sent over the wire. It checks a set when its turn on the line comes,
with the rounding of the wire, together with the current playback. A set sent but not yet confirmed
is a doubt: until it is resolved, only silence is admitted. All times [s] refer to one arbitrary
clock.
"""

import logging
import math
import sys
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

from drivers.errors import CommandRefused
from drivers.host.bounds import Bounds, PeakSums
from drivers.host.budget import COMMIT_DELAY, Budget, VibrationSpan
from drivers.host.rounding import Rounding, refused, wire_limits
from drivers.playing import AmplifierLayer, Playback, fade_of
from drivers.protocol.definition import QUANTITIES, has_feature
from drivers.protocol.records import Values
from drivers.protocol.sets import Command, LayerSet, is_vibrating
from registry.limits import GuardLimits

TOLERANCE = 1 + 1e-9
"""Tolerance factor of a limit for rounding of sums."""

_LEVEL = QUANTITIES["level"]
_RAMP = QUANTITIES["ramp"]
_VALID_FOR = QUANTITIES["valid_for"]
_STEPS = 2  # tolerance of levels in a status, in steps
_MEASURING_ERROR = 0.002  # of full level, if the amplifier measures its levels
_WEAK = 0.25  # largest measuring error, as a share of a weak level
_logger = logging.getLogger(__name__)


class Doubt(NamedTuple):
    """A set that was sent and is not confirmed yet."""

    token: int
    layers: tuple[LayerSet, ...]
    sent_at: float
    """When it may have begun to play [s]."""
    last_vibration: VibrationSpan | None
    """The vibration that the budget counted before it."""


class Ledger:
    """The ledger of an amplifier, initially silent.

    limits: configured limits; capabilities: values of the amplifier's record. Raises CommandError
    if the limits leave nothing to play.
    """

    def __init__(self, limits: GuardLimits, capabilities: Values) -> None:
        self._configured = limits
        self.adopt(capabilities)  # refuses limits that are no numbers
        self._budget = Budget(limits)

    def adopt(self, capabilities: Values) -> None:
        """Adopt new capabilities of the silent amplifier; spent on-time and duty stay spent."""
        self.limits = wire_limits(self._configured, capabilities)
        self.capabilities = capabilities
        self._is_measured = has_feature(capabilities, "levels_measured")
        self._rounding = Rounding(self.limits, capabilities)
        self.forget()

    def forget(self) -> None:
        """Begin with silence: nothing plays, whether the amplifier is armed or not."""
        # An amplifier may cut fades short, depending on when it plays. Upper bounds assume that it
        # cuts none.
        self.playback = Playback(self.capabilities["channels"], voices=sys.maxsize)
        self.lag = 0.0
        """By how much the amplifier may lag behind `playback` [s]."""
        self._starts = -math.inf
        """Start time in the last commit [s]; -infinite for an immediate start."""
        self._start_error = 0.0
        """Largest error of that time on the amplifier's clock [s]."""
        self._advanced_to = -math.inf
        """Everything due by this time [s] has been carried out."""
        self._is_playback_unsure = False
        """Whether silence followed a vibration in doubt, which may play or not."""
        self.may_be_silent = set[int]()
        """Layers that may be silent, after a silence without a reply or a renewal that was late."""
        self.doubt: Doubt | None = None
        """The set that was committed and is not confirmed."""
        self._last_token = 0
        """Token of the last set that was committed."""
        self._last_sent_at = 0.0
        """When the first commit of that set went out, or its start time [s]."""

    def go_on_from(self, earlier: "Ledger") -> None:
        """Count the vibrations of an earlier ledger of the same rig, as after a reconnection."""
        if self._configured == earlier._configured:
            self._budget = earlier._budget

    def admit(
        self, layers: Sequence[AmplifierLayer], now: float, *, delay: float = COMMIT_DELAY
    ) -> tuple[LayerSet, ...]:
        """Return layers in wire integers, with `valid_for` cut to the remaining time.

        delay: maximum time until they are committed [s]. Raises CommandRefused with channel and
        reason for any failure of the checks; nothing changes in that case.
        """
        try:
            requested = self._rounding.layers(layers)
            if not is_vibrating(*requested):
                return self._silence(requested, now, delay)
            if self.doubt is not None:
                token = self.doubt.token
                raise CommandRefused(f"set {token} must be confirmed first; read the status")
            if self._is_playback_unsure:
                raise CommandRefused("a set had no reply before the next; silence the amplifier")
            requested = self._within_budget(requested, now, delay)
            self._check_sums(requested, now, delay)
            return requested
        except CommandRefused:
            raise
        except (ArithmeticError, TypeError, ValueError) as error:
            raise CommandRefused(f"a set must have numbers in its range: {error}") from error
        except Exception as error:
            _logger.exception("a set could not be checked")
            raise CommandRefused(f"a set could not be checked: {error!r}; silence it") from error

    def _within_budget(
        self, layers: tuple[LayerSet, ...], now: float, delay: float
    ) -> tuple[LayerSet, ...]:
        """Return layers with `valid_for` cut to the time that on-time and duty leave."""
        fade = 0.0 if self._budget.is_unlimited else max(map(fade_of, layers))
        delay_with_onsets = delay + self._waits(layers, now)
        remaining = self._budget.remaining(now, fade=fade, delay=delay_with_onsets)
        if remaining == math.inf:
            return layers
        left = math.floor(min(remaining, _VALID_FOR.high) * _VALID_FOR.per_unit)
        if left <= 0:
            raise CommandRefused("on-time or duty limit reached; pause the vibration")
        shortened = []
        for layer in layers:
            if is_vibrating(layer):
                layer = replace(layer, valid_for=min(layer.valid_for or left, left))
            shortened.append(layer)
        return tuple(shortened)

    def sent(
        self,
        token: int,
        layers: tuple[LayerSet, ...],
        now: float,
        *,
        starts: float | None = None,
        error: float = 0.0,
    ) -> None:
        """Note that a set was committed, so that it may play from now on and is in doubt.

        starts: start time in its commit [s]; None for an immediate start. error: largest error of
        that time on the amplifier's clock [s]. If a commit is repeated, the set may have played
        since the first one, even if a status contradicts this: the status may be older.
        """
        if self.doubt is not None:
            if self.doubt.token == token:
                return
            self._leave_in_doubt(self.doubt)
        if self._last_token != token:
            self._last_token = token
            self._last_sent_at = now if starts is None else starts
            self._starts = -math.inf if starts is None else starts
            self._start_error = error
        last_vibration: VibrationSpan | None = None
        if is_vibrating(*layers):
            lasts = 0.0 if self._budget.is_unlimited else max(map(_duration, layers))
            last_vibration = self._budget.sent(now, lasts=lasts + self._waits(layers, now))
        self.doubt = Doubt(token, layers, self._last_sent_at, last_vibration)

    def _leave_in_doubt(self, doubt: Doubt) -> None:
        """Note that silence follows a set in doubt before its reply.

        A vibration counts as played, but may as well be lost, so that what it should replace plays
        on. Levels have no bound then, and no vibration is admitted until all layers end. A silence
        counts as lost; its layers may be silent.
        """
        if is_vibrating(*doubt.layers):
            self.resolve(doubt.token, doubt.sent_at)
            self._is_playback_unsure = True
            return
        for layer_set in doubt.layers:
            self.may_be_silent.add(layer_set.layer)

    def resolve(self, token: int, now: float) -> None:
        """Resolve the doubt at a time [s] by the token that the amplifier has committed last.

        If it is the set in doubt, that plays, perhaps since it was sent; else it was not played.
        """
        doubt = self.doubt
        if doubt is None:
            return
        self.doubt = None
        if token != doubt.token:
            self._budget.restore(doubt.last_vibration)
            return
        sent_at = doubt.sent_at
        playback = self.playback
        if playback.next_due == math.inf and playback.settles_at <= sent_at - self.lag:
            self.lag = 0.0
        self.lag = max(self.lag, now - sent_at, self._start_error)
        playback.uncertainty = self.lag
        if playback.next_due - 2 * self.lag <= now:
            for layer_set in doubt.layers:
                self._note_possible_end(layer_set, sent_at, now)
        playback.commit(doubt.layers, token, sent_at)
        if not self._budget.is_unlimited:
            self._budget.confirm(sent_at, now, end=self.playback.ends_by + self.lag)

    def _note_possible_end(self, layer_set: LayerSet, sent_at: float, now: float) -> None:
        """Note whether a layer may have ended before a set for it was played."""
        layer = layer_set.layer
        end = self.playback.end_of(layer)
        if not (sent_at < end and end - 2 * self.lag <= now):
            return
        if layer_set.renew:
            self.may_be_silent.add(layer)
        else:
            self.playback.add_ends(layer, sent_at)

    def correct(self, sent: LayerSet, achieved: LayerSet, token: int) -> None:
        """Adopt a layer of the set with this token as the amplifier reports that it plays it.

        Frequencies that the amplifier has rounded are sent rounded from now on, if the limits allow
        it, so that amplifier and ledger keep the phase of the same tones.
        """
        self.playback.correct(achieved, token)
        for command, played in zip(sent.commands, achieved.commands, strict=True):
            if self.limits.frequency_min <= played.frequency <= self.limits.frequency_max:
                self._rounding.achieved[command.channel, command.frequency] = played.frequency

    def note_ended(self, ramp: float, sent_at: float, now: float) -> None:
        """Note that all layers end along a ramp [s], by a request sent at a time [s].

        A set in doubt counts as played until then, so that the limits of duty and on-time hold.
        """
        doubt = self.doubt
        if doubt is not None and doubt.sent_at - self._start_error < sent_at:
            self.resolve(doubt.token, doubt.sent_at)
        self.doubt = None
        self._is_playback_unsure = False
        self.may_be_silent = set()
        self.lag = max(self.lag, now - sent_at)
        self.playback.uncertainty = self.lag
        self.playback.silence(sent_at, ramp)
        if not self._budget.is_unlimited:
            self._budget.confirm(sent_at, now, end=self.playback.ends_by + self.lag)

    def problem_of(self, status: Values, sent_at: float, now: float) -> str | None:
        """Describe a contradiction in the status of an armed amplifier; None if it agrees.

        sent_at, now: when the request for it went out, and when it came [s]. Levels of voices that
        change have only an upper bound, since it is not known exactly when they were committed.
        """
        late = sent_at - self.lag
        # Until then a status may show the set before.
        if sent_at < self._starts + self._start_error or late < self._advanced_to:
            return None
        self._advance(late)
        channel_count = self.playback.channels
        if len(status["levels"]) != channel_count:
            return f"levels must be {channel_count}, got {len(status['levels'])}"
        if len(status["tokens"]) != self.capabilities["layers"]:
            return f"layers must be {self.capabilities['layers']}, got {len(status['tokens'])}"
        unsure_layers = self._unsure_layers(now)
        token_problem = self._token_problem(status["tokens"], unsure_layers)
        if token_problem is not None:
            return token_problem
        return self._level_problem(status["levels"], late, now, unsure_layers)

    def _unsure_layers(self, now: float) -> set[int]:
        """Return the layers that may or may not have changed by now [s]."""
        unsure_until = now + 2 * self.lag
        unsure_layers = {*self.may_be_silent}
        if self.playback.changes_at <= unsure_until:
            unsure_layers |= self.playback.unsure(unsure_until)
        return unsure_layers

    def _token_problem(self, tokens: Sequence[int], unsure_layers: set[int]) -> str | None:
        """Describe the first wrong token of a layer; None if all agree."""
        expected_tokens = self.playback.tokens
        for layer, token in enumerate(tokens):
            expected = expected_tokens.get(layer, 0)
            if token == expected:
                continue
            if layer not in unsure_layers or token not in self.playback.next_tokens(layer):
                return f"token of layer {layer} must be {expected}, got {token}"
        return None

    def _level_problem(
        self, levels: Sequence[int], late: float, now: float, unsure_layers: set[int]
    ) -> str | None:
        """Describe the first wrong level of a channel; None if all agree; see `_highest_level`."""
        tolerance = _STEPS * max(self.capabilities["level_step"], 1)
        for channel, level in enumerate(levels):
            max_level, is_settled = self._highest_level(channel, late, unsure_layers)
            high = round(min(max_level, 1.0) * _LEVEL.per_unit)
            if is_settled and high - tolerance <= level <= high + tolerance:  # the usual case
                continue
            low = 0
            if is_settled:
                low = round(min(self.playback.level(channel, now), 1.0) * _LEVEL.per_unit)
            if self._is_measured:
                error = round(_MEASURING_ERROR * _LEVEL.per_unit)
                low -= min(error, round(_WEAK * low))
                high += min(error, round(_WEAK * high))
            if not low - tolerance <= level <= high + tolerance:
                return f"level of channel {channel} must be {low} to {high} (1e-4), got {level}"
        return None

    def _highest_level(
        self, channel: int, late: float, unsure_layers: set[int]
    ) -> tuple[float, bool]:
        """Return the highest level that a status may show, and whether no voice changes.

        late: the earliest time of the playback that it may show [s]. unsure_layers: layers that may
        have changed or not.
        """
        playback = self.playback
        if not unsure_layers and late >= playback.settles_at:  # the usual case
            return playback.settled_levels[channel], True
        level = 0.0
        is_settled = not unsure_layers
        for voice in playback.all_voices[channel]:
            transition = voice.transition
            if voice.layer in unsure_layers and not voice.has_ended:
                level += voice.peak(late)
            elif transition.end <= late:
                level += abs(transition.last)
            else:
                is_settled = False
                level += transition.peak(late)
        for layer_set in playback.waiting if unsure_layers else ():
            for command in layer_set.commands:
                if command.channel == channel:
                    level += command.peak / _LEVEL.per_unit
        return level, is_settled

    def _advance(self, time: float) -> None:
        """Carry out everything due by a time [s]."""
        if time >= self.playback.changes_at:
            self.playback.advance(time)
            self._advanced_to = time

    def _silence(
        self, layers: tuple[LayerSet, ...], now: float, delay: float
    ) -> tuple[LayerSet, ...]:
        """Return silent layers, which are never refused, with ramps cut to the time that is left.

        Voices of a silent layer end along their own endings, which may rise before they fall. If
        their sums could exceed a limit, or are unknown because a set is in doubt, commands of level
        0 on all channels skip the endings: every voice then falls along the ramp of its layer.
        """
        left = math.floor(min(self._budget.fade_left(now), _RAMP.high) * _RAMP.per_unit)
        silent_layers = tuple([replace(layer, ramp=min(layer.ramp, left)) for layer in layers])
        if self.doubt is None and self._are_sums_within(silent_layers, now, delay):
            return silent_layers
        commands = []
        for channel in range(self.capabilities["channels"]):
            frequency = self.limits.frequency_min
            commands.append(Command(channel, frequency, 0, 0, skip_ending=True))
        return tuple([replace(layer, commands=tuple(commands)) for layer in silent_layers])

    def _are_sums_within(self, layers: Sequence[LayerSet], now: float, delay: float) -> bool:
        """Whether level, power and rise surely stay within their limits."""
        try:
            self._check_sums(layers, now, delay)
        except CommandRefused:
            return False
        return True

    def _check_sums(self, layers: Sequence[LayerSet], now: float, delay: float) -> None:
        """Raise CommandRefused if level, power or rise may exceed its limit."""
        late = now - self.lag
        until = now + delay + self.lag
        self._advance(late)
        if self.limits.slew == math.inf:
            peaks = PeakSums(self.playback, layers, late, until)
            if self._are_within(peaks.levels):
                return
        refusal = self._refusal_of_sums(layers, late, until)
        if refusal is None:
            return
        faded = self.playback.faded_from(late)
        if faded > late and self._refusal_of_sums(layers, faded, until + faded - late) is None:
            refusal.until = faded + self.lag
        raise refusal

    def _are_within(self, levels: Sequence[float]) -> bool:
        """Whether the limits of level and power allow these levels simultaneously."""
        max_level = self.limits.level / _LEVEL.per_unit
        is_level_within = max(levels) <= max_level * TOLERANCE
        return is_level_within and math.hypot(*levels) ** 2 <= self.limits.power * TOLERANCE

    def _refusal_of_sums(
        self, layers: Sequence[LayerSet], late: float, until: float
    ) -> CommandRefused | None:
        """Return why layers must not start between `late` and `until` [s]; None if they may."""
        bounds = Bounds(self.playback, layers, late, until)
        levels, power = bounds.worst()
        highest = self.limits.level / _LEVEL.per_unit
        is_slew_limited = self.limits.slew < math.inf
        for channel, level in enumerate(levels):
            rise = bounds.rise(channel) if is_slew_limited else 0.0
            if rise > self.limits.slew * TOLERANCE:
                return refused(
                    channel,
                    f"level must rise by at most {self.limits.slew:g} per second, got "
                    f"{rise:g} per second; use a longer ramp",
                )
            if level > highest * TOLERANCE:
                return refused(
                    channel,
                    f"sum of layer levels must be at most {highest:g}, got {level:g}; lower the "
                    "levels, or wait for current layers to end",
                )
        if power > self.limits.power * TOLERANCE:
            return CommandRefused(
                f"sum of squared levels must be at most {self.limits.power:g}, got {power:g}; "
                "lower the levels or drive fewer channels simultaneously"
            )
        return None

    def _waits(self, layers: Sequence[LayerSet], now: float) -> float:
        """Return how long layers wait at most for the ends of onsets [s]."""
        if self._budget.is_unlimited:
            return 0.0
        waiting = [layer.layer for layer in layers if layer.after]
        ends = [self.playback.onsets_end(layer, now) for layer in waiting]
        return max(ends, default=now) - now


def _duration(layer: LayerSet) -> float:
    """Return how long a layer vibrates at most [s], with its fade."""
    if not is_vibrating(layer):
        return fade_of(layer)
    return fade_of(layer) + (_VALID_FOR.from_wire(layer.valid_for) or math.inf)


def is_silence(layers: Sequence[AmplifierLayer]) -> bool:
    """Whether layers only fall silent."""
    for layer in layers:  # noqa: SIM110  a generator is slower
        if layer.tones or layer.renew:
            return False
    return True
