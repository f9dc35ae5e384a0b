"""What a table is built for where nobody says which frequencies."""

import numpy as np
import pytest

from model.rig.rig import Limits
from model.table.table import default_drive_frequencies


@pytest.mark.parametrize(
    ("low", "high", "expected"),
    [
        (40.0, 500.0, range(60, 321, 10)),
        (40.0, 300.0, range(60, 301, 10)),
        (75.0, 85.0, [80]),
        (400.0, 430.0, [400, 410, 420, 430]),
        (61.0, 69.0, [61]),
    ],
)
def test_they_are_those_of_the_paper_that_the_rig_may_play(
    low: float, high: float, expected: list[float]
) -> None:
    """60 to 320 Hz in steps of 10 (the paper's section 4) within the limits; never none at all."""
    found = default_drive_frequencies(Limits(frequency_min=low, frequency_max=high, level=1.0))
    np.testing.assert_array_equal(found, list(expected))
