"""Reports of a simulated amplifier: capabilities, measurements, faults, temperature and clock.

    Crystal: counts age + error * age + warm_up * tau * (age - tau * (1 - exp(-age / tau))) [s]
    Clock:   runs 1 + rate times as fast as its crystal, from each change of its rate on

The clock sums whole numbers, so that no rounding adds up over hours of steering.
"""

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import NamedTuple

from drivers.playing import Playback
from drivers.protocol.definition import (
    CLOCK_TURN,
    FAULTS,
    FEATURES,
    HIGH_STEPS,
    NO_CHANNEL,
    QUANTITIES,
    SPAN,
    clock_at,
)
from drivers.protocol.records import Values

AMBIENT = 25.0  # °C
_RISE = 30.0  # K above ambient in the steady state at full stroke on every channel
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
        return ThermalState(time, self.at(time), AMBIENT + _RISE * load)


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
        "channels": channels,
        "layers": LAYERS,
        "voices": VOICES,
        "set_words": 4096,
        "knots": full["knots"],
        "features": sum(1 << FEATURES[each] for each in features),
        **limits,
        "frequency_step": 1,
        "level_step": 1,
        "phase_step": 1,
        "slew": full["slew"],
        "ramp_max": full["ramp"],
        "watchdog_min": QUANTITIES["watchdog"].minimum,
        "watchdog_max": full["watchdog"],
        "envelope_step_min": 10,
        "envelope_step_max": full["envelope_step"],
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
    """Return a status with its readings, which can depend on its other values.

    temperature [°C]; supply: supply voltage relative to its nominal value.
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
    """Return the values of GetAchieved for a layer."""
    playing = playback.playing(layer)
    commands = [
        {
            "channel": each.channel,
            "frequency": each.frequency,
            "level": each.level,
            "phase": each.phase,
        }
        for each in playing.commands
    ]
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


SETTLING = 10.0
"""Time constant [s] with which a crystal warms up: its error ends warm_up * SETTLING higher."""

_PER_RATE = QUANTITIES["rate"].per_unit
_PER_CRYSTAL = 1 << 40  # parts of a second of the crystal
_PER_SECOND = _PER_CRYSTAL * _PER_RATE  # parts of a second of the clock
_TURN = round(CLOCK_TURN) * _PER_SECOND
_STEPS = 4  # of Newton's method: each leaves the square of an error of 1e-4


@dataclass(frozen=True)
class Crystal:
    """A crystal, by default without errors.

    error: initial relative rate error; warm_up: its initial growth [1/s], see `SETTLING`; ahead:
    initial lead of the clock over the bench's time [s].
    """

    error: float = 0.0
    warm_up: float = 0.0
    ahead: float = 0.0

    def counted(self, age: float) -> float:
        """Return the seconds that it counts in its first seconds."""
        warming = age + SETTLING * math.expm1(-age / SETTLING)
        return age + self.error * age + self.warm_up * SETTLING * warming

    def pace(self, age: float) -> float:
        """Return the seconds that it counts in a second, at an age [s]."""
        return 1 + self.error - self.warm_up * SETTLING * math.expm1(-age / SETTLING)

    def drift(self, age: float) -> float:
        """Return by how much its pace grows in a second, at an age [s]."""
        return self.warm_up * math.exp(-age / SETTLING)


class StraightClock(NamedTuple):
    """A clock with a constant rate: its value [s] at a time [s], and its rate."""

    time: float
    shown: float
    pace: float

    def at(self, time: float) -> float:
        """Return its value at a time [s], within a turn."""
        return (self.shown + (time - self.time) * self.pace) % CLOCK_TURN


class AmplifierClock:
    """A clock of 32 bits that goes round once in 20 s, with supply since a time [s].

    Times [s] are the bench's, not before the last change; rate: in units of the wire; changes:
    counts changes of the rate, and changes of the shown value.
    """

    def __init__(self, crystal: Crystal = Crystal(), *, since: float = 0.0) -> None:
        self.crystal = crystal
        self.rate = 0
        self.changes = 0
        self._since = since
        # Parts of a second that crystal and clock had counted when its rate changed last.
        self._crystal, self._clock = 0, round((since + crystal.ahead) * _PER_SECOND)

    def reading(self, time: float) -> int:
        """Return the clock as a Status shows it, at a time [s]."""
        return clock_at(self._parts(time) % _TURN / _PER_SECOND)

    def seconds(self, time: float) -> float:
        """Return the clock [s] at a time [s], without wrapping."""
        return self._parts(time) / _PER_SECOND

    def straight(self, time: float) -> StraightClock:
        """Return the clock with its pace at a time [s], extrapolated without changes."""
        pace = self.crystal.pace(time - self._since) * (1 + self.rate / _PER_RATE)
        return StraightClock(time, self._parts(time) % _TURN / _PER_SECOND, pace)

    def steady(self, time: float, change: float) -> float:
        """Return for how long its crystal's drift changes it by less than a time [s]."""
        drift = abs(self.crystal.drift(time - self._since))
        return math.sqrt(2 * change / drift) if drift else math.inf

    def steer(self, rate: int, time: float) -> None:
        """Let it run faster than its crystal by a rate, from a time [s] on."""
        if rate != self.rate:
            self._clock, self._crystal = self._parts(time), self._counted(time)
            self.rate = rate
            self.changes += 1

    def shift(self, steps: int) -> None:
        """Move it on by steps of its high word."""
        self._clock += steps * HIGH_STEPS * _TURN // SPAN
        self.changes += 1

    def restart(self, time: float) -> None:
        """Let it show 0 at a time [s], as fast as its crystal, which stays as warm as it is."""
        self._clock, self._crystal, self.rate = 0, self._counted(time), 0
        self.changes += 1

    def reaches(self, high: int, time: float) -> float:
        """Return when its high word becomes this one next [s], as it runs at a time [s].

        That time itself, if it starts exactly there.
        """
        left = (high * HIGH_STEPS * _TURN // SPAN - self._parts(time)) % _TURN
        counted = self._counted(time) / _PER_CRYSTAL + left / (_PER_CRYSTAL * self._pace_words)
        age = time - self._since + left / _PER_SECOND
        for _ in range(_STEPS):
            age -= (self.crystal.counted(age) - counted) / self.crystal.pace(age)
        return max(self._since + age, time)

    @property
    def _pace_words(self) -> int:
        return _PER_RATE + self.rate

    def _counted(self, time: float) -> int:
        return round(self.crystal.counted(time - self._since) * _PER_CRYSTAL)

    def _parts(self, time: float) -> int:
        return self._clock + (self._counted(time) - self._crystal) * self._pace_words
