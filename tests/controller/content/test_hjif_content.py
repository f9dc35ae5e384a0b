"""HJIF files (ISO/IEC 23090-31) against values and waves calculated in the tests."""

import io
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pytest
from scipy.io import wavfile

from controller.content.pattern import Pattern, Transient
from model.arrays import FloatArray
from model.errors import InputError

Read = Callable[..., Pattern]
Keyframe = tuple[int, float, int | float]
"""Position, amplitude and frequency."""


def effect(position: int, *keyframes: Keyframe, **keys: Any) -> dict[str, Any]:
    """Return an effect with keyframes."""
    frames = []
    for relative_position, amplitude, frequency in keyframes:
        frame = {
            "relative_position": relative_position,
            "amplitude_modulation": amplitude,
            "frequency_modulation": frequency,
        }
        frames.append(frame)
    return {"effect_type": "Basis", "position": position, "keyframes": frames, **keys}


def reference(number: int, **keys: Any) -> dict[str, Any]:
    """Return a reference to an effect of the library."""
    return {"effect_type": "Reference", "id": number, **keys}


def band(kind: str, *effects: dict[str, Any], **keys: Any) -> dict[str, Any]:
    """Return a band from 65 to 300 Hz."""
    return {
        "band_type": kind,
        "lower_frequency_limit": 65,
        "upper_frequency_limit": 300,
        "effects": [*effects],
        **keys,
    }


def hjif_file(
    *channels: list[dict[str, Any]], library: Sequence[dict[str, Any]] = (), **keys: Any
) -> dict[str, Any]:
    """Return a file with channels of bands, at half the gain, after a perception of warmth."""
    channel_list = [{"gain": 0.5, "bands": bands} for bands in channels]
    warmth = {"perception_modality": "Temperature", "channels": channel_list[:1]}
    vibration = {
        "perception_modality": "Vibrotactile",
        "effect_library": [*library],
        "channels": channel_list,
    }
    return {"version": "2023", "profile": "Main", "perceptions": [warmth, vibration], **keys}


def test_hjif_channel_combines_its_bands(read: Read) -> None:
    """Ticks are 1/100 s; a reference has its own position; a square wave has 3 dB more power."""
    library = [effect(7, (0, 0.6, 65), (10, 1.0, 300), id=3)]
    square = effect(50, (0, 0.2, 65), (10, 0.2, 65), base_signal="Square")
    waves = band("VectorialWave", reference(3, position=20), square)
    taps = band("Transient", effect(10, (5, 0.8, 182.5), (60, -0.4, 400)))

    content = hjif_file([], [waves, taps], library=library, timescale=100)
    pattern = read("hjif", content, channel=2)

    assert pattern.duration == 0.7
    root = 0.1 * 2**0.5
    expected = [(0.2, 0.3), (0.3, 0.5), (0.3, 0), (0.5, 0), (0.5, root), (0.6, root)]
    assert np.array(pattern.intensity) == pytest.approx(np.array(expected))
    assert pattern.sharpness == ((0.2, 0.0), (0.3, 1.0), (0.5, 0.0), (0.6, 0.0))
    assert pattern.transients == (Transient(0.15, 0.4, 0.5), Transient(0.7, 0.2, 1.0))
    assert pattern.remarks == (
        "channel 2 of 2 read",
        "perceptions of 'Temperature' left out",
        "1 frequency outside 65 to 300 Hz moved to the nearest limit",
    )


def test_hjif_remarks_name_everything_that_is_not_played(read: Read) -> None:
    """Keys that would be felt, other interpolations, forms without effect; but no titles."""
    keyframes: tuple[Keyframe, ...] = ((0, 0.5, 100), (20, 0.9, 100))
    bands = [
        band("Curve", effect(0, *keyframes), curve_type="Akima"),
        band("Transient", effect(0, *keyframes, base_signal="Square", phase=1.0)),
        band("VectorialWave", effect(0), effect(0, (0, 0.5, 100))),
        band("VectorialWave", effect(0, *keyframes) | reference(3), id=1),
    ]
    library = [effect(0, *keyframes, id=3)]
    content = hjif_file(bands, library=library, syncs=[{"timestamp": 9}], level=1)
    content["perceptions"][1] |= {"description": "Rain", "vertices": [1], "avatars": []}

    remarks = read("hjif", content).remarks

    assert {remark for remark in remarks if "energy" not in remark} == {
        "perceptions of 'Temperature' left out",
        "2 unknown keys ignored: syncs, vertices",
        "curve: Akima drawn as Cubic",
        "curve: frequencies of keyframes left out",
        "base_signal of Transient left out",
        "effects without a duration or keyframes left out",
        "keyframes of references left out",
    }


