"""The localization table: its patterns, its answers, its file."""

import json
import zipfile
from dataclasses import replace

import numpy as np
import pytest

from model.drive_modes.sources import all_patterns, magnitudes_of_sources, sums_of_sources
from model.errors import InputError
from model.fem.assembly import assemble
from model.fem.elements import ELEMENTS
from model.fem.harmonic import direct_acceleration
from model.fem.mesh import Mesh
from model.files.array_file import digest_of
from model.finger.fingertip import fingertip_points
from model.finger.grid import Grid
from model.finger.perception import sensation_level
from model.structure.point_load import PointLoad
from model.structure.point_mass import PointMass
from model.table.build import build_table
from model.table.file import load_table, save_table
from model.table.question import Question
from model.table.summary import summarize
from model.table.weak_cells import find_weak_cells
from model.vibration.peak import peak_acceleration, tone_amplitudes
from paper_plate import make_paper_rig


@pytest.fixture(scope="module")
def rig():
    """A mesh that is quick to solve directly, of elements as smooth as fields are."""
    paper = make_paper_rig(24, 18)
    return replace(paper, mesh=Mesh(6, 5, paper.plate.length, paper.plate.width, ELEMENTS["Q5"]))


@pytest.fixture(scope="module")
def table(rig):
    """The paper's patterns on the paper's grid."""
    return build_table(rig)


def solved_directly(rig, pattern, points):
    """Frequencies and amplitudes of a pattern at points by the sparse direct solve."""
    matrices = assemble(rig.plate, rig.mesh)
    return tone_amplitudes(
        pattern.excitation,
        rig.eras,
        lambda f: direct_acceleration(matrices, rig.eras, f, points),
    )


def query(table, target, *, quiet=(), level_db_sl=20.0):
    """The pattern for one target."""
    return table.query(Question((target,), tuple(quiet), level_db_sl=level_db_sl))


def test_the_paper_has_4482_patterns():
    """Four ERAs alone and six pairs at 27 frequencies: 4 * 27 + 6 * 27²."""
    patterns = all_patterns(4, 27).index
    assert len(patterns) == 4 * 27 + 6 * 27**2 == 4482
    assert len(np.unique(patterns, axis=0)) == 4482
    assert set((patterns >= 0).sum(axis=1)) == {1, 2}


def test_patterns_that_tables_share_cannot_be_overwritten(table):
    """One table's user cannot change what another one answers."""
    with pytest.raises(ValueError, match="read-only"):
        all_patterns(len(table.eras), len(table.frequencies)).index[0, 0] = 5


def test_every_pattern_is_what_adding_up_its_tones_gives():
    """Row by row, the vectorised sum equals Eq. 28 written out for that pattern."""
    rng = np.random.default_rng(0)
    response = rng.normal(size=(5, 3, 4)) + 1j * rng.normal(size=(5, 3, 4))
    fast = sums_of_sources(magnitudes_of_sources(response).T, 3).T
    for row, pattern in zip(fast, all_patterns(3, 5).index, strict=True):
        slow = np.zeros(4)
        for frequency in range(5):
            slow += np.abs(response[frequency, pattern == frequency].sum(axis=0))
        np.testing.assert_allclose(row, slow)


@pytest.mark.parametrize(
    "quiet", [[(0.25, 0.18)], [(0.03, 0.19), (0.27, 0.05)]], ids=["one", "two"]
)
def test_an_answer_holds_against_the_direct_solve(rig, table, quiet):
    """Level and contrast predicted are those of the sparse direct solve at the fingertips."""
    target = (0.09, 0.07)
    pattern = query(table, target, quiet=quiet, level_db_sl=18.0)
    frequencies, at_target = solved_directly(rig, pattern, fingertip_points(*target, rig.plate))
    level = 20 * np.log10((10 ** (sensation_level(frequencies, at_target) / 20)).mean())
    assert level == pytest.approx(18.0, abs=0.01)
    loudest = max(
        peak_acceleration(solved_directly(rig, pattern, fingertip_points(*q, rig.plate))[1]).max()
        for q in quiet
    )
    contrast = 20 * np.log10(peak_acceleration(at_target).mean() / loudest)
    assert pattern.contrast_db == pytest.approx(contrast, abs=0.02)


