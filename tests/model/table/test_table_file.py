"""Table files: read back to the bit, or refused."""

import json
import zipfile
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from model.config.fields import parse_frequencies
from model.errors import InputError
from model.files.array_file import digest_of
from model.finger import Grid
from model.table.table_file import TableProblem, load_table, save_table, solve_table
from model.vibration import study_convergence
from plates import make_paper_rig, small_problem, small_table

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


@pytest.mark.parametrize(
    "damaged", [0.1, 0.5, 0.9, 0.99, (b"PK\x01\x02", 8), (b"), }", 3)], ids=str
)
def test_load_table_refuses_a_damaged_file(path, damaged):
    """A flipped bit at a share of it, in the flags of a member, or in the header of an array."""
    data = bytearray(path.read_bytes())
    is_share = isinstance(damaged, float)
    at = int(damaged * len(data)) if is_share else data.rindex(damaged[0]) + damaged[1]
    data[at] ^= 1
    path.write_bytes(data)
    with pytest.raises(InputError, match=str(path)):
        load_table(path)


def test_load_table_says_what_is_no_table(path, tmp_path):
    """One whose end is missing, as of a full disk, another kind of file, and none at all."""
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
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
        (descending, "frequencies"),
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


FREQUENCIES = np.array([60.0, 90.0, 110.0])


def quick_rig(nx=12, ny=9):
    """The paper's plate with frequencies up to 120 Hz, so that its reference mesh is coarse."""
    rig = make_paper_rig(nx, ny)
    return replace(rig, limits=replace(rig.limits, frequency_max=120.0))


@pytest.fixture(scope="module")
def problem():
    """A small table's."""
    return TableProblem(quick_rig(), FREQUENCIES, Grid(4, 3))


@pytest.mark.long
def test_build_is_the_same_to_the_bit_by_two_processes(problem, tmp_path):
    """Whichever process solves a part."""
    files = []
    for workers in (1, 2):
        path = tmp_path / f"{workers}.npz"
        save_table(solve_table(problem, drive_mode="switched", workers=workers), path)
        files.append(path.read_bytes())
    assert files[0] == files[1]


def test_build_states_the_discretisation_error_of_the_worst_era():
    """That of a convergence study, on elements and another raster, with an ERA inside the plate."""
    rig = quick_rig()
    rig = replace(rig, eras=(replace(rig.eras[0], x=0.11, y=0.09), *rig.eras[1:]))
    table = solve_table(TableProblem(rig, FREQUENCIES, Grid(2, 2)), drive_mode="switched")
    study = study_convergence(rig, [rig.mesh], frequencies=FREQUENCIES.tolist())
    assert table.reference_mesh != study.reference
    np.testing.assert_allclose(table.discretisation_error, study.errors[0].response, rtol=0.1)


def test_build_refuses_an_unknown_drive_mode(problem):
    """The error lists those there are."""
    with pytest.raises(InputError, match="switched, phased"):
        solve_table(problem, drive_mode="loud")
