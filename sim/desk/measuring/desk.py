"""How a rig is wired to a sound card, and what its limits allow of that."""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from model.arrays import ComplexArray, FloatArray
from model.calibration.responses import Responses, WiredSensor
from model.errors import InputError
from model.reduction.reduced_plate import reduce_plate
from model.rig.rig import Rig
from model.structure.attachments import footprints_of
from model.transients.time_response import plate_in_time
from sim.desk.measuring.multisine import PERIOD

MIN_SETTLING = 1.0
"""Time [s] of a run before what counts, at least: a plate with a usual loss factor has settled."""

_MAX_SETTLING = 5.0  # s
_LEFT = 0.01  # of a free vibration


def converters(response: ComplexArray) -> ComplexArray:
    """The loop-back's complex response (f,) with a modulus of 1 in the median.

    Dividing by it takes out the delay, fractions of a sample included, and the shape of filters;
    gains are left, since those of a level and of a sensitivity are stated.
    """
    return np.asarray(response / np.median(np.abs(response)))


@dataclass(frozen=True)
class Desk:
    """How a rig is wired to a sound card: its ERAs by their channels, counted from 1; a loop-back.

    The loop-back is a cable from the output after those of the ERAs to the input after those of
    the sensors; or, where a card has no output left, it has that of the last ERA (is_shared).
    """

    rig: Rig
    sensors: tuple[WiredSensor, ...]
    is_shared: bool = False

    @property
    def eras(self) -> list[tuple[str, int]]:
        """Name and output of each ERA."""
        return [(era.name, self.rig.wiring[era.name].number + 1) for era in self.rig.eras]

    @property
    def output(self) -> int:
        """Output of the loop-back, the last one."""
        return max(at for _, at in self.eras) + (not self.is_shared)

    @property
    def sources(self) -> list[int]:
        """Output of each source: of the ERAs in their order, and of a loop-back of its own."""
        outputs = [at for _, at in self.eras]
        return outputs if self.is_shared else [*outputs, self.output]

    @property
    def input(self) -> int:
        """Input of the loop-back, the last one."""
        return max(sensor.input for sensor in self.sensors) + 1

    @property
    def looped(self) -> int:
        """Number of the source that the loop-back brings back, the last one."""
        return self.sources.index(self.output)

    @property
    def named_inputs(self) -> dict[int, str]:
        """What each input has, the loop-back included."""
        named = {sensor.input: f"sensor {sensor.name}" for sensor in self.sensors}
        return named | {self.input: f"the loop-back of output {self.output}"}

    @property
    def columns(self) -> list[int]:
        """Index of each sensor's input."""
        return [sensor.input - 1 for sensor in self.sensors]

    @property
    def sensitivities(self) -> FloatArray:
        """Sensitivity of each sensor, see `WiredSensor`."""
        return np.array([sensor.sensitivity for sensor in self.sensors])

    def responses(
        self, frequencies: FloatArray, values: ComplexArray, looped: ComplexArray
    ) -> Responses:
        """Accelerations per base displacement [1/s²] from those of samples (f, inputs, sources).

        looped (f,): of the loop-back.
        """
        full = np.array([*self.rig.full_levels.values()])
        plain = values[:, self.columns, : len(self.eras)] / converters(looped)[:, None, None]
        return Responses(
            tuple(sensor.name for sensor in self.sensors),
            np.array([[sensor.x, sensor.y] for sensor in self.sensors]),
            frequencies,
            plain.transpose(0, 2, 1) / full[:, None] / self.sensitivities,
            masses=np.array([sensor.mass for sensor in self.sensors]),
        )

    def on_outputs(self, sources: FloatArray) -> FloatArray:
        """Samples (n, outputs) of the sources (n, sources)."""
        return np.asarray(sources @ np.eye(self.output)[[at - 1 for at in self.sources]])

    @cached_property
    def settling(self) -> float:
        """Time [s] of a run until free vibrations are at most 1 %, whole periods within 1 to 5 s.

        By the mode within the rig's limits that decays slowest; those below them hardly move.
        Raises InputError for a plate that is not supported.
        """
        rig = self.rig
        points = footprints_of(rig.eras, rig.masses)
        high = rig.limits.frequency_max
        reduced = reduce_plate(rig.plate, rig.mesh, points, frequency_max=high)
        modes = plate_in_time(reduced, rig.eras, loads=rig.masses).eigenvalues
        played = np.abs(modes.imag) / (2 * np.pi)
        within = (played >= rig.limits.frequency_min) & (played <= high)
        slowest = -float(modes.real[within].max(initial=-math.inf))
        least = max(slowest, -math.log(_LEFT) / _MAX_SETTLING)
        return max(MIN_SETTLING, PERIOD * math.ceil(-math.log(_LEFT) / least / PERIOD))

    @property
    def highest(self) -> float:
        """The highest level that the rig's limits allow on all ERAs at once."""
        limits = self.rig.limits
        return min(limits.level, float(np.sqrt(limits.power / len(self.rig.eras))), 1.0)

    def check(self, level: float) -> None:
        """Raise InputError for several amplifiers, and a level beyond the rig's limits."""
        if len({self.rig.wiring[era.name].amplifier for era in self.rig.eras}) > 1:
            raise InputError(
                "all ERAs must be on one sound card, got several amplifiers in the rig"
            )
        if not 0 < level <= self.highest:
            raise InputError(
                f"--level must be above 0 and at most {self.highest:.3g}, as the rig's limits "
                f"allow, got {level:g}"
            )

    def check_times(self, *, seconds: float, slew: float) -> None:
        """Raise InputError for limits in time that samples from memory would not keep.

        seconds: that are played without a pause; slew [1/s]: highest rise of a level.
        """
        limits = self.rig.limits
        for key, is_kept, played in (
            ("on_time", seconds <= limits.on_time, f"{seconds:.3g} s without a pause"),
            ("duty", limits.duty >= 1, "one run after the other"),
            ("slew", slew <= limits.slew, f"ramps of {slew:.3g} per second"),
        ):
            if not is_kept:
                raise InputError(
                    f"limits.{key} must allow what a sound card plays from memory, {played}, got "
                    f"{getattr(limits, key):g}; check whether the ERAs bear it, and widen it"
                )

    def check_frequencies(self, frequencies: FloatArray, *, what: str) -> None:
        """Raise InputError for frequencies [Hz] beyond the rig's limits; what: has them."""
        limits = self.rig.limits
        low, high = limits.frequency_min, limits.frequency_max
        if frequencies.min() < low or frequencies.max() > high:
            raise InputError(
                f"{what} must be within the rig's limits.frequency of {low:g} to {high:g} "
                f"Hz, got {frequencies.min():g} to {frequencies.max():g} Hz"
            )
