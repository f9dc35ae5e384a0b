"""Configuration of the witness: wires, amplifiers, limits of channels and time limits.

It is given independently of the controller's configuration.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, TypeAlias

WireKind: TypeAlias = Literal["serial", "modbus-tcp", "modbus-rtu", "socketcand", "slcan"]


@dataclass(frozen=True)
class ChannelLimits:
    """Limits of one channel: frequencies [Hz], level 0..1, rise of the level [1/s]."""

    frequency: tuple[float, float]
    level: float
    slew: float = math.inf


@dataclass(frozen=True)
class TimeLimits:
    """Time limits [s].

    heartbeat: between frames that feed the watchdog; reply: to a reply; together: until all
    amplifiers have a set; slack: error of the witness's own clock.
    """

    heartbeat: float = 0.075
    reply: float = 0.030
    together: float = 0.020
    slack: float = 0.001


@dataclass(frozen=True)
class AmplifierConfig:
    """An amplifier: its wire, its address, unit or node there, and the limits of its channels."""

    wire: str
    address: int
    channels: Mapping[int, ChannelLimits]


@dataclass(frozen=True)
class WitnessConfig:
    """Kinds of wires and amplifiers, both by name, and time limits."""

    wires: Mapping[str, WireKind]
    amplifiers: Mapping[str, AmplifierConfig]
    times: TimeLimits = TimeLimits()
