"""Formats of content and what a file of each becomes on a plate, by values worked out by hand.

AHAP as Apple documents it, .haptic of version 1 as its converter to AHAP has it, and HJIF with
waves that the tests make; files that are refused before their format reads them.
"""

import io
import math
import os
import random
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.io import wavfile

from controller.content.formats import (
    Ahap,
    named_content,
    named_contents,
    read_content,
)
from controller.content.pattern import Curve, Pattern, Transient
from controller.content.points import pattern_of_points
from controller.content.rendition import rendered, requested_level
from model.errors import InputError

Read = Callable[..., Pattern]


def haptic(*amplitude: dict[str, Any], major: int = 1, **more: Any) -> dict[str, Any]:
    """A file of envelopes."""
    envelopes = {"amplitude": list(amplitude), **more}
    signals = {"continuous": {"envelopes": envelopes}}
    return {"version": {"major": major, "minor": 9, "patch": 0}, "signals": signals}


def test_intensity_is_the_root_of_amplitude(read: Read) -> None:
    """So is the sharpness of what lasts; that of an emphasis is its frequency."""
    pattern = read(
        "haptic",
        haptic(
            {"time": 0, "amplitude": 0.25},
            {"time": 0.1, "amplitude": 0.04, "emphasis": {"amplitude": 0.49, "frequency": 0.3}},
            {"time": 0.2, "amplitude": 0.64, "new": 1},
            frequency=[{"time": 0.05, "frequency": 0.16}],
        ),
    )
    assert pattern == Pattern(
        0.2,
        ((0.0, 0.5), (0.1, 0.2), (0.2, 0.8)),
        ((0.05, 0.4),),
        (Transient(0.1, 0.7, 0.3),),
        ("1 unknown key ignored: new",),
    )


@pytest.mark.parametrize(
    ("given", "words"),
    [
        (haptic(major=2), r":3: version\.major: must be 1, got 2"),
        (haptic(major=0), r"version\.major: must be 1, got 0"),
        (haptic(), r"amplitude: must have at least 1 entry, got 0"),
        (haptic({"time": 0, "amplitude": 1.5}), r"amplitude\[0\]\.amplitude: must be at most 1"),
        (
            haptic({"time": 0.2, "amplitude": 0}, {"time": 0.1, "amplitude": 0}),
            r":16: signals\.continuous\.envelopes\.amplitude\[1\]\.time: must be at least 0\.2, "
            r"as at the previous point, got 0\.1",
        ),
        (
            haptic({"time": 0, "amplitude": 0.5, "emphasis": {"amplitude": 0.4, "frequency": 0.5}}),
            r":15: .*emphasis\.amplitude: must be at least the amplitude there, 0\.5, got 0\.4",
        ),
        (
            haptic({"time": 60.5, "amplitude": 0}, frequency=[{"time": 60.4, "frequency": 0}]),
            r"^\S+:\d+: signals\.continuous\.envelopes\.amplitude\[0\]: must end within 60 s",
        ),
    ],
    ids=["newer", "older", "empty", "loud", "backwards", "weak emphasis", "long"],
)
def test_refusal_has_line_and_key(read: Read, given: dict[str, Any], words: str) -> None:
    """Another version, and all that the format's own validation refuses."""
    with pytest.raises(InputError, match=words):
        read("haptic", given)


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
        "1 frequency outside 65 to 300 Hz moved to the nearest limit",
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
            r":\d+: perceptions\[1\]\.channels\[0\]\.bands\[0\]\.band_type: wavelet bands are "
            r"not supported; .*Synthesizer",
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
def test_hjif_refusal_has_line_and_key(read: Read, given: dict[str, Any], words: str) -> None:
    """What is not read is named, with what to do."""
    with pytest.raises(InputError, match=words):
        read("hjif", given)


EVERY_10_HZ = np.arange(40.0, 321.0, 10.0)
SECOND = Pattern(1.0, ((0.0, 1.0), (1.0, 1.0)), ((0.0, 0.5),))


@pytest.mark.parametrize(
    ("intensity", "level", "felt"),
    [(1.0, 20.0, 20.0), (0.5, 20.0, 15.0), (0.5, 30.0, 20.0), (0.01, 20.0, 10.1), (0.5, 4.0, 4.0)],
)
def test_intensity_is_a_level_from_10_db_sl_on(intensity: float, level: float, felt: float) -> None:
    """10 + i (level - 10) dB SL of what lasts and of taps, and never above the level itself."""
    steady = replace(SECOND, intensity=((0.0, intensity), (1.0, intensity)))
    assert rendered(steady, level, EVERY_10_HZ).level_db_sl == pytest.approx(felt)
    (tap,) = rendered(
        Pattern(0.0, (), (), (Transient(0.0, intensity, 0.5),)), level, EVERY_10_HZ
    ).clicks
    assert tap.level_db_sl == pytest.approx(felt)


