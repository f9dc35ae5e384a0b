"""The comparison of answers of two checkouts."""

import json
from pathlib import Path

import numpy as np
import pytest

from benchmarks import realised, versions
from model.table.table_file import build_table
from plates import smooth_rig


def run(monkeypatch: pytest.MonkeyPatch, *arguments: str) -> None:
    """Type the command."""
    monkeypatch.setattr("sys.argv", ["versions", *arguments])
    versions.main()


def test_report_says_what_other_answers_lose(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The same answers differ by nothing; one ERA turned by 180 degrees costs contrast."""
    rig = smooth_rig()
    table = build_table(rig, frequencies=np.array([110.0, 200.0]), drive_mode="phased")
    monkeypatch.setattr(versions, "_tables", lambda: iter([("paper_plate", "some", rig, table)]))
    monkeypatch.setattr(versions, "QUIET", (1,))
    monkeypatch.setattr(versions, "DRAWS", 8)
    monkeypatch.setattr(realised, "PAGE", tmp_path / "page.md")
    before, after = tmp_path / "before.json", tmp_path / "after.json"
    run(monkeypatch, "answer", str(before), "--sets", "2")
    answers = json.loads(before.read_text())
    for tones in answers["paper_plate, some, 1"]:
        tones["SW"][2] += np.pi
    after.write_text(json.dumps(answers))
    changes = []
    for other in (before, after):
        realised.PAGE.write_text("# Page\n<!-- begin versions -->\n<!-- end versions -->\n")
        run(monkeypatch, "compare", str(before), str(other), "--report")
        (row,) = (line for line in realised.PAGE.read_text().splitlines() if "paper_plate" in line)
        changes.append(float(row.split("|")[3]))
    assert changes[0] == 0.0
    assert changes[1] < -3.0
