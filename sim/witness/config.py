"""What the witness is told beforehand: wires, amplifiers on them, limits, and how long things take.

A plain dictionary, given independently of what the controller is configured with:

    {"wires": {"line": "serial"},
     "amplifiers": {"main": {"wire": "line", "address": 1, "channels": {0: {
         "frequency_hz": [40, 500], "level": 1.0, "slew_per_s": 100}}}},
     "times_s": {"lift": 0.02}}
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any

from model.errors import InputError

KINDS = ("serial", "modbus-tcp", "modbus-rtu", "socketcand", "slcan")
"""Of wires."""


@dataclass(frozen=True, slots=True)
class ChannelLimits:
    """What one channel may be asked for: Hz, level 0..1, rise of the level in 1/s."""

    frequency_min: float
    frequency_max: float
    level: float
    slew: float = math.inf


@dataclass(frozen=True, slots=True)
class TimeLimits:
    """How long things may take [s].

    lift: from the last finger's lift to a command of zero; release: to zero itself;
    touch: from a touch to a pattern; stop: from the wish to the frame; heartbeat: between two signs
    of life; reply: to an answer; together: until all amplifiers have what one has; slack: what the
    witness's own clock may be wrong by.
    """

    lift: float = 0.020
    release: float = 0.060
    touch: float = 0.100
    stop: float = 0.020
    heartbeat: float = 0.075
    reply: float = 0.030
    together: float = 0.020
    slack: float = 0.001


@dataclass(frozen=True)
class AmplifierConfig:
    """An amplifier: on which wire, under which address, unit or node, and its channels' limits."""

    wire: str
    address: int
    channels: Mapping[int, ChannelLimits]


@dataclass(frozen=True)
class WitnessConfig:
    """Wires with their kinds, amplifiers by name, and times."""

    wires: Mapping[str, str]
    amplifiers: Mapping[str, AmplifierConfig]
    times: TimeLimits = field(default_factory=TimeLimits)


def parse_config(given: Mapping[str, Any]) -> WitnessConfig:
    """The plan in a plain dictionary; InputError says which key is wrong."""
    _check_keys(given, {"wires", "amplifiers", "times_s"}, "the plan")
    wires = dict(_mapping(given, "wires"))
    for name, kind in wires.items():
        if kind not in KINDS:
            raise InputError(f"wires.{name} is {kind!r}; it must be one of {', '.join(KINDS)}")
    amplifiers = {
        name: _amplifier(name, raw, wires) for name, raw in _mapping(given, "amplifiers").items()
    }
    raw_times = given.get("times_s", {})
    _check_keys(raw_times, {one.name for one in fields(TimeLimits)}, "times_s")
    times = {key: _number(time, f"times_s.{key}") for key, time in raw_times.items()}
    return WitnessConfig(wires, amplifiers, TimeLimits(**times))


def _amplifier(name: str, raw: Any, wires: Mapping[str, str]) -> AmplifierConfig:
    where = f"amplifiers.{name}"
    if not isinstance(raw, Mapping):
        raise InputError(f"{where} must be a mapping with wire, address and channels")
    _check_keys(raw, {"wire", "address", "channels"}, where)
    wire = raw.get("wire")
    if not isinstance(wire, str) or wire not in wires:
        raise InputError(f"{where}.wire is {wire!r}; the wires are {', '.join(wires) or 'none'}")
    channels = {
        int(number): _limits(limits, f"{where}.channels.{number}")
        for number, limits in _mapping(raw, "channels", where).items()
    }
    return AmplifierConfig(wire, int(_number(raw.get("address", 1), f"{where}.address")), channels)


def _limits(raw: Any, where: str) -> ChannelLimits:
    if not isinstance(raw, Mapping):
        raise InputError(f"{where} must be a mapping with frequency_hz and level")
    _check_keys(raw, {"frequency_hz", "level", "slew_per_s"}, where)
    band = raw.get("frequency_hz")
    if not isinstance(band, list | tuple) or len(band) != 2:
        raise InputError(f"{where}.frequency_hz is {band!r}; it must be [lowest, highest]")
    low, high = (_number(one, f"{where}.frequency_hz") for one in band)
    slew = _number(raw["slew_per_s"], f"{where}.slew_per_s") if "slew_per_s" in raw else math.inf
    return ChannelLimits(low, high, _number(raw.get("level"), f"{where}.level"), slew)


def _mapping(raw: Mapping[str, Any], key: str, where: str = "the plan") -> Mapping[Any, Any]:
    found = raw.get(key)
    if not isinstance(found, Mapping) or not found:
        raise InputError(
            f"{where} names no {key}; see docs/reference/witness.md for what a plan looks like"
        )
    return found


def _number(given: Any, where: str) -> float:
    if isinstance(given, bool) or not isinstance(given, int | float) or not math.isfinite(given):
        raise InputError(f"{where} is {given!r}; it must be a number")
    return float(given)


def _check_keys(given: Any, known: set[str], where: str) -> None:
    if not isinstance(given, Mapping):
        raise InputError(f"{where} must be a mapping, not {type(given).__name__}")
    unknown = sorted(str(key) for key in given if key not in known)
    if unknown:
        raise InputError(
            f"{where} has the unknown key {unknown[0]!r}; known are {', '.join(sorted(known))}"
        )
