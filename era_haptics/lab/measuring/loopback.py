"""Checks of a measurement by its loop-back cable, and responses from recordings of a stepped sine.

The loop-back shows delay, converters, lost blocks, and whether inputs have the clock of the
outputs. Two devices, or an aggregate of two, drift by 10 to 100 millionths: runs are then no longer
orthogonal, and nothing else shows it where the loop-back has the right clock.

A stepped sine, measured with any converter, is read from WAV or CSV files (`read_stepped`).

- WAV: channels are the inputs of the sensors and, behind the last one, the references: a cable for
  each ERA in the order of the rig, or one for all. With one cable each ERA plays ascending
  frequencies, one ERA after the other in the order of the rig; a frequency that is not higher
  begins the next ERA. A tone is where the frequency of the analytic reference stays. The first
  half of each is left for the plate to settle; sensor by reference follows from products with
  both, under a Hann window.
- CSV: columns `frequency_hz`, `output`, `sensor`, and `magnitude` or `magnitude_db` with
  `phase_deg`, or `real` with `imag`. An output is an ERA's name, or its number from 1.

What a file does not say is in its name: SENSOR-OUTPUT.csv, or SENSOR.wav.
"""

import cmath
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from scipy import signal

from drivers.errors import LinkError
from era_haptics.lab.measuring.sound_card import (
    PERIOD,
    Desk,
    Multisine,
    ResponseEstimate,
    WiredSensor,
    are_positions,
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
from model.files.uff import read_bytes
from model.files.wav_file import samples_of
from model.quantities import counted

SILENT = 1e-5
"""Of full scale, rms: what an input without a signal stays below."""

_MAX_DELAY = 0.1  # s; lines 10 Hz apart repeat then
_NEARLY = 0.95
_STRAIGHT = 0.5  # rad
_AS_LATE = 0.02  # of the gain; one sample more at 500 Hz and 48 kHz makes 0.065
_SAME = 1e-3  # of periods; a lost block makes them differ by 0.8


def is_whole(periods: FloatArray, *, samples: int) -> bool:
    """Whether all periods of the loop-back (n,) are alike: no block was lost between them.

    Not so where it is silent, which tells nothing.
    """
    each = periods.reshape(-1, samples)
    size = np.linalg.norm(each[0])
    differ = np.linalg.norm(each - each[0], axis=1).max()
    return bool(size > SILENT * np.sqrt(samples) and differ <= _SAME * size)


def is_as_late(gain: ComplexArray, before: ComplexArray) -> bool:
    """Whether two gains (f,) have one delay, which a block lost between two runs changes."""
    return bool(np.abs(gain - before).max() <= _AS_LATE * np.abs(before).max())


def latency(response: ComplexArray, frequencies: FloatArray) -> float:
    """Delay [s] of a response at frequencies [Hz], from 0 to 0.1 s, by the slope of its phase.

    Lines d apart tell delays below 1 / d apart only.

    Raises LinkError where the phase is no straight line, so that nothing is known of the delay.
    """
    unit = response / np.abs(response)
    tried = np.arange(0, _MAX_DELAY, 0.1 / frequencies.max())
    alike = np.abs(np.exp(2j * np.pi * np.outer(tried, frequencies)) @ unit)
    # Lines at equal distances have several such delays: the shortest is meant.
    near = np.flatnonzero(alike > _NEARLY * alike.max())
    first_group = near[near - near[0] == np.arange(len(near))]
    nearest = tried[first_group[alike[first_group].argmax()]]
    rest = unit * np.exp(2j * np.pi * frequencies * nearest)
    phase = np.angle(rest / rest.mean())
    slope, first = np.polyfit(frequencies, phase, 1)
    if np.abs(phase - slope * frequencies - first).max() > _STRAIGHT:
        raise LinkError(
            f"loop-back: its phase must be that of a delay up to {1e3 * _MAX_DELAY:g} ms; check "
            "the cable, and that nothing else feeds this input"
        )
    return float(nearest - slope / (2 * np.pi))


TOLERANCE = 2e-6
"""Of a clock; 13 s of measuring turn 500 Hz by 5 degrees."""

_MAX_DRIFT = 1e-3  # a lost block of 64 samples at 48 kHz looks like more
_ALIKE = 0.999
_SURE = 5.0  # standard errors


def certain_drift(multisine: Multisine, runs: Sequence[FloatArray]) -> float:
    """Drift of an input's clock relative to the outputs', from whole periods of each run, (n,).

    Least squares of the phase 2 pi f t drift between the first and the last period, t apart,
    weighted by the power of each line. 0 where that is within its error, or not all that makes
    periods differ, as a lost block does.
    """
    n = multisine.samples
    first = np.array([multisine.found(each[:n]) for each in runs])
    last = np.array([multisine.found(each[-n:]) for each in runs])
    apart = PERIOD * (len(runs[0]) / n - 1)
    turned = last * first.conj()
    weights = np.abs(turned)
    slopes = np.broadcast_to(2 * np.pi * multisine.frequencies * apart, weights.shape)
    phases = np.angle(turned)
    moment = max(float((weights * slopes**2).sum()), 1e-300)
    relative = float((weights * slopes * phases).sum()) / moment
    rest = phases - slopes * relative
    error = np.sqrt(float((weights**2 * slopes**2 * rest**2).sum())) / moment
    alike = np.abs((turned * np.exp(-1j * slopes * relative)).sum()) / max(weights.sum(), 1e-300)
    is_large = max(TOLERANCE, _SURE * error) < abs(relative) < _MAX_DRIFT
    return relative if is_large and alike > _ALIKE else 0.0


_FULL = 0.999  # of full scale
_LOOPED = 0.05  # of a sample that a loop-back brings back at least
_CROSSTALK = 0.02  # of it, that other outputs may
_COHERENT = 0.9  # in the median over frequencies
_FAINT = 0.01  # of full scale: what converters themselves add is heard beside it
_MOVED = 5.0  # times the noise, in the median over frequencies and the maximum over sensors


def check_levels(recorded: FloatArray, named: Mapping[int, str]) -> None:
    """Raise InputError for clipped inputs, LinkError for silent ones, of one run (n, inputs).

    named: what the inputs have that are checked, by their number from 1.
    """
    clipped = [name for n, name in named.items() if np.abs(recorded[:, n - 1]).max() >= _FULL]
    if clipped:
        raise InputError(
            f"inputs must stay below full scale, got clipping of {', '.join(clipped)}; turn down "
            "the gain of the input, and its full_scale_v, or choose a lower --level"
        )
    silent = [n for n in named if np.sqrt((recorded[:, n - 1] ** 2).mean()) < SILENT]
    if len(silent) == len(named) > 1:
        raise LinkError(
            "all inputs are silent: check that --device is the one that is wired, its outputs and "
            "inputs not swapped, amplifier and sensor supply switched on"
        )
    if silent:
        inputs = ", ".join(f"{named[n]} (input {n})" for n in silent)
        raise LinkError(f"silent: {inputs}; check cables, amplifier and sensor supply (IEPE)")


def check_wiring(found: ResponseEstimate, desk: Desk) -> None:
    """Raise InputError unless the loop-back, and no sensor, has its output by a cable.

    A cable brings back one output alone. Sensors of a single source do so, too, and may.
    """
    came = np.median(np.abs(found.values), axis=0)  # (inputs, sources)
    own, at, output, named = desk.looped, desk.input, desk.output, desk.named_inputs
    first, others = came.max(axis=1), np.sort(came, axis=1)[:, :-1].max(axis=1, initial=0.0)
    may_tell = (len(desk.sources) > 1) | (np.arange(1, 1 + len(came)) == at)
    is_cable = (first > _LOOPED) & (others < _CROSSTALK * first) & may_tell
    by_cable = np.where(is_cable, came.argmax(axis=1), -1)  # source at each input, -1 for none
    looped, heard = came[at - 1, own], came[at - 1] * (np.arange(came.shape[1]) != own)
    of_eras = [f"output {to} of ERA {name}" for name, to in desk.eras]
    other = f"{heard.max():.2g} of {of_eras[heard.argmax()]}"
    back = np.flatnonzero(by_cable == own) + 1
    what = f"input {at} must bring back output {output} alone, as the loop-back, got"
    if by_cable[at - 1] not in (own, -1):
        raise InputError(f"{what} {other}: outputs are swapped; exchange their cables")
    if back.size and at not in back:
        raise InputError(
            f"the loop-back of output {output} must come back at input {at}, got it at input "
            f"{back[0]}, {named.get(back[0], 'of no sensor')}: inputs are swapped; exchange "
            "their cables"
        )
    if looped <= _LOOPED:
        raise InputError(f"{what} {looped:.2g} of it; connect them by a cable")
    if at not in back:
        raise InputError(f"{what} {other}, too; check mixers and monitoring of the sound card")
    for n in (each.input for each in desk.sensors if by_cable[each.input - 1] >= 0):
        raise InputError(
            f"input {n} must have {named[n]}, got output {desk.sources[by_cable[n - 1]]} as by a "
            "cable; check the plug of that sensor, Y cables and monitoring of the sound card"
        )


def check_clocks(multisine: Multisine, recorded: Sequence[FloatArray], desk: Desk) -> None:
    """Raise InputError for inputs with another clock than the outputs'; runs (n, inputs) each."""
    found = [
        f"{1e6 * drift:.0f} millionths at {name} (input {n})"
        for n, name in desk.named_inputs.items()
        if (drift := certain_drift(multisine, [each[:, n - 1] for each in recorded]))
    ]
    if found:
        raise InputError(
            f"inputs must have the clock of the outputs, got a drift of {', '.join(found)}; use "
            "one sound card, or clock all of them by one (word clock, ADAT)"
        )


def check_coherence(
    found: ResponseEstimate,
    recorded: Sequence[FloatArray],
    desk: Desk,
    *,
    is_heard: bool = False,
) -> None:
    """Raise LinkError for sensors that hear something else, and for ERAs that move nothing.

    found: of what was recorded, runs (n, inputs) each; is_heard: whether every ERA was heard at
    another place.
    """
    coherence = np.median(found.coherence[:, desk.columns], axis=0)
    peaks = np.max([np.abs(each[:, desk.columns]).max(axis=0) for each in recorded], axis=0)
    for are_faint, remedy in (
        (True, "too low a level: choose a higher --level, or turn up the gain of the input"),
        (False, "fix these sensors to the plate, check their cables and mains hum"),
    ):
        incoherent = [
            f"{sensor.name} ({each:.2f}, input up to {100 * peak:.2g} % of full scale)"
            for sensor, each, peak in zip(desk.sensors, coherence, peaks, strict=True)
            if each < _COHERENT and (peak < _FAINT) == are_faint
        ]
        if incoherent:
            raise LinkError(
                f"coherence must be at least {_COHERENT:g} in the median, got "
                f"{', '.join(incoherent)}; {remedy}"
            )
    moved = np.abs(found.values[:, desk.columns]) / found.std[:, desk.columns, None]
    for (name, at), each in zip(desk.eras, np.median(moved, axis=0).max(axis=0), strict=False):
        if each < _MOVED:
            raise LinkError(
                f"output {at} is not heard here, but was at another place: this one is near a "
                f"nodal line for ERA {name}; s skips it, or move it by a few cm, in its line of "
                "--sensors too (q, then --resume); if the next place does not hear it either, "
                "check its cable"
                if is_heard
                else f"output {at} moves nothing: check ERA {name}, its amplifier and its cable"
            )


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


def tones_of(path: Path, sensors: Sequence[WiredSensor], eras: Sequence[str]) -> list[SteppedTone]:
    """Tones of a recording of sensors, that ERAs played; raises InputError, with the time."""
    try:
        rate, samples = samples_of(read_bytes(path))
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
        if np.delete(sizes, loudest).max(initial=0) > _CROSSTALK * sizes[loudest]:
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
    for tone in tones_of(path, sensors, names):
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
