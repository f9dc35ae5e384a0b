"""Every benchmark starts; the data set of the contrast benchmark, its entries and its scores."""

import hashlib
import json
import re
import runpy
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from benchmarks.contrast.__main__ import (
    CHECKSUM,
    FILE,
    VERSION,
    SetScore,
    app,
    data_set,
    read_entry,
    score,
    summary,
)
from model.arrays import least_gap
from model.errors import InputError

ROOT = Path(__file__).parents[2]
_BEGUN_EARLY = re.compile(r"^if __name__ ==.*\n(\s.*\n|\n)*\S", re.MULTILINE)


def test_each_benchmark_starts() -> None:
    """Every module imports, and is whole before its command begins.

    Other solvers, `plate/peers`, need packages of their own.
    """
    files = [each.relative_to(ROOT) for each in sorted((ROOT / "benchmarks").rglob("*.py"))]
    assert not [each for each in files if _BEGUN_EARLY.search((ROOT / each).read_text("utf-8"))]
    own = [".".join(each.with_suffix("").parts) for each in files if "peers" not in each.parts]
    program = f"import importlib\nfor each in {own}: importlib.import_module(each)"
    subprocess.run([sys.executable, "-c", program], cwd=ROOT, check=True)


SET = "paper_plate/1-00"
DRIVE = {"SW": [200, 1.0, 0.0], "NE": [200, 0.7, 135.0]}
TURNED = {"SW": [200, 1.0, 90.0], "NE": [200, 0.7, 225.0]}
HALF = {"SW": [200, 0.5, 0.0], "NE": [200, 0.35, 135.0]}
WEAK = {"SW": [200, 1e-4, 0.0], "NE": [200, 0.7e-4, 135.0]}


def entry(path: Path, patterns: Mapping[str, Any], **changes: Any) -> Path:
    """A file with these patterns by set."""
    document = {"benchmark": "era-localization", "version": 1, "name": "test"}
    path.write_text(json.dumps({**document, "patterns": patterns, **changes}), encoding="utf-8")
    return path


def scored(path: Path, patterns: Mapping[str, Any]) -> dict[str, SetScore]:
    """The scores of such a file."""
    return score(read_entry(entry(path, patterns))[1])


def test_data_set_is_that_of_its_version_and_its_fingers_lie_apart() -> None:
    """Its bytes have the checksum that is published; a change is a new version.

    Fingers are at least 5 cm apart, 13 mm from edges, ten sets each to one, two and three quiet
    ones.
    """
    assert f"-{VERSION}." in FILE.name
    assert hashlib.sha256(FILE.read_bytes()).hexdigest() == CHECKSUM
    for plate in data_set().plates.values():
        assert [each.quiet_count for each in plate.sets] == [1] * 10 + [2] * 10 + [3] * 10
        size = np.array([plate.rig.plate.length, plate.rig.plate.width])
        for each in plate.sets:
            places = np.array(each.contacts)
            assert (np.minimum(places, size - places) >= 0.0129).all()
            assert least_gap(places) >= 0.0499


def test_contrast_is_of_ratios_and_level_of_amplitudes(tmp_path: Path) -> None:
    """The plate is linear: a common phase is not felt, half the amplitude loses 6.02 dB.

    In time, on a plate of another mesh, contrast is near that which nine of ten exceed, or above.
    """
    full, turned, half = (
        scored(tmp_path / "entry.json", {SET: drive})[SET] for drive in (DRIVE, TURNED, HALF)
    )
    assert turned.contrast_db == pytest.approx(full.contrast_db, abs=0.1)
    assert half.contrast_db == pytest.approx(full.contrast_db, abs=1e-4)
    assert half.level_db_sl == pytest.approx(full.level_db_sl - 6.02, abs=1e-2)
    in_time = score(read_entry(tmp_path / "entry.json")[1], in_time=True)[SET]
    assert in_time.contrast_db - 3 < in_time.in_time_db < in_time.contrast_db + 12


def test_weak_and_missing_patterns_count_nothing(tmp_path: Path) -> None:
    """Both are missed with 0 dB; a plate without any pattern is not scored."""
    scores = scored(tmp_path / "entry.json", {SET: WEAK, "paper_plate/1-01": DRIVE})
    assert len(scores) == 30
    assert scores[SET].contrast_db == 0.0
    assert scores[SET].is_missed
    assert scores["paper_plate/1-02"].is_missed
    assert not scores["paper_plate/1-01"].is_missed
    assert [(row["quiet"], row["missed"]) for row in summary(scores)] == [(1, 9), (2, 10), (3, 10)]


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
def test_entry_that_cannot_be_scored_is_refused(
    tmp_path: Path, patterns: Mapping[str, Any], changes: Mapping[str, Any]
) -> None:
    """Unknown sets, ERAs and versions, and what no ERA of the rig may play."""
    with pytest.raises(InputError):
        read_entry(entry(tmp_path / "entry.json", patterns, **changes))


def test_command_prints_rows_and_exports_the_data_set(tmp_path: Path) -> None:
    """`score --json` names data set and rows; exported rigs are files that load."""
    file = entry(tmp_path / "entry.json", {SET: DRIVE})
    ran = CliRunner().invoke(app, ["score", str(file), "--json"])
    assert ran.exit_code == 0, ran.output
    printed = json.loads(ran.stdout)
    assert printed["checksum"] == CHECKSUM
    assert [row["plate"] for row in printed["rows"]] == ["paper_plate"] * 3
    folder = tmp_path / "data"
    ran = CliRunner().invoke(app, ["export", "-o", str(folder)])
    assert ran.exit_code == 0, ran.output
    assert {each.name for each in folder.iterdir()} == {
        FILE.name,
        *(f"{name}.yaml" for name in data_set().plates),
    }


def test_entries_of_the_sound_zones_are_scored(tmp_path: Path) -> None:
    """Of one set: those of twenty drawn plates give more than those of the nominal plate alone."""
    document = json.loads(FILE.read_text("utf-8"))
    plate = document["plates"]["paper_plate"]
    plate["sets"] = {SET: plate["sets"][SET]}
    document["plates"] = {"paper_plate": plate}
    (tmp_path / FILE.name).write_text(json.dumps(document), "utf-8")
    (tmp_path / "paper_plate.yaml").write_text(plate["rig"], "utf-8")
    runpy.run_path(str(ROOT / "examples" / "sound_zones.py"))["write_entries"](tmp_path)
    for method in ("contrast-control", "pressure-matching"):
        nominal, drawn = (
            score(read_entry(tmp_path / f"{method}-{of}.json")[1])[SET].contrast_db
            for of in ("nominal-plate", "20-drawn-plates")
        )
        assert 5 < nominal < drawn < 25
