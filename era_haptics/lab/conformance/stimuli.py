"""Stimuli that one amplifier supports: tones, envelopes and layers, and times for its line.

Levels, frequencies and envelopes are within the stated capabilities; times are long compared with
an exchange on the line.
"""

import math
from dataclasses import replace
from functools import cached_property
from typing import Any

from drivers.protocol.definition import QUANTITIES, has_feature
from drivers.protocol.sets import Command, Envelope, LayerSet
from era_haptics.lab.conformance.capabilities import Capabilities
from era_haptics.lab.conformance.exchange_timing import SLOWEST, ExchangeTiming
from era_haptics.lab.conformance.judge_client import JudgeClient
from era_haptics.lab.conformance.outcomes import require
from era_haptics.lab.conformance.request_rows import FULL, Send, layer, play_now

_DEFAULT_FREQUENCY = QUANTITIES["frequency"].to_wire(110.0)
_OFFSET = 800  # steps of frequency between the usual and the second one
_PHASE, _ENVELOPE_STEP = QUANTITIES["phase"], QUANTITIES["envelope_step"]
# s; lead of a Commit before its moment, in addition to the exchanges; largest lateness allowed for
_LEAD, _MAX_LATENESS = 0.0025, 0.02


class Stimuli:
    """Stimuli for the amplifier behind a client.

    can: its capabilities. timing: of its exchanges. max_level: upper bound for driven channels,
    relative to full level.
    """

    def __init__(self, client: JudgeClient, can: Capabilities, max_level: float) -> None:
        self.client = client
        self.can = can
        self.timing = ExchangeTiming(client)
        self.channels = range(can["channels"])
        self._max_level = max_level

    # Supported values; a capability is read only when needed

    @property
    def layers(self) -> range:
        """The numbers of its layers."""
        return range(self.can["layers"])

    @property
    def _limits(self) -> list[dict[str, Any]]:
        """Limits of all channels together, then of each channel."""
        return [self.can, *self.can["limits"]]

    @cached_property
    def level(self) -> float:
        """Level of driven channels; NotApplicable if no level step is that low."""
        max_levels = [limits["level_max"] / FULL for limits in self._limits]
        level: float = min(self._max_level, *max_levels)
        step = self.can["level_step"] / FULL
        require(level >= step, f"level_max of {level:g} is below level_step of {step:g}")
        return level

    @cached_property
    def lowest(self) -> int:
        """Lowest frequency common to all channels, in steps; raises NotApplicable without one."""
        lowest = max(limits["frequency_min"] for limits in self._limits)
        require(lowest <= self.highest, "the channels have no frequency in common")
        return int(lowest)

    @cached_property
    def highest(self) -> int:
        """The highest frequency of every channel, in steps."""
        return int(min(limits["frequency_max"] for limits in self._limits))

    @cached_property
    def frequency(self) -> int:
        """The usual frequency, in steps."""
        return min(max(_DEFAULT_FREQUENCY, self.lowest), self.highest)

    @cached_property
    def second_frequency(self) -> int:
        """A second frequency, in steps, if there is one."""
        frequency = self.frequency + _OFFSET
        return frequency if frequency <= self.highest else self.lowest

    def close_frequency(self, number: int) -> int:
        """Return one of many close frequencies; all equal if there is no room."""
        spacing = max(10, self.can["frequency_step"])
        room = max(self.highest - self.frequency, 0)
        return int(self.frequency + min(spacing * number, room))

    def separate_frequency(self, number: int) -> int:
        """Return a separate frequency for a layer, so that layers do not interfere."""
        step = self.can["frequency_step"]
        frequency = self.frequency + max(40, step) * number
        highest = self.highest - (len(self.layers) - number) * step
        return int(max(min(frequency, highest), self.lowest))

    def has(self, feature: str) -> bool:
        """Return whether the amplifier states a feature; empty: a feature of all amplifiers."""
        return not feature or has_feature(self.can, feature)

    @property
    def ramp_max(self) -> int:
        """The longest ramp [ms]."""
        return int(self.can["ramp_max"])

    def require(self, feature: str) -> None:
        """Raise NotApplicable unless it states a feature."""
        require(self.has(feature), f"the feature {feature} is not stated")

    def require_knots(self) -> None:
        """Raise NotApplicable unless its envelopes have knots."""
        require(self.can["knots"] > 0, "the stated number of knots is 0")

    # Tones and layers

    def tone(
        self,
        channel: int = 0,
        fraction: float = 1.0,
        phase: float = 0.0,
        *,
        frequency: int = 0,
        keep: bool = False,
        onset: Envelope | None = None,
        ending: Envelope | None = None,
    ) -> Command:
        """Build a command at a fraction of the test level; frequency in steps, 0 for the usual one.

        Raises NotApplicable for a level that the amplifier can round to 0.
        """
        level = round(fraction * self.level * FULL)
        is_rounded_to_0 = 0 < level < self.can["level_step"]
        require(not is_rounded_to_0, f"level_step is coarser than {level / FULL:g}; raise --level")
        frequency = frequency or self.frequency
        wire_phase = _PHASE.to_wire(phase)
        return Command(channel, frequency, level, wire_phase, keep, onset=onset, ending=ending)

    def separate_tone(self, number: int, fraction: float) -> Command:
        """Build a tone on channel 0 that does not interfere with the tones of other layers."""
        return self.tone(0, fraction, frequency=self.separate_frequency(number))

    def separate_layer(self, number: int, fraction: float) -> LayerSet:
        """Build a layer with a tone that does not interfere with the tones of other layers."""
        return layer(number, self.separate_tone(number, fraction))

    def layer_0(
        self, *commands: Command, level: float = 1.0, ramp: int = 0, valid_for: int = 0
    ) -> LayerSet:
        """Build the content of layer 0, by default the usual tone on channel 0."""
        if not commands:
            commands = (self.tone(0, level),)
        return layer(0, *commands, ramp=ramp, valid_for=valid_for)

    def all_channels(self) -> LayerSet:
        """Build the usual tone on all channels."""
        return layer(0, *map(self.tone, self.channels))

    def envelope(self, step: float, *amplitudes: complex) -> Envelope:
        """Build an envelope of knots in fractions of the test level, with the nearest possible step
        [s].

        Uses as many knots as the amplifier supports.
        """
        low, high = self.can["envelope_step_min"], self.can["envelope_step_max"]
        wire_step = min(max(_ENVELOPE_STEP.to_wire(step), low), high)
        knots = []
        for amplitude in amplitudes[: self.can["knots"]]:
            level = round(abs(amplitude) * self.level * FULL)
            phase = math.degrees(math.atan2(amplitude.imag, amplitude.real))
            knots.append((level, _PHASE.to_wire(phase)))
        return Envelope(wire_step, tuple(knots))

    def transitions(self, ramp: int) -> list[list[Send]]:
        """Build a sequence of sets during which layers rise, fade, begin, end and wait."""
        slow = self.envelope(0.1, 0.25, 0.25, 0.25)
        tones = [self.separate_tone(number, 0.25) for number in range(4)]
        begins = [replace(tone, onset=slow) for tone in tones]
        ends = [replace(tone, ending=slow) for tone in tones]
        other_tone = self.separate_tone(len(self.layers), 0.25)
        quiet = [layer(number, self.separate_tone(number, 0.05)) for number in self.layers[4:]]
        start = play_now(layer(1, tones[1]), layer(2, tones[2]), *quiet)
        changes = play_now(
            layer(0, tones[0], ramp=ramp, valid_for=60_000),
            layer(1, ramp=ramp),
            layer(2, other_tone, ramp=ramp),
            layer(3, tones[3], ramp=ramp),
        )
        shaped = play_now(
            layer(0, begins[0]), layer(1, ends[1]), layer(2, ends[2]), layer(3, begins[3])
        )
        waiting = play_now(layer(2), layer(3, other_tone, after=True))
        return [[start, changes], [shaped, waiting]]

    # Times that are long compared with an exchange

    def scaled(self, milliseconds: int) -> int:
        """Return a time [ms] that is as long for this line as the given one for a quick line."""
        return math.ceil(milliseconds * self.timing.slowness)

    @property
    def shortest_watchdog(self) -> int:
        """The shortest watchdog time [ms], or that in which it can be fed on a slow line."""
        feeding_time = math.ceil(8_000 * min(self.timing.exchange_time, SLOWEST))
        shortest = max(self.can["watchdog_min"], feeding_time)
        return int(min(shortest, self.can["watchdog_max"]))

    @property
    def ramp(self) -> int:
        """A ramp [ms] that is long against an exchange."""
        required = max(100, math.ceil(6_000 * min(self.timing.exchange_time, 0.1)))
        return int(min(required, self.can["ramp_max"]))

    def require_ramp(self, duration: float = 0.0) -> None:
        """Raise NotApplicable unless a ramp can last for `duration` [s], or for a few exchanges."""
        duration = max(duration, 0.03 + 2 * min(self.timing.exchange_time, 1.0))
        is_long_enough = self.can["ramp_max"] >= 1000 * duration
        require(is_long_enough, f"ramp_max is shorter than {duration:.2g} s")

    @property
    def long_onset(self) -> Envelope:
        """An onset with knots that is long against an exchange, as far as there are knots."""
        exchange_time = min(max(self.timing.exchange_time, self.client.transit / 2), 1.3)
        duration = max(0.2, 12 * exchange_time)
        step_max = _ENVELOPE_STEP.from_wire(self.can["envelope_step_max"])
        self.require_knots()
        min_count = max(math.ceil(duration / step_max) - 1, 3)
        count = min(min_count, self.can["knots"])
        amplitudes = [1.0 if number % 2 else 0.5 for number in range(count)]
        return self.envelope(duration / (count + 1), *amplitudes)

    @property
    def short_onset(self) -> Envelope:
        """An onset with one knot, shorter than the long one where the line is quick enough."""
        return self.envelope(0.05, 1.0) if self.timing.slowness == 1 else self.long_onset

    def lead(self, count: int, duration: float) -> float:
        """Return how long before their moments [s] Commits are sent; `duration` [s]: of all.

        The lead allows for the lateness of this run, but at least for an exchange, so that a
        machine that was late once leaves no amplifier without a verdict.
        """
        lateness = min(self.client.lateness.largest, _MAX_LATENESS)
        shortest = 2.5 * self.timing.exchange_time + _LEAD
        return max(shortest, min(shortest + lateness, duration / count))
