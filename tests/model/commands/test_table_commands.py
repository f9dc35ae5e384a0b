"""`era table` as a user types it: build, show, verify, plot, export."""

import json
import os
import re
import shlex
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import Result
from typer.testing import CliRunner

from model.cli import app
from model.errors import InputError
from model.rig.file import example_rig_path
from model.table.file import load_table, save_table
from same_code import era_program

RUNNER = CliRunner()
RIG = str(example_rig_path())
QUICK = ["--mesh", "12x9", "--frequencies", "60,110,250", "--grid", "4x3"]
PNG = b"\x89PNG\r\n\x1a\n"


def table(*arguments: str | Path) -> Result:
    """Run `era table`; what it raises is raised here."""
    result = RUNNER.invoke(app, ["table", *map(str, arguments)])
    if isinstance(result.exception, Exception):
        raise result.exception
    return result


def as_json(*arguments: str | Path) -> dict[str, Any]:
    """The one object that it prints."""
    answer: dict[str, Any] = json.loads(table(*arguments, "--json").stdout)
    return answer


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small table of the example rig."""
    path = tmp_path_factory.mktemp("built") / "t.npz"
    table("build", RIG, "-o", path, *QUICK)
    return path


def test_build_says_what_it_made(tmp_path: Path) -> None:
    """Patterns, cells, time, how wrong the mesh is, the file, one next step; nothing else is left.

    66 patterns: 4 * 3 alone and 6 * 3² in pairs.
    """
    path = tmp_path / "t.npz"
    lines = table("build", RIG, "-o", path, *QUICK).stdout.splitlines()
    assert lines[0].startswith("66 patterns of 3 frequencies for 12 cells, built in ")
    assert "12x9" in lines[1]
    assert "% of a finer one" in lines[1]
    assert lines[-2].startswith(f"wrote {path}")
    assert lines[-1] == f"Next: era table show {path}"
    assert list(tmp_path.iterdir()) == [path]


def test_build_as_json(tmp_path: Path) -> None:
    """Everything that made the table, units in the names."""
    path = tmp_path / "t.npz"
    answer = as_json("build", RIG, "-o", path, "--mode", "phased", *QUICK)
    assert answer["frequencies_hz"] == [60.0, 110.0, 250.0]
    assert (answer["patterns"], answer["cells"], answer["mode"]) == (66, 12, "phased")
    assert (answer["mesh"], answer["element"]) == ([12, 9], "MITC4")
    assert 10 < answer["discretisation_error_percent"] < 100  # the paper's mesh is a coarse one
    assert answer["parts_reused"] == 0
    assert answer["files"] == [str(path)]
    assert load_table(path).fingerprint == answer["fingerprint"]


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["-o", "{tmp}/none/t.npz"], "folder that exists"),
        (["-o", "{tmp}"], "name of a file"),
        (["-o", "{tmp}/t.npz", "--mode", "loud"], "switched, graded, signed, phased"),
        (["-o", "{tmp}/t.npz", "--grid", "many"], "12x9"),
        (["-o", "{tmp}/t.npz", "--grid", "0x3"], "1x1 to 200x200"),
        (["-o", "{tmp}/t.npz", "--frequencies", "600:700:10"], "limits"),
    ],
)
def test_build_refuses_what_cannot_be(tmp_path: Path, arguments: list[str], says: str) -> None:
    """A clear error, and nothing is left behind."""
    with pytest.raises(InputError, match=says):
        table("build", RIG, "--mesh", "12x9", *(each.format(tmp=tmp_path) for each in arguments))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("ending", "status"), [(signal.SIGINT, 130), (signal.SIGKILL, -signal.SIGKILL)]
)
def test_an_ended_build_goes_on(tmp_path: Path, ending: signal.Signals, status: int) -> None:
    """Ctrl-C or a kill in the middle, two workers; the same command then uses what was done."""
    path, folder = tmp_path / "t.npz", tmp_path / "t.npz.parts"
    long = ["--mesh", "12x9", "--frequencies", "60:320:4", "--grid", "48x36"]
    with subprocess.Popen(
        [sys.executable, "-c", era_program(), "table", "build", RIG, "-o", str(path), *long,
         "--workers", "2"],
        stderr=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        text=True,
        start_new_session=True,
    ) as running:  # fmt: skip
        while len(list(folder.glob("*.part.npz"))) < 3:
            assert running.poll() is None
            time.sleep(0.01)
        os.killpg(running.pid, ending)
        _, said = running.communicate(timeout=60)
    assert running.returncode == status
    assert not path.exists()
    if ending is signal.SIGINT:
        assert "goes on from there" in said
        assert "Traceback" not in said
    kept = len(list(folder.glob("[!.]*.part.npz")))
    assert kept >= 3
    again = table("build", RIG, "-o", path, *long).stdout
    assert f"reused {kept} of " in again
    assert [left.name for left in tmp_path.iterdir()] == ["t.npz"]


def test_show_as_text(built: Path) -> None:
    """Cells, feasible share, dead zones, contrast, likeness, provenance, and the map of 4 by 3."""
    lines = table("show", built, "--weak").stdout.splitlines()
    text = "\n".join(lines)
    for name in (
        "feasible cells",
        "dead zones           0 %",
        "contrast to 3 others",
        "patterns alike",
        "12x9",
        "fingerprint",
    ):
        assert name in text
    start = next(number for number, line in enumerate(lines) if line.startswith("contrast in dB"))
    assert [len(line.split()) for line in lines[start + 1 : start + 4]] == [4, 4, 4]
    stars = sum(line.count("*") for line in lines[start + 1 : start + 4])
    assert sum(line.startswith("(0.") for line in lines) == stars > 0
    assert re.fullmatch(r"judged in \d+\.\d s", lines[-2])


def test_show_ends_with_a_question_that_can_be_asked(built: Path, tmp_path: Path) -> None:
    """The next command as a shell takes it, a space in the table's name included, is answered."""
    spaced = tmp_path / "my table.npz"
    spaced.write_bytes(built.read_bytes())
    era, group, *words = shlex.split(table("show", spaced).stdout.splitlines()[-1])[1:]
    assert (era, group, words[1]) == ("era", "table", str(spaced))
    assert as_json(*words)["contrast_db"] > 0


