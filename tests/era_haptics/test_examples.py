"""The notebooks of the examples and the code on the API page, executed."""

import os
import re
import runpy
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import era_haptics as era
from python_page import named

ROOT = Path(__file__).parents[2]
EXAMPLES = ROOT / "examples"
PAGE = (ROOT / "docs" / "reference" / "python-api.md").read_text("utf-8")

# Founding paper, in-house column of Table 2 [Hz].
TABLE_2 = ["31.98", "68.50", "76.62", "107.84", "160.77"]


@pytest.fixture(scope="module")
def cache(table_cache: Path) -> Iterator[None]:
    """A cache of tables of the tests' own."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(table_cache))
        yield


def run(name: str) -> str:
    """Run an example as a script and return its output; a busy machine may be warned."""
    done = subprocess.run(
        [sys.executable, EXAMPLES / name],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "MPLBACKEND": "Agg"},
    )
    errors = [line for line in done.stderr.splitlines() if '"level": "warning"' not in line]
    assert (done.returncode, errors) == (0, [])
    return done.stdout


def number_in(text: str, pattern: str) -> float:
    """The only number that matches a pattern."""
    (found,) = re.findall(pattern, text)
    return float(found)


@pytest.mark.long
@pytest.mark.usefixtures("cache")
def test_researcher_example_reproduces_the_paper(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Table 2, two contents apart, predicted against played measures, and pictures."""
    monkeypatch.setenv("ERA_PICTURES", str(tmp_path))
    ran: dict[str, Any] = runpy.run_path(str(EXAMPLES / "researcher.py"))
    assert [f"{frequency:.2f}" for frequency in ran["paper_frequencies"]] == TABLE_2
    assert all(felt.promised_contrast_db > 12 for felt in ran["both"].fingers)
    for answer, felt in ran["played"].values():
        predicted, more = answer.fingers[0], era.measures(ran["table"], answer)
        assert felt.contrast_db == pytest.approx(predicted.contrast_db, abs=0.2)
        assert felt.transient_contrast_db == pytest.approx(more.transient_contrast_db, abs=0.4)
        assert felt.level_db_sl == pytest.approx(predicted.level_db_sl, abs=0.05)
    ramp, shaped = (
        felt.contrast_db - felt.transient_contrast_db for _, felt in ran["played"].values()
    )
    assert shaped < 0.75 * ramp  # of the steady contrast is lost while it starts
    assert sum(felt >= ran["promised"] for felt in ran["drawn"]) >= 7
    assert (ran["study"]["phased"] >= ran["study"]["switched"] - 0.5).all()
    assert np.diff(ran["study"]["phased"]).min() > 0  # the farther, the easier
    pictures = sorted(path.name for path in tmp_path.iterdir())
    assert pictures == ["answer.png", "contents.png", "map.png", "ramp.png", "shaped.png"]


@pytest.mark.long
@pytest.mark.alone
@pytest.mark.usefixtures("cache")
def test_hmi_engineer_example_feels_what_was_predicted() -> None:
    """The contrast on the plate in time is the predicted one, and the daemon ends with status 0."""
    said = run("hmi_engineer.py")
    felt = number_in(said, r"contrast (\S+) dB felt")
    predicted = number_in(said, r"(\S+) dB predicted")
    assert predicted > 20
    assert felt == pytest.approx(predicted, abs=1.5)  # it has vibrated for a second
    assert "daemon ended with status 0" in said


@pytest.mark.usefixtures("cache")
def test_page_example_feels_what_was_predicted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Twelve lines, executed as printed; played contrast is the predicted one."""
    (tmp_path / "examples").mkdir()
    shutil.copy(EXAMPLES / "paper_plate.yaml", tmp_path / "examples")
    monkeypatch.chdir(tmp_path)
    lines = re.findall(r"^```python\n(.*?)^```$", PAGE, re.MULTILINE | re.DOTALL)[0]
    assert len(lines.split("\n\n")[1].splitlines()) == 12
    (tmp_path / "page.py").write_text(lines, "utf-8")
    ran = runpy.run_path("page.py")
    assert ran["felt"].contrast_db == pytest.approx(ran["only"].fingers[0].contrast_db, abs=0.2)
    assert (tmp_path / "contents.png").stat().st_size > 10_000


@pytest.mark.usefixtures("cache")
def test_readme_program_prints_what_is_said_of_each_finger(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """As the README shows it, a line a finger; the quiet one has no contrast of its own."""
    readme = (EXAMPLES.parent / "README.md").read_text("utf-8")
    (tmp_path / "examples").mkdir()
    shutil.copy(EXAMPLES / "paper_plate.yaml", tmp_path / "examples")
    monkeypatch.chdir(tmp_path)
    (lines,) = re.findall(r"^```python\n(.*?)^```$", readme, re.MULTILINE | re.DOTALL)
    (shown,) = re.findall(r"^```text\n(.*?)^```$", readme, re.MULTILINE | re.DOTALL)
    (tmp_path / "readme.py").write_text(lines, "utf-8")
    runpy.run_path("readme.py")
    printed = capsys.readouterr().out
    assert printed == shown
    assert ["contrast" in line for line in printed.splitlines()] == [True, True, True, False]


def test_page_rig_needs_no_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Nine lines, executed as printed: of three plates the thickest has the most contrast."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    lines = re.findall(r"^```python\n(.*?)^```$", PAGE, re.MULTILINE | re.DOTALL)[1]
    exec(lines, {"era": era})
    contrasts = [float(line.split()[1]) for line in capsys.readouterr().out.splitlines()]
    assert len(contrasts) == 3
    assert contrasts == sorted(contrasts)


def test_page_documents_every_name() -> None:
    """Exactly the exported names."""

    documented = named(PAGE)
    errors = set(re.findall(r"`(\w+)`", PAGE.partition("| exception")[2].partition("\n## ")[0]))
    assert documented | (errors & set(era.__all__)) == set(era.__all__)
    assert documented & errors == set()
