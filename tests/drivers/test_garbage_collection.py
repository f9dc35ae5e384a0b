"""Avoidance of long garbage collections."""

import gc

from drivers.garbage_collection import no_long_collections, without_collections


def test_present_objects_are_frozen_during_the_context() -> None:
    """All objects present at its start, and none afterwards."""
    with no_long_collections():
        assert gc.get_freeze_count() > 1000
    assert gc.get_freeze_count() == 0


def test_objects_built_without_collections_are_never_visited() -> None:
    """Many are frozen; of few nothing is, or the garbage of repeated failures would pile up."""
    try:
        for count, is_frozen in ((1_000, False), (100_000, True)):
            gc.collect()
            gc.unfreeze()
            with without_collections():
                assert not gc.isenabled()
                built = [[number] for number in range(count)]
            assert gc.isenabled()
            assert (gc.get_freeze_count() >= len(built)) is is_frozen
    finally:
        gc.unfreeze()