def test_course_follows_levels_in_decibels_and_is_silent_at_0() -> None:
    """From intensity 1 to 0.5 of 20 dB SL are 5 dB, a share of 0.562; of 0 nothing is left."""
    pattern = Pattern(1.0, ((0.0, 1.0), (0.4, 1.0), (0.4, 0.5), (0.8, 0.5), (0.8, 0.0), (1.0, 0.0)))
    course = rendered(pattern, 20.0, EVERY_10_HZ).course
    shares = course.at(np.array([0.2, 0.6, 0.9]))
    assert shares == pytest.approx([1.0, 10 ** (-5 / 20), 0.0])


@pytest.mark.parametrize(
    ("sharpness", "spacing", "band"),
    [
        (0.0, 10.0, (58.5, 80.0)),  # 65 Hz: the nearest three are 60, 70 and 80
        (0.5, 10.0, (164.25, 200.75)),  # 182.5 Hz, of which 10 % hold three
        (0.5, 50.0, (140.0, 240.0)),  # of 40, 90, 140, 190, 240: the nearest three
        (1.0, 10.0, (270.0, 330.0)),
    ],
)
def test_sharpness_is_a_band_that_has_three_frequencies(
    sharpness: float, spacing: float, band: tuple[float, float]
) -> None:
    """65 to 300 Hz with 10 % on each side, of what lasts and of taps."""
    frequencies = np.arange(40.0, 321.0, spacing)
    tap = Transient(0.5, 1.0, sharpness)
    pattern = replace(SECOND, sharpness=((0.0, sharpness),), transients=(tap,))
    found = rendered(pattern, 20.0, frequencies)
    assert found.band == pytest.approx(band)
    assert found.clicks[0].band == pytest.approx(band)


def test_what_lasts_has_one_band_where_most_of_its_energy_is() -> None:
    """0.7 s at 206 Hz and 0.3 s at 253 Hz: the band of 206 Hz, and 30 % is said to be lost."""
    pattern = replace(SECOND, sharpness=((0.0, 0.6), (0.7, 0.6), (0.7, 0.8), (1.0, 0.8)))
    found = rendered(pattern, 20.0, EVERY_10_HZ)
    assert found.band == pytest.approx((0.9 * 206, 1.1 * 206))
    assert found.remarks == (
        "sharpness of 30 % of the continuous part: 206 to 253 Hz in the file, one frequency here",
    )


def test_what_lasts_fades_for_30_ms_around_a_tap_of_40_ms() -> None:
    """Half of it 15 ms before a tap and 15 ms after its end, nothing within it."""
    pattern = replace(SECOND, transients=(Transient(0.5, 1.0, 0.5),))
    found = rendered(pattern, 20.0, EVERY_10_HZ)
    shares = found.course.at(np.array([0.46, 0.485, 0.5, 0.54, 0.555, 0.58]))
    assert shares == pytest.approx([1.0, 0.5, 0.0, 0.0, 0.5, 1.0])
    assert found.remarks == ("the continuous part, 30 ms before and after each tap",)


def test_of_taps_closer_than_60_ms_the_strongest_stay() -> None:
    """A rising row 50 ms apart keeps every other one; what lasts has the others, where it may."""
    row = [Transient(0.05 * number, 0.2 * number, 0.0) for number in range(5)]
    found = rendered(Pattern(1.0, transients=tuple(row)), 20.0, EVERY_10_HZ)
    assert [each.time for each in found.clicks] == pytest.approx([0.1, 0.2])
    assert found.remarks[0] == (
        "2 of 4 taps, less than 60 ms from a stronger one: moved into the continuous part"
    )
    assert found.level_db_sl == pytest.approx(16.0)
    shares = found.course.at(np.array([0.07, 0.155, 0.17, 0.3]))
    assert shares == pytest.approx([10 ** (-4 / 20), 0.5, 1.0, 0.0])


