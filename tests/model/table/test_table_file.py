"""Table files: read back to the bit or refused, kept between runs, and of one rig only.

Every key of a rig that changes is refused, but for a short list.
"""

import copy
import json
import os
import zipfile
from collections.abc import Mapping
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic.fields import FieldInfo

import rig_page
from key_tables import quantities
from kit.plates import make_paper_rig, small_problem, small_table
from model import caching
from model.commands.options import parse_frequencies
from model.config.fields import Section
from model.errors import InputError
from model.files.array_file import digest_of
from model.finger import Grid
from model.rig import plate_sections, sections
from model.rig.actuator_keys import EraSection, ExciterSection
from model.rig.rig import Rig
from model.rig.rig_file import parse_rig
from model.table import table_file
from model.table.table_file import TableProblem, cached_table, load_table, save_table, solve_table
from model.vibration import study_convergence

REMEDY = "era table build"


@pytest.fixture(scope="module")
def table():
    """A small one."""
    return small_table()


@pytest.fixture
def path(table, tmp_path):
    """Its file."""
    save_table(table, tmp_path / "t.npz")
    return tmp_path / "t.npz"


def test_load_table_reads_back_what_was_written(table, path):
    """Arrays to the bit and all else equal; no other file is left."""
    back = load_table(path, rig=make_paper_rig(12, 9))
    arrays = ("frequencies", "omega", "attachment_shapes", "shapes")
    others = ("plate", "eras", "masses", "mesh", "reference_mesh", "raster", "grid", "drive_mode")
    for name in (*arrays, *others):
        np.testing.assert_array_equal(getattr(back, name), getattr(table, name))
    assert list(path.parent.iterdir()) == [path]


@pytest.mark.parametrize("frequencies", [[60.0, 110.0, 250.0], [62.5, 65.0, 67.5]])
def test_load_table_for_another_plate_names_the_options_of_the_table(tmp_path, frequencies):
    """Who types the command gets frequencies, cells and drive mode that the table has."""
    problem = replace(small_problem(), frequencies=np.array(frequencies))
    table = solve_table(problem, drive_mode="phased")
    save_table(table, tmp_path / "t.npz")
    with pytest.raises(InputError) as refused:
        load_table(tmp_path / "t.npz", rig=replace(problem.rig, fingertip=None))
    option = dict(pairwise(str(refused.value).split()))
    assert (option["--mode"], option["--grid"]) == ("phased", "4x3")
    assert option["-o"] == str(tmp_path / "t.npz")
    np.testing.assert_allclose(parse_frequencies(option["--frequencies"]), frequencies)


