"""Limits in force: the least of the configuration, the amplifier's report and built-in ceilings."""

import math
from dataclasses import dataclass, replace

from drivers.errors import CommandError
from drivers.protocol.definition import PROTOCOL
from drivers.protocol.messages import Capabilities

# Below 10 Hz a plate on springs only moves as a rigid body and nothing is felt.
FREQUENCY_FLOOR = 10.0
# What the wire can express; the skin's sensitivity to vibration falls off long before it.
FREQUENCY_CEILING = PROTOCOL.quantities.frequency.high
# Full stroke: beyond it the electrodes of an actuator touch.
LEVEL_CEILING = 1.0
# No bus carries more sets per second, so a higher rate can only be a runaway loop.
RATE_CEILING = 2000.0


@dataclass(frozen=True)
class GuardLimits:
    """Limits of one amplifier: mechanical frequency [Hz] and level (1 is full stroke).

    slew [1/s]: highest rise of a level; power: sum of squared levels over all channels; on_time
    [s]: longest vibration without a pause; duty: share of `drivers.guard.budget.DUTY_WINDOW`;
    rate [1/s]: command sets that are not silent. All of these are unlimited by default.
    """

    frequency_min: float
    frequency_max: float
    level: float
    slew: float = math.inf
    power: float = math.inf
    on_time: float = math.inf
    duty: float = 1.0
    rate: float = math.inf


def limits_in_force(configured: GuardLimits, capabilities: Capabilities) -> GuardLimits:
    """Combine configured limits with an amplifier's and the ceilings.

    Raises CommandError for limits that are not finite or leave nothing to play.
    """
    for source, values, names in (
        ("configured", configured, ("frequency_min", "frequency_max", "level")),
        ("amplifier's", capabilities, ("frequency_min", "frequency_max", "level_max", "ramp_max")),
    ):
        for name in names:
            if not math.isfinite(getattr(values, name)):
                raise CommandError(
                    f"{source} {name} must be a finite number, got {getattr(values, name)}"
                )
    for name in ("slew", "power", "on_time", "duty", "rate"):
        if not getattr(configured, name) > 0:
            raise CommandError(f"{name} limit must be positive, got {getattr(configured, name):g}")
    limits = replace(
        configured,
        frequency_min=max(configured.frequency_min, capabilities.frequency_min, FREQUENCY_FLOOR),
        frequency_max=min(configured.frequency_max, capabilities.frequency_max, FREQUENCY_CEILING),
        level=min(configured.level, capabilities.level_max, LEVEL_CEILING),
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


def capabilities_in_force(capabilities: Capabilities) -> Capabilities:
    """Reduce an amplifier's ramps and channels to those that the protocol can express."""
    quantities = PROTOCOL.quantities
    return replace(
        capabilities,
        ramp_max=max(0.0, min(capabilities.ramp_max, quantities.ramp.high)),
        channels=min(capabilities.channels, quantities.channel_count.maximum),
    )
