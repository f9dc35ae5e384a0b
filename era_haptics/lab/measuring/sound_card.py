"""Sound card connected to a rig: wiring, multisines, and runs that play and record simultaneously.

The sound card plays one array from memory and records into another through a callback in C. Python
is not in the audio path, and lost blocks are counted.

Multisines play on all outputs simultaneously. In run e the phase of source i is rotated by 2 pi e i
/ S, where S is the number of sources and of runs. At every line the S runs are orthogonal (discrete
Fourier transform matrix), so the response to each source follows from all runs, with the full
amplitude of all sources. Lines are odd multiples of the lowest, so a square law shows in the empty
even lines. Amplitudes decrease with frequency because accelerations increase.
"""

import ctypes
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from drivers.errors import LinkError
from model.arrays import ComplexArray, Float32Array, FloatArray, IntArray
from model.errors import InputError
from model.estimate.forward import Sensor
from model.estimate.measurement import (
    INPUT_COLUMNS,
    PLACE_COLUMNS,
    Measurement,
    named_place,
    sensor_mass,
)
from model.files.csv_file import CsvLine, read_lines
from model.reduction.reduced_plate import reduce_plate
from model.rig.rig import Rig
from model.structure.attachments import footprints_of
from model.structure.plate import Plate
from model.transients.time_response import plate_in_time
from sim.soft_amp.engine import callback_address
from sim.soft_amp.output import (
    forget_lost_device,
    is_stream_active,
    portaudio_device,
    portaudio_stream,
    sounddevice,
)

PERIOD = 1.0
"""s; lines are whole numbers of hertz."""

_DRAWS = 20  # random phases; the lowest crest factor among them is 3.1 to 3.6
_RAMP = 0.02  # s
_STEP = 10  # Hz


