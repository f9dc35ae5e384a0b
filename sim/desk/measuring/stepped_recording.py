"""A recording of a stepped sine: where its tones are, and what each sensor heard of them.

Channels are the inputs of the sensors and, behind the last one, the references: one cable for each
ERA in the order of the rig, or one for all. In that case each ERA plays ascending frequencies, one
ERA after the other in the order of the rig; a frequency that is not higher begins the next.

Tones are where the frequency of the analytic reference stays. Of each, the first half is left for
the plate to settle; sensor by reference follows from products with both, under a Hann window.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy import signal

from drivers.errors import LinkError
from model.arrays import ComplexArray, FloatArray
from model.calibration.responses import WiredSensor
from model.errors import InputError
from model.files.uff import read_bytes
from model.files.wav_file import samples_of
from sim.desk.measuring.loopback import SILENT, check_levels

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
_CROSSTALK = 0.02  # of a reference in the others


@dataclass(frozen=True)
class Tone:
    """A tone [Hz] that an ERA played; place: file and time, for errors.

    ratios: samples of each sensor by those of the reference; NaN where they had not settled.
    """

    era: str
    frequency: float
    place: str
    ratios: ComplexArray


def tones_of(path: Path, sensors: Sequence[WiredSensor], eras: Sequence[str]) -> list[Tone]:
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
    found, number, before = list[Tone](), 0, 0.0
    for begin, end in _held(path, references.sum(axis=1), rate):
        place = f"{path} at {begin / rate:.1f} s"
        kept = slice((begin + end) // 2, end)
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
        found.append(Tone(eras[number], frequency, place, ratios))
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
