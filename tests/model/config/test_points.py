"""Positions given in another unit than metres."""

import pytest

from model.config.points import in_metres, parse_frequencies
from model.errors import InputError


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
    """The plate is 0.3 m by 0.2 m; no finger is half a centimetre from a corner."""
    assert in_metres(*place, length=0.3, width=0.2).rpartition(" ")[2] == remedy


@pytest.mark.parametrize(
    "text", ["0:100:10", "100:60:10", "60:320:0", "60:320:1e-9", "60:nan:10", "60,110,60", "sixty"]
)
def test_parse_frequencies_refuses_what_is_no_range_or_list(text: str) -> None:
    """Ranges from zero, downwards or too fine, a frequency twice, and words are refused."""
    with pytest.raises(InputError, match="--frequencies"):
        parse_frequencies(text)
