"""Building a table in parts: shared out, interrupted, gone on with."""

import logging
from dataclasses import replace

import numpy as np
import pytest

from model.errors import InputError
from model.finger.grid import Grid
from model.table import table_parts
from model.table.build import build_in_parts
from model.table.file import save_table
from model.table.kept_parts import KeptParts
from model.table.table_parts import TableProblem
from model.vibration.convergence import study_convergence
from paper_plate import make_paper_rig
from small_table import FREQUENCIES, small_problem

PARTS = 4  # discretisation, modes, fields and cells of a small table


@pytest.fixture(scope="module")
def problem():
    """A small table's."""
    return small_problem()


@pytest.fixture(scope="module")
def whole(problem, tmp_path_factory):
    """The file of an uninterrupted build by one process."""
    path = tmp_path_factory.mktemp("whole") / "t.npz"
    save_table(build_in_parts(problem, drive_mode="switched").table, path)
    return path.read_bytes()


def file_of(build, folder):
    """The bytes of a build's table."""
    save_table(build.table, folder / "t.npz")
    return (folder / "t.npz").read_bytes()


def interrupt_after(count):
    """A progress callback that presses Ctrl-C once so many parts are done."""

    def progress(done, of):
        assert of == PARTS
        if done == count:
            raise KeyboardInterrupt

    return progress


def interrupted(problem, folder, *, after):
    """Parts left by a build that was interrupted."""
    kept = KeptParts.beside(folder / "t.npz", problem.digest)
    with pytest.raises(KeyboardInterrupt):
        build_in_parts(problem, drive_mode="switched", kept=kept, progress=interrupt_after(after))
    assert len(list(kept.folder.iterdir())) == after
    return kept


def test_two_processes_make_the_same_file(problem, whole, tmp_path):
    """To the bit, whoever solves which part."""
    build = build_in_parts(problem, drive_mode="switched", workers=2)
    assert build.part_count == PARTS
    assert file_of(build, tmp_path) == whole


def test_an_interrupted_build_goes_on(problem, whole, tmp_path):
    """What was done is not done again, and the file is that of a build without interruption."""
    kept = interrupted(problem, tmp_path, after=3)
    told: list[int] = []
    build = build_in_parts(
        problem, drive_mode="switched", kept=kept, progress=lambda done, of: told.append(done)
    )
    assert build.reused_count == 3
    assert told == [3, PARTS]
    assert file_of(build, tmp_path) == whole
    kept.clear()
    assert not kept.folder.exists()


def test_whichever_part_is_missing_comes_where_it_belongs(problem, tmp_path, monkeypatch):
    """Twelve cells in shares of five: one share lost, the table is that of a build in one go."""
    monkeypatch.setattr(table_parts, "CELLS_PER_PART", 5)
    whole = file_of(build_in_parts(problem, drive_mode="switched"), tmp_path)
    kept = KeptParts.beside(tmp_path / "t.npz", problem.digest)
    build_in_parts(problem, drive_mode="switched", kept=kept)
    shares = sorted(kept.folder.glob("cells-*"))
    assert len(shares) == 3
    for share in shares:
        share.unlink()
        build = build_in_parts(problem, drive_mode="switched", kept=kept)
        assert (build.reused_count, build.part_count) == (5, 6)
        assert file_of(build, tmp_path) == whole


def test_kept_parts_are_for_any_mode(problem, tmp_path):
    """The mode is no part of what is solved."""
    kept = interrupted(problem, tmp_path, after=2)
    build = build_in_parts(problem, drive_mode="phased", kept=kept)
    assert build.reused_count == 2
    assert build.table.drive_mode == "phased"


