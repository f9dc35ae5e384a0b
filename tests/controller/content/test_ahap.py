"""AHAP as Apple documents it; all values by hand."""

from collections.abc import Callable
from typing import Any

import pytest

from controller.content.pattern import Curve, Pattern, Transient
from model.errors import InputError

Read = Callable[..., Pattern]


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
            {"ParameterID": "AudioPan", "ParameterValue": 9}, ]}},
          {"Event": {"EventType": "AudioCustom", "EventWaveformPath": "/etc/passwd"}},
        ],}""",
    )
    assert pattern.transients == (Transient(0.0, 1.0, 0.5),)
    assert pattern.remarks == (
        "1 unknown parameter left out",
        "1 audio event left out",
        "HapticIntensity: 1 value out of range clamped, from 1.5 to 1.5",
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


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('{"Version": 2, "Pattern": []}', r":1: Version: must be below 2, got 2"),
        ('{"Version": 1}', r":1: Pattern: missing; add it"),
        ('{"Pattern": [\n{"Event":\n{"Time": "x"}}]}', r":3: Pattern\[0\]\.Event\.Time: must be"),
        ('{"Pattern": [\n{"Event": {"Time": 1}}]}', r":2: Pattern\[0\]\.Event\.EventType: missing"),
        (
            '{"Pattern": [{}, \n{"Event": {"EventType": "HapticContinuous",'
            ' "EventDuration": 61}}]}',
            r":2: Pattern\[1\]: must end within 60 s, got 61 s",
        ),
    ],
)
def test_error_has_line_and_key(read: Read, text: str, words: str) -> None:
    """A later version, what is missing, of another type, or too long."""
    with pytest.raises(InputError, match=words):
        read("ahap", text)
