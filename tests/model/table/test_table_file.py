"""Table files: read back to the bit or refused, and kept between runs."""

import json
import os
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from kit.plates import make_paper_rig, small_table
from model import caching
from model.errors import InputError
from model.files.array_file import digest_of
from model.finger import Grid
from model.rig.rig import Rig
from model.table import table_file
from model.table.table import LocalizationTable
from model.table.table_file import TableProblem, cached_table, load_table, save_table, solve_table
from model.vibration import study_convergence

REMEDY = "era table build"

Arrays = dict[str, np.ndarray]
Header = dict[str, Any]


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """The file of a small table."""
    save_table(small_table(), tmp_path / "t.npz")
    return tmp_path / "t.npz"


# Reading


def test_load_table_reads_what_was_written(path: Path) -> None:
    """Arrays to the bit and all else equal; no other file remains."""
    table = load_table(path, rig=make_paper_rig(12, 9))

    expected = small_table()
    for name in (
        *("frequencies", "omega", "attachment_shapes", "shapes", "raster", "grid", "drive_mode"),
        *("plate", "eras", "masses", "mesh", "reference_mesh"),
    ):
        values, written = getattr(table, name), getattr(expected, name)
        np.testing.assert_array_equal(values, written, err_msg=name)
    assert list(path.parent.iterdir()) == [path]


# Damaged and forged files

PLACES: dict[str, Callable[[bytes], int]] = {
    "start": lambda content: len(content) // 10,
    "middle": lambda content: len(content) // 2,
    "end": lambda content: len(content) * 99 // 100,
    "flags of a member": lambda content: content.rindex(b"PK\x01\x02") + 8,
    "header of an array": lambda content: content.rindex(b"), }") + 3,
}


@pytest.mark.parametrize("place", PLACES)
def test_load_table_refuses_a_flipped_bit(path: Path, place: str) -> None:
    """The error names the file."""
    content = bytearray(path.read_bytes())
    content[PLACES[place](bytes(content))] ^= 1
    path.write_bytes(content)

    with pytest.raises(InputError, match=str(path)):
        load_table(path)


def forged_arrays() -> dict[str, tuple[str, Arrays]]:
    """Return the part that an error names, and arrays that replace those of a table."""
    table = small_table()
    return {
        "pickle": ("readable", {"frequencies": np.array([{"a": 1}], dtype=object)}),
        "type": ("readable", {"shapes": table.shapes.astype(np.float64)}),
        "not a number": ("checksum", {"shapes": table.shapes * np.float32(np.nan)}),
        "fewer": ("checksum", {"omega": table.omega[:10]}),
        "another member": ("readable", {"extra": np.zeros(3)}),
        "empty header": ("header", {"header": np.frombuffer(b"{}", dtype=np.uint8)}),
        "binary header": ("header", {"header": np.frombuffer(b"\xff\0", dtype=np.uint8)}),
    }


def test_load_table_refuses_forged_arrays(path: Path) -> None:
    """Pickles, other types, missing or additional members."""
    with np.load(path, allow_pickle=False) as content:
        arrays = dict(content)

    for name, (part, forged) in forged_arrays().items():
        np.savez(path, **arrays | forged)
        with pytest.raises(InputError) as error:
            load_table(path)
        assert part in str(error.value), name


REPLACED = {
    "fingerprint": {"fingerprint": "0" * 64},
    "raster": {"raster": {"length": 0.4}},
    "'loud'": {"mode": "loud"},
    "raster.nx": {"raster": {"nx": 40.5}},
    "shape of shapes": {"raster": {"nx": 39}},
    "plate": {"plate": {"colour": "red"}},
    "grid.nx": {"grid": {"nx": 12.5}},
    "version 0": {"format_version": 0},
    "loss_exponent": {"plate": {"loss_exponent": 1e9}},
    "phase_deg": {"uncertainty": {"phase_deg": 1e9}},
}
"""By what an error names: keys of the header with other values."""


def load_changed(path: Path, change: Callable[[Header, Arrays], object]) -> None:
    """Change the header and the arrays of a table, sign them again, and load them."""
    with np.load(path) as content:
        arrays = dict(content)
    header = json.loads(arrays.pop("header").tobytes())
    change(header, arrays)
    del header["sha256"]
    header["sha256"] = digest_of(json.dumps(header, sort_keys=True), arrays)
    encoded = np.frombuffer(json.dumps(header).encode(), dtype=np.uint8)
    np.savez(path, header=encoded, **arrays)
    load_table(path)


