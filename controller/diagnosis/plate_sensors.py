"""The sensors of a rig's amplifiers as those of its plate: where they are, what they read."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from drivers.errors import CommandError
from drivers.host.amplifier import Amplifier, Reading, read_sensors
from drivers.host.amplifier import Sensor as ReportedSensor
from model.arrays import ComplexArray, FloatArray
from model.identification.forward import Sensor
from model.rig.rig import Channel, Rig

_DERIVATIVES = {"ACCELERATION": 0, "VELOCITY": 1, "DISPLACEMENT": 2}
"""How often what a sensor reads is to be differentiated in time."""


@dataclass(frozen=True)
class PlateSensor:
    """A sensor of an amplifier: which of its sensors, and its place; derivatives to acceleration.

    frequency_max [Hz]: of its tones.
    """

    amplifier: str
    number: int
    place: Sensor
    derivatives: int
    frequency_max: float

    def accelerations(self, reading: Reading, frequencies: FloatArray) -> ComplexArray:
        """Complex amplitudes [m/s²] (f,) of the tones [Hz] of a reading."""
        amplitudes, degrees = np.array(reading.sensors[self.number].tones).T
        phasors = amplitudes * np.exp(1j * np.radians(degrees))
        return np.asarray(phasors * (2j * np.pi * frequencies) ** self.derivatives)


@dataclass(frozen=True)
class PlateSensors:
    """Sensors that are used; unused: why others are not, one line each."""

    used: tuple[PlateSensor, ...]
    unused: tuple[str, ...]


async def plate_sensors(rig: Rig, amplifiers: Mapping[str, Amplifier]) -> PlateSensors:
    """Read what the sensors of open amplifiers, by name, measure and where.

    Raises CommandError for an amplifier that has none, or none of use.
    """
    used: list[PlateSensor] = []
    unused: list[str] = []
    for name, amplifier in amplifiers.items():
        reported = await read_sensors(amplifier)
        if not reported:
            raise CommandError(
                f"amplifier {name} must measure the plate (feature sensors of the wire protocol), "
                "got one without; use one with sensors, or measure with accelerometers and run "
                "era calibrate"
            )
        own, rest = _of_amplifier(rig, name, reported)
        if not own:
            raise CommandError(
                f"amplifier {name} must have a sensor of acceleration, velocity or displacement at "
                "an ERA of the rig or at a place that it states, got "
                f"{'; '.join(rest) or 'none'}"
            )
        used += own
        unused += rest
    return PlateSensors(tuple(used), tuple(unused))


def check_clocks(amplifiers: Mapping[str, Amplifier]) -> None:
    """Raise CommandError unless all open amplifiers, by name, have one time."""
    if len(amplifiers) < 2:
        return
    for name, each in amplifiers.items():
        if not each.clock.can_be_steered:
            raise CommandError(
                f"amplifier {name} must have a clock that can be steered to be measured beside "
                "others while they play, got none; see its clock_error"
            )


def _of_amplifier(
    rig: Rig, amplifier: str, reported: Sequence[ReportedSensor]
) -> tuple[list[PlateSensor], list[str]]:
    eras = {channel: era for era, channel in rig.wiring.items()}
    used: list[PlateSensor] = []
    unused: list[str] = []
    for number, sensor in enumerate(reported):
        name = f"{amplifier}:{number}"
        derivatives = _DERIVATIVES.get(sensor.unit)
        era = "" if sensor.channel is None else eras.get(Channel(amplifier, sensor.channel), "")
        if derivatives is None:
            unused.append(f"sensor {name} measures {sensor.unit.lower()}")
        elif era:
            place = Sensor(era, era, amplifier=amplifier)
            if any(each.place == place for each in used):
                place = Sensor(name, era, amplifier=amplifier)
            used.append(PlateSensor(amplifier, number, place, derivatives, sensor.frequency_max))
        elif sensor.channel is not None:
            unused.append(f"sensor {name} is at channel {sensor.channel}, which has no ERA")
        elif sensor.x is None or sensor.y is None:
            unused.append(f"sensor {name} states no place")
        else:
            place = Sensor(name, x=sensor.x, y=sensor.y, amplifier=amplifier)
            used.append(PlateSensor(amplifier, number, place, derivatives, sensor.frequency_max))
    return used, unused
