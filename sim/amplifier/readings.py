"""Reports of a simulated amplifier: capabilities, status readings, faults, and measurements."""

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from drivers.playing import Playback
from drivers.protocol.definition import FAULTS, FEATURES, NO_CHANNEL, QUANTITIES
from drivers.protocol.records import Values

LAYERS = 8
VOICES = 16
LOWEST = 10.0  # Hz; the guard's floor: below it a plate only rocks
HIGH_VOLTAGE = 1800.0  # V
_CAPACITANCE = 1e-9  # F; of an actuator
_FRACTIONS = 16  # of a fade at which its sum with others is checked
_FEATURES = ("events", "interlock", "electrical", "address", "mark")
_Q = QUANTITIES
LIMITED = 1 + _Q["level"].step


def capabilities(channels: int, *, is_output: bool = False) -> Values:
    """Capabilities of a simulated amplifier with this number of channels.

    is_output: full level is a linear amplifier's output, else the stroke of a motion.
    """
    features = sum(1 << FEATURES[feature] for feature in _FEATURES)
    if is_output:
        features |= 1 << FEATURES["output"]
    limits = {
        "frequency_min": _Q["frequency"].to_wire(LOWEST),
        "frequency_max": _Q["frequency"].maximum,
        "level_max": _Q["level"].maximum,
    }
    return {
        "channels": channels,
        "layers": LAYERS,
        "voices": VOICES,
        "set_words": 4096,
        "knots": _Q["knots"].maximum,
        "features": features,
        **limits,
        "frequency_step": 1,
        "level_step": 1,
        "phase_step": 1,
        "slew": _Q["slew"].maximum,
        "ramp_max": _Q["ramp"].maximum,
        "watchdog_min": _Q["watchdog"].minimum,
        "watchdog_max": _Q["watchdog"].maximum,
        "envelope_step_min": 10,
        "envelope_step_max": _Q["envelope_step"].maximum,
        "clock_error": _Q["clock_error"].to_wire(1e-6),
        "limits": [dict(limits) for _ in range(channels)],
    }


@dataclass(frozen=True)
class AmplifierSummary:
    """Names of its state and fault, the token committed last, and the level of each channel."""

    state: str
    fault: str
    token: int
    is_high_voltage: bool
    levels: tuple[float, ...]


def with_readings(status: Values, *, temperature: float, supply: float) -> Values:
    """Return a status with its readings, which can depend on its other values.

    temperature [°C]; supply: supply voltage relative to its nominal value.
    """
    return {
        **status,
        "temperature": _Q["temperature"].to_wire(temperature),
        "high_voltage": _Q["high_voltage"].to_wire(HIGH_VOLTAGE * supply),
    }


@dataclass(frozen=True, slots=True)
class FaultRecord:
    """A fault by name at a time [s], and its channel if there is one."""

    fault: str
    channel: int | None
    time: float


def fault_list(records: Iterable[FaultRecord], now: float) -> Values:
    """Return the values of GetFaults at a time [s]."""
    entries = []
    for record in records:
        entry = {
            "fault": FAULTS[record.fault],
            "channel": NO_CHANNEL if record.channel is None else record.channel,
            "age": _Q["age"].to_wire(now - record.time),
        }
        entries.append(entry)
    return {"count": len(entries), "faults": entries}


def achieved(playback: Playback, layer: int) -> Values:
    """Return the values of GetAchieved for a layer."""
    playing = playback.playing(layer)
    commands = []
    for command in playing.commands:
        values = {
            "channel": command.channel,
            "frequency": command.frequency,
            "level": command.level,
            "phase": command.phase,
        }
        commands.append(values)
    return {
        "token": playback.tokens.get(layer, 0),
        "layer": layer,
        "count": len(commands),
        "commands": commands,
        "ramp": playing.ramp,
        "valid_for": playing.valid_for,
    }


def measured(playback: Playback, now: float) -> Iterator[Values]:
    """Yield the current of a typical actuator's capacitor at the level of each channel."""
    for channel in range(playback.channels):
        level = min(playback.level(channel, now), 1.0)
        # Force is proportional to the squared voltage, at half the frequency.
        voltage = HIGH_VOLTAGE * math.sqrt(level / 2)
        frequencies = [voice.frequency for voice in playback.all_voices[channel]]
        omega = math.pi * max(frequencies, default=0.0)
        current = omega * _CAPACITANCE * voltage
        yield {
            "channel_voltage": _Q["channel_voltage"].to_wire(voltage),
            "channel_current": _Q["channel_current"].to_wire(current),
        }


def exceeds_full(playback: Playback, channel: int, now: float) -> bool:
    """Whether a channel's sum exceeds full level by a step or more from now on."""
    times = {now}
    for voice in playback.all_voices[channel]:
        length = voice.transition.end - now
        for part in range(1, _FRACTIONS + 1):
            times.add(now + length * part / _FRACTIONS)
    return any(playback.level(channel, time) > LIMITED for time in times if time >= now)