RATE = 8000
"""Samples per second of the wave that the test calculates."""


def levels_every_20_ms(amplitude: FloatArray) -> FloatArray:
    """Return the RMS of an amplitude in every 20 ms."""
    return np.sqrt((amplitude**2).reshape(-1, RATE // 50).mean(axis=1))


@pytest.mark.parametrize("kind", ["HJIF wave", "HJIF curve", "WAV"])
@pytest.mark.parametrize("seed", range(3))
def test_level_over_time_is_that_of_the_same_wave_in_every_format(
    read: Read, seed: int, kind: str
) -> None:
    """A sine with a varying amplitude: within 1.5 dB in every 20 ms."""
    rng = np.random.default_rng(seed)
    positions = np.arange(0, 1001, 100)  # ms
    amplitudes = rng.uniform(0.2, 1.0, len(positions))
    frequency = int(rng.integers(120, 260))
    times = np.arange(RATE) / RATE
    envelope = np.interp(times, positions / 1000, amplitudes)
    wave = envelope * np.sin(2 * np.pi * frequency * times)

    if kind == "HJIF wave":
        keyframes = []
        for position, amplitude in zip(positions, amplitudes, strict=True):
            keyframes.append((int(position), float(amplitude), frequency))
        pattern = read("hjif", hjif_file([band("VectorialWave", effect(0, *keyframes))]))
        gain = 2
    elif kind == "HJIF curve":
        samples = []
        for number, sample in enumerate(wave.tolist()):
            samples.append({"relative_position": number, "amplitude_modulation": sample})
        curve = band("Curve", effect(0) | {"keyframes": samples}, curve_type="Linear")
        pattern = read("hjif", hjif_file([curve], timescale=RATE))
        gain = 2
    else:
        file = io.BytesIO()
        wavfile.write(file, RATE, wave.astype(np.float32))
        pattern = read("wav", file.getvalue())
        gain = 1

    intensity_times, intensities = np.array(pattern.intensity).T
    intensity = gain * np.interp(times, intensity_times, intensities)
    expected_level = np.sqrt(2) * levels_every_20_ms(wave)
    level_error_db = 20 * np.log10(levels_every_20_ms(intensity) / expected_level)
    assert level_error_db == pytest.approx(0, abs=1.5)
    sharpness = np.median([value for _, value in pattern.sharpness])
    assert sharpness == pytest.approx((frequency - 65) / 235, abs=0.01)


MINUTE = effect(0, (0, 1, 90), (60_000, 1, 90), id=3)
REFUSED = {
    "version": (hjif_file([], version="2025"), r"version: must be 2023, got '2025'"),
    "profile": (
        hjif_file([], profile="Other"),
        r"profile: must be Main or Simple Parametric, got 'Other'",
    ),
    "no channel": (hjif_file(), r"has no channel of vibration"),
    "wavelets": (
        hjif_file([band("WaveletWave")]),
        r":\d+: perceptions\[1\]\.channels\[0\]\.bands\[0\]\.band_type: wavelet bands are "
        r"not supported; .*Synthesizer",
    ),
    "reference": (
        hjif_file([band("Transient", reference(5))]),
        r"effects\[0\]\.id: must be an effect of the library",
    ),
    "order": (
        hjif_file([band("Transient", effect(0, (5, 1, 90), (0, 1, 90)))]),
        r"keyframes: must be in o",
    ),
    "long": (
        hjif_file([band("Transient", effect(61_000, (0, 1, 90)))]),
        r"effects\[0\]: must end within",
    ),
    "composite": (
        hjif_file([band("Transient", {"effect_type": "Composite"})]),
        r"effect_type: composite effects are not read",
    ),
    "curves": (  # ten curves of a minute; ten thousand would take minutes to read
        hjif_file([band("Curve", *[reference(3)] * 10)], library=[MINUTE]),
        r":\d+: .*effects\[9\]: has too many curves, or too long ones",
    ),
}


@pytest.mark.parametrize("case", REFUSED)
def test_hjif_file_is_refused_with_line_and_key(read: Read, case: str) -> None:
    """What is not supported is named, with what to do."""
    content, message = REFUSED[case]
    with pytest.raises(InputError, match=message):
        read("hjif", content)
