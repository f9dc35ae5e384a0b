"""Places as people type them, where they have another unit in mind."""

import pytest

from model.config.points import in_metres


@pytest.mark.parametrize(
    ("place", "says"),
    [
        ((8.0, 6.0), "; places are in metres: for 8 cm, 6 cm give 0.08,0.06"),
        ((20.0, 0.0), "; places are in metres: for 20 cm, 0 cm give 0.2,0"),
        ((80.0, 60.0), "; places are in metres: for 80 mm, 60 mm give 0.08,0.06"),
        ((0.4, 0.1), ""),
        ((1.0, 0.1), ""),
        ((-8.0, 6.0), ""),
        ((800.0, 6.0), ""),
        ((float("nan"), 6.0), ""),
        ((float("inf"), 6.0), ""),
    ],
)
def test_smaller_units_are_seen_where_they_fit_on_the_plate(
    place: tuple[float, float], says: str
) -> None:
    """On 0.3 m by 0.2 m; 0.4 m is beside it, and no finger is half a centimetre from a corner."""
    assert in_metres(*place, length=0.3, width=0.2) == says
