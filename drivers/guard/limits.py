"""Limits in force: the least of the configuration, the amplifier's report and built-in ceilings.

Where the channels of an amplifier differ, the least of all holds for each: the pattern needs all.
"""

import math
from dataclasses import replace

from drivers.errors import CommandError
from drivers.protocol.definition import PROTOCOL, WireQuantity
from drivers.protocol.messages import Capabilities, ChannelLimits
from registry.limits import GuardLimits

# Below 10 Hz a plate on springs only moves as a rigid body and nothing is felt.
FREQUENCY_FLOOR = 10.0
# What the wire can express; the skin's sensitivity to vibration falls off long before it.
FREQUENCY_CEILING = PROTOCOL.quantities.frequency.high
# Full stroke: beyond it the electrodes of an actuator touch.
LEVEL_CEILING = 1.0
# No bus carries more sets per second, so a higher rate can only be a runaway loop.
RATE_CEILING = 2000.0
# A set every 10 ms along ramps of 150 ms; the guard follows each voice.
VOICES_CEILING = 16
_SLACK = 1e-6  # of a step; sums of floats


def limits_in_force(configured: GuardLimits, capabilities: Capabilities) -> GuardLimits:
    """Combine configured limits with an amplifier's, its channels' and the ceilings.

    Raises CommandError for limits that are not finite or leave nothing to play.
    """
    for source, values, names in (
        ("configured", configured, ("frequency_min", "frequency_max", "level")),
        ("amplifier's", capabilities, ("frequency_min", "frequency_max", "level_max", "ramp_max")),
        *(
            ("channel's", channel, ("frequency_min", "frequency_max", "level_max"))
            for channel in capabilities.channel_limits
        ),
    ):
        for name in names:
            if not math.isfinite(getattr(values, name)):
                raise CommandError(
                    f"{source} {name} must be a finite number, got {getattr(values, name)}"
                )
    for name in ("slew", "power", "on_time", "duty", "rate"):
        if not getattr(configured, name) > 0:
            raise CommandError(f"{name} limit must be positive, got {getattr(configured, name):g}")
    frequency, level = PROTOCOL.quantities.frequency, PROTOCOL.quantities.level
    reported: list[Capabilities | ChannelLimits] = [capabilities, *capabilities.channel_limits]
    lowest = max(
        FREQUENCY_FLOOR, configured.frequency_min, *(one.frequency_min for one in reported)
    )
    highest = min(
        FREQUENCY_CEILING, configured.frequency_max, *(one.frequency_max for one in reported)
    )
    levels = (one.level_max for one in reported)
    limits = replace(
        configured,
        # In whole steps of the wire, so that no value is rounded beyond its limit.
        frequency_min=-_whole_steps(-lowest, frequency),
        frequency_max=_whole_steps(highest, frequency),
        level=_whole_steps(min(configured.level, LEVEL_CEILING, *levels), level),
        rate=min(configured.rate, RATE_CEILING),
    )
    if limits.frequency_min > limits.frequency_max:
        raise CommandError(
            "limits of configuration and amplifier must leave a frequency range, got "
            f"{limits.frequency_min:g} to {limits.frequency_max:g} Hz; widen limits.frequency in "
            "the rig file or use another amplifier"
        )
    if limits.level < 0:
        raise CommandError(f"level limit must be at least 0, got {limits.level:g}")
    return limits


def _whole_steps(value: float, quantity: WireQuantity) -> float:
    """Round a value down to a step of the wire."""
    return math.floor(value * quantity.per_unit + _SLACK) / quantity.per_unit


def capabilities_in_force(capabilities: Capabilities) -> Capabilities:
    """Limit an amplifier's ramps and channels to the range of the protocol, voices to a ceiling."""
    quantities = PROTOCOL.quantities
    return replace(
        capabilities,
        ramp_max=max(0.0, min(capabilities.ramp_max, quantities.ramp.high)),
        channels=min(capabilities.channels, quantities.channel_count.maximum),
        voices=min(max(capabilities.voices, quantities.voices.minimum), VOICES_CEILING),
    )