def test_show_as_json(built: Path) -> None:
    """Shares, contrasts and the map with its centres."""
    answer = as_json("show", built)
    assert answer["cells"] == 12
    assert answer["patterns"] == 66
    assert 0 <= answer["feasible_share"] <= 1
    assert 0 <= answer["alike_pattern_pairs_share"] < 0.5
    assert len(answer["map"]["centres_m"]) == len(answer["map"]["is_weak"]) == 12
    assert np.mean(answer["map"]["is_weak"]) == answer["weak_share"]
    assert answer["code_version"]


def test_verify_confirms_a_true_table(built: Path) -> None:
    """Status 0, a row for each sample, and how many hold."""
    result = table("verify", built, RIG, "--samples", "3")
    assert result.exit_code == 0
    rows = [line for line in result.stdout.splitlines() if line.endswith("holds")]
    assert len(rows) == 6
    assert "6 of 6 hold (seed 0)" in result.stdout


def test_verify_finds_a_false_table_out(built: Path, tmp_path: Path) -> None:
    """One ERA's field a tenth stronger, the checksum right: status 1, in JSON as well."""
    true = load_table(built)
    stronger = true.acceleration.copy()
    stronger[:, :, 2] *= 1.1
    save_table(replace(true, acceleration=stronger), tmp_path / "false.npz")
    result = table("verify", tmp_path / "false.npz", RIG, "--samples", "3")
    assert result.exit_code == 1
    assert "MISS" in result.stdout
    assert result.stdout.splitlines()[-1].startswith("Next: era table build")
    told = table("verify", tmp_path / "false.npz", RIG, "--samples", "3", "--json")
    assert told.exit_code == 1
    assert json.loads(told.stdout)["misses"] > 0