def test_no_other_pattern_has_more_contrast(rig, table):
    """The answer is the best of all patterns that reach the level, tried one by one."""
    target, quiet = (0.20, 0.15), (0.06, 0.06)
    pattern = query(table, target, quiet=[quiet], level_db_sl=20.0)
    matrices = assemble(rig.plate, rig.mesh)
    points = np.concatenate([fingertip_points(*p, rig.plate) for p in (target, quiet)])
    count = len(fingertip_points(*target, rig.plate))
    response = direct_acceleration(matrices, rig.eras, table.frequencies, points)
    best = -np.inf
    for row in all_patterns(4, 27).index[::7]:  # every seventh: enough to catch a wrong choice
        active = np.flatnonzero(row >= 0)
        amplitudes = np.array(
            [np.abs(response[f, row == f].sum(axis=0)) for f in np.unique(row[active])]
        )
        level = sensation_level(table.frequencies[np.unique(row[active])], amplitudes[:, :count])
        if 20 * np.log10((10 ** (level / 20)).mean()) >= 20.0:
            peak = amplitudes.sum(axis=0)
            best = max(best, 20 * np.log10(peak[:count].mean() / peak[count:].max()))
    assert np.isfinite(best)
    assert pattern.contrast_db >= best - 0.02


def test_level_scales_the_drive_and_leaves_the_contrast(table):
    """20 dB less asked for is a tenth of the stroke, the same ERAs, the same contrast."""
    loud = query(table, (0.1, 0.1), quiet=[(0.2, 0.1)], level_db_sl=20.0)
    soft = query(table, (0.1, 0.1), quiet=[(0.2, 0.1)], level_db_sl=0.0)
    # A pattern that only the softer level admits may be better, never worse.
    assert soft.contrast_db >= loud.contrast_db - 1e-9
    if soft.excitation.keys() == loud.excitation.keys():
        for name, tone in soft.excitation.items():
            if tone.frequency == loud.excitation[name].frequency:
                assert tone.amplitude == pytest.approx(loud.excitation[name].amplitude / 10)


def test_mirrored_contacts_get_mirrored_patterns(table):
    """On a symmetric plate, west and east swap with the contacts."""
    length = table.plate.length
    west = query(table, (0.07, 0.06), quiet=[(0.22, 0.15)])
    east = query(table, (length - 0.07, 0.06), quiet=[(length - 0.22, 0.15)])
    assert east.contrast_db == pytest.approx(west.contrast_db, abs=1e-3)
    swap = {"SW": "SE", "SE": "SW", "NE": "NW", "NW": "NE"}
    mirrored = {swap[name]: tone.frequency for name, tone in west.excitation.items()}
    assert {name: tone.frequency for name, tone in east.excitation.items()} == mirrored


def test_a_lone_finger_has_a_level_and_no_contrast(table):
    """Without other fingers there is nothing to be told from: contrast is None."""
    pattern = query(table, (0.15, 0.11))
    assert pattern.contrast_db is None
    assert pattern.quiet_level_db_sl is None
    assert pattern.level_db_sl == 20.0


def test_cells_are_numbered_along_x_first(table):
    """Cell 12 of a 12x9 grid is the first of the second row; its centre is half a cell in."""
    np.testing.assert_allclose(Grid(12, 9).centres(table.plate)[12], [0.0127, 0.0381])


def test_a_table_survives_its_file_to_the_bit(table, tmp_path):
    """What is read back is what was written, and answers the same."""
    path = tmp_path / "t.npz"
    save_table(table, path)
    back = load_table(path, fingerprint=table.fingerprint)
    for name in ("frequencies", "acceleration", "omega", "held", "shapes", "cell_sources"):
        np.testing.assert_array_equal(getattr(back, name), getattr(table, name))
    assert (back.plate, back.eras, back.masses, back.raster, back.grid) == (
        table.plate, table.eras, table.masses, table.raster, table.grid,
    )  # fmt: skip
    assert list(tmp_path.iterdir()) == [path]


def test_the_file_opens_with_plain_numpy(table, tmp_path):
    """Any researcher reads it: numpy.load without pickles."""
    path = tmp_path / "t.npz"
    save_table(table, path)
    with np.load(path, allow_pickle=False) as content:
        assert content["acceleration"].shape == (table.raster.point_count, 27, 4)
        assert json.loads(content["header"].tobytes())["format_version"] == 3


