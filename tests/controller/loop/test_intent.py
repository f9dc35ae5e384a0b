"""When an intent is asked for again."""

import math

import pytest

from controller.loop.intent import HapticIntent


@pytest.mark.parametrize(
    ("until", "due"), [(None, None), (7.0, 7.0), (3.0, 5.001), (math.nan, 5.001)]
)
def test_due_of_an_expired_intent_is_later(until: float | None, due: float | None) -> None:
    """So that it does not keep the loop busy."""
    assert HapticIntent((), until=until).due(5.0) == due
