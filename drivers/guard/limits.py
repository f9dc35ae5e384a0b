"""What no command may exceed: the least of the configuration, the amplifier, and the ceilings."""

import math
from dataclasses import dataclass

from drivers.errors import CommandError
from drivers.protocol.definition import PROTOCOL
from drivers.protocol.messages import Capabilities

# Below 10 Hz a plate on springs only rocks, nothing is felt, and the voltage stands nearly still.
FREQUENCY_FLOOR = 10.0
# What the wire can say; the skin's sensitivity to vibration has fallen off long before it.
FREQUENCY_CEILING = PROTOCOL.quantities.frequency.high
# Full stroke: beyond it the electrodes of an actuator touch.
LEVEL_CEILING = 1.0
# No bus carries more sets in a second, so more can only be a loop that runs wild.
RATE_CEILING = 2000.0


@dataclass(frozen=True)
class GuardLimits:
    """What the configuration allows: mechanical frequencies [Hz] and level (1 is full stroke).

    slew [1/s]: how fast a level may rise; power: the sum of squared levels over all channels;
    on_time [s]: how long there may be vibration without a pause; duty: which share of DUTY_WINDOW;
    rate [1/s]: how many sets that are not silent. All of these are without limit unless given.
    """

    frequency_min: float
    frequency_max: float
    level: float
    slew: float = math.inf
    power: float = math.inf
    on_time: float = math.inf
    duty: float = 1.0
    rate: float = math.inf


@dataclass(frozen=True)
class Bounds:
    """The least of all limits; units as in `GuardLimits` and `Capabilities`."""

    frequency_min: float
    frequency_max: float
    level: float
    slew: float
    power: float
    on_time: float
    duty: float
    rate: float
    ramp: float
    channels: int
    envelope_slots: int
    envelope_knots: int
    envelope_step_min: float
    envelope_step_max: float


_NEEDED = ("frequency_min", "frequency_max", "level_max", "ramp_max")


def tightest(limits: GuardLimits, capabilities: Capabilities) -> Bounds:
    """The bounds in force; raises CommandError for limits that leave nothing to play."""
    for whose, told, names in (
        ("the configured", limits, ("frequency_min", "frequency_max", "level")),
        ("the amplifier's", capabilities, _NEEDED),
    ):
        for name in names:
            if not math.isfinite(getattr(told, name)):
                raise CommandError(
                    f"{whose} {name} is {getattr(told, name)}; it must be a finite number"
                )
    for name in ("slew", "power", "on_time", "duty", "rate"):
        if not getattr(limits, name) > 0:
            raise CommandError(
                f"the {name} limit is {getattr(limits, name):g}; it must be above zero"
            )
    bounds = Bounds(
        frequency_min=max(limits.frequency_min, capabilities.frequency_min, FREQUENCY_FLOOR),
        frequency_max=min(limits.frequency_max, capabilities.frequency_max, FREQUENCY_CEILING),
        level=min(limits.level, capabilities.level_max, LEVEL_CEILING),
        slew=limits.slew,
        power=limits.power,
        on_time=limits.on_time,
        duty=limits.duty,
        rate=min(limits.rate, RATE_CEILING),
        ramp=max(0.0, min(capabilities.ramp_max, PROTOCOL.quantities.ramp.high)),
        channels=min(capabilities.channels, PROTOCOL.quantities.channel_count.maximum),
        envelope_slots=capabilities.envelope_slots,
        envelope_knots=capabilities.envelope_knots,
        envelope_step_min=capabilities.envelope_step_min,
        envelope_step_max=capabilities.envelope_step_max,
    )
    if bounds.frequency_min > bounds.frequency_max:
        raise CommandError(
            "the configured limits and the amplifier's own leave no frequency: from "
            f"{bounds.frequency_min:g} to {bounds.frequency_max:g} Hz; widen limits.frequency in "
            "the rig file or use another amplifier"
        )
    if bounds.level < 0:
        raise CommandError(f"the level limit is {bounds.level:g}; it must lie between 0 and 1")
    return bounds
