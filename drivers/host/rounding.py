"""Limits of an amplifier in wire integers, and layers rounded to them.

`wire_limits` combines the limits of the rig, the amplifier, its channels and this module to the
lowest of each. `Rounding` converts layers to wire integers: levels, frequencies and phases to the
nearest step, ramps upward, and `valid_for` never to 0, which would mean endless. It rejects values
that the wire cannot carry or the limits forbid.
"""

import math
from array import array
from collections.abc import Sequence
from dataclasses import dataclass
from operator import index

from drivers.errors import CommandError, CommandRefused
from drivers.playing import AmplifierLayer, AmplifierTone
from drivers.protocol.definition import QUANTITIES
from drivers.protocol.records import Values, WireQuantity
from drivers.protocol.sets import Command, Envelope, LayerSet
from registry.limits import GuardLimits

FREQUENCY_FLOOR = 10.0
"""Lowest frequency [Hz]; below it a plate on springs moves as a rigid body, and nothing is felt."""

_LEVEL = QUANTITIES["level"]
_PHASE = QUANTITIES["phase"]
_RAMP = QUANTITIES["ramp"]
_VALID_FOR = QUANTITIES["valid_for"]
_FREQUENCY = QUANTITIES["frequency"]
_SLACK = 1e-6  # of a step, for sums of floats
_NO_KNOTS = ((0, 0),)


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
        limit = getattr(configured, name)
        if not math.isfinite(limit):
            raise CommandError(f"{name} of the limits must be a finite number, got {limit}")
    for name in ("slew", "power", "on_time", "duty", "rate"):
        limit = getattr(configured, name)
        if not limit > 0:
            raise CommandError(f"{name} limit must be positive, got {limit:g}")
    frequency_min = -_whole_steps(-max(FREQUENCY_FLOOR, configured.frequency_min), _FREQUENCY)
    frequency_max = _whole_steps(configured.frequency_max, _FREQUENCY)
    level_max = _whole_steps(min(configured.level, 1.0), _LEVEL)
    for reported in (capabilities, *capabilities["limits"]):
        frequency_min = max(frequency_min, reported["frequency_min"])
        frequency_max = min(frequency_max, reported["frequency_max"])
        level_max = min(level_max, reported["level_max"])
    if frequency_min > frequency_max:
        low = _FREQUENCY.from_wire(frequency_min)
        high = _FREQUENCY.from_wire(frequency_max)
        raise CommandError(
            f"limits of rig and amplifier must leave a frequency range, got {low:g} to {high:g} "
            "Hz; widen limits.frequency in the rig file or use another amplifier"
        )
    if level_max < 0:
        raise CommandError(f"level limit must be at least 0, got {configured.level:g}")
    return WireLimits(frequency_min, frequency_max, level_max, configured.slew, configured.power)


def _whole_steps(value: float, quantity: WireQuantity) -> int:
    """Round a value down to a step of the wire."""
    return math.floor(value * quantity.per_unit + _SLACK)


