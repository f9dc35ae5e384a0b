"""The desk of a measurement: a rig whose ERAs and accelerometers are wired to one sound card."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from era_haptics.lab.measuring.sensor_file import WiredSensor
from era_haptics.lab.measuring.settling import plate_settling_time
from era_haptics.lab.measuring.wiring import SoundCardWiring
from model.arrays import ComplexArray, FloatArray
from model.errors import InputError
from model.estimate.measurement import Measurement
from model.rig.rig import Rig


@dataclass(frozen=True)
class Desk:
    """A rig and its accelerometers on a sound card.

    is_shared: whether the loop-back shares the output of the last ERA, by a Y cable.
    """

    rig: Rig
    sensors: tuple[WiredSensor, ...]
    is_shared: bool = False

    @cached_property
    def wiring(self) -> SoundCardWiring:
        """Outputs and inputs of the sound card; an ERA's output is its channel, counted from 1."""
        channels = self.rig.wiring
        outputs = {era.name: channels[era.name].number + 1 for era in self.rig.eras}
        return SoundCardWiring(outputs, self.sensors, self.is_shared)

    @cached_property
    def settling(self) -> float:
        """Time [s] that a run plays before its recording is analyzed; see `plate_settling_time`."""
        return plate_settling_time(self.rig)

    # Responses

    def responses(
        self, frequencies: FloatArray, era_responses: ComplexArray, loopback: ComplexArray
    ) -> Measurement:
        """Convert responses of samples (f, sensors, ERAs) to acceleration per base displacement
        [1/s²].

        loopback (f,): response of the loop-back.
        """
        full_levels = np.array([*self.rig.full_levels.values()])
        sensitivities = [[sensor.sensitivity] for sensor in self.sensors]
        compensated = era_responses / converter_response(loopback)[:, None, None]
        return Measurement(
            tuple(sensor.place for sensor in self.sensors),
            frequencies,
            compensated / full_levels / sensitivities,
            drives_lag=True,
        )

    # Limits of the rig

    @property
    def max_level(self) -> float:
        """Highest level that the rig's limits allow on all ERAs simultaneously."""
        limits = self.rig.limits
        return min(limits.level, float(np.sqrt(limits.power / len(self.rig.eras))), 1.0)

    def check_level(self, level: float) -> None:
        """Raise InputError for several amplifiers, or a level beyond the rig's limits."""
        if len({self.rig.wiring[era.name].amplifier for era in self.rig.eras}) > 1:
            raise InputError(
                "all ERAs must be on one sound card, got several amplifiers in the rig"
            )
        if not 0 < level <= self.max_level:
            raise InputError(
                f"--level must be above 0 and at most {self.max_level:.3g}, as the rig's limits "
                f"allow, got {level:g}"
            )

    def check_times(self, *, seconds: float, slew: float) -> None:
        """Raise InputError for time limits that prerecorded samples would violate.

        seconds: played without a pause; slew [1/s]: highest rise of a level.
        """
        limits = self.rig.limits
        for key, is_kept, played in (
            ("on_time", seconds <= limits.on_time, f"{seconds:.3g} s without a pause"),
            ("duty", limits.duty >= 1, "one run after the other"),
            ("slew", slew <= limits.slew, f"ramps of {slew:.3g} per second"),
        ):
            if not is_kept:
                raise InputError(
                    f"limits.{key} must allow the signals of a sound card, {played}, got "
                    f"{getattr(limits, key):g}; check that the ERAs withstand them, and widen it"
                )

    def check_frequencies(self, frequencies: FloatArray, *, what: str) -> None:
        """Raise InputError for frequencies [Hz] beyond the rig's limits; what: option's name."""
        limits = self.rig.limits
        low, high = limits.frequency_min, limits.frequency_max
        if frequencies.min() < low or frequencies.max() > high:
            raise InputError(
                f"{what} must be within the rig's limits.frequency of {low:g} to {high:g} "
                f"Hz, got {frequencies.min():g} to {frequencies.max():g} Hz"
            )


def converter_response(loopback: ComplexArray) -> ComplexArray:
    """Response of the converters (f,): the loop-back's, scaled to a median modulus of 1.

    Division by this response removes the delay, including fractions of a sample, and the shape of
    filters. Gains remain, since levels and sensitivities are stated separately.
    """
    return np.asarray(loopback / np.median(np.abs(loopback)))
