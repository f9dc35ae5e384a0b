"""Positions given in another unit than metres."""

import pytest

from model.config.points import in_metres


@pytest.mark.parametrize(
    ("place", "remedy"),
    [
        ((8.0, 6.0), "0.08,0.06"),
        ((20.0, 0.0), "0.2,0"),
        ((80.0, 60.0), "0.08,0.06"),
        ((0.4, 0.1), ""),
        ((1.0, 0.1), ""),
        ((-8.0, 6.0), ""),
        ((800.0, 6.0), ""),
        ((float("nan"), 6.0), ""),
        ((float("inf"), 6.0), ""),
    ],
)
def test_in_metres_converts_places_that_smaller_units_put_on_the_plate(
    place: tuple[float, float], remedy: str
) -> None:
    """On 0.3 m by 0.2 m; 0.4 m is beside it, and no finger is half a centimetre from a corner."""
    assert in_metres(*place, length=0.3, width=0.2).rpartition(" ")[2] == remedy
