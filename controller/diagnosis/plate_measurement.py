"""Measuring a rig's plate by its own ERAs and the sensors of its amplifiers."""

import asyncio
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from controller.diagnosis.interleaved_tones import Step, ToneSchedule, interleaved
from controller.diagnosis.plate_sensors import PlateSensor, plate_sensors
from controller.diagnosis.tone_player import TonePlayer
from controller.play.routing import Drive
from drivers.errors import CommandError, CommandRefused
from drivers.host.amplifier import Reading, measure_tones
from drivers.host.clock import CLOCK_SETTLING
from drivers.opening import Lines
from drivers.protocol.definition import HEARTBEAT
from model.arrays import ComplexArray, FloatArray, best_first, best_of
from model.calibration.responses import Responses
from model.ensemble.draws import MAX_HELD
from model.errors import InputError
from model.identification.least_squares import MeasuredPlate, Measurement, Repeat
from model.processes import Progress, unseen
from model.rig.rig import Rig
from model.vibration import Tone
from registry import threads

LEVEL = 0.1
"""Usual level of every tone, 20 dB below full stroke."""

HIGHEST = 10**-0.5
"""Highest level of every tone as a share of the highest allowed one, 10 dB below it."""

_COMPARED = 2  # tones of a repeated step
_AGREED = 5e-6  # s; of clocks: 0.5 degrees of 300 Hz
_TURNED = 4.0  # of the clocks' errors rms, by which a repeated tone may be turned
_READINGS = 2  # of a step, where the first is disturbed or overloaded


@dataclass(frozen=True, eq=False)
class _StepResponses:
    """One step: frequency [Hz] of each ERA (n,), NaN where silent; responses (s, n) [1/s²]."""

    frequencies: FloatArray
    responses: ComplexArray


