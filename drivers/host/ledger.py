"""What one amplifier was sent and may play: the only maker of the sets that go over its wire.

A set is checked when its turn on the line has come, as the wire rounds it, against what plays then
over the sum of all layers. What was sent and is not confirmed is one doubt: until it is resolved
only silence is admitted. Times [s] are of any one clock.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from numbers import Integral

from drivers.contents import Layer, Shape, Tone
from drivers.errors import CommandRefused
from drivers.guard.budget import COMMIT_DELAY, Budget, Vibration
from drivers.host.bounds import all_bounds, plain_bounds, worst
from drivers.host.limits import RATE_CEILING, wire_limits
from drivers.playback import Playback
from drivers.protocol.records import Values
from drivers.protocol.sets import Command, Envelope, LayerSet
from drivers.protocol.table import QUANTITIES
from registry.limits import GuardLimits

TOLERANCE = 1 + 1e-9
"""Factor by which a sum of floats may exceed a limit."""
_LEVEL, _PHASE = QUANTITIES["level"], QUANTITIES["phase"]
_RAMP, _VALID_FOR = QUANTITIES["ramp"], QUANTITIES["valid_for"]
_STEP, _FREQUENCY = QUANTITIES["envelope_step"], QUANTITIES["frequency"]
_SLACK = 1e-6  # of a step; sums of floats


class Ledger:
    """The ledger of one amplifier, at first silent.

    limits: configured; capabilities: values of its record. Raises CommandError for limits that
    leave nothing to play.
    """

    def __init__(self, limits: GuardLimits, capabilities: Values) -> None:
        self.configured = limits
        self.limits = wire_limits(limits, capabilities)
        self.capabilities = capabilities
        self._budget = Budget(replace(limits, rate=min(limits.rate, RATE_CEILING)))
        self.playback = Playback(capabilities["channels"], capabilities["voices"])
        self.lag = 0.0  # s; by which what plays may be later than `playback` says
        self._doubt: tuple[int, tuple[LayerSet, ...], float, Vibration | None] | None = None

    @property
    def doubt(self) -> int:
        """Token of the set that was committed and is not confirmed; 0: none."""
        return 0 if self._doubt is None else self._doubt[0]

    def adopt(self, capabilities: Values) -> None:
        """Go on with other capabilities, silent; what was spent of on-time and duty stays spent."""
        self.limits, self.capabilities = wire_limits(self.configured, capabilities), capabilities
        self.forget()

    def forget(self) -> None:
        """Start anew: the amplifier is silent, armed or not."""
        self.playback = Playback(self.capabilities["channels"], self.capabilities["voices"])
        self.lag, self._doubt = 0.0, None

    def admit(
        self, layers: Sequence[Layer], now: float, *, delay: float = COMMIT_DELAY
    ) -> tuple[LayerSet, ...]:
        """Return layers as the wire has them, `valid_for` shortened to what time is left.

        delay [s]: within which they are committed. Raises CommandRefused with channel and reason;
        nothing changes then.
        """
        numbers = [layer.number for layer in layers]
        if len(set(numbers)) < len(numbers) or not numbers:
            raise CommandRefused(f"a set must have each layer once, at least one, got {numbers}")
        try:
            requested = tuple([self._on_wire(layer) for layer in layers])
        except (ArithmeticError, TypeError, ValueError) as error:
            raise CommandRefused(f"a set must have numbers in its range: {error}") from error
        if not any(is_vibrating(one) for one in requested):
            return self._silence(requested, now, delay)
        if self._doubt is not None:
            raise CommandRefused(f"set {self.doubt} must be confirmed first; read the status")
        self._check_sums(requested, now, delay)
        return self._within_budget(requested, now, delay)

    def sent(self, token: int, layers: tuple[LayerSet, ...], now: float) -> None:
        """Note that a set may play from now on: it was committed, and is in doubt.

        Again, where its commit is repeated: it may have played since the first time.
        """
        if self.doubt == token:
            return
        lasts = max((self._lasts(one) for one in layers), default=0.0)
        is_vibration = any(is_vibrating(one) for one in layers)
        before = self._budget.sent(now, lasts=lasts) if is_vibration else None
        self._doubt = token, layers, now, before

    def confirmed(self, now: float) -> None:
        """Note at a time [s] that the set in doubt plays, since it was sent at the earliest."""
        if self._doubt is None:
            return
        token, layers, sent_at, _ = self._doubt
        self._doubt = None
        if self.playback.is_settled(sent_at - self.lag) and self.playback.next_due == math.inf:
            self.lag = 0.0
        self.lag = self.playback.uncertainty = max(self.lag, now - sent_at)
        for one in layers:
            ends = self.playback.end_of(one.layer)
            if not one.renew and sent_at < ends and ends - 2 * self.lag <= now:
                self.playback.add_ends(one.layer, sent_at)
        self.playback.commit(layers, token, sent_at)
        if not self._budget.is_unlimited:
            self._budget.confirm(sent_at, now, end=self.playback.ends_by + self.lag)

    def refused(self) -> None:
        """Note that the set in doubt was not played."""
        if self._doubt is not None:
            self._budget.restore(self._doubt[3])
            self._doubt = None

    def silenced(self, ramp: float, sent_at: float, now: float) -> None:
        """Note that all layers fall silent along a ramp [s], by a request sent at a time [s]."""
        self._doubt = None
        self.lag = self.playback.uncertainty = max(self.lag, now - sent_at)
        self.playback.silence(sent_at, ramp)
        if not self._budget.is_unlimited:
            self._budget.confirm(sent_at, now, end=self.playback.ends_by + self.lag)

    def resolve(self, token: int, now: float) -> None:
        """Resolve the doubt by the token that the amplifier says it committed last."""
        if token == self.doubt:
            self.confirmed(now)
        else:
            self.refused()

    def _on_wire(self, layer: Layer) -> LayerSet:
        """Return a layer in integers of the wire; CommandRefused for what the wire cannot have."""
        can = self.capabilities
        if not _is_integer(layer.number, can["layers"] - 1):
            raise CommandRefused(f"layer must be 0 to {can['layers'] - 1}, got {layer.number!r}")
        ramp_max = _RAMP.from_wire(can["ramp_max"])
        for name, value, highest in (
            ("ramp", layer.ramp, ramp_max),
            ("valid_for", layer.valid_for, _VALID_FOR.high),
        ):
            if not 0 <= value <= highest:  # nor NaN
                raise CommandRefused(f"{name} must be 0 to {highest:g} s, got {value!r} s")
        if layer.renew and (layer.tones or layer.after):
            raise CommandRefused("renew must be without tones and after")
        if layer.after and not layer.tones:
            raise CommandRefused("after must be with tones")
        channels = [tone.channel for tone in layer.tones]
        for tone in layer.tones:
            if not _is_integer(tone.channel, can["channels"] - 1):
                text = f"channel must be 0 to {can['channels'] - 1}, got {tone.channel!r}"
                raise CommandRefused(text, channel=tone.channel)
            if channels.count(tone.channel) > 1:
                text = f"channel {tone.channel} must occur once in a layer"
                raise CommandRefused(text, channel=tone.channel)
        return LayerSet(
            int(layer.number),
            min(math.ceil(layer.ramp * _RAMP.per_unit - _SLACK), can["ramp_max"]),
            max(_VALID_FOR.to_wire(layer.valid_for), 1) if layer.valid_for else 0,
            tuple([self._command(tone) for tone in layer.tones]),
            after=bool(layer.after),
            renew=bool(layer.renew),
        )

    def _command(self, tone: Tone) -> Command:
        limits, channel = self.limits, int(tone.channel)
        level = self._level(tone.level, "level", channel)
        for name, value in (("frequency", tone.frequency), ("phase", tone.phase)):
            if not math.isfinite(value):
                raise _refused(channel, f"{name} must be a finite number, got {value!r}")
        onset, ending = tone.onset, tone.ending
        frequency = round(tone.frequency * _FREQUENCY.per_unit)
        if level == 0 and onset is None:
            frequency = limits.frequency_min
        if not limits.frequency_min <= frequency <= limits.frequency_max:
            low, high = map(_FREQUENCY.from_wire, (limits.frequency_min, limits.frequency_max))
            text = f"frequency must be {low:g} to {high:g} Hz, got {tone.frequency:g} Hz"
            raise _refused(channel, text)
        return Command(
            *(channel, frequency, level, _PHASE.to_wire(float(tone.phase))),
            keep_phase=bool(tone.keep_phase),
            skip_ending=bool(tone.skip_ending),
            onset=None if onset is None else self._envelope(onset, channel),
            ending=None if ending is None else self._envelope(ending, channel),
        )

    def _level(self, level: float, name: str, channel: int) -> int:
        highest = self.limits.level / _LEVEL.per_unit
        if not 0 <= level <= highest * TOLERANCE:  # nor NaN
            raise _refused(channel, f"{name} must be 0 to {highest:g}, got {level!r}")
        return min(round(level * _LEVEL.per_unit), self.limits.level)

    def _envelope(self, shape: Shape, channel: int) -> Envelope:
        can = self.capabilities
        low, high = (
            _STEP.from_wire(can[name]) for name in ("envelope_step_min", "envelope_step_max")
        )
        if not low <= shape.step <= high:
            text = f"step of an envelope must be {low:g} to {high:g} s, got {shape.step!r} s"
            raise _refused(channel, text)
        if len(shape.knots) > can["knots"]:
            text = f"knots of an envelope must be at most {can['knots']}, got {len(shape.knots)}"
            raise _refused(channel, text)
        knots = tuple(
            (self._level(abs(knot), "level of a knot", channel), _phase_of(knot))
            for knot in shape.knots
        )
        return Envelope(math.ceil(shape.step * _STEP.per_unit - _SLACK), knots)

    def _silence(
        self, layers: tuple[LayerSet, ...], now: float, delay: float
    ) -> tuple[LayerSet, ...]:
        """Return silent layers, their ramps within the time that is left, endings only if safe."""
        left = self._budget.fade_left(now)
        silent = tuple(_within_ramp(one, left) for one in layers)
        try:
            if self._doubt is None:
                self._check_sums(silent, now, delay)
                return silent
        except CommandRefused:
            pass
        commands = tuple(
            Command(channel, self.limits.frequency_min, 0, 0, skip_ending=True)
            for channel in range(self.capabilities["channels"])
        )
        return tuple(replace(one, commands=commands) for one in silent)

    def _check_sums(self, layers: Sequence[LayerSet], now: float, delay: float) -> None:
        late, until = now - self.lag, now + delay + self.lag  # ends are as late as they can be
        self.playback.advance(late)
        if self.limits.slew == math.inf and self._is_plain_and_within(layers, late, until):
            return
        bounds = all_bounds(self.playback, layers, late, until=until)
        levels, power = worst(bounds)
        highest = _LEVEL.from_wire(self.limits.level)
        for channel, (bound, level) in enumerate(zip(bounds, levels, strict=True)):
            if bound.rise > self.limits.slew * TOLERANCE:
                text = (
                    f"level must rise by at most {self.limits.slew:g} per second, got "
                    f"{bound.rise:g} per second; use a longer ramp"
                )
                raise _refused(channel, text)
            if level > highest * TOLERANCE:
                text = (
                    f"level of all layers must be at most {highest:g}, got {level:g}; lower the "
                    "levels, or let what plays end first"
                )
                raise _refused(channel, text)
        if power > self.limits.power * TOLERANCE:
            raise CommandRefused(
                f"sum of squared levels must be at most {self.limits.power:g}, got {power:g}; "
                "lower the levels or drive fewer channels at once"
            )

    def _is_plain_and_within(self, layers: Sequence[LayerSet], late: float, until: float) -> bool:
        """Whether a cross-fade that needs no closer look is within the limits: nearly every set."""
        ends = plain_bounds(self.playback, layers, late, until=until)
        if ends is None:
            return False
        highest = _LEVEL.from_wire(self.limits.level) * TOLERANCE
        if max(map(max, ends)) > highest:
            return False
        if self.limits.power == math.inf:
            return True
        return all(math.hypot(*levels) ** 2 <= self.limits.power * TOLERANCE for levels in ends)

    def _within_budget(
        self, layers: tuple[LayerSet, ...], now: float, delay: float
    ) -> tuple[LayerSet, ...]:
        """Shorten `valid_for` to the on-time and duty that are left."""
        fade = max(self._fade(one) for one in layers)
        remaining = self._budget.remaining(now, fade=fade, delay=delay)
        if remaining == math.inf:
            return layers
        left = math.floor(min(remaining, _VALID_FOR.high) * _VALID_FOR.per_unit)
        if left <= 0:
            raise CommandRefused("on-time or duty limit reached; pause the vibration")
        return tuple(
            replace(one, valid_for=min(one.valid_for or left, left)) if is_vibrating(one) else one
            for one in layers
        )

    def _fade(self, one: LayerSet) -> float:
        """Return how long a layer takes to end [s]: along its ramp or its longest ending."""
        endings = [
            _STEP.from_wire(command.ending.step) * (len(command.ending.knots) + 1)
            for command in one.commands
            if command.ending is not None
        ]
        return max(_RAMP.from_wire(one.ramp), *endings, 0.0)

    def _lasts(self, one: LayerSet) -> float:
        if not is_vibrating(one):
            return self._fade(one)
        return self._fade(one) + (_VALID_FOR.from_wire(one.valid_for) or math.inf)


def is_vibrating(one: LayerSet) -> bool:
    """Whether a layer plays after its set, so that it spends time and rate."""
    return one.renew or any(command.is_driven for command in one.commands)


def _is_integer(value: object, highest: int) -> bool:
    return (type(value) is int or isinstance(value, Integral)) and 0 <= int(value) <= highest


def _refused(channel: int, text: str) -> CommandRefused:
    return CommandRefused(f"channel {channel}: {text}", channel=channel)


def _phase_of(knot: complex) -> int:
    return _PHASE.to_wire(math.degrees(math.atan2(knot.imag, knot.real)))


def _within_ramp(one: LayerSet, left: float) -> LayerSet:
    """Return a silent layer with its ramp shortened to a time that is left [s]."""
    if _RAMP.from_wire(one.ramp) <= left:
        return one
    return replace(one, ramp=math.floor(left * _RAMP.per_unit))