def test_what_lasts_20_ms_is_a_tap() -> None:
    """It would be over before a plate follows; a tap is raised so that it is felt."""
    pattern = Pattern(0.3, ((0.0, 0.0), (0.1, 0.0), (0.1, 0.8), (0.12, 0.8), (0.12, 0.0)))
    found = rendered(pattern, 20.0, EVERY_10_HZ)
    assert found.course is None
    (tap,) = found.clicks
    assert (tap.time, tap.level_db_sl) == pytest.approx((0.1, 18.0))


def test_beside_others_bands_reach_a_third_of_an_octave() -> None:
    """From 206 Hz up to 259.5 and, from 10 % below it, by as much down to 161.9; taps alike."""
    pattern = replace(SECOND, sharpness=((0.0, 0.6),), transients=(Transient(0.5, 1.0, 0.6),))
    found = rendered(pattern, 20.0, EVERY_10_HZ).smoothed()
    assert found.band == pytest.approx((161.9, 259.5), abs=0.1)
    assert found.clicks[0].band == pytest.approx((161.9, 259.5), abs=0.1)


@pytest.mark.parametrize(("hertz", "is_texture"), [(25.0, True), (4.0, False)])
def test_modulation_of_10_to_30_hz_is_a_texture_that_smoothing_keeps(
    hertz: float, is_texture: bool
) -> None:
    """Comes and goes 25 times a second: of that the average of 20 ms would leave the half."""
    times = np.linspace(0, 1, 401)
    wave = np.sin(2 * np.pi * hertz * times)
    levels = 20 * np.log10(0.6 + 0.4 * wave)  # to the highest
    intensity = np.clip(1 + levels / 10, 1e-6, 1)
    pattern = Pattern(1.0, tuple(zip(times.tolist(), intensity.tolist(), strict=True)))
    found = rendered(pattern, 20.0, EVERY_10_HZ)
    assert (found.modulation_hz is not None) is is_texture
    if not is_texture:
        return
    assert found.modulation_hz == pytest.approx(hertz, abs=1)
    for each in (found, found.smoothed()):
        middle = each.course.at(np.arange(0.2, 0.8, 0.005))
        depth = (middle.max() - middle.min()) / (middle.max() + middle.min())
        assert depth == pytest.approx((1 - 0.32) / 1.32, abs=0.1)  # not below 10 dB SL


def test_wanted_levels_are_of_all_taps_and_of_what_lasts_between() -> None:
    """Taps that are merged are wanted all the same; what lasts pauses for them, 6 dB at half."""
    taps = Transient(0.5, 1.0, 0.5), Transient(0.53, 0.5, 0.5)
    pattern = replace(SECOND, intensity=((0.0, 0.5), (1.0, 0.5)), transients=taps)
    times = np.array([0.2, 0.485, 0.5, 0.539, 0.55, 0.585, 1.2])
    levels = requested_level(pattern, 20.0, times)
    assert levels == pytest.approx([15.0, 9.0, 20.0, 20.0, 15.0, 9.0, -np.inf], abs=0.03)


def event(kind: str, time: float, duration: float = 0.0, **values: float) -> dict[str, Any]:
    """An event with its parameters."""
    parameters = [{"ParameterID": name, "ParameterValue": v} for name, v in values.items()]
    return {
        "Event": {
            "EventType": f"Haptic{kind}",
            "Time": time,
            "EventDuration": duration,
            "EventParameters": parameters,
        }
    }


def curve(name: str, time: float, *points: tuple[float, float]) -> dict[str, Any]:
    """A curve of a control, whose points count from its own time."""
    given = [{"Time": at, "ParameterValue": value} for at, value in points]
    return {
        "ParameterCurve": {
            "ParameterID": f"Haptic{name}Control",
            "Time": time,
            "ParameterCurveControlPoints": given,
        }
    }


def near(*points: tuple[float, float]) -> tuple[Any, ...]:
    """The same curve but for rounding."""
    return tuple(pytest.approx(point) for point in points)