def test_a_failed_write_leaves_the_old_table(table, tmp_path, monkeypatch):
    """When the disk fails half-way, the file is the old one and nothing else lies about."""
    path = tmp_path / "t.npz"
    save_table(table, path)
    before = path.read_bytes()

    def full_disk(stream, **arrays):
        stream.write(b"half")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(np, "savez", full_disk)
    with pytest.raises(OSError, match="No space"):
        save_table(table, path)
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


def test_a_table_of_another_plate_is_refused(table, tmp_path):
    """A plate a tenth of a millimetre thicker is another plate."""
    path = tmp_path / "t.npz"
    save_table(table, path)
    other = make_paper_rig(24, 18)
    thicker = replace(other, plate=replace(other.plate, thickness=0.0016))
    with pytest.raises(InputError, match="another plate"):
        load_table(path, fingerprint=thicker.fingerprint)


def test_a_table_knows_what_the_plate_carries(tmp_path):
    """With 60 g on it the plate answers as the direct solve says; the file keeps it for its rig."""
    rig = replace(make_paper_rig(12, 9), masses=(PointMass(0.1, 0.15, 0.06),))
    laden = build_table(rig, frequencies=np.array([110.0, 210.0]))
    solved = direct_acceleration(
        assemble(rig.plate, rig.mesh),
        rig.eras,
        laden.frequencies,
        laden.raster.points,
        loads=[PointLoad(0.1, 0.15, mass=0.06)],
    )
    error = np.linalg.norm(laden.acceleration.transpose(1, 2, 0) - solved) / np.linalg.norm(solved)
    assert error < 1e-3
    save_table(laden, tmp_path / "laden.npz")
    back = load_table(tmp_path / "laden.npz", fingerprint=rig.fingerprint)
    assert back.masses == rig.masses
    with pytest.raises(InputError, match="built for another plate"):
        load_table(tmp_path / "laden.npz", fingerprint=make_paper_rig(12, 9).fingerprint)


def test_the_fingerprint_is_of_the_physics_not_of_the_wiring(rig):
    """Rewiring channels keeps the table, another stiffness does not."""
    rewired = replace(rig, wiring={}, amplifiers={})
    assert rewired.fingerprint == rig.fingerprint
    softer = replace(rig, eras=(replace(rig.eras[0], stiffness=16000.0), *rig.eras[1:]))
    assert softer.fingerprint != rig.fingerprint


@pytest.mark.parametrize("share", [0.1, 0.5, 0.9, 0.999])
def test_a_flipped_byte_is_refused(table, tmp_path, share):
    """One wrong byte anywhere in the data is noticed."""
    path = tmp_path / "t.npz"
    save_table(table, path)
    data = bytearray(path.read_bytes())
    data[int(share * len(data))] ^= 0x01
    path.write_bytes(data)
    with pytest.raises(InputError, match=r"damaged|not a readable|bad header|holds"):
        load_table(path)


@pytest.mark.parametrize(
    ("mark", "offset", "byte"),
    [(b"PK\x01\x02", 8, 0x01), (b"), }", 3, ord(" "))],
    ids=["encrypted member", "header that does not parse"],
)
def test_a_wrong_byte_in_the_framing_is_refused(table, tmp_path, mark, offset, byte):
    """A flag that says encrypted, a bracket left open in an array's header."""
    path = tmp_path / "t.npz"
    save_table(table, path)
    data = bytearray(path.read_bytes())
    data[data.rindex(mark) + offset] = byte
    path.write_bytes(data)
    with pytest.raises(InputError, match="not a readable"):
        load_table(path)


def test_a_truncated_file_is_refused(table, tmp_path):
    """The first half of a table's bytes is no table, and is told as a file that cannot be read."""
    path = tmp_path / "t.npz"
    save_table(table, path)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.raises(InputError, match="not a readable"):
        load_table(path)


def test_a_missing_table_says_how_to_build_one(tmp_path):
    """The error names the command."""
    with pytest.raises(InputError, match="era table build"):
        load_table(tmp_path / "none.npz")


