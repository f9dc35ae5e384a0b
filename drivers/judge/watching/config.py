"""Configuration of the witness: wires, amplifiers, limits of channels and time limits.

A plain mapping, given independently of the controller's configuration:

    {"wires": {"line": "serial"},
     "amplifiers": {"main": {"wire": "line", "address": 1, "channels": {0: {
         "frequency_hz": [40, 500], "level": 1.0, "slew_per_s": 100}}}},
     "times_s": {"heartbeat": 0.08}}
"""

from collections.abc import Mapping
from typing import Annotated, Any, Literal, TypeAlias

from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, ValidationError

from drivers.errors import CommandError
from registry.wording import first_problem

WireKind: TypeAlias = Literal["serial", "modbus-tcp", "modbus-rtu", "socketcand", "slcan"]


class _Section(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)


class ChannelLimits(_Section):
    """Limits of one channel: frequency [Hz], level 0..1, rise of the level [1/s]."""

    frequency_hz: Annotated[tuple[FiniteFloat, FiniteFloat], Field(strict=False)]
    level: FiniteFloat
    slew_per_s: float = float("inf")


class TimeLimits(_Section):
    """Time limits [s].

    heartbeat: between frames that feed the watchdog; reply: to a reply; together: until all
    amplifiers have a set; slack: error of the witness's own clock.
    """

    heartbeat: FiniteFloat = 0.075
    reply: FiniteFloat = 0.030
    together: FiniteFloat = 0.020
    slack: FiniteFloat = 0.001


class AmplifierConfig(_Section):
    """An amplifier: its wire, its address, unit or node there, and the limits of its channels.

    power: limit of the sum of their squared levels.
    """

    wire: str
    address: int = 1
    channels: Annotated[dict[int, ChannelLimits], Field(min_length=1, strict=False)]
    power: float = float("inf")


class WitnessConfig(_Section):
    """Kinds of wires and amplifiers, both by name, and time limits."""

    wires: Annotated[dict[str, WireKind], Field(min_length=1)]
    amplifiers: Annotated[dict[str, AmplifierConfig], Field(min_length=1)]
    times_s: TimeLimits = TimeLimits()


def parse_config(given: Mapping[str, Any]) -> WitnessConfig:
    """Check a plain mapping; raises CommandError naming the key."""
    try:
        config = WitnessConfig.model_validate(given)
    except ValidationError as error:
        key, problem = first_problem(error)
        raise CommandError(
            f"witness configuration: {key}: {problem}; docs/reference/witness.md has an example"
        ) from error
    for name, amplifier in config.amplifiers.items():
        if amplifier.wire not in config.wires:
            raise CommandError(
                f"witness configuration: amplifiers.{name}.wire: must be one of "
                f"{', '.join(config.wires)}, got {amplifier.wire!r}"
            )
    return config