@pytest.mark.parametrize("what", ["frequencies", "plate", "grid", "mesh", "numerics"])
def test_parts_of_another_table_are_not_used(problem, tmp_path, caplog, what):
    """Anything that changes the numbers changes what is looked for; nothing is called damaged."""
    interrupted(problem, tmp_path, after=3)
    rig = problem.rig
    other = {
        "frequencies": lambda: replace(problem, frequencies=FREQUENCIES + 1),
        "plate": lambda: replace(
            problem, rig=replace(rig, plate=replace(rig.plate, loss_factor=0.02))
        ),
        "grid": lambda: replace(problem, grid=Grid(3, 4)),
        "mesh": lambda: replace(problem, rig=make_paper_rig(14, 9)),
        "numerics": lambda: problem,
    }[what]()
    digest = other.digest
    if what == "numerics":
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(table_parts, "NUMERICS_VERSION", 0)
            digest = replace(problem).digest
    kept = KeptParts.beside(tmp_path / "t.npz", digest)
    with caplog.at_level(logging.WARNING):
        assert [part for part in other.parts() if kept.load(part) is not None] == []
    assert caplog.text == ""


@pytest.mark.parametrize("harm", ["flip", "cut", "swap", "stray", "edit"])
def test_a_damaged_part_is_told_and_solved_again(problem, whole, tmp_path, caplog, harm):
    """A flipped bit, a cut file, another part's or table's, an edited one: not used, named."""
    kept = interrupted(problem, tmp_path, after=3)
    (path,) = kept.folder.glob("fields-*")
    data = bytearray(path.read_bytes())
    if harm == "flip":
        data[len(data) // 2] ^= 1
    elif harm == "cut":
        del data[len(data) // 2 :]
    elif harm == "edit":
        with np.load(path) as content:
            arrays = dict(content)
        arrays["acceleration"][0] = 1
        np.savez(path, **arrays)
        data = bytearray(path.read_bytes())
    elif harm == "stray":
        (tmp_path / "other").mkdir()
        elsewhere = replace(problem, frequencies=FREQUENCIES + 1)
        (other,) = interrupted(elsewhere, tmp_path / "other", after=3).folder.glob("fields-*")
        data = bytearray(other.read_bytes())
    else:
        (other,) = kept.folder.glob("modes-*")
        data = bytearray(other.read_bytes())
    path.write_bytes(data)
    with caplog.at_level(logging.WARNING):
        build = build_in_parts(problem, drive_mode="switched", kept=kept)
    assert path.name in caplog.text
    assert "computed again" in caplog.text
    assert build.reused_count == 2
    assert file_of(build, tmp_path) == whole


def test_clearing_takes_what_is_ours(tmp_path):
    """Of a killed build a half-written part, too; a file of someone else's in the folder stays."""
    folder = tmp_path / "t.npz.parts"
    folder.mkdir()
    (folder / ".cells-0123.part.npz.4567").write_text("half")
    (folder / "notes.txt").write_text("mine")
    KeptParts.beside(tmp_path / "t.npz", "digest").clear()
    assert [path.name for path in folder.iterdir()] == ["notes.txt"]


def test_a_table_says_how_wrong_its_mesh_is():
    """The error stated is that of a convergence study, which compares on another raster.

    It is that of the worst ERA: one stands inside, so that they differ.
    """
    rig = make_paper_rig(24, 18)
    rig = replace(rig, eras=(replace(rig.eras[0], x=0.11, y=0.09), *rig.eras[1:]))
    frequencies = np.array([110.0, 165.0, 250.0])
    table = build_in_parts(TableProblem(rig, frequencies, Grid(2, 2)), drive_mode="switched").table
    study = study_convergence(rig, [rig.mesh], frequencies=frequencies.tolist())
    assert table.reference_mesh == study.reference
    np.testing.assert_allclose(table.discretisation_error, study.errors[0].response, rtol=0.1)


def test_a_table_too_large_to_be_read_is_refused_before_it_is_solved():
    """Two thousand frequencies on the finest grid: its size is told."""
    with pytest.raises(InputError, match="GB"):
        TableProblem(make_paper_rig(48, 36), np.linspace(40, 500, 2000), Grid(200, 200))


def test_an_unknown_mode_is_refused(problem):
    """The error lists those there are."""
    with pytest.raises(InputError, match="switched, graded, signed, phased"):
        build_in_parts(problem, drive_mode="loud")
