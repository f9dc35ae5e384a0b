"""Damaged frames into every codec, some thousands; `make fuzz` takes a million each."""

import pytest

from mutation import CODECS, attack


@pytest.mark.parametrize("name", CODECS)
def test_damaged_frames_do_no_harm(name: str) -> None:
    """No exception, no hang, nothing beyond the protocol's limits; and some are understood."""
    codec = CODECS[name]()
    assert attack(codec, 4000, seed=7) > 100