def test_controls_multiply_intensity_and_add_to_sharpness(read: Read) -> None:
    """Of what lasts and of a transient; what is last holds on."""
    pattern = read(
        "ahap",
        {
            "Version": 1.0,
            "Pattern": [
                event("Continuous", 0.1, 0.4, HapticIntensity=0.8, HapticSharpness=0.3),
                event("Transient", 0.2, HapticIntensity=0.6, HapticSharpness=0.3),
                curve("Intensity", 0.1, (0.0, 1.0), (0.2, 0.5)),
                {
                    "Parameter": {
                        "ParameterID": "HapticSharpnessControl",
                        "ParameterValue": 0.4,
                        "Time": 0.15,
                    }
                },
            ],
        },
    )
    assert pattern.intensity == near((0.1, 0.8), (0.3, 0.4), (0.5, 0.4))
    assert pattern.sharpness == near((0.1, 0.3), (0.15, 0.3), (0.15, 0.7), (0.5, 0.7))
    assert pattern.transients == (Transient(0.2, pytest.approx(0.6 * 0.75), 0.7),)
    assert (pattern.duration, pattern.remarks) == (0.5, ())


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ({"AttackTime": 0.5}, ((1.0, 0.0), (1.1, 1.0), (1.5, 1.0))),
        ({"ReleaseTime": 0.5}, ((1.0, 1.0), (1.5, 1.0), (1.6, 0.0))),
        ({"Sustained": 0.0, "DecayTime": 0.5}, ((1.0, 1.0), (1.1, 0.0))),
        (
            {"Sustained": 0.0, "DecayTime": 1.0, "AttackTime": 0.5},
            ((1.0, 0.0), (1.1, 1.0), (1.5, 0.6)),
        ),
    ],
    ids=["attack", "release", "decay", "attack and decay"],
)
def test_envelope_of_an_event(read: Read, values: dict[str, float], expected: Curve) -> None:
    """Half of attack, decay or release is 0.1 s, all of it 1 s: 10 ms times 100 to that power."""
    pattern = read("ahap", {"Pattern": [event("Continuous", 1.0, 0.5, **values)]})
    assert pattern.intensity == near(*expected)
    assert pattern.sharpness[0] == (1.0, 0.5)


def test_events_together_add_as_powers(read: Read) -> None:
    """0.3 and 0.4 are 0.5 with the sharpness of the stronger; 0.8 and 0.9 are limited to 1."""
    pattern = read(
        "ahap",
        {
            "Pattern": [
                event("Continuous", 0.0, 0.2, HapticIntensity=0.3, HapticSharpness=0.9),
                event("Continuous", 0.1, 0.2, HapticIntensity=0.4, HapticSharpness=0.2),
                event("Continuous", 0.4, 0.1, HapticIntensity=0.8),
                event("Continuous", 0.4, 0.1, HapticIntensity=0.9),
            ]
        },
    )
    steps = [(0.0, 0.3), (0.1, 0.3), (0.1, 0.5), (0.2, 0.5), (0.2, 0.4), (0.3, 0.4), (0.3, 0.0)]
    assert pattern.intensity == near(*steps, (0.4, 0.0), (0.4, 1.0), (0.5, 1.0))
    assert pattern.sharpness[:4] == near((0.0, 0.9), (0.1, 0.9), (0.1, 0.2), (0.3, 0.2))


def test_later_curve_replaces_the_rest_of_an_earlier_one(read: Read) -> None:
    """From its own beginning on."""
    curves = [curve("Intensity", 0.2, (0.0, 0.0)), curve("Intensity", 0.0, (0.0, 1.0), (0.4, 0.0))]
    pattern = read("ahap", {"Pattern": [event("Continuous", 0.0, 0.3), *curves]})
    assert pattern.intensity == near((0.0, 1.0), (0.2, 0.5), (0.2, 0.0), (0.3, 0.0))


def test_what_apple_ignores_passes_and_is_said(read: Read) -> None:
    """Trailing commas, defaults, values out of range, unknown keys and parameters, audio."""
    pattern = read(
        "ahap",
        """{"Pattern": [
          {"Event": {"EventType": "HapticTransient", "Colour": "blue, ]", "EventParameters": [
            {"ParameterID": "HapticIntensity", "ParameterValue": 1.5},
            {"ParameterID": "HapticSharpness"},
            {"ParameterID": "HapticIntensty", "ParameterValue": 1},
            {"ParameterID": "AudioPan", "ParameterValue": 9}, ]}},
          {"Parameter": {"ParameterID": "Flavour\\u001b", "Time": 0, "ParameterValue": 1}},
          {"Event": {"EventType": "AudioCustom", "EventWaveformPath": "/etc/passwd"}},
        ],}""",
    )
    assert pattern.transients == (Transient(0.0, 1.0, 0.5),)
    assert pattern.remarks == (
        "2 unknown parameters left out: HapticIntensty (did you mean HapticIntensity?), "
        "'Flavour\\x1b'",
        "1 audio parameter left out: AudioPan",
        "1 audio event left out",
        "HapticIntensity: 1 value out of range clamped, got 1.5",
        "1 unknown key ignored: Colour",
    )


