"""Building a table in parts: by several processes, interrupted, resumed."""

import logging
import shutil
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

FREQUENCIES = np.array([60.0, 90.0, 110.0])
PARTS = 2  # discretisation and modes


def quick_rig(nx=12, ny=9):
    """The paper's plate with frequencies up to 120 Hz, so that its reference mesh is coarse."""
    rig = make_paper_rig(nx, ny)
    return replace(rig, limits=replace(rig.limits, frequency_max=120.0))


@pytest.fixture(scope="module")
def problem():
    """A small table's."""
    return TableProblem(quick_rig(), FREQUENCIES, Grid(4, 3))


@pytest.fixture(scope="module")
def whole(problem, tmp_path_factory):
    """Folder with the file of an uninterrupted build by one process, and with its parts."""
    folder = tmp_path_factory.mktemp("whole")
    kept = KeptParts.beside(folder / "t.npz", problem.digest)
    save_table(build_in_parts(problem, drive_mode="switched", kept=kept).table, folder / "t.npz")
    return folder


@pytest.fixture
def kept(problem, whole, tmp_path):
    """A copy of the parts, those of an interrupted build."""
    shutil.copytree(whole / "t.npz.parts", tmp_path / "t.npz.parts")
    return KeptParts.beside(tmp_path / "t.npz", problem.digest)


def file_of(build, folder):
    """The bytes of a build's table."""
    save_table(build.table, folder / "again.npz")
    return (folder / "again.npz").read_bytes()


@pytest.mark.long
def test_build_is_the_same_to_the_bit_by_two_processes(problem, whole, tmp_path):
    """Whichever process solves a part."""
    build = build_in_parts(problem, drive_mode="switched", workers=2)
    assert file_of(build, tmp_path) == (whole / "t.npz").read_bytes()


def test_build_keeps_the_parts_that_were_finished_when_it_was_interrupted(problem, tmp_path):
    """One of two, and no other file."""

    def progress(done, of):
        assert of == PARTS
        if done == 1:
            raise KeyboardInterrupt

    kept = KeptParts.beside(tmp_path / "t.npz", problem.digest)
    with pytest.raises(KeyboardInterrupt):
        build_in_parts(problem, drive_mode="switched", kept=kept, progress=progress)
    assert len(list(kept.folder.iterdir())) == 1


@pytest.mark.parametrize("kind", ["modes", "discretisation"])
def test_resumed_build_is_the_same_to_the_bit(problem, whole, kept, tmp_path, kind):
    """The missing part is put in its place; a resumed build may have another drive mode."""
    (part,) = kept.folder.glob(f"{kind}-*")
    part.unlink()
    build = build_in_parts(problem, drive_mode="switched", kept=kept)
    assert (build.reused_count, build.part_count) == (PARTS - 1, PARTS)
    assert file_of(build, tmp_path) == (whole / "t.npz").read_bytes()
    phased = build_in_parts(problem, drive_mode="phased", kept=kept)
    assert (phased.reused_count, phased.table.drive_mode) == (PARTS, "phased")


def test_clear_removes_parts_only(kept):
    """Half-written ones too; the folder goes with them if it is then empty."""
    (kept.folder / ".modes-0123.part.npz.4567").write_text("half-written by a killed build")
    (kept.folder / "notes.txt").write_text("not a part")
    kept.clear()
    assert [path.name for path in kept.folder.iterdir()] == ["notes.txt"]


@pytest.mark.parametrize("what", ["frequencies", "plate", "grid", "mesh", "numerics"])
def test_parts_of_another_table_are_not_used(problem, kept, caplog, monkeypatch, what):
    """Anything that changes the numbers changes what is looked for; none counts as damaged."""
    softer = replace(problem.rig, plate=replace(problem.rig.plate, loss_factor=0.02))
    changes = {
        "frequencies": {"frequencies": FREQUENCIES + 1},
        "plate": {"rig": softer},
        "grid": {"grid": Grid(3, 4)},
        "mesh": {"rig": quick_rig(14, 9)},
        "numerics": {},
    }
    assert all(kept.load(part) is not None for part in problem.parts())
    if what == "numerics":
        monkeypatch.setattr(table_parts, "NUMERICS_VERSION", 0)
    other = replace(problem, **changes[what])
    kept = replace(kept, problem_digest=other.digest)
    with caplog.at_level(logging.WARNING):
        assert [part for part in other.parts() if kept.load(part) is not None] == []
    assert caplog.text == ""


@pytest.mark.parametrize("harm", ["flip", "cut", "swap", "edit"])
def test_build_solves_a_damaged_part_again(problem, whole, kept, tmp_path, caplog, harm):
    """A flipped bit, a cut file, another part, an edited one: not used, named."""
    (path,) = kept.folder.glob("modes-*")
    data = bytearray(path.read_bytes())
    match harm:
        case "flip":
            data[len(data) // 2] ^= 1
        case "cut":
            del data[len(data) // 2 :]
        case "edit":
            with np.load(path) as content:
                arrays = dict(content)
            arrays["omega"][0] = 1
            np.savez(path, **arrays)
            data = bytearray(path.read_bytes())
        case "swap":
            (other,) = kept.folder.glob("discretisation-*")
            data = bytearray(other.read_bytes())
    path.write_bytes(data)
    with caplog.at_level(logging.WARNING):
        build = build_in_parts(problem, drive_mode="switched", kept=kept)
    assert path.name in caplog.text
    assert build.reused_count == PARTS - 1
    assert file_of(build, tmp_path) == (whole / "t.npz").read_bytes()


def test_build_states_the_discretisation_error_of_the_worst_era():
    """That of a convergence study, on elements and another raster, with an ERA inside the plate."""
    rig = quick_rig()
    rig = replace(rig, eras=(replace(rig.eras[0], x=0.11, y=0.09), *rig.eras[1:]))
    table = build_in_parts(TableProblem(rig, FREQUENCIES, Grid(2, 2)), drive_mode="switched").table
    study = study_convergence(rig, [rig.mesh], frequencies=FREQUENCIES.tolist())
    assert table.reference_mesh != study.reference
    np.testing.assert_allclose(table.discretisation_error, study.errors[0].response, rtol=0.1)


def test_build_refuses_an_unknown_drive_mode(problem):
    """The error lists those there are."""
    with pytest.raises(InputError, match="switched, phased"):
        build_in_parts(problem, drive_mode="loud")