def test_load_table_refuses_a_damaged_file(path, tmp_path):
    """A flipped bit at a share of it, in the flags of a member, or in the header of an array.

    One whose end is missing, as of a full disk, another kind of file, and none at all.
    """
    whole = path.read_bytes()
    shares = [int(share * len(whole)) for share in (0.1, 0.5, 0.9, 0.99)]
    for at in (*shares, whole.rindex(b"PK\x01\x02") + 8, whole.rindex(b"), }") + 3):
        path.write_bytes(whole[:at] + bytes([whole[at] ^ 1]) + whole[at + 1 :])
        with pytest.raises(InputError, match=str(path)):
            load_table(path)
    path.write_bytes(whole[: len(whole) // 2])
    (tmp_path / "t.txt").write_text("not a table")
    said = {"t.npz": "cut off", "t.txt": r"not a \.npz file", "none.npz": REMEDY}
    for name, what in said.items():
        with pytest.raises(InputError, match=what):
            load_table(tmp_path / name)


@pytest.mark.parametrize(
    ("change", "named"),
    [
        (lambda t: {"frequencies": np.array([{"a": 1}], dtype=object)}, "readable"),
        (lambda t: {"shapes": t.shapes.astype(np.float64)}, "readable"),
        (lambda t: {"shapes": t.shapes * np.float32(np.nan)}, "checksum"),
        (lambda t: {"omega": t.omega[:10]}, "checksum"),
        (lambda t: {"extra": np.zeros(3)}, "readable"),
        (lambda t: {"header": np.frombuffer(b"{}", dtype=np.uint8)}, "header"),
        (lambda t: {"header": np.frombuffer(b"\xff\x00", dtype=np.uint8)}, "header"),
    ],
    ids=["pickle", "type", "nan", "fewer", "more members", "empty header", "binary header"],
)
def test_load_table_refuses_a_forged_file(table, path, change, named):
    """Pickles, other types, missing or extra members."""
    with np.load(path, allow_pickle=False) as content:
        arrays = {**content, **change(table)}
    np.savez(path, **arrays)
    with pytest.raises(InputError, match=named):
        load_table(path)


def test_load_table_refuses_compressed_and_vast_members_unread(path, tmp_path):
    """A compressed member, and members that declare a terabyte in a file of kilobytes."""
    packed, vast = tmp_path / "packed.npz", tmp_path / "vast.npz"
    with (
        zipfile.ZipFile(path) as good,
        zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as compressed,
        zipfile.ZipFile(vast, "w") as declared,
    ):
        for info in good.infolist():
            compressed.writestr(info.filename, good.read(info))
            declared.writestr(info.filename, good.read(info))
        declared.filelist[0].file_size = 1 << 40
    with pytest.raises(InputError, match="compressed"):
        load_table(packed)
    with pytest.raises(InputError, match=r"1\d{12} bytes"):
        load_table(vast)


def descending(header, arrays):
    """Frequencies that descend."""
    header["frequencies_hz"].reverse()
    arrays["frequencies"] = arrays["frequencies"][::-1].copy()


def without_frequencies(header, arrays):
    """A table of no frequencies."""
    header["frequencies_hz"], header["discretisation_error"] = [], []
    arrays["frequencies"] = arrays["frequencies"][:0]


@pytest.mark.parametrize(
    ("change", "named"),
    [
        (lambda header, _: header.update(fingerprint="0" * 64), "fingerprint"),
        (lambda header, _: header["raster"].update(length=0.4), "raster"),
        (lambda header, _: header.update(mode="loud"), "'loud'"),
        (lambda header, _: header["raster"].update(nx=40.5), "raster.nx"),
        (lambda header, _: header["raster"].update(nx=39), "shape of shapes"),
        (lambda header, _: header["plate"].update(colour="red"), "plate"),
        (lambda header, _: header["grid"].update(nx=12.5), "grid.nx"),
        (lambda header, _: header.update(format_version=0), "version 0"),
        (lambda header, _: header["frequencies_hz"].__setitem__(0, 61.0), "frequencies"),
        (
            lambda header, arrays: (
                arrays.update(frequencies=np.array(header["frequencies_hz"][::-1]))
                or header["frequencies_hz"].reverse()
            ),
            "frequencies",
        ),
        (without_frequencies, "frequencies"),
        (lambda header, _: header["plate"].update(loss_exponent=1e9), "loss_exponent"),
        (lambda header, _: header["uncertainty"].update(phase_deg=1e9), "phase_deg"),
        (lambda header, _: header["eras"][0].update(bolt_mass=1e300), "bolt_mass"),
        (lambda header, _: header["eras"][0].update(x=1e3), "on the plate"),
        (lambda _, arrays: arrays["omega"].fill(0), "omega"),
        (lambda _, arrays: arrays["attachment_shapes"].fill(1e-30), "attachment_shapes"),
        (lambda _, arrays: arrays["shapes"].fill(0), "shapes"),
        (lambda _, arrays: arrays["shapes"].__setitem__((3, 2), 1e30), r"1e\+30"),
        (lambda _, arrays: arrays["shapes"].__setitem__(0, np.nan), "shapes"),
    ],
)
def test_load_table_refuses_content_that_contradicts_itself(path, change, named):
    """Impossible frequencies, counts and fields under a right checksum; the remedy is named."""
    with np.load(path) as content:
        arrays = dict(content)
    header = json.loads(arrays.pop("header").tobytes())
    change(header, arrays)
    del header["sha256"]
    header["sha256"] = digest_of(json.dumps(header, sort_keys=True), arrays)
    encoded = np.frombuffer(json.dumps(header).encode(), dtype=np.uint8)
    np.savez(path, header=encoded, **arrays)
    with pytest.raises(InputError, match=f"{named}.*{REMEDY}"):
        load_table(path)


@pytest.mark.long
def test_build_is_the_same_to_the_bit_by_two_processes(tmp_path):
    """Whichever process solves a part."""
    problem = TableProblem(RIG, np.array([60.0, 80.0, 100.0]), Grid(4, 3))
    files = [tmp_path / f"{workers}.npz" for workers in (1, 2)]
    for workers, path in enumerate(files, start=1):
        save_table(solve_table(problem, drive_mode="switched", workers=workers), path)
    assert files[0].read_bytes() == files[1].read_bytes()


@pytest.mark.long
def test_build_states_the_discretization_error_of_the_worst_era():
    """That of a convergence study, on elements and another raster, with an ERA inside the plate."""
    rig, frequencies = quick_rig(lowest=40.0, highest=120.0), [60.0, 90.0, 110.0]
    rig = replace(rig, eras=(replace(rig.eras[0], x=0.11, y=0.09), *rig.eras[1:]))
    problem = TableProblem(rig, np.array(frequencies), Grid(2, 2))
    table = solve_table(problem, drive_mode="switched")
    study = study_convergence(rig, [rig.mesh], frequencies=frequencies)
    assert table.reference_mesh != study.reference
    np.testing.assert_allclose(table.discretization_error, study.errors[0].response, rtol=0.1)


def quick_rig(nx=12, ny=9, lowest=60.0, highest=100.0):
    """The paper's plate up to 100 Hz: five frequencies, solved quickly on a coarse reference."""
    rig = make_paper_rig(nx, ny)
    limits = replace(rig.limits, frequency_min=lowest, frequency_max=highest)
    return replace(rig, limits=limits)


RIG = quick_rig()


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


def test_cached_table_is_built_for_each_rig_and_choice(builds):
    """Stiffness, mesh, limits, frequencies, grid and mode each decide a table.

    A rig is solved once, and its wiring does not matter.
    """
    choices = [
        (RIG, {}),
        (STIFFER, {}),
        (quick_rig(16, 12), {}),
        (replace(RIG, limits=replace(RIG.limits, frequency_max=200.0)), {}),
        (RIG, {"frequencies": np.array([70.0])}),
        (RIG, {"frequencies": np.array([70.0, 90.0])}),
        (RIG, {"grid": Grid(3, 2)}),
        (RIG, {"drive_mode": "switched"}),
    ]
    tables = [cached_table(rig, **FEW | options) for rig, options in choices]
    again, path = cached_table(replace(RIG, wiring={}, amplifiers={}), **FEW)
    assert (again.fingerprint, path) == (tables[0][0].fingerprint, tables[0][1])
    assert len(builds) == len({path for _, path in tables}) == len(choices)
    assert tables[5][0].frequencies.tolist() == [70.0, 90.0]
    assert tables[6][0].grid == Grid(3, 2)
    assert [tables[n][0].drive_mode for n in (0, 7)] == ["phased", "switched"]


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
        older.setattr(table_file, "CURRENT_PREFIX", "table-4.0-")
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


GLASS = {"name": "glass", "E": 70e9, "rho": 2500.0, "nu": 0.2}
FILM = {"name": "film", "E": 1e6, "rho": 1000.0, "nu": 0.45}
ROWS = [[1, 1, 0.1], [900, 2, 0.1]]
RIGS: dict[str, dict[str, Any]] = {
    "plain": {
        "plate": {
            "length": 0.3,
            "width": 0.2,
            "thickness": 0.002,
            "material": GLASS,
            "air_gap": {"depth": 0.01, "closed": False},
            "loss_factor": 0.01,
            "loss_exponent": 0.1,
            "modes": [[1.01, 1.1]],
        },
        "mesh": "12x9 Legendre",
        "eras": {
            "W": {"at": [0.0, 0.1], "amplifier": "main", "channel": 0, "damping_ratio": 0.05},
            "E": {"at": [0.3, 0.1], "amplifier": "main", "channel": 1, "damping": 2.0},
            "N": {"at": [0.15, 0.2], "amplifier": "main", "channel": 2},
            "leg": {"at": [0.15, 0.0], "damping": 2.0},
        },
        "masses": {"camera": {"at": [0.1, 0.1], "mass": 0.01, "foot": 0.005}},
        "amplifiers": {"main": {"url": "sim://"}, "other": {"url": "sim://"}},
        "threshold": "vibrotactile-probe",
        "fingertip": {"stiffness": 1000.0},
        "uncertainty": {"gain": 0.05, "damping": 1.5},
        "limits": {"power": 4.0},
    },
    "layers": {
        "plate": {
            "length": 0.3,
            "width": 0.2,
            "layers": [
                {"material": GLASS, "thickness": 0.001, "loss_factor": 0.02},
                {"material": FILM, "thickness": 0.001, "by_frequency": ROWS},
                {"material": GLASS, "thickness": 0.001},
            ],
        },
        "mesh": "12x9 Legendre",
        "eras": {
            name: {"at": at, "stiffness": 17e3, "amplifier": "main", "channel": channel}
            for channel, (name, at) in enumerate(
                {"W": [0.0, 0.1], "E": [0.3, 0.1], "N": [0.15, 0.2]}.items()
            )
        },
        "amplifiers": {"main": {"url": "sim://"}},
    },
}  # fmt: skip
RIGS["board"] = {
    "plate": {
        "length": 0.3,
        "width": 0.2,
        "thickness": 0.005,
        "grain": "length",
        "material": {
            "E1": 12e9,
            "E2": 5e9,
            "G12": 0.7e9,
            "G13": 0.3e9,
            "G23": 0.2e9,
            "nu12": 0.05,
            "rho": 680.0,
        },
    },
    "mesh": "12x9 Legendre",
    "eras": RIGS["layers"]["eras"],
    "masses": {"frame": {"along": "edges", "mass_per_length": 0.05, "points": 4}},
    "supports": {
        "foot": {"at": [0.01, 0.02], "kind": "foam"},
        "tape": {"along": "edges", "stiffness_per_length": 100.0},
    },
    "amplifiers": {"main": {"url": "sim://"}},
}
RIGS["exciters"] = copy.deepcopy(RIGS["plain"]) | {
    "mesh": "12x9 Legendre",
    "masses": {},
    "eras": {
        name: {"at": at, "stiffness": 17e3}
        for name, at in {"W": [0.0, 0.1], "E": [0.3, 0.1], "N": [0.15, 0.2]}.items()
    }
    | {
        "X1": {
            "at": [0.1, 0.05],
            "foot": 0.004,
            "coil_mass": 1e-3,
            "weight": 0.02,
            "resonance": 200,
            "resonance_is": "free",
            "q": 3,
            "force_factor": 1.5,
            "resistance": 3.6,
            "inductance": 1e-4,
            "source_resistance": 0.1,
            "power": 1,
            "excursion": 5e-4,
            "gains": [[40, 1, 0], [500, 1.1, 10]],
        },
        "X2": {
            "at": [0.2, 0.05],
            "type": "DAEX25CT-4",
            "stiffness": 4000,
            "damping": 0.8,
            "clip": 1,
        },
        "X3": {"at": [0.15, 0.12], "type": "DAEX25CT-4"},
    },
}
for channel, name in enumerate(("X1", "X2", "X3")):
    wired = {"kind": "exciter", "amplifier": "main", "channel": channel}
    RIGS["exciters"]["eras"][name] |= wired
RIGS["sheets"] = copy.deepcopy(RIGS["layers"])
RIGS["sheets"]["plate"]["layers"] = 2 * [{"material": GLASS, "thickness": 0.001}]
for era in RIGS["plain"]["eras"].values():
    era |= {"stiffness": 17e3, "bolt_mass": 0.003, "stroke": 1e-4, "foot": 0.004}
    era["gains"] = [[40, 1, 0], [500, 1.1, 10]]

RIGS["weather"] = copy.deepcopy(RIGS["plain"]) | {"mesh": "18x14 Legendre"}
del RIGS["weather"]["plate"]["air_gap"]
RIGS["weather"]["plate"] |= {
    "material": "plywood",
    "thickness": 0.004,
    "temperature": [10, 30],
    "humidity": [0.3, 0.6],
}
WEATHER = ("temperature", "measured_temperature", "humidity", "measured_humidity")
SECTIONS: dict[type[Section], tuple[str, tuple[Any, ...]]] = {
    sections.RigSection: ("plain", ()),
    plate_sections.PlateSection: ("plain", ("plate",)),
    plate_sections.MaterialSection: ("plain", ("plate", "material")),
    plate_sections.AirGapSection: ("plain", ("plate", "air_gap")),
    plate_sections.LayerSection: ("layers", ("plate", "layers", 1)),
    EraSection: ("plain", ("eras", "W")),
    ExciterSection: ("exciters", ("eras", "X1")),
    sections.MassSection: ("plain", ("masses", "camera")),
    sections.SupportSection: ("board", ("supports", "foot")),
    sections.AmplifierSection: ("plain", ("amplifiers", "main")),
    sections.UncertaintySection: ("plain", ("uncertainty",)),
    sections.FingertipSection: ("plain", ("fingertip",)),
    sections.LimitsSection: ("plain", ("limits",)),
}
"""An instance of every section of a rig file: the rig, and where it is there."""

ELSEWHERE: dict[tuple[type[Section], str], tuple[str, tuple[Any, ...]]] = {
    (plate_sections.PlateSection, "bond"): ("sheets", ("plate",)),
    (plate_sections.PlateSection, "layers"): ("layers", ("plate",)),
    (plate_sections.PlateSection, "grain"): ("board", ("plate",)),
    **{(plate_sections.PlateSection, key): ("weather", ("plate",)) for key in WEATHER},
    **{
        (plate_sections.MaterialSection, key): ("board", ("plate", "material"))
        for key in plate_sections.ORTHOTROPIC
    },
    (sections.MassSection, "mass_per_length"): ("board", ("masses", "frame")),
    (sections.MassSection, "points"): ("board", ("masses", "frame")),
    (sections.SupportSection, "stiffness_per_length"): ("board", ("supports", "tape")),
    (sections.SupportSection, "points"): ("board", ("supports", "tape")),
    (EraSection, "damping"): ("plain", ("eras", "E")),
    (ExciterSection, "damping"): ("exciters", ("eras", "X2")),
    (ExciterSection, "stiffness"): ("exciters", ("eras", "X2")),
    (ExciterSection, "clip"): ("exciters", ("eras", "X2")),
    (ExciterSection, "type"): ("exciters", ("eras", "X3")),
}

MAY_DIFFER = {
    "mesh",
    "amplifiers",
    "url",
    "full_level",
    "clock_error",
    "amplifier",
    "channel",
    "name",
    "limits",
    *sections.LimitsSection.model_fields,
}
"""Keys that may have other values than the rig of a table, by the reference of the table's file."""

OTHERS: dict[str, Any] = {
    "plate": {"length": 0.3, "width": 0.2, "thickness": 0.003, "material": "steel"},
    "material": "steel",
    "air_gap": None,
    "layers": [{"material": GLASS, "thickness": 0.003}],
    "bond": "none",
    "temperature": [5, 30],
    "humidity": [0.2, 0.6],
    "modes": [[1.02, 1.1]],
    "by_frequency": [[1, 1, 0.1], [900, 2.1, 0.1]],
    "closed": True,
    "promised_thresholds": ["vibrotactile-probe"],
    "mesh": "13x9 Legendre",
    "eras": {each: RIGS["plain"]["eras"][each] for each in "WEN"},
    "at": [0.05, 0.15],
    "gains": [[40, 1, 0], [500, 1.2, 10]],
    "type": "DAEX25FHE-4",
    "resonance_is": "mounted",
    "magnet": "held",
    "amplifier": "other",
    "channel": 9,
    "masses": {},
    "supports": {"leg": {"at": [0.01, 0.02], "kind": "rubber"}},
    "grain": "width",
    "kind": "rubber",
    "points": 5,
    "amplifiers": {"main": {"url": "sim://"}, "other": {"url": "serial:///dev/b"}},
    "url": "serial:///dev/b",
    "full_level": "output",
    "clock_error": "unknown",
    "name": "another",
    "limits": {"level": 0.5},
    "frequency": [50, 400],
    "uncertainty": {"gain": 0},
    "fingertip": "none",
    "threshold": "pressing-fingertip",
}
"""Another value of each key that is no plain quantity."""


def rig_of(data: Mapping[str, Any]) -> Rig:
    """The rig of a file with these data."""
    return parse_rig("rig.json", json.dumps(data))  # YAML, too


def other_value(field: FieldInfo, value: Any) -> float:
    """A little beside a quantity's value, or the least that it may have."""
    quantity = quantities(field)[0]
    value = field.get_default(call_default_factory=True) if value is None else value
    least = max(quantity.above, quantity.at_least)
    start = value if isinstance(value, float | int) else least
    step = 0.01 * (abs(start) or min(1.0, quantity.at_most))
    return float(start + (step if start + step <= quantity.at_most else -step))


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A table of each rig."""
    found = {}
    for name, data in RIGS.items():
        problem = TableProblem(rig_of(data), np.array([60.0, 110.0]), Grid(2, 2))
        found[name] = tmp_path_factory.mktemp("tables") / f"{name}.npz"
        save_table(solve_table(problem, drive_mode="phased"), found[name])
        load_table(found[name], rig=problem.rig)
    return found


@pytest.mark.parametrize(
    ("section", "key"),
    [
        pytest.param(each, key, id=f"{each.__name__}.{key}")
        for each in rig_page.SECTIONS.values()
        for key in each.model_fields
        # A kind has other keys, `along` has one value, surfaces are in tests/model/structure.
        if key not in ("kind", "along", "surface", "mode_amplitude")
        and each is not plate_sections.SurfaceSection
    ],
)
def test_a_rig_that_differs_in_a_key_is_refused(
    section: type[Section], key: str, files: dict[str, Path]
) -> None:
    """By its key, unless it is one of few that may differ."""
    name, place = ELSEWHERE.get((section, key), SECTIONS[section])
    data = copy.deepcopy(RIGS[name])
    parent = data
    for part in place:
        parent = parent[part]
    is_plain = key not in OTHERS or section is sections.UncertaintySection
    parent[key] = (
        other_value(section.model_fields[key], parent.get(key)) if is_plain else OTHERS[key]
    )
    rig = rig_of(data)
    if key in MAY_DIFFER and (section, key) != (ExciterSection, "power"):  # which is a limit's, too
        load_table(files[name], rig=rig)
        return
    with pytest.raises(InputError) as refused:
        load_table(files[name], rig=rig)
    named = "uncertainty" if key in WEATHER else place[0] if place else key
    assert f" {'masses' if named == 'supports' else named}" in str(refused.value)
