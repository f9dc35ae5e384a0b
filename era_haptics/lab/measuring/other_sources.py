"""Responses from other sources than a sound card: files of a stepped sine, a simulated plate.

A stepped sine was recorded or measured with any converter: WAV or CSV files.

- WAV: channels are the inputs of the sensors and, behind the last one, the references: a cable for
  each ERA in the order of the rig, or one for all. With one cable each ERA plays ascending
  frequencies, one ERA after the other in the order of the rig; a frequency that is not higher
  begins the next ERA. A tone is where the frequency of the analytic reference stays. The first
  half of each is left for the plate to settle; sensor by reference follows from products with
  both, under a Hann window.
- CSV: columns `frequency_hz`, `output`, `sensor`, and `magnitude` or `magnitude_db` with
  `phase_deg`, or `real` with `imag`. An output is an ERA's name, or its number from 1.

What a file does not say is in its name: SENSOR-OUTPUT.csv, or SENSOR.wav.

The simulated plate deviates from its rig's file.
"""

import cmath
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from scipy import signal

from drivers.errors import LinkError
from era_haptics.lab.measuring.measure import CROSSTALK, SILENT, check_levels
from era_haptics.lab.measuring.sound_card import (
    Desk,
    WiredSensor,
    are_positions,
    multisine_frequencies,
)
from model.arrays import ComplexArray, FloatArray
from model.errors import InputError
from model.estimate.measurement import (
    MeasuredValue,
    Measurement,
    measurement_of,
    write_responses,
)
from model.files.csv_file import read_lines
from model.files.uff import read_measured_bytes
from model.files.wav_file import samples_of
from model.quantities import counted
from model.reduction.free_plate import solve_free_plate
from model.structure.attachments import PointLoad
from sim.plant.imperfections import draw_imperfections

CLOSE = 2e-4
"""Of a frequency: nearer ones are the same, played for several ERAs."""

_MIN_RATE, _MAX_RATE = 1000, 1_000_000  # Hz
_FRAME = 0.05  # s
_HIGHEST = 1500.0  # Hz, of a tone
_HELD = 0.3  # Hz between two frames of one tone
_GLIDE = 1.0  # Hz within a tone
_SHORTEST = 10  # frames of a tone
_LOUD = 0.01  # of the loudest frame
_SETTLED = 0.05  # of a sensor's response between the two halves of what is kept


@dataclass(frozen=True)
class SteppedTone:
    """A tone [Hz] that an ERA played; place: file and time, for errors.

    ratios: samples of each sensor by those of the reference; NaN where they had not settled.
    """

    era: str
    frequency: float
    place: str
    ratios: ComplexArray