@dataclass(frozen=True, eq=False)
class Multisine:
    """The signals of so many sources; level: their largest sample; seed: of the phases.

    frequencies (f,) [Hz]: whole multiples of 1 / PERIOD.
    """

    frequencies: FloatArray
    sources: int
    rate: float
    level: float
    seed: int = 0

    def __post_init__(self) -> None:
        """Refuse what cannot be played."""
        if self.rate * PERIOD % 1:
            raise InputError(f"sample rate must be a whole number of hertz, got {self.rate:g} Hz")
        lines = self.frequencies * PERIOD
        if len(lines) == 0 or np.abs(lines - np.round(lines)).max() > 1e-6 or lines.min() < 1:
            raise InputError(
                f"frequencies must be whole multiples of {1 / PERIOD:g} Hz, got "
                f"{', '.join(f'{each:g}' for each in self.frequencies[:3]) or 'none'}, ..."
            )
        if self.frequencies.max() > 0.4 * self.rate:
            raise InputError(
                f"frequencies must be at most {0.4 * self.rate:g} Hz at this sample rate, got "
                f"{self.frequencies.max():g} Hz"
            )

    @property
    def slew(self) -> float:
        """Highest rise [1/s] of the level, along the ramp at the start."""
        return np.pi / 2 * self.level / _RAMP

    @property
    def samples(self) -> int:
        """Samples of a period."""
        return round(self.rate * PERIOD)

    @cached_property
    def lines(self) -> IntArray:
        """Number of each line in the spectrum of a period, (f,)."""
        return np.round(self.frequencies * PERIOD).astype(int)

    @cached_property
    def _amplitudes(self) -> ComplexArray:
        """Complex amplitudes of cosines of source 0 in run 0, (f,), of the lowest crest drawn."""
        rng = np.random.default_rng(self.seed)
        sizes = 1 / self.frequencies
        best, lowest = sizes + 0j, np.inf
        for _ in range(_DRAWS):
            drawn = sizes * np.exp(2j * np.pi * rng.uniform(size=len(sizes)))
            peak = np.abs(self._analytic(drawn)).max()
            if peak < lowest:
                best, lowest = drawn, peak
        # The envelope is the largest sample under any turn of the phases.
        return np.asarray(best * self.level / lowest)

    def _analytic(self, amplitudes: ComplexArray) -> ComplexArray:
        """One period of the sum of a exp(i omega t), whose real part is played, (n,)."""
        spectrum = np.zeros(self.samples, dtype=complex)
        spectrum[self.lines] = amplitudes
        return np.asarray(np.fft.ifft(spectrum) * self.samples)

    def played(self, run: int) -> ComplexArray:
        """Complex amplitudes (f, sources) of the samples of a run."""
        return self._amplitudes[:, None] * self._phase_factors(run)

    def signal(self, run: int, *, periods: float) -> FloatArray:
        """Samples (n, sources) of so many periods, with ramps at both ends."""
        period = (self._analytic(self._amplitudes)[:, None] * self._phase_factors(run)).real
        found = np.resize(period, (round(periods * self.samples), self.sources))
        return ramped(found, round(_RAMP * self.rate))

    def found(self, recorded: FloatArray) -> ComplexArray:
        """Complex amplitudes (f, ...) at the lines of whole periods of samples (n, ...)."""
        lines = self.lines * (len(recorded) // self.samples)
        return np.asarray(np.fft.rfft(recorded, axis=0)[lines] * 2 / len(recorded))

    def _phase_factors(self, run: int) -> ComplexArray:
        return np.asarray(np.exp(2j * np.pi * run * np.arange(self.sources) / self.sources))


def ramped(samples: FloatArray, count: int) -> FloatArray:
    """Samples (n, sources) with squared-sine ramps of `count` samples at both ends."""
    ramp = np.sin(np.linspace(0, np.pi / 2, count)) ** 2
    shape = np.ones((len(samples), 1))
    shape[:count, 0] = ramp
    shape[-count:, 0] *= ramp[::-1]
    return samples * shape


def multisine_frequencies(low: float, high: float) -> FloatArray:
    """Odd whole frequencies [Hz] in steps of 10 from above a lowest to below a highest one."""
    odd = np.arange(1.0, high + 1e-9, 2)
    odd = odd[odd >= low]
    if not odd.size:
        raise InputError(f"limits.frequency must leave odd hertz, got {low:g} to {high:g} Hz")
    return np.unique([*odd[:: _STEP // 2], odd[-1]])


_AROUND = 4  # lines of a period on either side, from which noise is taken


@dataclass(frozen=True, eq=False)
class ResponseEstimate:
    """Sample-to-sample responses (f, inputs, sources), H1 estimate over all runs.

    - std (f, inputs): standard deviation of each response's modulus.
    - coherence (f, inputs): fraction of the power that comes from the sources.
    - even (inputs,): amplitude at even lines, which are not played, relative to the played lines,
      minus noise.
    """

    values: ComplexArray
    std: FloatArray
    coherence: FloatArray
    even: FloatArray


def estimate(multisine: Multisine, recorded: Sequence[FloatArray]) -> ResponseEstimate:
    """Estimate responses from whole periods of each run, (periods x samples, inputs).

    Requires at least two periods: between the lines of one period, the spectrum of several contains
    only noise. Solves Y = U H^T at each line by least squares, with U the amplitudes played (runs,
    sources).
    """
    n = multisine.samples
    periods = len(recorded[0]) // n
    spectra = np.array([np.fft.rfft(each, axis=0) for each in recorded], dtype=complex)
    spectra *= 2 / len(recorded[0])
    lines = multisine.lines * periods
    heard = spectra[:, lines]  # (runs, f, inputs)
    played = np.array([multisine.played(run) for run in range(len(recorded))])  # (runs, f, s)
    values = np.linalg.solve(played.transpose(1, 0, 2), heard.transpose(1, 0, 2))
    # The noise is in the bins around each line that no period has.
    offsets = np.arange(-_AROUND * periods, _AROUND * periods + 1)
    offsets = offsets[offsets % periods != 0]
    bins = np.clip(lines[:, None] + offsets, 1, spectra.shape[1] - 1)
    noise = np.asarray((np.abs(spectra[:, bins]) ** 2).mean(axis=(0, 2)))
    power = (np.abs(heard) ** 2).mean(axis=0)
    size = np.abs(multisine.played(0)[:, :1])
    return ResponseEstimate(
        values.transpose(0, 2, 1),
        np.sqrt(noise / len(recorded)) / size,
        np.clip(1 - noise / np.maximum(power, 1e-300), 0.0, 1.0),
        _even(spectra, lines, periods, noise),
    )


def _even(spectra: ComplexArray, lines: IntArray, periods: int, noise: FloatArray) -> FloatArray:
    """Amplitude at the even lines next to the odd ones, relative to these, (inputs,)."""
    beside = lines + periods
    power = (np.abs(spectra[:, beside]) ** 2).mean(axis=0) - noise
    played = (np.abs(spectra[:, lines]) ** 2).mean(axis=0).sum(axis=0)
    return np.asarray(np.sqrt(np.maximum(power.sum(axis=0), 0) / np.maximum(played, 1e-300)))


MAX_PORTS = 64
_POLL = 0.02  # s
_STALLED = 10.0  # s without a sample; `jackd -S` may be slow on a loaded machine


class _Transfer(ctypes.Structure):
    """`struct transfer` of firmware/ports/sound/transfer.h."""

    _fields_ = (
        ("play", ctypes.c_void_p),
        ("record", ctypes.c_void_p),
        ("frames", ctypes.c_uint64),
        ("position", ctypes.c_uint64),
        ("outputs", ctypes.c_uint32),
        ("inputs", ctypes.c_uint32),
        ("is_running", ctypes.c_uint32),
        ("gaps", ctypes.c_uint32),
    )


class DeviceLost(LinkError):
    """A device that is gone, or takes no samples, in the middle of a run."""


_BLOCK = 512  # frames; late samples are worse than a delay, which is measured


class SoundCard:
    """Open device with its first outputs and inputs.

    limit: largest sample allowed, since nothing downstream checks it. The stream runs until
    `close`, so that its delay stays constant.
    """

    name: str
    """Of the device."""
    rate: float
    """Samples per second [Hz]."""

    def __init__(self, *, outputs: int, inputs: int, limit: float) -> None:
        for what, count in (("outputs", outputs), ("inputs", inputs)):
            if count > MAX_PORTS:
                raise InputError(f"{what} must be at most {MAX_PORTS}, got {count}")
        self.transfer = _Transfer(outputs=outputs, inputs=inputs)
        self._limit = limit * (1 + 1e-6)  # of rounding
        self._stream: Any = None
        self.gaps = 0
        """Gaps in the sound of the last run."""

    @property
    def given(self) -> int:
        """Address of the data for the callbacks."""
        return ctypes.addressof(self.transfer)

    def run(self, played: FloatArray) -> Float32Array:
        """Play samples (n, outputs), and return those recorded meanwhile (n, inputs).

        `gaps` counts gaps in the sound. Raises DeviceLost, ValueError for samples beyond the
        limit.
        """
        transfer = self.transfer
        before = transfer.gaps
        found = self.start(played)
        done, since = 0, time.monotonic()
        try:
            while done < len(found):
                time.sleep(_POLL)
                if transfer.position != done:
                    done, since = transfer.position, time.monotonic()
                elif not self._is_playing():
                    self._abandon()
                    raise DeviceLost(f"{self.name}: the device was lost")
                elif time.monotonic() - since > _STALLED:
                    raise DeviceLost(f"{self.name}: took no sample within {_STALLED:g} s")
        finally:
            if done < len(found):
                self.close()  # the callback still has the memory
        self.gaps = transfer.gaps - before
        return found

    def start(self, played: FloatArray) -> Float32Array:
        """Start playing samples (n, outputs); return the array (n, inputs) that is being recorded.

        Raises ValueError for samples beyond the limit.
        """
        transfer = self.transfer
        out = np.ascontiguousarray(played, dtype=np.float32)
        if not (np.abs(out) <= self._limit).all():  # also rejects NaN
            raise ValueError(f"samples must be at most {self._limit:g}, got {np.abs(out).max():g}")
        found = np.zeros((len(out), transfer.inputs), dtype=np.float32)
        self._memory = out, found  # kept, since the callback uses it
        transfer.play, transfer.record = out.ctypes.data, found.ctypes.data
        transfer.frames, transfer.position = len(out), 0
        transfer.is_running = 1
        return found

    def _is_playing(self) -> bool:
        return self._stream is None or is_stream_active(self._stream)

    def _abandon(self) -> None:
        """Leave a lost device to the end of the process."""
        self._stream = None
        forget_lost_device()

    def close(self) -> None:
        """Stop immediately and release the device."""
        if self._stream is not None:
            self._stream.close(ignore_errors=True)
            self._stream = None


def open_card(device: str, *, outputs: int, inputs: int, limit: float) -> SoundCard:
    """Open a PortAudio device by name or number.

    The stream runs in both directions on one device, because two devices would have two clocks.
    limit: largest sample, relative to full scale. Raises InputError for an unsuitable device,
    LinkError for a busy or removed device.
    """
    card = SoundCard(outputs=outputs, inputs=inputs, limit=limit)
    found = portaudio_device(device, outputs=outputs, inputs=inputs)
    card.name, card.rate = found["name"], float(found["default_samplerate"])
    try:
        card._stream = portaudio_stream(
            found["index"],
            callback_address("transfer_portaudio"),
            card.given,
            outputs=outputs,
            inputs=inputs,
            samplerate=card.rate,
            blocksize=_BLOCK,
            latency="high",
        )
    except sounddevice().PortAudioError as problem:
        raise LinkError(
            f"--device {card.name}: cannot be opened: {problem.args[0]}; end the program that "
            "uses it"
        ) from None
    return card


MIN_SETTLING = 1.0
"""Time [s] of a run before what counts, at least: a plate with a usual loss factor has settled."""

_MAX_SETTLING = 5.0  # s
_LEFT = 0.01  # of a free vibration


def converters(response: ComplexArray) -> ComplexArray:
    """Complex loop-back response (f,), normalized to a median modulus of 1.

    Dividing by the loop-back removes the delay, including fractions of a sample, and the shape of
    filters. Gains remain, since levels and sensitivities are stated separately.
    """
    return np.asarray(response / np.median(np.abs(response)))


@dataclass(frozen=True)
class WiredSensor:
    """An accelerometer at x, y [m] on an input of a sound card."""

    name: str
    x: float
    y: float
    input: int
    """Number of the input, from 1."""
    sensitivity: float
    """Samples, in full scale, by acceleration [1/(m/s²)]."""
    mass: float = 0.0
    """Mass of a moved sensor [kg], like `model.estimate.forward.Sensor.mass`."""

    @property
    def place(self) -> Sensor:
        """The sensor on the plate, without its wiring."""
        return Sensor(self.name, x=self.x, y=self.y, mass=self.mass)


def read_sensors(
    path: Path, plate: Plate, *, mass: float | None = None, may_move: bool = False
) -> tuple[WiredSensor, ...]:
    """Read the accelerometers of a plate, or the positions of a moved one.

    mass [g]: of the sensor, overrides the file; may_move: whether a moved sensor is allowed. Raises
    InputError with file and line.
    """
    sensors: list[WiredSensor] = []
    columns = (*PLACE_COLUMNS, *INPUT_COLUMNS[:2])
    lines = [*read_lines(path, columns, optional=tuple(_OPTIONAL))]
    moves = may_move and len(lines) > 1 and len({line.number("input") for line in lines}) == 1
    for line in lines:
        sensors.append(_sensor(line, sensors, plate, mass=mass, moves=moves))
    if not moves and len(sensors) > 1 and any(sensor.mass for sensor in sensors):
        raise InputError(
            f"{path}: mass_g must be given for a single moved sensor, got several sensors, which "
            "all load the plate; leave it out, and give them in the rig as masses"
        )
    return tuple(sensors)


def are_positions(sensors: Sequence[WiredSensor]) -> bool:
    """Return whether the sensors are positions of a moved sensor."""
    return len(sensors) > 1 and len({sensor.input for sensor in sensors}) == 1


def _sensor(
    line: CsvLine, before: Sequence[WiredSensor], plate: Plate, *, mass: float | None, moves: bool
) -> WiredSensor:
    place = line.place
    name, (x, y) = named_place(line, [other.name for other in before], plate)
    channel, sensitivity = map(line.number, ("input", "mv_per_m_s2"))
    is_taken = not moves and any(channel == other.input for other in before)
    if channel != int(channel) or channel < 1 or is_taken:
        raise InputError(
            f"{place}: input must be a number from 1 that no other sensor has, got {channel:g}; "
            "a sensor moved between positions requires era measure, and a file of its own"
        )
    gain, full_scale, own = (line.number(column, default) for column, default in _OPTIONAL.items())
    for column, value in (("gain", gain), ("full_scale_v", full_scale)):
        if value <= 0:
            raise InputError(f"{place}: {column} must be above zero, got {value:g}")
    weight = sensor_mass(place, own if mass is None else mass, column="mass_g")
    if sensitivity == 0:
        raise InputError(f"{place}: mv_per_m_s2 must not be zero, got 0; negative: upside down")
    found = WiredSensor(name, x, y, int(channel), 1e-3 * sensitivity * gain / full_scale, weight)
    if moves and before and replace(before[0], name=name, x=x, y=y) != found:
        raise InputError(
            f"{place}: one sensor that is moved must have one sensitivity, gain, full scale and "
            f"mass, got others than sensor {before[0].name}; make the columns the same in all lines"
        )
    return found


_OPTIONAL = dict(zip(INPUT_COLUMNS[2:], (1.0, 1.0, 0.0), strict=True))


@dataclass(frozen=True)
class Desk:
    """Wiring of a rig to a sound card: ERAs by channel, counted from 1, and a loop-back.

    The loop-back is a cable from the output after the ERA outputs to the input after those of the
    sensors. If the card has no free output, it shares the output of the last ERA (is_shared).
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
        """What is connected to each input, including the loop-back."""
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
    ) -> Measurement:
        """Convert responses of samples (f, inputs, sources) to acceleration per base displacement
        [1/s²].

        looped (f,): response of the loop-back.
        """
        full = np.array([*self.rig.full_levels.values()])
        plain = values[:, self.columns, : len(self.eras)] / converters(looped)[:, None, None]
        return Measurement(
            tuple(each.place for each in self.sensors),
            frequencies,
            plain / full / self.sensitivities[:, None],
            drives_lag=True,
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
        """Highest level that the rig's limits allow on all ERAs simultaneously."""
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
                    f"limits.{key} must allow the signals of a sound card, {played}, got "
                    f"{getattr(limits, key):g}; check that the ERAs withstand them, and widen it"
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


TRIES = 3
"""Attempts of a run."""

_TAIL = 0.05  # s; longer than the ramp


@dataclass(frozen=True, eq=False)
class Run:
    """Recording of a run, (n, inputs).

    is_whole: whether the last attempt lost no block; repeated: number of attempts before it.
    """

    recorded: FloatArray
    is_whole: bool
    repeated: int

    @property
    def whole(self) -> FloatArray:
        """Return the recording; raises LinkError if every attempt lost blocks."""
        if self.is_whole:
            return self.recorded
        raise LinkError(
            f"blocks of sound were lost in {self.repeated + 1} attempts of a run; end other "
            "programs, give the sound server real-time priority, or choose larger blocks"
        )


def run_time(periods: int, *, settling: float = MIN_SETTLING) -> float:
    """Duration of a run [s] with `periods` analyzed periods after settling."""
    return settling + PERIOD * periods + _TAIL


def play_and_record(
    card: SoundCard,
    played: FloatArray,
    *,
    settling: float,
    seconds: float,
    is_whole: Callable[[FloatArray], bool],
    tries: int = TRIES,
) -> Run:
    """Play samples (n, outputs), and keep `seconds` of the recording after `settling` [s].

    is_whole: checks the kept recording (n, inputs) for lost blocks; if it fails, the run is
    repeated.
    """
    start, count = round(settling * card.rate), round(seconds * card.rate)
    for repeated in range(tries):
        kept = card.run(played)[start : start + count].astype(float)
        if is_whole(kept):
            return Run(kept, True, repeated)
    return Run(kept, False, tries - 1)


def play_on_one(
    card: SoundCard, sines: Multisine, output: int, *, outputs: int, periods: int
) -> FloatArray:
    """Play a multisine on one output, counted from 1, without a loop-back.

    Return whole periods of the recording (n, inputs); repeats if the device reports gaps. Raises
    LinkError after three attempts.
    """
    signal = sines.signal(0, periods=run_time(periods) / PERIOD)
    return play_and_record(
        card,
        signal * np.eye(outputs)[output - 1],
        settling=MIN_SETTLING,
        seconds=PERIOD * periods,
        is_whole=lambda _kept: not card.gaps,
    ).whole