@pytest.mark.parametrize("named", REPLACED)
def test_load_table_refuses_a_value_of_the_header(path: Path, named: str) -> None:
    """Impossible counts and quantities under a right checksum; the error names the remedy."""

    def change(header: Header, arrays: Arrays) -> None:
        for key, value in REPLACED[named].items():
            if isinstance(value, Mapping):
                header[key].update(value)
            else:
                header[key] = value

    with pytest.raises(InputError, match=f"{named}.*{REMEDY}"):
        load_changed(path, change)


@pytest.mark.parametrize(
    ("key", "value", "named"),
    [("bolt_mass", 1e300, "bolt_mass"), ("x", 1e3, "on the plate")],
)
def test_load_table_refuses_a_value_of_an_era(
    path: Path, key: str, value: float, named: str
) -> None:
    """Its mass, or a position beyond the plate."""

    def change(header: Header, arrays: Arrays) -> None:
        header["eras"][0][key] = value

    with pytest.raises(InputError, match=f"{named}.*{REMEDY}"):
        load_changed(path, change)


@pytest.mark.parametrize(
    ("name", "index", "value"),
    [
        ("omega", ..., 0),
        ("attachment_shapes", ..., 1e-30),
        ("shapes", ..., 0),
        ("shapes", (3, 2), 1e30),
        ("shapes", 0, np.nan),
    ],
)
def test_load_table_refuses_impossible_fields(
    path: Path, name: str, index: Any, value: float
) -> None:
    """Under a right checksum; the error names the array."""

    def change(header: Header, arrays: Arrays) -> None:
        arrays[name][index] = value

    with pytest.raises(InputError, match=f"{name}.*{REMEDY}"):
        load_changed(path, change)


# Building


def quick_rig(nx: int = 12, ny: int = 9, lowest: float = 60.0, highest: float = 100.0) -> Rig:
    """Return the paper's plate up to 100 Hz, solved quickly on a coarse reference."""
    rig = make_paper_rig(nx, ny)
    limits = replace(rig.limits, frequency_min=lowest, frequency_max=highest)
    return replace(rig, limits=limits)


RIG = quick_rig()


@pytest.mark.long
def test_build_is_the_same_to_the_bit_by_two_processes(tmp_path: Path) -> None:
    """Whichever process solves a part."""
    problem = TableProblem(RIG, np.array([60.0, 80.0, 100.0]), Grid(4, 3))
    contents = []

    for workers in (1, 2):
        path = tmp_path / f"{workers}.npz"
        save_table(solve_table(problem, drive_mode="switched", workers=workers), path)
        contents.append(path.read_bytes())

    assert contents[0] == contents[1]


@pytest.mark.long
def test_build_states_the_discretization_error_of_the_worst_era() -> None:
    """That of a convergence study, on elements and another raster, with an ERA inside the plate."""
    rig = quick_rig(lowest=40.0, highest=120.0)
    inside = replace(rig.eras[0], x=0.11, y=0.09)
    rig = replace(rig, eras=(inside, *rig.eras[1:]))
    frequencies = [60.0, 90.0, 110.0]

    problem = TableProblem(rig, np.array(frequencies), Grid(2, 2))
    table = solve_table(problem, drive_mode="switched")

    study = study_convergence(rig, [rig.mesh], frequencies=frequencies)
    assert table.reference_mesh != study.reference
    np.testing.assert_allclose(table.discretization_error, study.errors[0].response, rtol=0.1)


# The cache

TWO_FREQUENCIES = np.array([70.0, 80.0])
STIFFER = replace(RIG, eras=(replace(RIG.eras[0], stiffness=18000.0), *RIG.eras[1:]))


def cached(rig: Rig = RIG, **options: Any) -> tuple[LocalizationTable, Path | None]:
    """Return the cached table of a rig, by default with two frequencies and four cells."""
    defaults = {"frequencies": TWO_FREQUENCIES, "grid": Grid(2, 2)}
    return cached_table(rig, **defaults | options)


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A cache folder of the test's own."""
    folder = tmp_path / "cache"
    monkeypatch.setattr(caching.platformdirs, "user_cache_path", lambda *_, **__: folder)
    return folder


@pytest.fixture
def builds(monkeypatch: pytest.MonkeyPatch) -> list[TableProblem]:
    """The problems that are solved."""
    problems: list[TableProblem] = []
    solve = table_file.solve_table

    def counting(problem: TableProblem, **options: Any) -> LocalizationTable:
        problems.append(problem)
        return solve(problem, **options)

    monkeypatch.setattr(table_file, "solve_table", counting)
    return problems