class PlateSelfMeasurement:
    """Plays interleaved tones on all ERAs of a rig and reads the sensors of its amplifiers.

    lines: to its amplifiers, urls: by name. level: of every tone, 0..1 of full stroke, None for the
    usual one; is_quick: one round; progress: called with the number of steps done and of all.
    """

    def __init__(
        self,
        rig: Rig,
        lines: Callable[[], Lines],
        urls: Mapping[str, str],
        *,
        level: float | None = None,
        is_quick: bool = False,
        progress: Progress = unseen,
    ) -> None:
        self._rig = rig
        self._player = TonePlayer(rig, lines, urls)
        self._level = checked_level(rig, level)
        self._is_quick = is_quick
        self._progress = progress

    async def run(self) -> MeasuredPlate:
        """Measure; always ends silent and disarmed.

        Raises DriverError, among them CommandRefused for a reading that is disturbed or overloaded
        twice.
        """
        try:
            can = await self._player.open()
            sensors = await plate_sensors(self._rig, self._player.amplifiers)
            tones = interleaved(
                self._rig,
                _frequency_range(can.limits.frequencies, sensors.used),
                is_quick=self._is_quick,
            )
            await self._player.group.arm()
            await self._hold_clocks()
            started = threads.now()
            heard, half, last = await self._all(tones, sensors.used)
            await self._player.silence()
            await self._wait(self._player.ramp)
            duration = threads.now() - started
        finally:
            await self._player.close()
        return MeasuredPlate(
            self._measurement(sensors.used, heard, half, last),
            self._level,
            duration,
            sensors=tuple(map(_described, sensors.used)),
            notes=sensors.unused,
            details={"settling_s": tones.settling, "window_s": tones.window},
        )

    async def _hold_clocks(self) -> None:
        """Wait until the clocks of the amplifiers agree, or as long as that takes at most."""
        end = threads.now() + CLOCK_SETTLING
        while threads.now() < end and max(self._player.group.clock_errors.values()) > _AGREED:
            await self._wait(HEARTBEAT)

    async def _all(
        self, tones: ToneSchedule, sensors: Sequence[PlateSensor]
    ) -> tuple[list[_StepResponses], tuple[int, _StepResponses], _StepResponses]:
        """All steps; the loudest at half the level, with its number; the first once more."""
        heard: list[_StepResponses] = []
        count = len(tones.steps) + 2
        for step in tones.steps:
            heard.append(await self._hear(step, tones, sensors, level=self._level))
            self._progress(len(heard), count)
        loudest = best_of([np.nanmax(np.abs(each.responses)) for each in heard])
        half = await self._hear(tones.steps[loudest], tones, sensors, level=self._level / 2)
        self._progress(count - 1, count)
        last = await self._hear(tones.steps[0], tones, sensors, level=self._level)
        self._progress(count, count)
        return heard, (loudest, half), last

    async def _hear(
        self, step: Step, tones: ToneSchedule, sensors: Sequence[PlateSensor], *, level: float
    ) -> _StepResponses:
        """Play a step until the plate has settled, and read it."""
        eras = {self._rig.eras[number].name: frequency for number, frequency in step}
        plays = await self._player.play(
            {
                era: Tone(frequency, level * self._rig.era(era).full_level)
                for era, frequency in eras.items()
            }
        )
        await self._wait(self._player.ramp + tones.settling)
        frequencies = np.array([plays[era].frequency for era in eras])
        problem = ""
        for _ in range(_READINGS):
            readings = await self._read(frequencies.tolist(), tones.window)
            problem = self._problem(readings, sensors)
            if not problem:
                return self._responses(plays, list(eras), frequencies, readings, sensors)
        raise CommandRefused(problem)

    def _problem(self, readings: Mapping[str, Reading], sensors: Sequence[PlateSensor]) -> str:
        """What is wrong with readings by amplifier, or nothing."""
        for name, reading in readings.items():
            if reading.state != "COMPLETE" or reading.token != self._player.token:
                return (
                    f"amplifier {name}: what plays must stay the same during a reading, got a "
                    "change of it twice; leave the amplifier to this command, and start again"
                )
        for sensor in sensors:
            several = readings[sensor.amplifier].sensors
            if sensor.number >= len(several):
                return (
                    f"amplifier {sensor.amplifier} must read {sensor.number + 1} sensors or more, "
                    f"as it says, got {len(several)}; it breaks the wire protocol"
                )
            if several[sensor.number].is_overloaded:
                return (
                    f"sensor {sensor.number} of amplifier {sensor.amplifier} must stay within its "
                    "range, got an overload twice; choose a lower --level than "
                    f"{self._level:g}"
                )
        return ""

    async def _read(self, frequencies: list[float], window: float) -> dict[str, Reading]:
        """Read all amplifiers over one window, feeding their watchdogs."""

        async def measured() -> dict[str, Reading]:
            readings = await asyncio.gather(
                *(
                    measure_tones(each, frequencies, window)
                    for each in self._player.amplifiers.values()
                )
            )
            return dict(zip(self._player.amplifiers, readings, strict=True))

        reading = asyncio.create_task(measured())
        try:
            while not reading.done():
                await asyncio.wait({reading}, timeout=HEARTBEAT)
                await self._player.group.beat()
            return reading.result()
        finally:
            reading.cancel()
            await asyncio.gather(reading, return_exceptions=True)

    def _responses(
        self,
        plays: Drive,
        eras: Sequence[str],
        frequencies: FloatArray,
        readings: Mapping[str, Reading],
        sensors: Sequence[PlateSensor],
    ) -> _StepResponses:
        """Responses to the tones that ERAs play, of sensors whose clocks are held to theirs."""
        rig, held = self._rig, self._clock_errors
        number = {era.name: n for n, era in enumerate(rig.eras)}
        played = np.full(len(rig.eras), np.nan)
        responses = np.full((len(sensors), len(rig.eras)), np.nan, dtype=complex)
        for row, sensor in enumerate(sensors):
            heard = sensor.accelerations(readings[sensor.amplifier], frequencies)
            for era, frequency, acceleration in zip(eras, frequencies, heard, strict=True):
                played[number[era]] = frequency
                both = sensor.amplifier, rig.wiring[era].amplifier
                if both[0] == both[1] or max(held[name] for name in both) <= MAX_HELD:
                    command = plays[era]
                    base = command.level * rig.era(era).full_level
                    turned = np.exp(-1j * math.radians(command.phase))
                    responses[row, number[era]] = acceleration * turned / base
        return _StepResponses(played, responses)

    @property
    def _clock_errors(self) -> dict[str, float]:
        """Errors of the clocks of several amplifiers with ERAs, by name, rms [s]."""
        used, errors = self._rig.channel_counts, self._player.group.clock_errors
        return {name: errors[name] for name in used} if len(used) > 1 else {}

    async def _wait(self, seconds: float) -> None:
        """Wait [s], feeding the watchdogs."""
        end = threads.now() + seconds
        while (left := end - threads.now()) > 0:
            await asyncio.sleep(min(HEARTBEAT, left))
            await self._player.group.beat()

    def _measurement(
        self,
        sensors: Sequence[PlateSensor],
        heard: Sequence[_StepResponses],
        half: tuple[int, _StepResponses],
        last: _StepResponses,
    ) -> Measurement:
        """All responses, with the repeated ones."""
        frequencies = np.unique(np.concatenate([each.frequencies for each in heard]))
        frequencies = frequencies[np.isfinite(frequencies)]
        values = np.full((len(frequencies), len(sensors), len(self._rig.eras)), np.nan + 0j)
        for each in heard:
            for era in np.flatnonzero(np.isfinite(each.frequencies)):
                row = np.searchsorted(frequencies, each.frequencies[era])
                values[row, :, era] = each.responses[:, era]
        measurement = Measurement.of([each.place for each in sensors], frequencies, values)
        loudest, at_half = half
        return replace(
            measurement,
            clock_errors=self._clock_errors,
            half_level=self._repeats(heard[loudest], at_half, sensors),
            at_end=self._repeats(heard[0], last, sensors),
        )

    def _repeats(
        self, first: _StepResponses, again: _StepResponses, sensors: Sequence[PlateSensor]
    ) -> tuple[Repeat, ...]:
        """The loudest tones of a step and of its repetition: noise hides changes of the others.

        Repeated ones without what clocks turned them by in between.
        """
        sizes = np.linalg.norm(np.nan_to_num(first.responses), axis=0)
        hears = np.array([sensor.amplifier for sensor in sensors])
        held, found = self._clock_errors, list[Repeat]()
        for n in best_first(sizes)[:_COMPARED]:
            era, frequency = self._rig.eras[n].name, float(first.frequencies[n])
            values, repeated = first.responses[:, n], again.responses[:, n].copy()
            known, plays = np.isfinite(values), self._rig.wiring[era].amplifier
            for name in {*held} - {plays}:
                rows = known & (hears == name)
                limit = math.tau * frequency * _TURNED * math.hypot(held[plays], held[name])
                turned = np.angle(np.vdot(repeated[rows], values[rows]))
                repeated[rows] *= np.exp(1j * np.clip(turned, -limit, limit))
            found.append(Repeat(era, frequency, values[known], repeated[known]))
        return tuple(found)


