"""Limits in force, in integers of the wire: the least of rig, amplifier, channels and ceilings."""

import math
from dataclasses import dataclass

from drivers.errors import CommandError
from drivers.protocol.quantity import WireQuantity
from drivers.protocol.records import Values
from drivers.protocol.table import QUANTITIES
from registry.limits import GuardLimits

FREQUENCY_FLOOR = 10.0
"""Below it a plate on springs only moves as a rigid body, and nothing is felt [Hz]."""
RATE_CEILING = 2000.0
"""No wire carries more sets a second, so a higher rate can only be a runaway loop."""
_SLACK = 1e-6  # of a step; sums of floats


@dataclass(frozen=True, slots=True)
class WireLimits:
    """What a set may contain: frequencies and levels of the wire; slew, power as in GuardLimits."""

    frequency_min: int
    frequency_max: int
    level: int
    slew: float
    power: float


def wire_limits(configured: GuardLimits, capabilities: Values) -> WireLimits:
    """Combine configured limits with an amplifier's and its channels'.

    Where channels differ the least of all holds for each, since a pattern needs all. Raises
    CommandError for limits that are no numbers, or leave nothing to play.
    """
    for name in ("frequency_min", "frequency_max", "level"):
        if not math.isfinite(value := getattr(configured, name)):
            raise CommandError(f"{name} of the limits must be a finite number, got {value}")
    for name in ("slew", "power", "on_time", "duty", "rate"):
        if not (value := getattr(configured, name)) > 0:
            raise CommandError(f"{name} limit must be positive, got {value:g}")
    reported = [capabilities, *capabilities["limits"]]
    frequency, level = QUANTITIES["frequency"], QUANTITIES["level"]
    lowest = max(FREQUENCY_FLOOR, configured.frequency_min)
    limits = WireLimits(
        max(-_whole_steps(-lowest, frequency), *(each["frequency_min"] for each in reported)),
        min(
            _whole_steps(configured.frequency_max, frequency),
            *(each["frequency_max"] for each in reported),
        ),
        min(
            _whole_steps(min(configured.level, 1.0), level),
            *(each["level_max"] for each in reported),
        ),
        configured.slew,
        configured.power,
    )
    if limits.frequency_min > limits.frequency_max:
        low, high = (
            frequency.from_wire(end) for end in (limits.frequency_min, limits.frequency_max)
        )
        raise CommandError(
            f"limits of rig and amplifier must leave a frequency range, got {low:g} to {high:g} "
            "Hz; widen limits.frequency in the rig file or use another amplifier"
        )
    if limits.level < 0:
        raise CommandError(f"level limit must be at least 0, got {configured.level:g}")
    return limits


def _whole_steps(value: float, quantity: WireQuantity) -> int:
    """Round a value down to a step of the wire."""
    return math.floor(value * quantity.per_unit + _SLACK)
