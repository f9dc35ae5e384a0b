"""A small table of the paper's plate, for tests of the Python API."""

import pytest

import era_haptics as era


@pytest.fixture(scope="session")
def table(tmp_path_factory: pytest.TempPathFactory) -> era.LocalizationTable:
    """A small table, in a cache of its own."""
    rig = era.load_rig(era.example_rig_path())
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
        return era.table(rig, drive_mode="phased", frequencies=[60, 110, 250], grid=era.Grid(4, 3))