def _described(sensor: PlateSensor) -> Mapping[str, object]:
    """A sensor for programs."""
    place = sensor.place
    return {
        "amplifier": sensor.amplifier,
        "sensor": sensor.number,
        "era": place.era or None,
        "x_m": None if place.era else place.x,
        "y_m": None if place.era else place.y,
    }


def _frequency_range(
    playable: tuple[float, float], sensors: Sequence[PlateSensor]
) -> tuple[float, float]:
    """Return frequencies [Hz] that rig and amplifiers play and sensors measure."""
    low, high = playable
    high = min(high, *(each.frequency_max for each in sensors))
    if not low < high:
        raise CommandError(
            f"sensors must measure above {low:g} Hz, the lowest frequency of rig and amplifiers, "
            f"got up to {high:g} Hz"
        )
    return low, high


def checked_level(rig: Rig, level: float | None) -> float:
    """Level of every tone: the usual one or less, as the rig's limits of level and power allow.

    Raises InputError for one above 0.32 of full stroke or of what the limits allow.
    """
    limits = rig.limits
    allowed = min(limits.level, math.sqrt(limits.power / len(rig.eras)), 1.0)
    highest = HIGHEST * allowed
    if level is None:
        return min(LEVEL, highest)
    if not 0 < level <= highest:
        raise InputError(
            f"--level must be above 0 and at most {highest:.3g}, 10 dB below what the rig allows, "
            f"got {level:g}"
        )
    return level


def observation_of(measurement: Measurement, rig: Rig) -> Responses:
    """Responses to the channels of a rig one by one, from those to interleaved tones.

    Raises InputError for a plate that was not linear or has changed meanwhile.
    """
    measurement.check()
    sensors = measurement.sensors
    places = [rig.era(each.era) if each.era else each for each in sensors]
    return Responses(
        tuple(each.name for each in sensors),
        np.array([(each.x, each.y) for each in places]),
        measurement.frequencies,
        measurement.values.swapaxes(1, 2),
        has_phases=not measurement.drives_lag,
    )