def test_verify_refuses_another_plate_first(built: Path, tmp_path: Path) -> None:
    """A rig of another thickness: its fingerprint is told before anything is computed."""
    other = tmp_path / "other.yaml"
    other.write_text(Path(RIG).read_text().replace("1.5 mm", "1.6 mm"))
    with pytest.raises(InputError, match="another plate"):
        table("verify", built, other)
    with pytest.raises(InputError, match="the table comes first, then the rig"):
        table("verify", RIG, built)


def test_contacts_that_cannot_be_read_are_told_by_their_option(built: Path) -> None:
    """No target at all, and one with a unit."""
    with pytest.raises(InputError, match=r"with --target X,Y, metres, or .* --batch FILE"):
        table("query", built, "--quiet", "0.1,0.1")
    with pytest.raises(InputError, match=r"--target '9cm,8cm' .* metres without a unit"):
        table("query", built, "--target", "9cm,8cm")


def test_a_build_that_is_interrupted_at_once_names_no_folder(tmp_path: Path, monkeypatch) -> None:
    """Nothing is kept yet, so nothing goes on."""

    def interrupted(*arguments: object, **options: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("model.table.build.build_in_parts", interrupted)
    outcome = CliRunner().invoke(
        app, ["table", "build", RIG, "-o", str(tmp_path / "t.npz"), *QUICK]
    )
    assert "interrupted; nothing was done yet" in outcome.stderr
    assert ".parts" not in outcome.stderr


def test_plot_writes_its_pictures(built: Path, tmp_path: Path) -> None:
    """Four of them in a new folder; the names are told."""
    folder = tmp_path / "new" / "pictures"
    answer = as_json("plot", built, "-o", folder)
    names = ["weak_cells", "levels", "contrast", "answer"]
    assert answer["files"] == [str(folder / f"{name}.png") for name in names]
    for file in answer["files"]:
        assert Path(file).read_bytes().startswith(PNG)


def test_plot_says_how_long_it_took_what_it_wrote_and_what_is_next(
    built: Path, tmp_path: Path
) -> None:
    """The time, a line for each of the four pictures, and a command."""
    lines = table("plot", built, "-o", tmp_path).stdout.splitlines()
    assert re.fullmatch(r"\d+\.\d s; wrote", lines[0])
    assert {Path(line.strip()) for line in lines[1:5]} == set(tmp_path.glob("*.png"))
    assert lines[5:] == [f"Next: era table show {built} --weak"]


def test_export_writes_both_formats(built: Path, tmp_path: Path) -> None:
    """The file and how to open it are told; --content is for CSV only."""
    said = table("export", built, "--format", "mat", "-o", tmp_path / "t.mat").stdout
    assert "loadmat" in said.splitlines()[-1]
    table("export", built, "--format", "csv", "-o", tmp_path / "t.csv")
    table("export", built, "--format", "csv", "--content", "fields", "-o", tmp_path / "f.csv")
    heads = [(tmp_path / name).read_text().split(",")[0] for name in ("t.csv", "f.csv")]
    assert heads == ["SW_hz", "x_m"]
    with pytest.raises(InputError, match="--content"):
        table("export", built, "--format", "mat", "--content", "fields", "-o", tmp_path / "t.mat")


def test_a_rig_is_not_taken_for_a_table_nor_replaced_by_one(tmp_path: Path) -> None:
    """Neither build nor export writes over a file of another kind; asking says what it is not."""
    rig = tmp_path / "rig.yaml"
    rig.write_bytes(Path(RIG).read_bytes())
    made = tmp_path / "t.npz"
    table("build", RIG, "-o", made, *QUICK)
    for arguments in (
        ("build", RIG, "-o", rig, *QUICK),
        ("export", made, "--format", "csv", "-o", rig),
        ("export", made, "--format", "mat", "-o", tmp_path / "t.csv"),
    ):
        with pytest.raises(InputError, match=r"ends in \.(npz|csv|mat); try "):
            table(*arguments)
    with pytest.raises(InputError, match="give a file that era table build has written"):
        table("query", rig, "--target", "0.1,0.1")
    assert rig.read_bytes() == Path(RIG).read_bytes()
    table("build", RIG, "-o", made, *QUICK)  # a table gives way to a newer one
