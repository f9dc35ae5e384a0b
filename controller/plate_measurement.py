"""Measuring a rig's plate by its own ERAs and the sensors of its amplifiers.

`plate_sensors` reads what the amplifiers' sensors measure and where. `TonePlayer` plays small tones
on the path of every pattern: routed by the wiring, admitted by the ledgers, over the wire, with the
levels that amplifiers confirm. `PlateSelfMeasurement` plays the whole schedule and reads it.

Tones are interleaved: every ERA plays at the same time, each at a frequency of its own. The range
is cut into as many bands as ERAs play at once. In each step every band sounds at the same place
within it, so that the tones of a step are a band apart; from step to step the ERAs take turns over
the bands. One round plays every tone once; as many rounds as ERAs play it on each of them.
"""

import asyncio
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from controller.play.routing import (
    Drive,
    PlaybackCapabilities,
    playback_capabilities,
    route,
    tones_by_era,
)
from drivers.errors import CommandError, CommandRefused
from drivers.host.amplifier import Amplifier
from drivers.host.amplifier_sensors import (
    AmplifierSensor,
    Reading,
    measure_tones,
    read_amplifier_sensors,
)
from drivers.host.clock import CLOCK_SETTLING
from drivers.host.group import Group
from drivers.opening import Lines
from drivers.protocol.definition import HEARTBEAT, QUANTITIES
from model.arrays import ComplexArray, FloatArray, best_first, best_of
from model.ensemble.draws import MAX_HELD
from model.errors import InputError
from model.estimate.forward import Sensor
from model.estimate.measurement import Measurement, Repeat
from model.processes import Progress, unseen
from model.reduction.reduced_plate import reduce_plate
from model.rig.rig import Channel, Rig
from model.structure.attachments import footprints_of
from model.transients.time_response import plate_in_time
from model.vibration import Excitation, Tone
from registry import threads

_WINDOW = 0.2  # s; of a reading: 1 % of noise is enough, and shorter ones hear more of it
_TONES = 28  # over the range; theory in doubt asks for more, gains and springs for ten
_PER_BAND = 2  # at least
_AT_ONCE = 16  # tones of a reading
_MARGIN = 1.01  # of a window, for frequencies as amplifiers round them
# Of a vibration, where a plate counts as settled: readings tell the rest from their tones.
_LEFT = 0.02
_SETTLING = (0.2, 1.0)  # s, least and most

Step = tuple[tuple[int, float], ...]
"""Number of each ERA that plays, and its frequency [Hz]."""


@dataclass(frozen=True, eq=False)
class MeasuredPlate:
    """A measurement and the circumstances in which it was made."""

    measurement: Measurement
    level: float | None
    """Level of what was played, 0..1 of full stroke, None if unknown."""
    duration: float | None
    """Duration [s], None if unknown."""
    sensors: tuple[Mapping[str, object], ...]
    """The sensors used, for programs."""
    notes: tuple[str, ...]
    """Lines for people."""
    details: Mapping[str, object]
    """Further keys and values for programs."""


@dataclass(frozen=True)
class ToneSchedule:
    """Steps of interleaved tones, each with its settling time and window [s]."""

    steps: tuple[Step, ...]
    settling: float
    window: float


def interleaved(
    rig: Rig, frequency_range: tuple[float, float], *, is_quick: bool = False
) -> ToneSchedule:
    """Tones over a range [Hz] for a rig; is_quick: one round only."""
    low, high = frequency_range
    steps: list[Step] = []
    closest = high
    numbers = range(len(rig.eras))
    for first in range(0, len(numbers), _AT_ONCE):
        group = numbers[first : first + _AT_ONCE]
        own, apart = _rounds(group, low, high, count=1 if is_quick else len(group))
        steps += own
        closest = min(closest, apart)
    window = max(_WINDOW, _MARGIN / closest, _MARGIN / low)
    return ToneSchedule(tuple(steps), settling(rig, frequency_range), window)