@pytest.mark.parametrize(
    ("sharpness", "expected"),
    [((0.8, 0.8), (0.9, 0.9)), ((0.0, 1.0), (0.1, 0.85)), ((1, 1), (1, 1))],
)
def test_a_sharpness_curve_is_added_to_transients(
    read: Read, sharpness: tuple[float, float], expected: tuple[float, float]
) -> None:
    """Taps of 0.1 at 0 and 0.3 s below a line over 0.4 s: its value there more, up to 1."""
    taps = [event("Transient", time, HapticSharpness=0.1) for time in (0.0, 0.3)]
    line = curve("Sharpness", 0.0, (0.0, sharpness[0]), (0.4, sharpness[1]))
    pattern = read("ahap", {"Pattern": [*taps, line]})
    assert [each.sharpness for each in pattern.transients] == pytest.approx(expected)
    assert pattern.remarks == ()


def test_what_no_transient_has_is_said(read: Read) -> None:
    """Envelopes, durations, and their controls where nothing lasts; a curve without points."""
    given = [
        event("Transient", 0.0, 0.2, AttackTime=0.5),
        event("Transient", 0.1, 0.2),
        curve("AttackTime", 0.0, (0.0, 0.5)),
        curve("Intensity", 0.0),
    ]
    assert read("ahap", {"Pattern": given}).remarks == (
        "1 envelope of a transient left out",
        "2 durations of transients left out",
        "1 curve without points left out",
        "1 HapticAttackTimeControl left out",
    )
    lasting = event("Continuous", 0.0, 0.2, Sustained=0.0)
    assert read("ahap", {"Pattern": [lasting, given[2]]}).remarks == ()


PARTS = [
    b"[" * 30,
    b'{"a":' * 30,
    b'"',
    b"\\",
    b"NaN",
    b"1e999",
    b"9" * 5000,
    b"\xff",
    b"null",
    b",",
]


def test_named_contents_are_felt(tmp_path: Path) -> None:
    """Every one has something to feel within a second, and nothing of it is left out."""
    assert named_contents() == ("click", "error", "selection", "success", "tick", "warning")
    for name in named_contents():
        pattern = read_content(named_content(name))
        assert max([*(v for _, v in pattern.intensity), *(t.intensity for t in pattern.transients)])
        assert pattern.duration < 1
        assert pattern.remarks == ()
    with pytest.raises(InputError, match="unknown content 'clik'; did you mean click"):
        named_content("clik")


@pytest.mark.parametrize(
    ("ending", "given", "words"),
    [
        ("vij", "", "version 0 of the .haptic format"),
        ("hmpg", "", "binary form of HJIF; .* `Decoder -f .* `Synthesizer -b"),
        ("mp3", "", "unknown format of content 'mp3'; known: ahap, haptic, hjif, wav"),
        ("ahap", b" " * (4 << 20) + b"{}", "must be up to 4 MiB long; shorten the content"),
        ("ahap", "[]", ":1: must be an object in braces"),
        (
            "ahap",
            '{\n"Pattern": [1 2]}',
            ":2: is not valid JSON: Expecting ',' delimiter in column 15; correct it there",
        ),
        (
            "ahap",
            '{"Pattern": []}\0\0',
            r":1: nothing must follow the end .* got '\\x00\\x00'",
        ),
        (
            "hjif",
            '{"a": 1}\n# end\n',
            r":2: nothing must follow the end .* got '# end\\n' in column 1; remove it",
        ),
        ("ahap", '{"Pattern": [', ":1: is not valid JSON: .*; its end is missing: export it again"),
        ("haptic", b" " * (2 << 20) + b"{}", "is larger than 2 MiB; shorten the content"),
        ("haptic", '{"a": [1,]}', "is not valid JSON"),
        ("ahap", b'{\n"\xff"}', ":2: byte 0xff is not valid UTF-8"),
        ("ahap", '{"a":\n' + "[" * 20 + "]" * 20 + "}", ":2: is nested more than 20 levels deep"),
        pytest.param(
            "ahap",
            '{"a": [' + "0," * 99_999 + "0]}",
            "has more than 100000 values",
            id="too many values",
        ),
        (
            "ahap",
            '{"Pattern": [{\n"b": 1,\n"b": 2}]}',
            r":3: Pattern\[0\]\.b: is given twice, .* 2",
        ),
        ("ahap", '{"Pattern": [],\n"Version": NaN}', ":2: Version: must be a finite number"),
        ("ahap", '{"Pattern": [],\n"Version": 1e999}', ":2: Version: must be a finite number"),
    ],
)
def test_refusal_before_a_format_reads(
    read: Read, ending: str, given: str | bytes, words: str
) -> None:
    """Other endings, what is too much, no JSON, or given twice: with the line and the key."""
    with pytest.raises(InputError, match=words):
        read(ending, given)


