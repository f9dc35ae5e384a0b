"""Every benchmark starts; the data set of the contrast benchmark, its entries and its scores."""

import json
import re
import runpy
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from benchmarks.contrast.__main__ import (
    CHECKSUM,
    FILE,
    SetScore,
    app,
    read_entry,
    score,
    summary,
)
from model.errors import InputError

ROOT = Path(__file__).parents[2]
# Code below the line that starts the command.
_CODE_AFTER_START = re.compile(r"^if __name__ ==.*\n(\s.*\n|\n)*\S", re.MULTILINE)


def test_each_benchmark_starts() -> None:
    """Every module imports, and is complete before its command starts.

    Other solvers, `plate/peers`, need packages of their own.
    """
    files = sorted((ROOT / "benchmarks").rglob("*.py"))
    modules = []
    for file in files:
        assert not _CODE_AFTER_START.search(file.read_text("utf-8")), file
        parts = file.relative_to(ROOT).with_suffix("").parts
        if "peers" not in parts:
            modules.append(".".join(parts))
    program = f"import importlib\nfor name in {modules}: importlib.import_module(name)"

    subprocess.run([sys.executable, "-c", program], cwd=ROOT, check=True)


# The data set of the contrast benchmark, its entries and its scores

SET = "paper_plate/1-00"
DRIVE = {"SW": [200, 1.0, 0.0], "NE": [200, 0.7, 135.0]}
ROTATED = {"SW": [200, 1.0, 90.0], "NE": [200, 0.7, 225.0]}
HALF = {"SW": [200, 0.5, 0.0], "NE": [200, 0.35, 135.0]}
WEAK = {"SW": [200, 1e-4, 0.0], "NE": [200, 0.7e-4, 135.0]}


def write_entry(path: Path, patterns: Mapping[str, Any], **changes: Any) -> Path:
    """Write an entry with these patterns by set."""
    document = {"benchmark": "era-localization", "version": 1, "name": "test"}
    document |= {"patterns": patterns, **changes}
    path.write_text(json.dumps(document), encoding="utf-8")
    return path


def scores_of(path: Path, **options: bool) -> dict[str, SetScore]:
    """The scores of an entry by set."""
    _, patterns = read_entry(path)
    return score(patterns, **options)


def test_contrast_is_a_ratio_and_level_an_amplitude(tmp_path: Path) -> None:
    """The plate is linear: a common phase is not felt, half the amplitude loses 6.02 dB.

    In time, on a plate of another mesh, contrast is near its 10th percentile, or above.
    """
    path = tmp_path / "entry.json"
    full = scores_of(write_entry(path, {SET: DRIVE}))[SET]
    rotated = scores_of(write_entry(path, {SET: ROTATED}))[SET]
    half = scores_of(write_entry(path, {SET: HALF}))[SET]
    in_time = scores_of(path, in_time=True)[SET]

    assert rotated.contrast_db == pytest.approx(full.contrast_db, abs=0.1)
    assert half.contrast_db == pytest.approx(full.contrast_db, abs=1e-4)
    assert half.level_db_sl == pytest.approx(full.level_db_sl - 6.02, abs=1e-2)
    assert in_time.contrast_db - 3 < in_time.in_time_db < in_time.contrast_db + 12


def test_weak_and_missing_patterns_score_nothing(tmp_path: Path) -> None:
    """Both are missed with 0 dB; a plate without any pattern is not scored."""
    path = write_entry(tmp_path / "entry.json", {SET: WEAK, "paper_plate/1-01": DRIVE})

    scores = scores_of(path)

    assert len(scores) == 30
    assert scores[SET].contrast_db == 0.0
    assert scores[SET].is_missed
    assert scores["paper_plate/1-02"].is_missed
    assert not scores["paper_plate/1-01"].is_missed
    missed_by_quiet = {row["quiet"]: row["missed"] for row in summary(scores)}
    assert missed_by_quiet == {1: 9, 2: 10, 3: 10}


@pytest.mark.parametrize(
    ("patterns", "changes"),
    [
        ({"paper_plate/9-00": DRIVE}, {}),
        ({SET: {"E1": [200, 1.0, 0.0]}}, {}),
        ({SET: {"SW": [900, 1.0, 0.0]}}, {}),
        ({SET: {"SW": [200, 1.5, 0.0]}}, {}),
        ({SET: {"SW": [200, 0.0, 0.0]}}, {}),
        ({SET: {"SW": [200, 1.0]}}, {}),
        ({SET: DRIVE}, {"version": 2}),
        ({SET: DRIVE}, {"benchmark": "another"}),
    ],
)
def test_entry_that_cannot_be_scored_is_rejected(
    tmp_path: Path, patterns: Mapping[str, Any], changes: Mapping[str, Any]
) -> None:
    """Unknown sets, ERAs and versions, and tones beyond the limits of the rig."""
    path = write_entry(tmp_path / "entry.json", patterns, **changes)

    with pytest.raises(InputError):
        read_entry(path)


def run(*words: str | Path) -> str:
    """The output of a command of the benchmark that must succeed."""
    result = CliRunner().invoke(app, [str(word) for word in words])
    assert result.exit_code == 0, result.output
    return result.stdout


def test_score_prints_data_set_and_rows(tmp_path: Path) -> None:
    """A row for each number of quiet fingers, as JSON."""
    path = write_entry(tmp_path / "entry.json", {SET: DRIVE})

    report = json.loads(run("score", path, "--json"))

    assert report["checksum"] == CHECKSUM
    assert [row["plate"] for row in report["rows"]] == ["paper_plate"] * 3


@pytest.mark.parametrize("method", ["contrast-control", "pressure-matching"])
def test_sound_zones_of_drawn_plates_score_more_than_nominal_ones(
    method: str, sound_zones: Path
) -> None:
    """Twenty drawn plates give more contrast than the nominal plate alone."""
    nominal = scores_of(sound_zones / f"{method}-nominal-plate.json")[SET]
    drawn = scores_of(sound_zones / f"{method}-20-drawn-plates.json")[SET]

    assert 5 < nominal.contrast_db < drawn.contrast_db < 25


@pytest.fixture(scope="module")
def sound_zones(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the entries of the sound-zone example for one set."""
    folder = tmp_path_factory.mktemp("zones")
    document = json.loads(FILE.read_text("utf-8"))
    plate = document["plates"]["paper_plate"]
    plate["sets"] = {SET: plate["sets"][SET]}
    document["plates"] = {"paper_plate": plate}
    (folder / FILE.name).write_text(json.dumps(document), "utf-8")
    (folder / "paper_plate.yaml").write_text(plate["rig"], "utf-8")
    example = runpy.run_path(str(ROOT / "examples" / "sound_zones.py"))
    example["write_entries"](folder)
    return folder
