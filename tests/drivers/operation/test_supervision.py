from itertools import islice

import pytest

from drivers.operation.supervision import assume_energised, pauses


def test_pauses_grow_up_to_a_limit() -> None:
    """Each twice the one before: 0.1, 0.2, ... 5 s."""
    assert list(islice(pauses(), 8)) == pytest.approx([0.1, 0.2, 0.4, 0.8, 1.6, 3.2, 5.0, 5.0])


def test_a_lost_amplifier_may_still_play_until_its_watchdog_has_passed() -> None:
    """And a margin of 100 ms."""
    assert assume_energised(10.0, 10.3, watchdog=0.25)
    assert not assume_energised(10.0, 10.36, watchdog=0.25)
