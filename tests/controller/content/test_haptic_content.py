"""Files with the ending .haptic, version 1, as the format's converter to AHAP reads them."""

from collections.abc import Callable
from typing import Any

import pytest

from controller.content.pattern import Pattern, Transient
from model.errors import InputError

Read = Callable[..., Pattern]


def haptic_file(*amplitude: dict[str, Any], major: int = 1, **envelopes: Any) -> dict[str, Any]:
    """Return a file with an amplitude envelope and other envelopes."""
    return {
        "version": {"major": major, "minor": 9, "patch": 0},
        "signals": {"continuous": {"envelopes": {"amplitude": [*amplitude], **envelopes}}},
    }


def test_haptic_intensity_and_sharpness_are_roots_of_amplitude_and_frequency(read: Read) -> None:
    """The sharpness of an emphasis is its frequency itself."""
    emphasis = {"amplitude": 0.49, "frequency": 0.3}
    amplitude = (
        {"time": 0, "amplitude": 0.25},
        {"time": 0.1, "amplitude": 0.04, "emphasis": emphasis},
        {"time": 0.2, "amplitude": 0.64, "new": 1},
    )
    frequency = [{"time": 0.05, "frequency": 0.16}]

    pattern = read("haptic", haptic_file(*amplitude, frequency=frequency))

    assert pattern.duration == 0.2
    assert pattern.intensity == ((0.0, 0.5), (0.1, 0.2), (0.2, 0.8))
    assert pattern.sharpness == ((0.05, 0.4),)
    assert pattern.transients == (Transient(0.1, 0.7, 0.3),)
    assert pattern.remarks == ("1 unknown key ignored: new",)


WEAK_EMPHASIS = {"amplitude": 0.4, "frequency": 0.5}
REFUSED = {
    "newer": (haptic_file(major=2), r":3: version\.major: must be 1, got 2"),
    "older": (haptic_file(major=0), r"version\.major: must be 1, got 0"),
    "empty": (haptic_file(), r"amplitude: must have at least 1 entry, got 0"),
    "loud": (
        haptic_file({"time": 0, "amplitude": 1.5}),
        r"amplitude\[0\]\.amplitude: must be at most 1",
    ),
    "backwards": (
        haptic_file({"time": 0.2, "amplitude": 0}, {"time": 0.1, "amplitude": 0}),
        r":16: signals\.continuous\.envelopes\.amplitude\[1\]\.time: must be at least 0\.2, "
        r"as at the previous point, got 0\.1",
    ),
    "weak emphasis": (
        haptic_file({"time": 0, "amplitude": 0.5, "emphasis": WEAK_EMPHASIS}),
        r":15: .*emphasis\.amplitude: must be at least the amplitude there, 0\.5, got 0\.4",
    ),
    "long": (
        haptic_file({"time": 60.5, "amplitude": 0}, frequency=[{"time": 60.4, "frequency": 0}]),
        r"^\S+:\d+: signals\.continuous\.envelopes\.amplitude\[0\]: must end within 60 s",
    ),
}


@pytest.mark.parametrize("case", REFUSED)
def test_haptic_file_is_refused_with_line_and_key(read: Read, case: str) -> None:
    """Another version, and everything that the format's own validation refuses."""
    content, message = REFUSED[case]
    with pytest.raises(InputError, match=message):
        read("haptic", content)