def repacked(source, target, **changed):
    """A copy of an .npz whose members are replaced, numpy's format kept."""
    with np.load(source, allow_pickle=False) as content:
        arrays = {**content, **changed}
    np.savez(target, **arrays)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda t: {"frequencies": np.array([{"a": 1}], dtype=object)}, "not a readable"),
        (lambda t: {"acceleration": t.acceleration.astype(np.complex128)}, "not a readable"),
        (lambda t: {"acceleration": t.acceleration * np.complex64(np.nan)}, "damaged"),
        (lambda t: {"cell_sources": t.cell_sources[:10]}, "damaged"),
        (lambda t: {"extra": np.zeros(3)}, "not a readable"),
        (lambda t: {"header": np.frombuffer(b"{}", dtype=np.uint8)}, "bad header"),
        (lambda t: {"header": np.frombuffer(b"\xff\x00", dtype=np.uint8)}, "bad header"),
    ],
    ids=["pickle", "type", "nan", "fewer", "more members", "empty header", "binary header"],
)
def test_a_forged_file_is_refused(table, tmp_path, change, says):
    """Pickles, other types, missing or extra members: nothing of it is used."""
    save_table(table, tmp_path / "t.npz")
    repacked(tmp_path / "t.npz", tmp_path / "forged.npz", **change(table))
    with pytest.raises(InputError, match=says):
        load_table(tmp_path / "forged.npz")


def test_a_compressed_bomb_is_refused_before_it_is_unpacked(table, tmp_path):
    """A member that claims gigabytes is refused by its size, not read."""
    path = tmp_path / "bomb.npz"
    save_table(table, tmp_path / "t.npz")
    with (
        zipfile.ZipFile(tmp_path / "t.npz") as good,
        zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as bad,
    ):
        for info in good.infolist():
            bad.writestr(info.filename, good.read(info))
    with pytest.raises(InputError, match="compressed"):
        load_table(path)


def test_more_than_the_file_has_is_not_read(table, tmp_path):
    """Members that declare a terabyte between them, in a file of kilobytes."""
    path = tmp_path / "vast.npz"
    save_table(table, tmp_path / "t.npz")
    with zipfile.ZipFile(tmp_path / "t.npz") as good, zipfile.ZipFile(path, "w") as bad:
        for info in good.infolist():
            bad.writestr(info.filename, good.read(info))
        bad.filelist[0].file_size = 1 << 40
    with pytest.raises(InputError, match=r"it declares 1\d{12} bytes"):
        load_table(path)


def test_an_old_format_says_how_to_rebuild(table, tmp_path):
    """Another format version is refused with the command that makes a new table."""
    save_table(table, tmp_path / "t.npz")
    with np.load(tmp_path / "t.npz") as content:
        header = json.loads(content["header"].tobytes())
    header["format_version"] = 0
    encoded = np.frombuffer(json.dumps(header).encode(), dtype=np.uint8)
    repacked(tmp_path / "t.npz", tmp_path / "old.npz", header=encoded)
    with pytest.raises(InputError, match=r"version 0.*era table build"):
        load_table(tmp_path / "old.npz")


@pytest.mark.parametrize(
    ("frequencies", "says"),
    [
        ([], "at least one"),
        ([100.0, 100.0], "ascend"),
        ([200.0, 100.0], "ascend"),
        ([10.0], "limits"),
        ([100.0, 900.0], "limits"),
        ([100.0, float("nan")], "numbers"),
    ],
)
def test_impossible_frequencies_are_refused(rig, frequencies, says):
    """None, unordered, outside the rig's limits, not a number."""
    with pytest.raises(InputError, match=says):
        build_table(rig, frequencies=np.array(frequencies))


def test_the_summary_counts_what_the_table_holds(table):
    """Every cell of the paper's plate can be made to feel it; contrast falls with more fingers."""
    summary = summarize(table, find_weak_cells(table))
    assert summary["cells"] == 108
    assert summary["patterns"] == 4482
    assert summary["dead_zone_share"] == 0.0
    medians = [summary[f"contrast_{k}_quiet_median_db"] for k in (1, 2, 3)]
    assert medians[0] > medians[1] > medians[2] > 0


def test_a_small_plate_has_no_contact_sets_to_show():
    """Where no two fingers fit 5 cm apart the distribution is empty, not an endless loop."""
    rig = make_paper_rig(6, 6)
    small = replace(
        rig,
        plate=replace(rig.plate, length=0.03, width=0.03),
        mesh=replace(rig.mesh, length=0.03, width=0.03),
        eras=tuple(replace(era, x=0.03 * (era.x > 0), y=0.03 * (era.y > 0)) for era in rig.eras),
    )
    built = build_table(small, grid=Grid(2, 2))
    summary = summarize(built, find_weak_cells(built))
    assert summary["contrast_1_quiet_median_db"] is None


