"""Tables kept between runs, and never a wrong one."""

import os
from dataclasses import replace

import numpy as np
import pytest

from model import caching
from model.finger import Grid
from model.table import table_file
from model.table.table_file import cached_table
from plates import make_paper_rig


def quick_rig(nx, ny):
    """The paper's plate up to 100 Hz: five frequencies, solved quickly."""
    rig = make_paper_rig(nx, ny)
    return replace(rig, limits=replace(rig.limits, frequency_min=60.0, frequency_max=100.0))


RIG = quick_rig(12, 9)
FEW = {"frequencies": np.array([70.0, 80.0]), "grid": Grid(2, 2)}
STIFFER = replace(RIG, eras=(replace(RIG.eras[0], stiffness=18000.0), *RIG.eras[1:]))


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    """A cache folder of the test's own."""
    folder = tmp_path / "cache"
    monkeypatch.setattr(caching.platformdirs, "user_cache_path", lambda *_, **__: folder)
    return folder


@pytest.fixture
def builds(monkeypatch):
    """The problems that are solved."""
    solved = []
    solve = table_file.solve_table

    def counting(problem, **options):
        solved.append(problem)
        return solve(problem, **options)

    monkeypatch.setattr(table_file, "solve_table", counting)
    return solved


def test_cached_table_is_read_the_second_time(builds):
    """A rig is solved once; its wiring does not matter."""
    first, path = cached_table(RIG, **FEW)
    again, same = cached_table(replace(RIG, wiring={}, amplifiers={}), **FEW)
    assert (same, again.fingerprint) == (path, first.fingerprint)
    assert len(builds) == 1


def test_cached_table_is_built_for_each_rig_and_choice(builds):
    """Stiffness, mesh, limits, frequencies, grid and mode each decide a table."""
    choices = [
        (RIG, {}),
        (STIFFER, {}),
        (quick_rig(16, 12), {}),
        (replace(RIG, limits=replace(RIG.limits, frequency_max=200.0)), {}),
        (RIG, {"frequencies": np.array([70.0])}),
        (RIG, {"frequencies": np.array([70.0, 90.0])}),
        (RIG, {"grid": Grid(3, 2)}),
        (RIG, {"drive_mode": "phased"}),
    ]
    tables = [cached_table(rig, **FEW | options) for rig, options in choices]
    assert len(builds) == len({path for _, path in tables}) == len(choices)
    assert tables[5][0].frequencies.tolist() == [70.0, 90.0]
    assert tables[6][0].grid == Grid(3, 2)
    assert tables[7][0].drive_mode == "phased"


def test_cached_table_is_built_again_when_its_file_is_damaged_or_foreign(builds):
    """A flipped byte, no table at all, or the table of another rig costs a build."""
    _, path = cached_table(RIG, **FEW)
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    _, other = cached_table(STIFFER, **FEW)
    for content in (data, b"damaged", other.read_bytes()):
        path.write_bytes(content)
        table, again = cached_table(RIG, **FEW)
        assert (table.fingerprint, again) == (RIG.fingerprint, path)
    assert len(builds) == 2 + 3
    assert cached_table(RIG, **FEW)[1] == path
    assert len(builds) == 2 + 3


def test_cached_table_of_other_numerics_is_replaced(builds, monkeypatch, cache):
    """A table of another NUMERICS_VERSION is not used, and removed with the next that is kept."""
    with monkeypatch.context() as older:
        older.setattr(table_file, "NUMERICS_VERSION", 0)
        older.setattr(table_file, "_CURRENT", "table-4.0-")
        cached_table(RIG, **FEW)
    (cache / "table-0123456789abcdef.npz").touch()
    _, path = cached_table(RIG, **FEW)
    assert len(builds) == 2
    assert list(cache.iterdir()) == [path]


def test_cached_table_least_recently_used_is_removed(monkeypatch, cache):
    """Of three tables two stay, a read one among them."""
    monkeypatch.setattr(table_file, "MAX_CACHED_TABLES", 2)
    paths = []
    for age, frequency in ((200, 60.0), (100, 70.0)):
        paths.append(cached_table(RIG, frequencies=np.array([frequency]), grid=Grid(2, 2))[1])
        os.utime(paths[-1], (paths[-1].stat().st_atime, paths[-1].stat().st_mtime - age))
    cached_table(RIG, frequencies=np.array([60.0]), grid=Grid(2, 2))
    _, newest = cached_table(RIG, frequencies=np.array([80.0]), grid=Grid(2, 2))
    assert set(cache.iterdir()) == {paths[0], newest}


@pytest.mark.parametrize("has_home", [True, False])
def test_cached_table_is_built_without_a_folder_to_keep_it(cache, monkeypatch, has_home):
    """A cache folder that cannot be made is no reason to fail, nor a user without a home."""
    cache.write_text("a file where the folder should be")
    if not has_home:  # neither HOME nor an entry in passwd, as in a container
        monkeypatch.undo()
        for name in ("HOME", "XDG_CACHE_HOME"):
            monkeypatch.delenv(name, raising=False)
        monkeypatch.setattr("os.path.expanduser", lambda path: path)
    table, path = cached_table(RIG)
    assert path is None
    assert table.frequencies.tolist() == [60.0, 70.0, 80.0, 90.0, 100.0]