CHOICES: dict[str, dict[str, Any]] = {
    "default": {},
    "stiffness": {"rig": STIFFER},
    "mesh": {"rig": quick_rig(16, 12)},
    "limits": {"rig": quick_rig(highest=200.0)},
    "a frequency": {"frequencies": TWO_FREQUENCIES[:1]},
    "frequencies": {"frequencies": np.array([70.0, 90.0])},
    "grid": {"grid": Grid(3, 2)},
    "mode": {"drive_mode": "switched"},
}


def test_cached_table_is_built_for_each_rig_and_choice(builds: list[TableProblem]) -> None:
    """Stiffness, mesh, limits, frequencies, grid and mode each decide a table.

    A rig is solved once, and its wiring does not matter.
    """
    tables = {}
    paths = {}
    for name, options in CHOICES.items():
        tables[name], paths[name] = cached(**options)
    unwired, path = cached(replace(RIG, wiring={}, amplifiers={}))

    assert path == paths["default"]
    assert unwired.fingerprint == tables["default"].fingerprint
    assert len(builds) == len(CHOICES)
    assert len({*paths.values()}) == len(CHOICES)
    assert tables["frequencies"].frequencies.tolist() == [70.0, 90.0]
    assert tables["grid"].grid == Grid(3, 2)
    assert tables["default"].drive_mode == "phased"
    assert tables["mode"].drive_mode == "switched"


@pytest.mark.parametrize("content", ["flipped byte", "no table", "other rig"])
def test_cached_table_is_built_again_if_its_file_is_damaged(
    builds: list[TableProblem], content: str
) -> None:
    """A flipped byte, no table at all, or the table of another rig costs a build."""
    _, path = cached()
    flipped = bytearray(path.read_bytes())
    flipped[len(flipped) // 2] ^= 1
    _, other_path = cached(STIFFER)
    contents = {
        "flipped byte": flipped,
        "no table": b"damaged",
        "other rig": other_path.read_bytes(),
    }
    path.write_bytes(contents[content])

    table, path_of_new = cached()
    _, path_of_kept = cached()

    assert table.fingerprint == RIG.fingerprint
    assert path_of_new == path_of_kept == path
    assert len(builds) == 3


def test_cached_table_of_other_numerics_is_replaced(
    builds: list[TableProblem], monkeypatch: pytest.MonkeyPatch, cache: Path
) -> None:
    """A table of another NUMERICS_VERSION is not used, and removed with the next that is kept."""
    with monkeypatch.context() as older:
        older.setattr(table_file, "NUMERICS_VERSION", 0)
        older.setattr(table_file, "CURRENT_PREFIX", "table-4.0-")
        cached()
    (cache / "table-0123456789abcdef.npz").touch()

    _, path = cached()

    assert len(builds) == 2
    assert list(cache.iterdir()) == [path]


def test_least_recently_used_table_is_removed(monkeypatch: pytest.MonkeyPatch, cache: Path) -> None:
    """Of three tables two stay, a read one among them."""
    monkeypatch.setattr(table_file, "MAX_CACHED_TABLES", 2)
    _, path = cached(frequencies=np.array([60.0]))
    _, unused = cached(frequencies=np.array([70.0]))
    for old, age in ((path, 200), (unused, 100)):
        times = old.stat()
        os.utime(old, (times.st_atime, times.st_mtime - age))

    cached(frequencies=np.array([60.0]))
    _, newest = cached(frequencies=np.array([80.0]))

    assert set(cache.iterdir()) == {path, newest}


@pytest.mark.parametrize("has_home", [True, False])
def test_table_is_built_without_a_cache_folder(
    cache: Path, monkeypatch: pytest.MonkeyPatch, has_home: bool
) -> None:
    """A cache folder that cannot be made is no reason to fail, nor a user without a home."""
    cache.write_text("a file where the folder should be")
    if not has_home:  # neither HOME nor an entry in passwd, as in a container
        monkeypatch.undo()
        monkeypatch.delenv("HOME", raising=False)
        monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
        monkeypatch.setattr("os.path.expanduser", lambda path: path)

    table, path = cached_table(RIG)

    assert path is None
    assert table.frequencies.tolist() == [60.0, 70.0, 80.0, 90.0, 100.0]