def test_the_header_names_every_parameter(table, tmp_path):
    """Plain JSON: plate, ERAs, frequencies, grid, mesh, raster, mode, version, how wrong it is."""
    save_table(table, tmp_path / "t.npz")
    with np.load(tmp_path / "t.npz") as content:
        header = json.loads(content["header"].tobytes())
    assert header["frequencies_hz"] == list(range(60, 321, 10))
    assert header["plate"]["thickness"] == 0.0015
    assert [era["stroke"] for era in header["eras"]] == [100e-6] * 4
    assert (header["mesh"]["nx"], header["mesh"]["element"]) == (6, "Q5")
    assert (header["grid"]["nx"], header["grid"]["ny"], header["mode"]) == (12, 9, "switched")
    assert header["raster"]["nx"] * header["raster"]["ny"] == len(table.acceleration)
    assert header["discretisation_error"] == table.discretisation_error.tolist()
    assert header["reference_mesh"]["nx"] > header["mesh"]["nx"]
    assert header["code_version"].startswith("0.")


def other_frequencies(header, arrays):
    """In the header alone."""
    header["frequencies_hz"][0] = 61.0


def descending_frequencies(header, arrays):
    """In the header and in the array."""
    header["frequencies_hz"].reverse()
    arrays["frequencies"] = arrays["frequencies"][::-1].copy()


def no_frequencies(header, arrays):
    """And nothing at them."""
    header["frequencies_hz"], header["discretisation_error"] = [], []
    arrays["frequencies"] = arrays["frequencies"][:0]
    arrays["acceleration"] = arrays["acceleration"][:, :0].copy()
    arrays["cell_sources"] = arrays["cell_sources"][:1]


def cells_that_are_no_count(header, arrays):
    """A count with a decimal point."""
    header["grid"]["nx"] = 12.5


def raster_that_is_no_count(header, arrays):
    """A side of so many and a half points."""
    header["raster"]["nx"] += 0.5


def nothing_moves(header, arrays):
    """At any frequency."""
    arrays["acceleration"] *= 0


def more_than_any_plate(header, arrays):
    """What overflows when it is squared."""
    arrays["acceleration"][3, 2, 1] = 1e30


def not_a_number(header, arrays):
    """One of all fields."""
    arrays["acceleration"][0, 0, 0] = np.nan


def another_plates_fingerprint(header, arrays):
    """So that it would serve a rig that it was not built for."""
    header["fingerprint"] = "0" * 64


def raster_of_another_size(header, arrays):
    """Fingers would be looked for elsewhere."""
    header["raster"]["length"] *= 1.1


def unknown_mode(header, arrays):
    """What no question could be answered in."""
    header["mode"] = "loud"


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (another_plates_fingerprint, "fingerprint is not that of the plate"),
        (raster_of_another_size, "raster is not of the plate's size"),
        (unknown_mode, "unknown drive mode 'loud'"),
        (raster_that_is_no_count, "bad header .raster.nx"),
        (nothing_moves, "acceleration is zero everywhere"),
        (more_than_any_plate, r"values up to 1e\+30"),
        (not_a_number, "not numbers"),
        (other_frequencies, "header's frequencies"),
        (descending_frequencies, "do not ascend"),
        (no_frequencies, "frequencies are none"),
        (cells_that_are_no_count, "bad header .grid.nx"),
    ],
)
def test_a_header_that_contradicts_the_table_is_refused(table, tmp_path, change, says):
    """Frequencies and counts that cannot be, fields of no plate; the checksum is that of all."""
    save_table(table, tmp_path / "t.npz")
    with np.load(tmp_path / "t.npz") as content:
        arrays = dict(content)
    header = json.loads(arrays.pop("header").tobytes())
    change(header, arrays)
    del header["sha256"]
    header["sha256"] = digest_of(json.dumps(header, sort_keys=True), arrays)
    encoded = np.frombuffer(json.dumps(header).encode(), dtype=np.uint8)
    np.savez(tmp_path / "t.npz", header=encoded, **arrays)
    with pytest.raises(InputError, match=says):
        load_table(tmp_path / "t.npz")
