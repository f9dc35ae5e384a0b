"""The long tests run to their end, whatever fails or hangs on their way."""

import subprocess
import sys
from pathlib import Path

import nightly

PROGRAM = Path(__file__).parents[1] / "tests" / "programs" / "nightly.py"
FIVE_SECONDS = str(5 / 3600)  # hours

MAKEFILE = """\
failing:
\t@echo "channel 2 plays"; exit 3
hanging:
\t@sleep 1000 & echo $$! > left_behind; sleep 1000
passing:
\t@echo "=== 3 passed in 1 s ==="
"""


def is_running(pid: int) -> bool:
    """Whether a process exists and is no zombie."""
    try:
        status = Path(f"/proc/{pid}/stat").read_text()
    except FileNotFoundError:
        return False
    state = status.rpartition(")")[2].split()[0]
    return state != "Z"


def test_nightly_lists_every_target_after_a_failed_and_a_hung_one(tmp_path: Path) -> None:
    """The page has a row for each target and the output of failed ones; no process is left."""
    (tmp_path / "Makefile").write_text(MAKEFILE)

    run = subprocess.run(
        [
            *(sys.executable, PROGRAM, "failing", "hanging", "passing"),
            *("--folder", tmp_path, "--target-hours", FIVE_SECONDS),
        ],
        capture_output=True,
        text=True,
    )

    page = (tmp_path / "out/nightly/page.md").read_text()
    results = {}
    for row in page.splitlines():
        if row.startswith("| `"):
            target, result, _minutes, _date, _commit, last_line = row[2:-2].split(" | ")
            results[target] = (result, last_line)
    assert results["`failing`"] == ("failed", "channel 2 plays")
    assert results["`hanging`"][0].startswith("ended after")
    assert results["`passing`"] == ("passed", "3 passed in 1 s")
    assert "## failing: failed\n\n    channel 2 plays\n" in page
    assert not is_running(int((tmp_path / "left_behind").read_text()))
    assert run.returncode == 1


def test_report_replaces_the_row_of_a_target_that_ran_again() -> None:
    """Rows of other targets keep their result, date and commit."""
    fuzz = nightly.row(nightly.Outcome("fuzz", "passed", 60.0, "no crash"), "1111111")
    soak = nightly.row(nightly.Outcome("soak", "failed", 60.0, "late by 3 ms"), "1111111")
    repaired_soak = nightly.row(nightly.Outcome("soak", "passed", 90.0, "in time"), "2222222")

    rows = nightly.rows_by_target(nightly.table([fuzz, soak]))
    rows["soak"] = repaired_soak

    assert list(rows.values()) == [fuzz, repaired_soak]