class Rounding:
    """Rounds layers for one amplifier; capabilities: values of its record."""

    def __init__(self, limits: WireLimits, capabilities: Values) -> None:
        self._limits = limits
        self._can = capabilities
        self._channels: int = capabilities["channels"]
        self._layers: int = capabilities["layers"]
        self._ramp_max = _RAMP.from_wire(capabilities["ramp_max"])
        self.achieved: dict[tuple[int, int], int] = {}
        """Frequency that the amplifier plays in place of another one, by channel and frequency."""

    def layers(self, layers: Sequence[AmplifierLayer]) -> tuple[LayerSet, ...]:
        """Return layers in integers of the wire; raises CommandRefused with channel and reason."""
        layer_sets: list[LayerSet] = []
        numbers: list[int] = []
        for layer in layers:
            number = index(layer.number)
            self._check_layer(layer, number)
            numbers.append(number)
            ramp = math.ceil(layer.ramp * _RAMP.per_unit - _SLACK)
            valid_for = 0
            if layer.valid_for:
                valid_for = max(round(layer.valid_for * _VALID_FOR.per_unit), 1)
            commands = self._commands(layer.tones)
            layer_sets.append(
                LayerSet(
                    number,
                    min(ramp, self._can["ramp_max"]),
                    valid_for,
                    tuple(commands.values()),
                    bool(layer.after),
                    bool(layer.renew),
                )
            )
        if len(set(numbers)) < len(numbers):
            raise CommandRefused(f"a set must have each layer once, got {numbers}")
        return tuple(layer_sets)

    def _check_layer(self, layer: AmplifierLayer, number: int) -> None:
        """Raise CommandRefused for a layer that cannot be played, apart from its tones."""
        ramp = layer.ramp
        valid_for = layer.valid_for
        if not 0 <= number < self._layers:
            raise CommandRefused(f"layer must be 0 to {self._layers - 1}, got {number!r}")
        if not 0 <= ramp <= self._ramp_max:  # nor NaN
            raise CommandRefused(f"ramp must be 0 to {self._ramp_max:g} s, got {ramp!r} s")
        if not 0 <= valid_for <= _VALID_FOR.high:
            raise CommandRefused(
                f"valid_for must be 0 to {_VALID_FOR.high:g} s, got {valid_for!r} s"
            )
        if layer.renew and (layer.tones or layer.after):
            raise CommandRefused("renew must be without tones and after")
        if layer.after and not layer.tones:
            raise CommandRefused("after must be with tones")

    def _commands(self, tones: Sequence[AmplifierTone]) -> dict[int, Command]:
        """Return the commands of tones by channel; it runs with each set, so it makes few calls."""
        limits = self._limits
        commands: dict[int, Command] = {}
        for tone in tones:
            channel = index(tone.channel)
            level = tone.level
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
            if level == 0 and tone.onset is None:
                frequency = limits.frequency_min
            if not limits.frequency_min <= frequency <= limits.frequency_max:
                raise self._frequency_refused(channel, tone.frequency)
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
                tone.onset,
                tone.ending,
            )
        for tone in tones:
            if tone.onset is not None:
                self._check_envelope(tone.channel, tone.onset)
            if tone.ending is not None:
                self._check_envelope(tone.channel, tone.ending)
        return commands

    def _frequency_refused(self, channel: int, frequency: float) -> CommandRefused:
        low = _FREQUENCY.from_wire(self._limits.frequency_min)
        high = _FREQUENCY.from_wire(self._limits.frequency_max)
        return refused(channel, f"frequency must be {low:g} to {high:g} Hz, got {frequency:g} Hz")

    def _level_refused(self, channel: int, name: str, level: float) -> CommandRefused:
        highest = self._limits.level / _LEVEL.per_unit
        return refused(channel, f"{name} must be 0 to {highest:g}, got {level!r}")

    def _check_envelope(self, channel: int, envelope: Envelope) -> None:
        """Raise CommandRefused for an envelope that is not allowed."""
        low, high = self._can["envelope_step_min"], self._can["envelope_step_max"]
        step = envelope.step
        if not low <= step <= high:
            raise refused(
                channel, f"step of an envelope must be {low} to {high} (0.1 ms), got {step}"
            )
        max_knots = self._can["knots"]
        count = len(envelope.knots)
        if count > max_knots:
            raise refused(channel, f"knots of an envelope must be at most {max_knots}, got {count}")
        try:
            levels, phases = zip(*(envelope.knots or _NO_KNOTS), strict=True)
            array("q", (*levels, *phases))  # raises for numbers that are no integers
        except (TypeError, ValueError) as error:
            raise refused(
                channel, f"knots of an envelope must be pairs of integers: {error}"
            ) from error
        peak = max(levels)
        if not 0 <= min(levels) <= peak <= self._limits.level:
            raise self._level_refused(channel, "level of a knot", peak / _LEVEL.per_unit)
        if not _PHASE.minimum <= min(phases) <= max(phases) <= _PHASE.maximum:
            raise refused(channel, "phase of a knot must be -180 to 179.99 degrees")


def refused(channel: int, text: str) -> CommandRefused:
    """Return the error of a channel that must not play something; text: why, as `X must be Y`."""
    return CommandRefused(f"channel {channel}: {text}", channel=channel)
