"""Avoidance of long garbage collections."""

import gc

from drivers.operation.steady import no_long_collections


def is_looked_at(thing: object) -> bool:
    """Whether a full collection looks at an object."""
    return any(one is thing for one in gc.get_objects())


def test_present_objects_are_frozen_during_the_context() -> None:
    """What was there before is not looked at, what comes later is; afterwards both are."""
    before = [object()]
    assert is_looked_at(before)
    with no_long_collections():
        later = [object()]
        assert not is_looked_at(before)
        assert is_looked_at(later)
    assert is_looked_at(before)
    assert gc.get_freeze_count() == 0