def _rounds(
    eras: Sequence[int], low: float, high: float, *, count: int
) -> tuple[list[Step], float]:
    """Rounds of a group of ERAs, and how far apart [Hz] tones of a step are."""
    n = len(eras)
    length = max(_PER_BAND, _TONES // n)
    bands = np.linspace(low, high, n * length).reshape(n, length)
    steps = [
        tuple((era, float(bands[(j + place + number) % n, place])) for j, era in enumerate(eras))
        for number in range(count)
        for place in range(length)
    ]
    return steps, float(bands[-1, 0] - bands[-2, 0]) if n > 1 else high


def settling(rig: Rig, frequency_range: tuple[float, float]) -> float:
    """Time [s] until what rings within a range [Hz] has died away, on the rig as written."""
    low, high = frequency_range
    loads = list(rig.masses)
    points = footprints_of(rig.eras, loads)
    reduced = reduce_plate(rig.plate, rig.mesh, points, frequency_max=high)
    decay = plate_in_time(reduced, rig.eras, loads=loads).decay
    heard = decay[(decay.imag >= 2 * np.pi * low) & (decay.imag <= 2 * np.pi * high)]
    slowest = float(heard.real.max()) if len(heard) else -np.inf
    return float(np.clip(np.log(_LEFT) / slowest, *_SETTLING))


_DERIVATIVES = {"ACCELERATION": 0, "VELOCITY": 1, "DISPLACEMENT": 2}
"""How often what a sensor reads is to be differentiated in time."""


@dataclass(frozen=True)
class PlateSensor:
    """A sensor of an amplifier that measures the plate."""

    amplifier: str
    number: int
    """Its number among the sensors of the amplifier."""
    place: Sensor
    derivatives: int
    """Number of derivatives in time from what it measures to acceleration."""
    frequency_max: float
    """Highest frequency of a tone that it measures [Hz]."""

    def accelerations(self, reading: Reading, frequencies: FloatArray) -> ComplexArray:
        """Complex amplitudes [m/s²] (f,) of the tones [Hz] of a reading."""
        amplitudes, degrees = np.array(reading.sensors[self.number].tones).T
        phasors = amplitudes * np.exp(1j * np.radians(degrees))
        return np.asarray(phasors * (2j * np.pi * frequencies) ** self.derivatives)


async def plate_sensors(
    rig: Rig, amplifiers: Mapping[str, Amplifier]
) -> tuple[list[PlateSensor], list[str]]:
    """Read what the sensors of open amplifiers, by name, measure and where.

    Returns those of the plate, and a line for each other one, why it is not used.

    Raises CommandError for an amplifier that has none, or none of use.
    """
    used: list[PlateSensor] = []
    unused: list[str] = []
    for name, amplifier in amplifiers.items():
        reported = await read_amplifier_sensors(amplifier)
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
    return used, unused


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
    rig: Rig, amplifier: str, reported: Sequence[AmplifierSensor]
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


RAMP = 0.05  # s; long enough not to excite the plate at onset or end
_LEVEL_TOLERANCE = 0.02  # relative; more than any amplifier rounds
_LEVEL_STEP = QUANTITIES["level"].from_wire(1)


class TonePlayer:
    """Plays tones on the amplifiers of a rig; urls: by the amplifiers' names."""

    def __init__(self, rig: Rig, lines: Callable[[], Lines], urls: Mapping[str, str]) -> None:
        self.ramp = RAMP
        """Ramp [s] of what was played last."""
        self.token = 0
        """Token of the set that was played last."""
        self.amplifiers: Mapping[str, Amplifier] = {}
        self._rig = rig
        self._lines = lines()
        self._urls = urls
        self.group = Group({})
        self._ramp_max = RAMP

    async def open(self) -> PlaybackCapabilities:
        """Open all amplifiers, disarmed; return what they can play.

        Raises DriverError and InputError.
        """
        self.amplifiers = {
            name: await self._lines.amplifier(
                url, self._rig.limits, name=name, is_output=name in self._rig.outputs
            )
            for name, url in self._urls.items()
        }
        self.group = Group(self.amplifiers)
        await self.group.open()
        found = playback_capabilities(self._rig, self.amplifiers)
        self._ramp_max = min(RAMP, found.ramp_max)
        return found

    async def silence(self) -> None:
        """Let what plays fall silent."""
        self.ramp = RAMP
        await self.group.silence(RAMP)

    async def play(self, excitation: Excitation) -> Drive:
        """Play on all amplifiers; return the tone of each driven ERA by name, as confirmed.

        Raises CommandRefused for a level that is not played.
        """
        layers = route(excitation, self._rig, ramp=self._ramp_max)
        self.ramp = max(layer.ramp for layer in layers.values())
        played = await self.group.apply({name: [layer] for name, layer in layers.items()})
        self.token = played.token
        plays = tones_by_era(played.layers, self._rig)
        for era, wired in self._rig.wiring.items():
            tones = layers[wired.amplifier].tones
            (requested,) = [tone.level for tone in tones if tone.channel == wired.number]
            level = plays[era].level if era in plays else 0.0
            if not math.isclose(requested, level, rel_tol=_LEVEL_TOLERANCE, abs_tol=_LEVEL_STEP):
                raise CommandRefused(
                    f"amplifier {wired.amplifier}: level of channel {wired.number} must be "
                    f"{requested:g}, got {level:g}; let it cool down, or choose another --level"
                )
        return plays

    async def close(self) -> None:
        """Play silence, confirm it, disarm and close, whatever came before."""
        try:
            await self.group.close(RAMP)
        finally:
            await self._lines.close()


_LEVEL = 0.1
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

    urls: of the amplifiers by name.
    level: of every tone, 0..1 of full stroke; None: the usual one.
    is_quick: play one round only.
    progress: called with the number of steps done and of all.
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
            sensors, unused = await plate_sensors(self._rig, self._player.amplifiers)
            low, high = can.limits.frequencies
            high = min(high, *(each.frequency_max for each in sensors))
            if not low < high:
                raise CommandError(
                    f"sensors must measure above {low:g} Hz, the lowest frequency of rig and "
                    f"amplifiers, got up to {high:g} Hz"
                )
            tones = interleaved(self._rig, (low, high), is_quick=self._is_quick)
            await self._player.group.arm()
            end = threads.now() + CLOCK_SETTLING
            while threads.now() < end and max(self._player.group.clock_errors.values()) > _AGREED:
                await self._wait(HEARTBEAT)
            started = threads.now()
            heard, half, last = await self._all(tones, sensors)
            await self._player.silence()
            await self._wait(self._player.ramp)
            duration = threads.now() - started
        finally:
            await self._player.close()
        return MeasuredPlate(
            self._measurement(sensors, heard, half, last),
            self._level,
            duration,
            sensors=tuple(map(_described, sensors)),
            notes=tuple(unused),
            details={"settling_s": tones.settling, "window_s": tones.window},
        )

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
        measurement = Measurement([each.place for each in sensors], frequencies, values)
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


def checked_level(rig: Rig, level: float | None) -> float:
    """Level of every tone: the usual one or less, as the rig's limits of level and power allow.

    Raises InputError for one above 0.32 of full stroke or of what the limits allow.
    """
    limits = rig.limits
    allowed = min(limits.level, math.sqrt(limits.power / len(rig.eras)), 1.0)
    highest = HIGHEST * allowed
    if level is None:
        return min(_LEVEL, highest)
    if not 0 < level <= highest:
        raise InputError(
            f"--level must be above 0 and at most {highest:.3g}, 10 dB below what the rig allows, "
            f"got {level:g}"
        )
    return level


def observation_of(measurement: Measurement, rig: Rig) -> Measurement:
    """A measurement by interleaved tones as a rig check takes it, with all sensors at points.

    Raises InputError for a plate that was not linear or has changed meanwhile.
    """
    measurement.check()
    eras = [rig.era(each.era) if each.era else each for each in measurement.sensors]
    places = zip(measurement.sensors, eras, strict=True)
    return replace(
        measurement,
        sensors=tuple(replace(each, era="", x=at.x, y=at.y) for each, at in places),
        errors=None,
        has_phases=not measurement.drives_lag,
    )
