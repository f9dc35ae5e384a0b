"""The .haptic format, version 1; the values as its converter to AHAP has them, by hand."""

from collections.abc import Callable
from typing import Any

import pytest

from controller.content.pattern import Pattern, Transient
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
            r":16: signals\.continuous\.envelopes\.amplitude\[1\]\.time: must be at least that of "
            r"the point before, 0\.2, got 0\.1",
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
)
def test_refusal_has_line_and_key(read: Read, given: dict[str, Any], words: str) -> None:
    """Another version, and all that the format's own validation refuses."""
    with pytest.raises(InputError, match=words):
        read("haptic", given)
