"""What a simulated amplifier says: capabilities, what its channels play, faults; how warm it is."""

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from drivers.playing.playback import Playback
from drivers.protocol.definition import FAULTS, FEATURES, NO_CHANNEL, QUANTITIES
from drivers.protocol.records import Values

AMBIENT = 25.0  # °C
RISE = 30.0  # K above ambient in the steady state at full stroke on every channel
TIME_CONSTANT = 120.0  # s
DERATE_ABOVE = 70.0  # °C
FAULT_ABOVE = 85.0  # °C
GOOD_BELOW = 65.0  # °C; faults can be cleared, and derating ends
DERATED = 0.5  # of the level


@dataclass(frozen=True, slots=True)
class ThermalState:
    """Temperature [°C], exponential from its value at `since` [s] to `final`."""

    since: float
    temperature: float = AMBIENT
    final: float = AMBIENT

    def at(self, time: float) -> float:
        """Temperature [°C] at a time [s] not before since."""
        left = math.exp((self.since - time) / TIME_CONSTANT)
        return self.final + (self.temperature - self.final) * left

    def when(self, threshold: float) -> float:
        """Time [s] at which a threshold [°C] is crossed; infinity for never."""
        before, after = self.temperature - threshold, self.final - threshold
        if before * after >= 0:
            return math.inf
        return self.since + TIME_CONSTANT * math.log((before - after) / -after)

    def driven(self, time: float, *, load: float) -> "ThermalState":
        """The state from a time [s], with the mean square level of all channels as load."""
        return ThermalState(time, self.at(time), AMBIENT + RISE * load)


LAYERS, VOICES = 8, 16
LOWEST = 10.0  # Hz; the guard's floor: below it a plate only rocks


def capabilities(channels: int, *, is_output: bool = False) -> Values:
    """Capabilities of a simulated amplifier with this number of channels.

    is_output: full level is a linear amplifier's output, else the stroke of a motion.
    """
    features = {"events", "interlock", "electrical", "address", "mark"}
    features |= {"output"} if is_output else set()
    full = {name: quantity.maximum for name, quantity in QUANTITIES.items()}
    low, high = QUANTITIES["frequency"].to_wire(LOWEST), full["frequency"]
    limits = {"frequency_min": low, "frequency_max": high, "level_max": full["level"]}
    return {
        **{"channels": channels, "layers": LAYERS, "voices": VOICES, "set_words": 4096},
        **{"knots": full["knots"], "features": sum(1 << FEATURES[each] for each in features)},
        **limits,
        **{"frequency_step": 1, "level_step": 1, "phase_step": 1, "slew": full["slew"]},
        **{"ramp_max": full["ramp"], "watchdog_min": QUANTITIES["watchdog"].minimum},
        **{"watchdog_max": full["watchdog"]},
        **{"envelope_step_min": 10, "envelope_step_max": full["envelope_step"]},
        "clock_error": QUANTITIES["clock_error"].to_wire(1e-6),
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


HIGH_VOLTAGE = 1800.0  # V
_CAPACITANCE = 1e-9  # F; of an actuator
_FRACTIONS = 16  # of a fade at which its sum with others is looked at
_Q = QUANTITIES
LIMITED = 1 + _Q["level"].step


def with_readings(status: Values, *, temperature: float, supply: float) -> Values:
    """Return a status with its readings, which may follow from the rest of it.

    temperature [°C]; supply: share of its voltage that the supply has.
    """
    in_units = {"temperature": temperature, "high_voltage": HIGH_VOLTAGE * supply}
    return status | {name: _Q[name].to_wire(value) for name, value in in_units.items()}


FaultRecord = tuple[str, int | None, float]
"""Name, channel if there is one, and time [s] of a fault."""


def fault_list(faults: Iterable[FaultRecord], now: float) -> Values:
    """Return the values of GetFaults at a time [s]."""
    listed = [
        {
            "fault": FAULTS[fault],
            "channel": NO_CHANNEL if channel is None else channel,
            "age": _Q["age"].to_wire(now - at),
        }
        for fault, channel, at in faults
    ]
    return {"count": len(listed), "faults": listed}


def achieved(playback: Playback, layer: int) -> Values:
    """Return the values of GetAchieved: what a layer plays."""
    playing = playback.playing(layer)
    commands = [
        {
            **{"channel": each.channel, "frequency": each.frequency},
            **{"level": each.level, "phase": each.phase},
        }
        for each in playing.commands
    ]
    return {
        **{"token": playback.tokens.get(layer, 0), "layer": layer},
        **{"count": len(commands), "commands": commands},
        **{"ramp": playing.ramp, "valid_for": playing.valid_for},
    }


def measured(playback: Playback, now: float) -> Iterator[Values]:
    """Yield what a capacitor of a typical actuator draws at the level of each channel."""
    for channel in range(playback.channels):
        level = min(playback.level(channel, now), 1.0)
        # Force goes with the voltage squared, at half the frequency.
        voltage = HIGH_VOLTAGE * math.sqrt(level / 2)
        frequencies = [voice.frequency for voice in playback.all_voices[channel]]
        omega = math.pi * max(frequencies, default=0.0)
        yield {
            "channel_voltage": _Q["channel_voltage"].to_wire(voltage),
            "channel_current": _Q["channel_current"].to_wire(omega * _CAPACITANCE * voltage),
        }


def exceeds_full(playback: Playback, channel: int, now: float) -> bool:
    """Whether a channel's sum exceeds full level by a step or more from now on."""
    times = {now}
    for voice in playback.all_voices[channel]:
        length = voice.transition.end - now
        times.update(now + length * part / _FRACTIONS for part in range(1, _FRACTIONS + 1))
    return any(playback.level(channel, at) > LIMITED for at in times if at >= now)
