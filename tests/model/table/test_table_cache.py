"""Tables are kept between runs, and never the wrong one."""

from dataclasses import replace

import numpy as np
import pytest

from model.finger.grid import Grid
from model.table import table_cache, table_parts
from model.table.table_cache import cached_table
from paper_plate import make_paper_rig


@pytest.fixture
def rig():
    """A mesh that is quick to solve, at five frequencies: 60 to 100 Hz."""
    return quick_rig(12, 9)


def quick_rig(nx, ny):
    """The paper's plate, which is not to be driven beyond 100 Hz."""
    rig = make_paper_rig(nx, ny)
    return replace(rig, limits=replace(rig.limits, frequency_min=60.0, frequency_max=100.0))


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    """A cache folder of the test's own."""
    monkeypatch.setattr(
        table_cache.platformdirs, "user_cache_path", lambda *_, **__: tmp_path / "cache"
    )
    return tmp_path / "cache"


@pytest.fixture
def builds(monkeypatch):
    """Counts how often a table is really built."""
    counted = []
    build = table_cache.build_table

    def counting(rig, **options):
        counted.append(rig)
        return build(rig, **options)

    monkeypatch.setattr(table_cache, "build_table", counting)
    return counted


def test_the_second_time_it_is_read(rig, builds):
    """The same rig is solved once."""
    first, path = cached_table(rig)
    second, again = cached_table(rig)
    assert len(builds) == 1
    assert path == again
    assert second.fingerprint == first.fingerprint


def test_who_builds_a_table_asks_nobody_else_to(rig, caplog):
    """The log says why it is built, not how to build one: first there is none, then a bad one."""
    caplog.set_level("INFO", logger="model.table.table_cache")
    _, path = cached_table(rig)
    path.write_bytes(b"damaged")
    cached_table(rig)
    assert caplog.messages == [
        f"building the localization table: there is no table {path}",
        f"building the localization table: {path} is not a readable localization table "
        "(it is no .npz file)",
    ]


def test_another_plate_or_mesh_is_another_table(rig, builds):
    """A stiffer ERA, and a finer mesh, each get a table of their own."""
    stiffer = replace(rig, eras=(replace(rig.eras[0], stiffness=18000.0), *rig.eras[1:]))
    paths = {cached_table(r)[1] for r in (rig, stiffer, quick_rig(16, 12))}
    assert len(builds) == len(paths) == 3


def test_a_damaged_cache_is_built_anew(rig, builds):
    """A flipped byte costs a rebuild, not a wrong answer."""
    _, path = cached_table(rig)
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)
    cached_table(rig)
    assert len(builds) == 2
    assert cached_table(rig)[1] == path
    assert len(builds) == 2


def test_another_rigs_table_under_its_name_is_built_anew(rig, builds):
    """A file that was copied over the right one is whole, and of another plate."""
    stiffer = replace(rig, eras=(replace(rig.eras[0], stiffness=18000.0), *rig.eras[1:]))
    _, path = cached_table(rig)
    _, other = cached_table(stiffer)
    path.write_bytes(other.read_bytes())
    table, again = cached_table(rig)
    assert (len(builds), again) == (3, path)
    assert table.fingerprint == rig.fingerprint


def test_what_other_code_made_is_built_anew(rig, builds, monkeypatch):
    """A table that an older model left behind is not what this one would say, so it is replaced."""
    with monkeypatch.context() as older:
        older.setattr(table_parts, "code_version", lambda: "0.0.1+000000000000")
        table, path = cached_table(rig)
        assert table.code_version == "0.0.1+000000000000"
    table, again = cached_table(rig)
    assert (len(builds), again) == (2, path)
    assert table.code_version != "0.0.1+000000000000"
    assert cached_table(rig)[0].code_version == table.code_version
    assert len(builds) == 2


def test_every_choice_has_a_table_of_its_own(rig, builds):
    """Other frequencies, as many of them, another grid and another mode are not mixed up."""
    low, high = np.array([70.0, 80.0]), np.array([70.0, 90.0])
    cached_table(rig, frequencies=low)
    assert cached_table(rig, frequencies=high)[0].frequencies.tolist() == [70.0, 90.0]
    assert cached_table(rig, frequencies=low, grid=Grid(3, 2))[0].grid == Grid(3, 2)
    assert cached_table(rig, frequencies=low, drive_mode="phased")[0].drive_mode == "phased"
    assert len(builds) == 4


def test_without_a_place_to_keep_it_the_table_is_built_all_the_same(rig, cache, builds):
    """A cache folder that cannot be made is no reason to fail."""
    cache.write_text("a file where the folder should be")
    table, path = cached_table(rig)
    assert path is None
    assert table.frequencies.tolist() == [60.0, 70.0, 80.0, 90.0, 100.0]
