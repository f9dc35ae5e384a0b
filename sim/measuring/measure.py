"""A rig's plate measured through a sound card."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from drivers.errors import LinkError
from model.arrays import ComplexArray, FloatArray
from model.calibration.responses import Responses
from model.errors import InputError
from model.rig.rig import Rig
from sim.measuring.checks import check_clocks, check_coherence, check_levels, check_wiring
from sim.measuring.estimate import Estimate, estimate
from sim.measuring.live_plot import Show
from sim.measuring.loopback import converters, gain_of, is_as_late, is_whole, latency
from sim.measuring.multisine import PERIOD, Multisine
from sim.measuring.sound_card import SoundCard
from sim.sensors.sensor_file import WiredSensor

_SETTLING = 1.0  # s; T60 of the paper's plate
_TAIL = 0.05  # s; longer than the ramp
_TRIES = 3

Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class Desk:
    """How a rig is wired to a sound card: its ERAs by their channels, counted from 1; a loop-back.

    The loop-back is a cable from the output after those of the ERAs to the input after those of
    the sensors.
    """

    rig: Rig
    sensors: tuple[WiredSensor, ...]

    @property
    def eras(self) -> list[tuple[str, int]]:
        """Name and output of each ERA."""
        rig = self.rig
        return [(era.name, rig.wiring[era.name].number + 1) for era in rig.eras]

    @property
    def output(self) -> int:
        """Output of the loop-back, the last one."""
        return max(at for _, at in self.eras) + 1

    @property
    def input(self) -> int:
        """Input of the loop-back, the last one."""
        return max(sensor.input for sensor in self.sensors) + 1

    def on_outputs(self, sources: FloatArray) -> FloatArray:
        """Samples (n, outputs) of the sources (n, eras + 1), the loop-back last."""
        found = np.zeros((len(sources), self.output))
        found[:, [*(at - 1 for _, at in self.eras), self.output - 1]] = sources
        return found

    @property
    def highest(self) -> float:
        """The highest level that the rig's limits allow on all ERAs at once."""
        limits = self.rig.limits
        return min(limits.level, float(np.sqrt(limits.power / len(self.rig.eras))), 1.0)

    def check(self, level: float) -> None:
        """Raise InputError for several amplifiers, and a level beyond the rig's limits."""
        rig = self.rig
        if len({rig.wiring[era.name].amplifier for era in rig.eras}) > 1:
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


@dataclass(frozen=True, eq=False)
class Measured:
    """Responses with what is known of them.

    coherence (f, sensors), std (f, sensors) relative to the root mean square of the sensor; latency
    [s] through the sound card; even (sensors,): of a square law; repeated: runs played again since
    blocks were lost; converters (f,): response of the loop-back.
    """

    responses: Responses
    coherence: FloatArray
    std: FloatArray
    latency: float
    even: FloatArray
    repeated: int
    converters: ComplexArray


def measure(
    desk: Desk,
    card: SoundCard,
    multisine: Multisine,
    *,
    periods: int = 2,
    progress: Progress = lambda done, total: None,
    show: Show = lambda recorded: None,
) -> Measured:
    """Play all runs of a multisine and estimate the responses.

    periods: of each run that are analysed. progress: called with the milliseconds done and all;
    show: with the runs recorded so far, after each.
    Raises InputError, LinkError for what is clipped, silent, swapped, incoherent, or lost three
    times.
    """
    runs = multisine.sources
    whole = _SETTLING / PERIOD + periods + _TAIL
    desk.check_times(seconds=PERIOD * whole, slew=multisine.slew)
    total = round(1e3 * PERIOD * whole * runs)
    recorded: list[FloatArray] = []
    gains: list[ComplexArray] = []
    repeated, is_lost = 0, False
    for run in range(runs):
        signal = desk.on_outputs(multisine.signal(run, periods=whole))
        for attempt in range(_TRIES):
            heard = card.run(
                signal,
                progress=lambda frames, run=run: progress(  # type: ignore[misc]
                    round(1e3 * (run * PERIOD * whole + frames / multisine.rate)), total
                ),
            )
            kept = _settled(heard.astype(float), multisine, periods)
            check_levels(kept, desk.sensors, cable=(desk.output, desk.input))
            looped = kept[:, desk.input - 1]
            gain = gain_of(looped, multisine, run)
            # The cable decides: drivers report losses that were none, and miss others.
            if is_whole(looped, samples=multisine.samples) and is_as_late(gain, (*gains, gain)[0]):
                break
            is_lost = is_lost or attempt == _TRIES - 1
            if is_lost:
                break
            repeated += 1
        recorded.append(kept)
        gains.append(gain)
        show(recorded)
    progress(total, total)
    found = estimate(multisine, recorded)
    # Another signal than the loop-back's, or another clock, looks like lost blocks; that is the
    # cause to be told.
    check_wiring(found, desk.sensors, desk.eras, loopback=desk.input, output=desk.output)
    check_clocks(multisine, recorded, desk.sensors, loopback=desk.input)
    if is_lost:
        raise LinkError(
            f"blocks of sound were lost in {_TRIES} attempts of a run; end other programs, give "
            "the sound server real-time priority, or choose larger blocks"
        )
    check_coherence(found, desk.sensors, desk.eras)
    return _measured(desk, multisine, found, repeated)


def _settled(heard: FloatArray, multisine: Multisine, periods: int) -> FloatArray:
    start = round(_SETTLING * multisine.rate)
    return heard[start : start + periods * multisine.samples]


def _measured(desk: Desk, multisine: Multisine, found: Estimate, repeated: int) -> Measured:
    looped = found.values[:, desk.input - 1, -1]
    return Measured(
        responses_of_samples(desk, multisine.frequencies, found.values, looped),
        coherence=found.coherence[:, _columns(desk.sensors)],
        std=_relative(found, _columns(desk.sensors)),
        latency=latency(looped, multisine.frequencies),
        even=found.even[_columns(desk.sensors)],
        repeated=repeated,
        converters=looped,
    )


def responses_of_samples(
    desk: Desk, frequencies: FloatArray, values: ComplexArray, looped: ComplexArray
) -> Responses:
    """Accelerations per base displacement [1/s²] from responses of samples (f, inputs, sources)."""
    sensitivity = np.array([sensor.sensitivity for sensor in desk.sensors])
    strokes = np.array([era.stroke for era in desk.rig.eras])
    plain = values[:, _columns(desk.sensors), : len(strokes)] / converters(looped)[:, None, None]
    return Responses(
        tuple(sensor.name for sensor in desk.sensors),
        np.array([[sensor.x, sensor.y] for sensor in desk.sensors]),
        frequencies,
        plain.transpose(0, 2, 1) / strokes[:, None] / sensitivity,
    )


def _columns(sensors: Sequence[WiredSensor]) -> list[int]:
    return [sensor.input - 1 for sensor in sensors]


def _relative(found: Estimate, columns: list[int]) -> FloatArray:
    values = found.values[:, columns, :-1]
    rms = np.sqrt((np.abs(values) ** 2).mean(axis=(0, 2)))
    return np.asarray(found.std[:, columns] / rms)
