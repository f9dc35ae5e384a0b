"""HJIF: values by hand, and the level of waves that the test makes itself."""

import io
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy.io import wavfile

from controller.content.pattern import Pattern, Transient
from model.errors import InputError

Read = Callable[..., Pattern]


def effect(position: int, *keyframes: tuple[int, float, int], **more: Any) -> dict[str, Any]:
    """An effect of keyframes: position, amplitude and frequency."""
    names = ("relative_position", "amplitude_modulation", "frequency_modulation")
    frames = [dict(zip(names, each, strict=True)) for each in keyframes]
    return {"effect_type": "Basis", "position": position, "keyframes": frames, **more}


def band(kind: str, *effects: dict[str, Any], **more: Any) -> dict[str, Any]:
    """A band of 65 to 300 Hz."""
    limits = {"lower_frequency_limit": 65, "upper_frequency_limit": 300}
    return {"band_type": kind, **limits, "effects": list(effects), **more}


def hjif(*channels: list[dict[str, Any]], library: Any = (), **more: Any) -> dict[str, Any]:
    """A file of channels of bands, of half the gain; first a perception of warmth."""
    made = [{"gain": 0.5, "bands": each} for each in channels]
    warmth = {"perception_modality": "Temperature", "channels": made[:1]}
    touch = {
        "perception_modality": "Vibrotactile",
        "effect_library": list(library),
        "channels": made,
    }
    return {"version": "2023", "profile": "Main", "perceptions": [warmth, touch], **more}


def test_bands_of_one_channel(read: Read) -> None:
    """Ticks of 1/100 s; a reference plays at its own place; a square wave has 3 dB more power."""
    library = [effect(7, (0, 0.6, 65), (10, 1.0, 300), id=3)]
    square = effect(50, (0, 0.2, 65), (10, 0.2, 65), base_signal="Square")
    pattern = read(
        "hjif",
        hjif(
            [],
            [
                band(
                    "VectorialWave", {"effect_type": "Reference", "id": 3, "position": 20}, square
                ),
                band("Transient", effect(10, (5, 0.8, 182.5), (60, -0.4, 400))),
            ],
            library=library,
            timescale=100,
        ),
        channel=2,
    )
    two = 0.1 * 2**0.5
    assert pattern.intensity == tuple(
        pytest.approx(each)
        for each in ((0.2, 0.3), (0.3, 0.5), (0.3, 0), (0.5, 0), (0.5, two), (0.6, two))
    )
    assert pattern.sharpness == ((0.2, 0.0), (0.3, 1.0), (0.5, 0.0), (0.6, 0.0))
    assert pattern.transients == (Transient(0.15, 0.4, 0.5), Transient(0.7, 0.2, 1.0))
    assert pattern.duration == 0.7
    assert pattern.remarks == (
        "channel 2 of 2 read",
        "perceptions of 'Temperature' left out",
        "1 frequency outside 65 to 300 Hz moved to the nearest of these",
    )


def test_what_is_not_played_is_said(read: Read) -> None:
    """Keys that would be felt, curves drawn otherwise, forms without effect, moments; no titles."""
    frames = (0, 0.5, 100), (20, 0.9, 100)
    bands = [
        band("Curve", effect(0, *frames), curve_type="Akima"),
        band("Transient", effect(0, *frames, base_signal="Square", phase=1.0)),
        band("VectorialWave", effect(0), effect(0, (0, 0.5, 100))),
    ]
    own = effect(0, *frames) | {"effect_type": "Reference", "id": 3}
    bands.append(band("VectorialWave", own, id=1))
    given = hjif(bands, library=[effect(0, *frames, id=3)], syncs=[{"timestamp": 9}], level=1)
    given["perceptions"][1] |= {"description": "Rain", "vertices": [1], "avatars": []}
    remarks = {each for each in read("hjif", given).remarks if "energy" not in each}
    assert remarks == {
        "perceptions of 'Temperature' left out",
        "2 unknown keys ignored: syncs, vertices",
        "curve: Akima drawn as Cubic",
        "curve: frequencies of keyframes left out",
        "base_signal of Transient left out",
        "effects without a duration or keyframes left out",
        "keyframes of references left out",
    }


@pytest.mark.parametrize("seed", range(3))
def test_level_over_time_is_that_of_the_wave(read: Read, seed: int) -> None:
    """Of HJIF, of the curve and of the WAV that are the same wave: within 1.5 dB in each 20 ms.

    The wave is the sum of a sine and its amplitude, reckoned here at 8 kHz.
    """
    rng = np.random.default_rng(seed)
    ticks = np.arange(0, 1001, 100)
    levels = rng.uniform(0.2, 1.0, len(ticks))
    hertz = int(rng.integers(120, 260))
    time = np.arange(8000) / 8000
    wave = np.interp(time, ticks / 1000, levels) * np.sin(2 * np.pi * hertz * time)
    rms = np.sqrt(2 * (wave**2).reshape(-1, 160).mean(axis=1))
    frames = [(int(t), a, hertz) for t, a in zip(ticks, levels, strict=True)]
    file = io.BytesIO()
    wavfile.write(file, 8000, wave.astype(np.float32))
    samples = [
        {"relative_position": n, "amplitude_modulation": a} for n, a in enumerate(wave.tolist())
    ]
    curve = effect(0) | {"keyframes": samples}
    linear = hjif([band("Curve", curve, curve_type="Linear")], timescale=8000)
    patterns = (
        (2, read("hjif", hjif([band("VectorialWave", effect(0, *frames))]))),
        (2, read("hjif", linear)),
        (1, read("wav", file.getvalue())),
    )
    for gain, pattern in patterns:
        times, given = np.array(pattern.intensity).T
        course = gain * np.interp(time, times, given)
        level = np.sqrt((course**2).reshape(-1, 160).mean(axis=1))
        assert abs(20 * np.log10(level / rms)).max() < 1.5
        sharpness = np.median([value for _, value in pattern.sharpness])
        assert sharpness == pytest.approx((hertz - 65) / 235, abs=0.01)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        (hjif([], version="2025"), r"version: must be 2023, got '2025'"),
        (hjif([], profile="Other"), r"profile: must be Main or Simple Parametric, got 'Other'"),
        (hjif(), r"has no channel of vibration"),
        (
            hjif([band("WaveletWave")]),
            r":\d+: perceptions\[1\]\.channels\[0\]\.bands\[0\]\.band_type: bands of wavelets are "
            r"not read; .*Synthesizer",
        ),
        (
            hjif([band("Transient", {"effect_type": "Reference", "id": 5})]),
            r"effects\[0\]\.id: must be an effect of the library",
        ),
        (hjif([band("Transient", effect(0, (5, 1, 90), (0, 1, 90)))]), r"keyframes: must be in o"),
        (hjif([band("Transient", effect(61_000, (0, 1, 90)))]), r"effects\[0\]: must end within"),
        (
            hjif([band("Transient", {"effect_type": "Composite"})]),
            r"effect_type: composite effects are not read",
        ),
        pytest.param(  # 10 of a minute each: of ten thousand it would be minutes of work
            hjif(
                [band("Curve", *[{"effect_type": "Reference", "id": 3}] * 10)],
                library=[effect(0, (0, 1, 90), (60_000, 1, 90), id=3)],
            ),
            r":\d+: .*effects\[9\]: has too many curves, or too long ones",
            id="curves",
        ),
    ],
)
def test_refusal_has_line_and_key(read: Read, given: dict[str, Any], words: str) -> None:
    """What is not read is named, with what to do."""
    with pytest.raises(InputError, match=words):
        read("hjif", given)
