"""AHAP files as Apple documents them, against values calculated by hand."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from controller.content.pattern import Curve, Pattern, Transient

Read = Callable[..., Pattern]


def event(kind: str, time: float, duration: float = 0.0, **values: float) -> dict[str, Any]:
    """Return an event with its parameters."""
    parameters = []
    for name, value in values.items():
        parameters.append({"ParameterID": name, "ParameterValue": value})
    return {
        "Event": {
            "EventType": f"Haptic{kind}",
            "Time": time,
            "EventDuration": duration,
            "EventParameters": parameters,
        }
    }


def control(name: str, time: float, value: float) -> dict[str, Any]:
    """Return a control that is constant from a time on."""
    parameter = {"ParameterID": f"Haptic{name}Control", "ParameterValue": value, "Time": time}
    return {"Parameter": parameter}


def control_curve(name: str, time: float, *points: tuple[float, float]) -> dict[str, Any]:
    """Return the curve of a control, whose points are relative to its own time."""
    control_points = []
    for point_time, value in points:
        control_points.append({"Time": point_time, "ParameterValue": value})
    return {
        "ParameterCurve": {
            "ParameterID": f"Haptic{name}Control",
            "Time": time,
            "ParameterCurveControlPoints": control_points,
        }
    }


def ahap_file(*entries: dict[str, Any]) -> dict[str, Any]:
    """Return a file with events and parameters."""
    return {"Version": 1.0, "Pattern": [*entries]}


def assert_curve(curve: Curve, *points: tuple[float, float]) -> None:
    """Assert that a curve has these times and values, except for rounding."""
    assert np.array(curve) == pytest.approx(np.array(points))


def test_ahap_controls_multiply_intensity_and_add_to_sharpness(read: Read) -> None:
    """Of a continuous event and of a transient; the last value of a control remains."""
    pattern = read(
        "ahap",
        ahap_file(
            event("Continuous", 0.1, 0.4, HapticIntensity=0.8, HapticSharpness=0.3),
            event("Transient", 0.2, HapticIntensity=0.6, HapticSharpness=0.3),
            control_curve("Intensity", 0.1, (0.0, 1.0), (0.2, 0.5)),
            control("Sharpness", 0.15, 0.4),
        ),
    )

    assert_curve(pattern.intensity, (0.1, 0.8), (0.3, 0.4), (0.5, 0.4))
    assert_curve(pattern.sharpness, (0.1, 0.3), (0.15, 0.3), (0.15, 0.7), (0.5, 0.7))
    assert pattern.transients == (Transient(0.2, pytest.approx(0.6 * 0.75), 0.7),)
    assert pattern.duration == 0.5
    assert pattern.remarks == ()


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
def test_ahap_event_has_an_envelope(read: Read, values: dict[str, float], expected: Curve) -> None:
    """A value v of attack, decay or release is 10 ms x 100^v: 0.5 is 0.1 s, and 1 is 1 s."""
    pattern = read("ahap", ahap_file(event("Continuous", 1.0, 0.5, **values)))

    assert_curve(pattern.intensity, *expected)
    assert pattern.sharpness[0] == (1.0, 0.5)


def test_ahap_simultaneous_events_add_their_powers(read: Read) -> None:
    """0.3 and 0.4 are 0.5 with the sharpness of the stronger; 0.8 and 0.9 are limited to 1."""
    pattern = read(
        "ahap",
        ahap_file(
            event("Continuous", 0.0, 0.2, HapticIntensity=0.3, HapticSharpness=0.9),
            event("Continuous", 0.1, 0.2, HapticIntensity=0.4, HapticSharpness=0.2),
            event("Continuous", 0.4, 0.1, HapticIntensity=0.8),
            event("Continuous", 0.4, 0.1, HapticIntensity=0.9),
        ),
    )

    steps = [(0.0, 0.3), (0.1, 0.3), (0.1, 0.5), (0.2, 0.5), (0.2, 0.4), (0.3, 0.4), (0.3, 0.0)]
    assert_curve(pattern.intensity, *steps, (0.4, 0.0), (0.4, 1.0), (0.5, 1.0))
    assert_curve(pattern.sharpness[:4], (0.0, 0.9), (0.1, 0.9), (0.1, 0.2), (0.3, 0.2))


def test_ahap_later_curve_replaces_the_rest_of_an_earlier_one(read: Read) -> None:
    """From its own beginning on, whatever the order in the file."""
    later = control_curve("Intensity", 0.2, (0.0, 0.0))
    earlier = control_curve("Intensity", 0.0, (0.0, 1.0), (0.4, 0.0))

    pattern = read("ahap", ahap_file(event("Continuous", 0.0, 0.3), later, earlier))

    assert_curve(pattern.intensity, (0.0, 1.0), (0.2, 0.5), (0.2, 0.0), (0.3, 0.0))


@pytest.mark.parametrize(
    ("first", "last", "expected"),
    [(0.8, 0.8, (0.9, 0.9)), (0.0, 1.0, (0.1, 0.85)), (1.0, 1.0, (1.0, 1.0))],
)
def test_ahap_sharpness_curve_is_added_to_transients(
    read: Read, first: float, last: float, expected: tuple[float, float]
) -> None:
    """Two taps of 0.1, at 0 and 0.3 s of a line over 0.4 s; the sum is limited to 1."""
    taps = [event("Transient", time, HapticSharpness=0.1) for time in (0.0, 0.3)]
    line = control_curve("Sharpness", 0.0, (0.0, first), (0.4, last))

    pattern = read("ahap", ahap_file(*taps, line))

    assert [tap.sharpness for tap in pattern.transients] == pytest.approx(expected)
    assert pattern.remarks == ()


def test_ahap_remarks_name_what_apple_ignores(read: Read) -> None:
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


def test_ahap_remarks_name_what_a_transient_cannot_have(read: Read) -> None:
    """Envelopes, durations and the controls of envelopes; and a curve without points."""
    attack = control_curve("AttackTime", 0.0, (0.0, 0.5))
    transients = ahap_file(
        event("Transient", 0.0, 0.2, AttackTime=0.5),
        event("Transient", 0.1, 0.2),
        attack,
        control_curve("Intensity", 0.0),
    )
    continuous = ahap_file(event("Continuous", 0.0, 0.2, Sustained=0.0), attack)

    assert read("ahap", transients).remarks == (
        "1 envelope of a transient left out",
        "2 durations of transients left out",
        "1 curve without points left out",
        "1 HapticAttackTimeControl left out",
    )
    assert read("ahap", continuous).remarks == ()
