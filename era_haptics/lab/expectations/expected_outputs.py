"""Expected channel levels and layer tokens of an amplifier."""

import math
from collections.abc import Sequence

from drivers.playing import Playback, playback_of
from drivers.protocol.definition import QUANTITIES, has_flag
from drivers.protocol.records import Values
from drivers.protocol.sets import LayerSet
from era_haptics.lab.expectations.mismatches import ReportMismatch, ReportUnclear, alternatives
from era_haptics.lab.expectations.tolerances import DRIFT, LATE, SAMPLE, Interval
from era_haptics.lab.expectations.uncertain_playback import UncertainPlayback

_TOLERANCE = 0.0015  # of full level; rounding, and the last step of a fade
_MAX_STEPS = 4  # of half a level step, in addition to one per voice
_MAX_ENDING = 3.3  # s; 32 knots, 0.1 s apart
_PERIOD = 0.1  # s; a sum of tones reaches its peak within this time
_LASTING = 3.0  # s; later endings are not awaited
_AMBIGUOUS = "a request arrived while a layer or its onset was ending"
_RAMP = QUANTITIES["ramp"]
_LEVEL = QUANTITIES["level"]
_LAYERS = QUANTITIES["layer_count"].maximum
_VOICES = QUANTITIES["voices"].maximum
_ALL_LAYERS = {*range(_LAYERS)}


def silent() -> Playback:
    """Return a silent playback with the maximum number of channels and voices.

    It never cuts a fade short, so its levels are upper bounds.
    """
    return Playback(QUANTITIES["channel_count"].maximum, _VOICES)