def test_files_that_are_none(tmp_path: Path) -> None:
    """A folder, a missing file and a pipe are refused without waiting; so is a channel of AHAP."""
    for name, make in (("folder", Path.mkdir), ("missing", None), ("pipe", os.mkfifo)):
        path = tmp_path / f"{name}.ahap"
        if make:
            make(path)
        with pytest.raises(InputError, match=r"\.ahap: (is a folder|no such file|cannot be read)"):
            read_content(path)
    with pytest.raises(InputError, match=r"channel must be left out: \.ahap has no channels"):
        read_content(named_content("tick"), 1)
    with pytest.raises(InputError, match="channel must be at least 1, got 0"):
        read_content(named_content("error"), 0)


@pytest.mark.parametrize("name", named_contents())
def test_damaged_file_is_read_or_refused(read: Read, name: str) -> None:
    """Cut, with parts repeated, replaced or nested: InputError, or values within their bounds."""
    rng = random.Random(name)
    path = named_content(name)
    whole = path.read_bytes()
    for _ in range(150):
        at, end = sorted(rng.sample(range(len(whole)), 2))
        middle = rng.choice((b"", whole[at:end] * 3, rng.choice(PARTS)))
        damaged = whole[:at] + middle + whole[rng.choice((at, at + 1, end, len(whole))) :]
        with suppress(InputError):
            pattern = read(path.suffix[1:], damaged)
            values = [
                value for curve in (pattern.intensity, pattern.sharpness) for _, value in curve
            ]
            values += [each.intensity for each in pattern.transients]
            assert all(0 <= value <= 1 for value in values)
            assert 0 <= pattern.duration <= 60


@pytest.mark.parametrize(
    ("pattern", "words"),
    [
        (Pattern(-1.0), "must last 0 s or longer, got -1 s"),
        (Pattern(math.nan), "must last 0 s or longer, got nan s"),
        (Pattern(61.0), "must end within 60 s, got 61 s"),
        (Pattern(1.0, ((0.0, 3.0),)), r"intensity\[0\] must be 0 to 1, got 3 at 0 s"),
        (
            Pattern(1.0, (), ((0.0, 0.1), (0.5, math.nan))),
            r"sharpness\[1\] must be .* nan at 0.5 s",
        ),
        (Pattern(1.0, ((0.5, 1.0), (0.4, 1.0))), r"intensity\[1\] must be 0.5 to 60 s, got 0.4 s"),
        (
            Pattern(1.0, transients=(Transient(0.1, 1.0, 1.5),)),
            r"sharpness of transients\[0\] must be 0 to 1, got 1.5 at 0.1 s",
        ),
    ],
    ids=["backwards", "no number", "long", "too strong", "no sharpness", "order", "transient"],
)
def test_what_a_format_makes_is_within_bounds(
    read: Read, monkeypatch: pytest.MonkeyPatch, pattern: Pattern, words: str
) -> None:
    """Or the file is refused: an intensity of 3 would be felt 20 dB above its level."""
    monkeypatch.setattr(Ahap, "read", lambda *_: pattern)
    with pytest.raises(InputError, match=rf"content\.ahap: .*{words}"):
        read("ahap", "")


def test_points_and_taps_of_a_program() -> None:
    """Both curves of the points, and taps; one out of place is named."""
    tap = (0.3, 1.0, 0.5)
    pattern = pattern_of_points([(0, 0.5, 1), (0.2, 1, 0)], [tap])
    taps = (Transient(*tap),)
    assert pattern == Pattern(0.3, ((0, 0.5), (0.2, 1)), ((0, 1), (0.2, 0)), taps)
    for points, words in (
        ([], "points and taps must be 1 to 500 together, got 0"),
        ([(0, 0, 0)] * 501, "points and taps must be 1 to 500 together, got 501"),
        ([(0, 0)], r"points\[0\] must be \[time_s, intensity, sharpness\], got 2 values"),
        ([(1, 0, 0), (0, 0, 0)], r"points\[1\] time_s must be 1 to 60, got 0"),
        ([(0, float("nan"), 0)], r"points\[0\] intensity must be 0 to 1, got nan"),
    ):
        with pytest.raises(InputError, match=words):
            pattern_of_points(points)
