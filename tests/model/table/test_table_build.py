"""Building a table in parts: by several processes, interrupted, resumed."""

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
    return file_of(build_in_parts(problem, drive_mode="switched"), tmp_path_factory.mktemp("whole"))


def file_of(build, folder):
    """The bytes of a build's table."""
    save_table(build.table, folder / "t.npz")
    return (folder / "t.npz").read_bytes()


def interrupted(problem, folder, *, after):
    """Parts left by a build that was interrupted after so many."""

    def progress(done, of):
        assert of == PARTS
        if done == after:
            raise KeyboardInterrupt

    kept = KeptParts.beside(folder / "t.npz", problem.digest)
    with pytest.raises(KeyboardInterrupt):
        build_in_parts(problem, drive_mode="switched", kept=kept, progress=progress)
    assert len(list(kept.folder.iterdir())) == after
    return kept


def test_build_is_the_same_by_two_processes_and_resumed(problem, whole, tmp_path):
    """To the bit; finished parts are reused, for any drive mode, and then removed."""
    assert file_of(build_in_parts(problem, drive_mode="switched", workers=2), tmp_path) == whole
    kept = interrupted(problem, tmp_path, after=3)
    phased = build_in_parts(problem, drive_mode="phased", kept=KeptParts(**vars(kept)))
    assert (phased.reused_count, phased.table.drive_mode) == (3, "phased")
    progress: list[int] = []
    (kept.folder / min(path.name for path in kept.folder.iterdir())).unlink()
    build = build_in_parts(
        problem, drive_mode="switched", kept=kept, progress=lambda done, of: progress.append(done)
    )
    assert (build.reused_count, build.part_count) == (3, PARTS)
    assert progress == [3, PARTS]
    assert file_of(build, tmp_path) == whole
    (kept.folder / ".cells-0123.part.npz.4567").write_text("half-written by a killed build")
    (kept.folder / "notes.txt").write_text("not a part")
    kept.clear()
    assert [path.name for path in kept.folder.iterdir()] == ["notes.txt"]


def test_build_puts_each_missing_part_in_its_place(problem, tmp_path, monkeypatch):
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


@pytest.mark.parametrize("what", ["frequencies", "plate", "grid", "mesh", "numerics"])
def test_parts_of_another_table_are_not_used(problem, tmp_path, caplog, monkeypatch, what):
    """Anything that changes the numbers changes what is looked for; none counts as damaged."""
    interrupted(problem, tmp_path, after=3)
    thinner = replace(problem.rig, plate=replace(problem.rig.plate, loss_factor=0.02))
    changes = {
        "frequencies": {"frequencies": FREQUENCIES + 1},
        "plate": {"rig": thinner},
        "grid": {"grid": Grid(3, 4)},
        "mesh": {"rig": make_paper_rig(14, 9)},
        "numerics": {},
    }
    if what == "numerics":
        monkeypatch.setattr(table_parts, "NUMERICS_VERSION", 0)
    other = replace(problem, **changes[what])
    kept = KeptParts.beside(tmp_path / "t.npz", other.digest)
    with caplog.at_level(logging.WARNING):
        assert [part for part in other.parts() if kept.load(part) is not None] == []
    assert caplog.text == ""


@pytest.mark.parametrize("harm", ["flip", "cut", "swap", "stray", "edit"])
def test_build_solves_a_damaged_part_again(problem, whole, tmp_path, caplog, harm):
    """A flipped bit, a cut file, another part's or table's, an edited one: not used, named."""
    kept = interrupted(problem, tmp_path, after=3)
    (path,) = kept.folder.glob("fields-*")
    data = bytearray(path.read_bytes())
    match harm:
        case "flip":
            data[len(data) // 2] ^= 1
        case "cut":
            del data[len(data) // 2 :]
        case "edit":
            with np.load(path) as content:
                arrays = dict(content)
            arrays["acceleration"][0] = 1
            np.savez(path, **arrays)
            data = bytearray(path.read_bytes())
        case "stray":
            (tmp_path / "other").mkdir()
            elsewhere = replace(problem, frequencies=FREQUENCIES + 1)
            (other,) = interrupted(elsewhere, tmp_path / "other", after=3).folder.glob("fields-*")
            data = bytearray(other.read_bytes())
        case "swap":
            (other,) = kept.folder.glob("modes-*")
            data = bytearray(other.read_bytes())
    path.write_bytes(data)
    with caplog.at_level(logging.WARNING):
        build = build_in_parts(problem, drive_mode="switched", kept=kept)
    assert path.name in caplog.text
    assert build.reused_count == 2
    assert file_of(build, tmp_path) == whole


def test_build_states_the_discretisation_error_of_the_worst_era():
    """That of a convergence study, which compares on another raster; one ERA stands inside."""
    rig = make_paper_rig(24, 18)
    rig = replace(rig, eras=(replace(rig.eras[0], x=0.11, y=0.09), *rig.eras[1:]))
    frequencies = np.array([110.0, 165.0, 250.0])
    table = build_in_parts(TableProblem(rig, frequencies, Grid(2, 2)), drive_mode="switched").table
    study = study_convergence(rig, [rig.mesh], frequencies=frequencies.tolist())
    assert table.reference_mesh == study.reference
    np.testing.assert_allclose(table.discretisation_error, study.errors[0].response, rtol=0.1)


def test_build_refuses_an_unknown_drive_mode(problem):
    """The error lists those there are."""
    with pytest.raises(InputError, match="switched, graded, signed, phased"):
        build_in_parts(problem, drive_mode="loud")