class ExpectedOutputs:
    """Expected channels and layers of an amplifier, initially silent; times and intervals in
    seconds.

    - capabilities: reply to GetCaps, empty while unknown.
    - slack [s]: tolerance of times.
    - began, cause: interval and cause of the last change.
    - is_exact: levels equal the commands within one step; may_derate: levels can be lower because
      the amplifier is warm.
    - interferes: levels show the interference of tones at the same frequency.
    - lasting: values of `valid_for` that a layer can report, of its set or a waiting one.
    """

    def __init__(
        self,
        capabilities: Values,
        *,
        report: ReportMismatch,
        unclear: ReportUnclear | None,
        slack: float,
        cause: str,
        began: Interval,
    ) -> None:
        self.began = began
        self.cause = cause
        self.is_exact = True
        self.may_derate = False
        self.interferes = False
        self.lasting: dict[int, set[int]] = {}
        self.playback = playback_of(capabilities) if capabilities else silent()
        """Playback with each commit in the middle of its interval."""
        self.uncertain_playback = UncertainPlayback(self.playback)
        self._report = report
        self._report_unclear = unclear
        self._slack = slack
        self._half_step = capabilities.get("level_step", 1) / 2 / _LEVEL.per_unit
        self._has_floor = True  # False after a fault, which can cut a fade short
        self._unknown_until = [-math.inf] * _LAYERS  # s; of the output of each layer
        self._former_levels: Sequence[float] = ()  # of the channels, before the last set
        self._highest = 0.0  # upper bound of any channel's sum since the last status
        # Since when a sum exceeds full level without being reported.
        self._unlimited_since = math.inf

    def forget(self) -> None:
        """Treat all outputs as unknown."""
        self._unknown_until = [math.inf] * _LAYERS

    # Changes

    def play(
        self,
        layers: Sequence[LayerSet],
        token: int,
        when: Interval,
        *,
        is_exact: bool,
        is_immediate: bool = True,
    ) -> None:
        """Play a set from some time in an interval; is_exact: every command without rounding.

        is_immediate: the set can start slightly later, unlike one with a start time.
        """
        is_prompt = not (is_immediate or any(map(_is_timed, layers)))
        delay = SAMPLE if is_prompt else LATE
        start = Interval(when.earliest, when.latest + delay)
        if self._report_unclear and self.uncertain_playback.is_ambiguous(start, layers):
            self._report_unclear(_AMBIGUOUS)
        shortened_by = self.uncertain_playback.shortened_by(start, layers)
        self._former_levels = self.playback.settled_levels
        for layer_set in layers:
            self._note_valid_for(layer_set)
            unknown_until = max(self._unknown_after(layer_set, start), shortened_by)
            self._unknown_until[layer_set.layer] = unknown_until
        self.uncertain_playback.commit(layers, token, start)
        numbers = ", ".join(str(layer_set.layer) for layer_set in layers)
        self.began = when
        self.cause = f"set {token} (layers: {numbers or 'none'})"
        self._has_floor = True
        self.is_exact = self.is_exact and is_exact
        self._highest = max(self._highest, self._peak(start.earliest))

    def _note_valid_for(self, layer_set: LayerSet) -> None:
        """Record the `valid_for` that a layer can report after a set."""
        lasting = self.lasting.setdefault(layer_set.layer, set())
        if layer_set.renew:
            return
        if not layer_set.after:
            lasting.clear()
        lasting.add(layer_set.valid_for)

    def _unknown_after(self, layer_set: LayerSet, start: Interval) -> float:
        """Return until when [s] a layer's output is unknown after a set that starts in an
        interval."""
        layer = layer_set.layer
        half_width = self.uncertain_playback.half_widths[layer]
        layer_end = self.playback.end_of(layer)
        if start.earliest - half_width <= layer_end <= start.latest + half_width:
            # The layer can end on its own, and then along other transitions than the set's.
            continues = layer_set.renew or any(tone.keep_phase for tone in layer_set.commands)
            return math.inf if continues else self._faded_at(layer_set, start.latest)
        unknown_until = self._unknown_until[layer]
        if layer_set.renew or layer_set.after:
            return unknown_until
        fade_end = start.latest + _MAX_ENDING + _RAMP.from_wire(layer_set.ramp)
        return min(unknown_until, fade_end)

    def _faded_at(self, layer_set: LayerSet, time: float) -> float:
        """Return when a layer has faded, whether it ends on its own or because of a set."""
        layer = layer_set.layer
        ramp = max(_RAMP.from_wire(layer_set.ramp), self.playback.ramp_of(layer))
        faded_at = time + ramp
        for voices in self.playback.all_voices:
            for voice in voices:
                if voice.layer == layer and not voice.has_ended:
                    faded_at = max(faded_at, voice.ended(time, ramp).transition.end)
        return faded_at

    def silence(
        self, when: Interval, ramp: float, cause: str, *, has_floor: bool = True
    ) -> Interval:
        """Fade all layers along a ramp [s] from some time in an interval; return when all are
        silent."""
        start = Interval(when.earliest, when.latest + LATE)
        if self.uncertain_playback.is_ambiguous(start, None, ramp):
            self.forget()  # layers fade along the ramp or along their endings
            if self._report_unclear is not None:
                self._report_unclear(_AMBIGUOUS)
        self.uncertain_playback.silence(start, ramp)
        is_known = max(self._unknown_until) < start.earliest
        last_end = start.latest + ramp
        self._unknown_until = [min(until, last_end) for until in self._unknown_until]
        self.began = when
        self.cause = cause
        self._has_floor = has_floor
        fades_end = self.playback.ends_by
        lag = self.uncertain_playback.lag
        earliest = when.earliest
        if has_floor and is_known:
            earliest = max(fades_end - lag, earliest)
        latest = max(fades_end + lag, start.latest if is_known else last_end)
        return Interval(earliest, latest)

    # Known outputs

    def _widened(self, when: Interval) -> Interval:
        """Return an interval widened by the clock's drift."""
        tolerance = self._slack + DRIFT * (when.latest - self.began.earliest)
        return Interval(when.earliest - tolerance, when.latest + tolerance)

    def sure(self, when: Interval) -> set[int]:
        """Return the layers whose output is known throughout an interval.

        No layer is known while the output of any layer is unknown.
        """
        start, end = self._widened(when)
        if max(self._unknown_until) >= start:
            return set()
        return _ALL_LAYERS - self.uncertain_playback.unsure(start, end)

    def tokens_of(self, layer: int, sure: set[int]) -> set[int]:
        """Return the tokens that a layer can report; sure: layers whose output is known."""
        if layer in sure:
            return {self.playback.tokens.get(layer, 0)}
        return self.playback.next_tokens(layer)

    def waits(self, when: Interval) -> bool:
        """Return whether a set surely waits for the end of an onset throughout an interval."""
        return self.sure(when) == _ALL_LAYERS and bool(self.playback.waiting)

    def settled_at(self, now: float) -> float:
        """Return when all outputs are constant for long or silent [s], as far as is known."""
        playback = self.playback.copied()
        horizon = now + _LASTING
        settled_at = now
        while (due := playback.next_due) < horizon:
            playback.advance(due)
            settled_at = due
        for voices in playback.all_voices:
            for voice in voices:
                settled_at = max(settled_at, voice.transition.end)
        return settled_at

    # Statuses

    def check(self, status: Values, when: Interval) -> None:
        """Compare a status that was true at some time in an interval, and start the next from
        there."""
        start = self._widened(when).earliest
        sure_layers = self.sure(when)
        if sure_layers:
            levels = [_LEVEL.from_wire(level) for level in status["levels"]]
            largest = self.check_levels(levels, when, self._report)
            self._check_tokens(status["tokens"], sure_layers, when)
            self._check_limited(largest, when, is_limited=has_flag(status, "limited"))
        self._note_silent_layers(status["tokens"], when.latest)
        self._highest = self._peak(start)

    def _check_tokens(self, tokens: Sequence[int], sure: set[int], when: Interval) -> None:
        """Compare the token of each layer; sure: layers whose output is known."""
        for layer, token in enumerate(tokens):
            possible = self.tokens_of(layer, sure)
            if token not in possible:
                quantity = f"token of layer {layer}, {self._since(when)}"
                expected = alternatives(possible)
                self._report("token", when.latest, quantity, expected=expected, actual=token)

    def _check_limited(self, largest: float, when: Interval, *, is_limited: bool) -> None:
        """Compare the flag of limited sums; largest: highest level that a channel surely has."""
        is_beyond = largest > 1 + _TOLERANCE + 2 * self._half_step
        is_excused = is_limited or not is_beyond or not self.is_exact or self.may_derate
        since = math.inf if is_excused else min(self._unlimited_since, when.latest)
        self._unlimited_since = since
        must_be_limited = self._widened(when).earliest - since > _PERIOD
        is_missing = must_be_limited and not is_limited
        is_unfounded = is_limited and self._highest < 1 + self._half_step
        if is_missing or is_unfounded:
            self._report(
                "plays", when.latest, "limited", expected=must_be_limited, actual=is_limited
            )

    def _note_silent_layers(self, tokens: Sequence[int], time: float) -> None:
        """Record that unknown layers without a token are silent, except for their last fade."""
        for layer, until in enumerate(self._unknown_until):
            is_over = layer >= len(tokens) or not tokens[layer]
            if until == math.inf and is_over:
                self._unknown_until[layer] = time + _MAX_ENDING + _RAMP.high

    def _peak(self, time: float) -> float:
        """Return the largest future sum of a channel with endings; infinite if a set waits."""
        if self.playback.waiting:
            return math.inf
        return max(sum(voice.peak(time) for voice in voices) for voices in self.playback.all_voices)

    def check_levels(
        self, levels: Sequence[float], when: Interval, report_low: ReportMismatch | None
    ) -> float:
        """Compare channel levels; returns the highest level that a channel surely has.

        report_low: receives levels that are too low; None if low levels are allowed.
        """
        can_be_low = self.may_derate or not self.is_exact
        start, end = self._widened(when)
        largest = 0.0
        for channel, level in enumerate(levels[: self.playback.channels]):
            lowest, highest = self.uncertain_playback.bounds(
                channel, start, end, is_exact=self.interferes
            )
            largest = max(largest, lowest)
            voices = len(self.playback.all_voices[channel])
            slack = max((_MAX_STEPS + voices) * self._half_step, _TOLERANCE)
            low = min(lowest, 1.0) - slack if self._has_floor else -slack
            high = min(highest, 1.0) + slack
            report = self._report if level > high else None
            if level < low and not can_be_low:
                report = report_low
            if report is not None:
                rule = self._rule(channel, level, when)
                quantity = f"level of channel {channel}, {self._since(when)}"
                expected = f"{max(low, 0.0):.4g} to {high:.4g}"
                report(rule, when.latest, quantity, expected=expected, actual=level)
        return largest

    def _since(self, when: Interval) -> str:
        """Format the time since the last change."""
        low = 1e3 * (when.earliest - self.began.latest)
        high = 1e3 * (when.latest - self.began.earliest)
        return f"{low:.1f} to {high:.1f} ms after {self.cause}"

    def _rule(self, channel: int, level: float, when: Interval) -> str:
        """Return the rule that a wrong level violates."""
        if self.cause == "the watchdog":
            return "watchdog"
        if self.playback.settles_at > self._widened(when).earliest - self.uncertain_playback.lag:
            return "ramp"
        if not self.cause.startswith("set"):
            return "silent"
        has_former_level = channel < len(self._former_levels)
        former_level = self._former_levels[channel] if has_former_level else 0.0
        return "commit" if abs(level - former_level) < _TOLERANCE else "plays"


def _is_timed(layer_set: LayerSet) -> bool:
    """Return whether a layer ends or starts on its own later, possibly with a delay."""
    onsets = [tone.onset for tone in layer_set.commands]
    is_shaped = any(onset is not None and onset.knots for onset in onsets)
    return bool(layer_set.valid_for or layer_set.after or is_shaped)