def _tones_of(path: Path, sensors: Sequence[WiredSensor], eras: Sequence[str]) -> list[SteppedTone]:
    """Tones of a recording of sensors, that ERAs played; raises InputError, with the time."""
    try:
        rate, samples = samples_of(read_measured_bytes(path))
        if not _MIN_RATE <= rate <= _MAX_RATE:
            raise InputError(f"rate must be {_MIN_RATE} to {_MAX_RATE} Hz, got {rate} Hz")
        first = max(sensor.input for sensor in sensors)
        references = samples[:, first:]
        if references.shape[1] not in (1, len(eras)):
            raise InputError(
                f"channels must be {first} of sensors and 1 or {len(eras)} references behind them, "
                f"got {samples.shape[1]}"
            )
        check_levels(samples, {sensor.input: f"sensor {sensor.name}" for sensor in sensors})
    except (InputError, LinkError) as error:
        raise InputError(f"{path}: {error}") from error
    columns = [sensor.input - 1 for sensor in sensors]
    found, number, before = list[SteppedTone](), 0, 0.0
    for start, end in _held(path, references.sum(axis=1), rate):
        place = f"{path} at {start / rate:.1f} s"
        kept = slice((start + end) // 2, end)
        sizes = np.linalg.norm(references[kept], axis=0)
        loudest = int(sizes.argmax())
        if np.delete(sizes, loudest).max(initial=0) > CROSSTALK * sizes[loudest]:
            raise InputError(
                f"{place}: one output must play at a time, got several references; play a stepped "
                "sine on one output after another"
            )
        both = np.column_stack([references[kept, loudest], samples[kept][:, columns]])
        frequency, ratios = _heard(both, rate)
        if references.shape[1] == 1:
            number += frequency <= before * (1 + CLOSE)
        else:
            number = loudest
        before = frequency
        if number >= len(eras):
            raise InputError(
                f"{place}: one reference must have ascending tones for each of {len(eras)} ERAs in "
                "turn, got more; record a reference for each ERA, or a file SENSOR-OUTPUT.wav"
            )
        found.append(SteppedTone(eras[number], frequency, place, ratios))
    played = {tone.era for tone in found}
    if played != set(eras):
        raise InputError(
            f"{path}: tones must be of all of {', '.join(eras)}, got {', '.join(sorted(played))}"
        )
    return found


def _held(path: Path, reference: FloatArray, rate: int) -> list[tuple[int, int]]:
    """First and last sample of each tone."""
    factor = max(1, int(rate / (4 * _HIGHEST)))
    slow = signal.decimate(reference, factor, ftype="fir") if factor > 1 else reference
    size = round(_FRAME * rate / factor)
    count = len(slow) // size
    if count == 0 or np.sqrt((reference**2).mean()) < SILENT:
        raise InputError(f"{path}: the reference is silent; connect it with what plays")
    frames = signal.hilbert(slow[: count * size]).reshape(count, size)
    # The window takes out what harmonics and hum turn to and fro within a frame.
    turns = np.angle((frames[:, 1:] * frames[:, :-1].conj()) @ signal.windows.hann(size - 1))
    frequencies = turns * rate / factor / (2 * np.pi)
    loud = np.abs(frames).min(axis=1)
    is_on = loud > _LOUD * loud.max()
    is_edge = (np.abs(np.diff(frequencies)) > _HELD) | (np.diff(is_on.astype(int)) != 0)
    groups = np.split(np.arange(count), np.flatnonzero(is_edge) + 1)
    held = [each for each in groups if len(each) >= _SHORTEST and is_on[each].all()]
    for each in held:
        low, high = frequencies[each].min(), frequencies[each].max()
        if high - low > _GLIDE:
            raise InputError(
                f"{path} at {each[0] * _FRAME:.1f} s: each tone must be held, got a sweep from "
                f"{low:.1f} to {high:.1f} Hz; play a stepped sine, 1.5 s for each tone"
            )
    is_lost = is_on.copy()
    is_lost[[frame for each in held for frame in each]] = False
    runs = np.split(np.arange(count), np.flatnonzero(np.diff(is_lost)) + 1)
    for each in (run for run in runs if is_lost[run[0]] and len(run) >= _SHORTEST):
        raise InputError(
            f"{path} at {each[0] * _FRAME:.1f} s: the reference must be one steady tone or silent, "
            f"got {frequencies[each].min():.1f} to {frequencies[each].max():.1f} Hz by turns; take "
            "it from what plays by a cable, without hum and noise, and play a stepped sine"
        )
    if not held:
        raise InputError(
            f"{path}: tones must be held for {_SHORTEST * _FRAME:g} s and more, better 1.5 s, got "
            "none; play a stepped sine"
        )
    step = size * factor
    return [(each[0] * step, (each[-1] + 1) * step) for each in held]


def _heard(both: FloatArray, rate: int) -> tuple[float, ComplexArray]:
    """Frequency [Hz] of a tone, and sensors by reference, the first column of samples (n, s + 1).

    The frequency by the phase of the reference between both halves, beside the loudest line of its
    spectrum; NaN where these do not agree.
    """
    half = len(both) // 2
    spectrum = np.abs(np.fft.rfft(both[:, 0] * signal.windows.hann(len(both))))
    coarse = float(spectrum.argmax() * rate / len(both))
    halves = both[: 2 * half].reshape(2, half, -1)
    turning = np.exp(-2j * np.pi * coarse * np.arange(half) / rate) * signal.windows.hann(half)
    first, last = turning @ (halves - halves.mean(axis=1, keepdims=True))
    drift = np.angle(last[0] / first[0] * np.exp(-2j * np.pi * coarse * half / rate))
    one, other = first[1:] / first[0], last[1:] / last[0]
    mean = (one + other) / 2
    is_settled = np.abs(other - one) <= _SETTLED * np.abs(mean)
    return coarse + drift * rate / (2 * np.pi * half), np.where(is_settled, mean, np.nan)


_OPTIONAL = ("output", "sensor", "magnitude", "magnitude_db", "phase_deg", "real", "imag")
_UNNAMED = ("frequency_hz", "magnitude_db", "phase_deg")
_ENDINGS = (".csv", ".wav")
_Known = TypeVar("_Known")


def measured_from(
    source: Path, desk: Desk, output: Path
) -> tuple[list[str | None], dict[str, Any]]:
    """Read files of a stepped sine, write responses, and return the report; raises InputError."""
    found = measurement_of(read_stepped(source, desk), desk.rig)
    return written(found, desk, output, source=str(source))


def read_stepped(source: Path, desk: Desk) -> list[MeasuredValue]:
    """Read a file, or all of a folder; raises InputError with file and line or time."""
    files = [source]
    if source.is_dir():
        files = sorted(each for each in source.iterdir() if each.suffix.lower() in _ENDINGS)
    if not files or any(each.suffix.lower() not in _ENDINGS for each in files):
        raise InputError(f"--from {source}: must be a .csv or .wav file, or a folder with such")
    stated: list[MeasuredValue] = []
    heard: list[MeasuredValue] = []
    for path in files:
        if path.suffix.lower() == ".wav":
            heard += _of_recording(path, desk)
        else:
            stated += _of_lines(path, desk)
    # Clocks of converters say nearly, and not quite, the same of one tone in several recordings.
    order, same = np.unique([each.frequency for each in heard]), dict[float, float]()
    while order.size:
        group = order[order <= order[0] * (1 + CLOSE)]
        same |= dict.fromkeys(group.tolist(), float(group.mean()))
        order = order[len(group) :]
    return [*stated, *(replace(each, frequency=same[each.frequency]) for each in heard)]


def _of_lines(path: Path, desk: Desk) -> Iterator[MeasuredValue]:
    for line in read_lines(path, ("frequency_hz",), optional=_OPTIONAL, unnamed=_UNNAMED):
        sensor, output = (
            line.cells.get(column) or _in_name(path, number, column)
            for number, column in enumerate(("sensor", "output"))
        )
        place = _sensor(desk, sensor, line.place)
        frequency = line.number("frequency_hz")
        if frequency <= 0:
            raise InputError(f"{line.place}: frequency_hz must be above 0, got {frequency:g}")
        era = _era(desk, output, line.place)
        yield _value(desk, era, place, frequency, line.complex_number(), line.place)


def _of_recording(path: Path, desk: Desk) -> Iterator[MeasuredValue]:
    sensors = [*desk.sensors]
    if are_positions(sensors):
        sensors = [_sensor(desk, _in_name(path, 0, "sensor"), str(path))]
    names = [name for name, _ in desk.eras]
    if "-" in path.stem:
        names = [_era(desk, _in_name(path, 1, "output"), str(path))]
    for tone in _tones_of(path, sensors, names):
        for sensor, ratio in zip(sensors, tone.ratios.tolist(), strict=True):
            if not cmath.isnan(ratio):
                yield _value(desk, tone.era, sensor, tone.frequency, ratio, tone.place)


def _in_name(path: Path, number: int, what: str) -> str:
    """The part of a file's name SENSOR-OUTPUT that stands for what a column would say."""
    parts = path.stem.rpartition("-")[::2] if "-" in path.stem else (path.stem, "")
    if not parts[number]:
        raise InputError(
            f"{path}: must have a column {what}, or a name such as SENSOR-OUTPUT{path.suffix}, for "
            f"instance P3-1{path.suffix}"
        )
    return parts[number]


def _sensor(desk: Desk, name: str, place: str) -> WiredSensor:
    return _known(f"{place}: sensor", name, {sensor.name: sensor for sensor in desk.sensors})


def _era(desk: Desk, output: str, place: str) -> str:
    numbers = {str(number): name for name, number in desk.eras}
    return _known(f"{place}: output", output, numbers | {name: name for name, _ in desk.eras})


def _known(what: str, given: str, known: Mapping[str, _Known]) -> _Known:
    if given not in known:
        raise InputError(f"{what} must be one of {', '.join(known)}, got {given!r}")
    return known[given]


def _value(
    desk: Desk, era: str, sensor: WiredSensor, frequency: float, ratio: complex, place: str
) -> MeasuredValue:
    actuator = desk.rig.era(era)
    return MeasuredValue(
        era,
        sensor.name,
        (sensor.x, sensor.y),
        None,
        frequency,
        ratio / actuator.full_level / sensor.sensitivity,
        place,
        sensor.mass,
        is_per_volt=actuator.UNIT == "V",
    )


def written(
    found: Measurement, desk: Desk, output: Path, *, source: str
) -> tuple[list[str | None], dict[str, Any]]:
    """Write responses that have a source; return the report. Raises InputError."""
    write_responses(output, found, desk.rig)
    absent = [each.name for each in desk.sensors if each.name not in found.names]
    lines = found.frequencies
    count = found.values.size - found.count
    rows = [
        f"{source}: {counted(len(found.sensors), 'sensor')}, "
        f"{counted(len(lines), 'frequency', plural='frequencies')} from {lines[0]:g} to "
        f"{lines[-1]:g} Hz, {counted(found.count, 'value')}",
        f"{counted(count, 'value')} missing, or not settled and left out" if count else None,
        f"without {', '.join(absent)}" if absent else None,
        f"wrote {output}",
    ]
    return rows, {
        "frequencies_hz": lines.tolist(),
        "sensors": [*found.names],
        "without": absent,
        "values": found.count,
        "values_missing": count,
        "files": [str(output)],
    }


NOISE = 2e-3
"""Of a sensor's root mean square over all that it reads, of each part."""


def measured_by_simulation(
    desk: Desk, output: Path, *, frequencies: FloatArray | None, seed: int
) -> tuple[list[str | None], dict[str, Any]]:
    """Write responses of a plate drawn within a rig's uncertainty; return the report.

    frequencies (f,) [Hz]: None for those of `era measure`; seed: of the plate and of the noise.
    Sensors weigh what their file says, one that is moved at one place at a time. Raises InputError
    for frequencies beyond the rig's limits.
    """
    rig, sensors = desk.rig, desk.sensors
    limits, drawn = rig.limits, draw_imperfections(rig, seed=seed)
    if frequencies is None:
        frequencies = multisine_frequencies(limits.frequency_min, limits.frequency_max)
    desk.check_frequencies(frequencies, what="--frequencies")
    real = drawn.plate.realised(rig)
    plate = solve_free_plate(real.plate, real.mesh, frequency_max=limits.frequency_max)
    points = np.array([[each.x, each.y] for each in sensors])
    weights = [PointLoad(each.x, each.y, mass=each.mass) for each in sensors]
    found = [
        plate.acceleration(
            real.eras,
            frequencies,
            point[None],
            loads=[*real.masses, *([weight] if are_positions(sensors) else weights)],
        )
        for point, weight in zip(points, weights, strict=True)
    ]
    drives = drawn.factors(rig) / np.array([*rig.full_levels.values()])
    values = np.concatenate(found, axis=2) * drives[:, None]  # (f, eras, sensors)
    parts = np.random.default_rng(seed).standard_normal((2, *values.shape))
    rms = np.sqrt((np.abs(values) ** 2).mean(axis=(0, 1)))
    values += NOISE * rms * (parts[0] + 1j * parts[1])
    places = [each.place for each in sensors]
    if not are_positions(sensors):
        places = [replace(each, mass=0.0) for each in places]
    measured = Measurement(places, frequencies, values.swapaxes(1, 2))
    return written(measured, desk, output, source="simulated plate")
