"""Pauses between attempts."""

from itertools import islice

import pytest

from drivers.operation.pauses import pauses


def test_pauses_grow_up_to_a_limit() -> None:
    """Each twice the one before: 0.1, 0.2, ... 5 s."""
    assert list(islice(pauses(), 8)) == pytest.approx([0.1, 0.2, 0.4, 0.8, 1.6, 3.2, 5.0, 5.0])
