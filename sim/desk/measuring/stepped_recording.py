"""A recording of a stepped sine: where its tones are, and what each sensor heard of them.

Channels are the inputs of the sensors and, behind the last one, the references: one cable for each
ERA in the order of the rig, or one for all. In that case each ERA plays ascending frequencies, one
ERA after the other in the order of the rig; a frequency that is not higher begins the next.

Tones are where the frequency of the analytic reference stays. Of each, the first half is left for
the plate to settle; sensor by reference follows from products with both, under a Hann window.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy import signal

from drivers.errors import LinkError
from model.arrays import ComplexArray, FloatArray
from model.calibration.sensor_file import WiredSensor
from model.errors import InputError
from model.files.uff import read_bytes
from model.files.wav_file import samples_of
from sim.desk.measuring.loopback import SILENT, check_levels

_FRAME = 0.05  # s
_HIGHEST = 1500.0  # Hz, of a tone
_HELD = 0.3  # Hz between two frames of one tone
_GLIDE = 1.0  # Hz within a tone
_SHORTEST = 10  # frames of a tone
_LOUD = 0.01  # of the loudest frame
_SETTLED = 0.05  # of a sensor's response between the two halves of what is kept
_CROSSTALK = 0.02  # of a reference in the others
_CLOSE = 2e-4  # of a frequency: the same, played for several ERAs


@dataclass(frozen=True)
class Tone:
    """A tone [Hz] that an ERA played, start [s] after the beginning of the file.

    ratios: samples of each sensor by those of the reference; None where they had not settled.
    """

    era: str
    frequency: float
    start: float
    ratios: tuple[complex | None, ...]


def tones_of(path: Path, sensors: Sequence[WiredSensor], eras: Sequence[str]) -> list[Tone]:
    """Tones of a recording of sensors, that ERAs played; raises InputError, with the time."""
    try:
        rate, samples = samples_of(read_bytes(path))
        check_levels(samples, sensors)
    except (InputError, LinkError) as error:
        raise InputError(f"{path}: {error}") from error
    if not np.isfinite(samples).all():
        raise InputError(f"{path}: samples must be finite")
    first = max(sensor.input for sensor in sensors)
    references = samples[:, first:]
    if references.shape[1] not in (1, len(eras)):
        raise InputError(
            f"{path}: channels must be {first} of sensors and 1 or {len(eras)} references behind "
            f"them, got {samples.shape[1]}"
        )
    columns = [sensor.input - 1 for sensor in sensors]
    found, number, before = [], 0, 0.0
    for begin, end in _held(path, references.sum(axis=1), rate):
        kept = slice((begin + end) // 2, end)
        played = references[kept]
        loudest = int(np.linalg.norm(played, axis=0).argmax())
        frequency = _frequency(played[:, loudest], rate)
        place = f"{path} at {begin / rate:.1f} s"
        if references.shape[1] == 1:
            number += frequency <= before * (1 + _CLOSE)
        else:
            number = loudest
            _check_alone(place, played, loudest)
        if number >= len(eras):
            raise InputError(
                f"{place}: one reference must have ascending tones for each of {len(eras)} ERAs in "
                "turn, got more; record a reference for each ERA, or a file SENSOR-OUTPUT.wav"
            )
        before = frequency
        both = np.column_stack([played[:, loudest], samples[kept][:, columns]])
        found.append(Tone(eras[number], frequency, begin / rate, _ratios(both, frequency, rate)))
    if {tone.era for tone in found} != set(eras):
        raise InputError(
            f"{path}: tones must be of all of {', '.join(eras)}, got "
            f"{', '.join(sorted({tone.era for tone in found}))}"
        )
    return _alike(found)


def _held(path: Path, reference: FloatArray, rate: int) -> Iterator[tuple[int, int]]:
    """First and last sample of each tone."""
    factor = max(1, int(rate / (4 * _HIGHEST)))
    slow = signal.decimate(reference, factor, ftype="fir") if factor > 1 else reference
    size = round(_FRAME * rate / factor)
    count = len(slow) // size
    if count == 0 or np.sqrt((reference**2).mean()) < SILENT:
        raise InputError(f"{path}: the reference is silent; connect it with what plays")
    analytic = signal.hilbert(slow[: count * size])
    turns = np.angle(analytic[1:] * analytic[:-1].conj())
    per_frame = np.resize(turns, count * size).reshape(count, size).mean(axis=1)
    frequencies = per_frame * rate / factor / (2 * np.pi)
    loud = np.abs(analytic).reshape(count, size).min(axis=1)
    is_on = loud > _LOUD * loud.max()
    breaks = np.abs(np.diff(frequencies)) > _HELD
    edges = np.flatnonzero(breaks | (np.diff(is_on.astype(int)) != 0)) + 1
    is_any = False
    for frames in np.split(np.arange(count), edges):
        if len(frames) < _SHORTEST or not is_on[frames].all():
            continue
        low, high = frequencies[frames].min(), frequencies[frames].max()
        if high - low > _GLIDE:
            raise InputError(
                f"{path} at {frames[0] * _FRAME:.1f} s: each tone must be held, got a sweep from "
                f"{low:.1f} to {high:.1f} Hz; play a stepped sine, 1.5 s for each tone"
            )
        is_any = True
        yield frames[0] * size * factor, (frames[-1] + 1) * size * factor
    if not is_any:
        raise InputError(
            f"{path}: tones must be held for {_SHORTEST * _FRAME:g} s and more, better 1.5 s, got "
            "none; play a stepped sine"
        )


def _frequency(played: FloatArray, rate: int) -> float:
    """Frequency [Hz] of a tone, by the phase between the halves of its samples."""
    spectrum = np.abs(np.fft.rfft(played * np.hanning(len(played))))
    coarse = float(spectrum.argmax() * rate / len(played))
    first, last = _halves(played[:, None], coarse, rate)
    half = len(played) // 2 / rate
    return coarse + float(np.angle(last[0] / first[0])) / (2 * np.pi * half)


def _halves(samples: FloatArray, frequency: float, rate: int) -> list[ComplexArray]:
    """Complex amplitudes (channels,) of both halves of samples, on one clock."""
    half = len(samples) // 2
    window = signal.windows.hann(half)
    angles = 2 * np.pi * frequency * np.arange(2 * half) / rate
    return [
        (window * np.exp(-1j * angles[part])) @ (samples[part] - samples[part].mean(axis=0))
        for part in (slice(0, half), slice(half, 2 * half))
    ]


def _ratios(both: FloatArray, frequency: float, rate: int) -> tuple[complex | None, ...]:
    """Sensors by reference, the first column, where both halves agree."""
    first, last = (each[1:] / each[0] for each in _halves(both, frequency, rate))
    mean = (first + last) / 2
    settled = np.abs(last - first) <= _SETTLED * np.abs(mean)
    return tuple(
        complex(value) if is_settled else None
        for value, is_settled in zip(mean, settled, strict=True)
    )


def _check_alone(place: str, played: FloatArray, loudest: int) -> None:
    size = np.linalg.norm(played, axis=0)
    others = np.delete(size, loudest)
    if others.max(initial=0) > _CROSSTALK * size[loudest]:
        raise InputError(
            f"{place}: one output must play at a time, got several references; play a stepped sine "
            "on one output after another"
        )


def _alike(tones: list[Tone]) -> list[Tone]:
    """The same tones, where frequencies that are nearly one are one."""
    order = np.sort([tone.frequency for tone in tones])
    groups = np.split(order, np.flatnonzero(np.diff(order) > _CLOSE * order[1:]) + 1)
    means = np.array([group.mean() for group in groups])
    return [
        replace(tone, frequency=float(means[np.abs(means - tone.frequency).argmin()]))
        for tone in tones
    ]
