"""Avoidance of long garbage collections."""

import gc

from drivers.operation.steady import no_long_collections


def is_collected(thing: object) -> bool:
    """Whether a full collection visits an object."""
    return any(one is thing for one in gc.get_objects())


def test_present_objects_are_frozen_during_the_context() -> None:
    """Later ones are collected as usual; afterwards both are."""
    before = [object()]
    assert is_collected(before)
    with no_long_collections():
        later = [object()]
        assert not is_collected(before)
        assert is_collected(later)
    assert is_collected(before)
    assert gc.get_freeze_count() == 0
