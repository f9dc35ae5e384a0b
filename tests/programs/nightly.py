"""Run the long targets of make one after another, and write their results as a page.

    python tests/programs/nightly.py TARGET ... [--hours N] [--target-hours N] [--report]

out/nightly/page.md has a row for each target, and the end of the output of each that failed. It is
written again after every target, so that an interrupted run leaves the results it has. The whole
output of a target is in out/nightly/TARGET.log. `--report` copies the rows to the documentation.

A failed target does not end the run. A target that takes more than its hours is ended with all its
processes. Targets that have not begun when the hours of the run are up count as failed, too.

A target that is run again by itself replaces its own row in the documentation. So each row names
its date and commit.
"""

import argparse
import contextlib
import os
import platform
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

ROOT = Path(__file__).parents[2]
REPORT = ROOT / "docs" / "measured" / "nightly.md"
_HOUR = 3600.0
_LINES_OF_A_FAILURE = 40
_LAST_LINE_WIDTH = 110
_RULES = "=-_ "
"""Characters with which pytest frames its last line."""

_OF_THE_CALLING_MAKE = ("MAKEFLAGS", "MAKELEVEL", "MFLAGS")
"""Variables with options and depth of a make that started this program."""


@dataclass(frozen=True)
class Outcome:
    """What became of a target: its result, its duration [s] and what it printed."""

    target: str
    result: str
    seconds: float
    output: str

    @property
    def is_passed(self) -> bool:
        """Whether the target ended by itself, and without a failure."""
        return self.result == "passed"

    @property
    def last_line(self) -> str:
        """The last line that the target printed itself, without what make says about it."""
        lines = [line.strip(_RULES) for line in self.output.splitlines()]
        own_lines = [line for line in lines if line and not line.startswith("make")]
        return own_lines[-1] if own_lines else ""


def run_target(target: str, folder: Path, log: Path, limit: float) -> Outcome:
    """Run a target of the Makefile in a folder, at most for a limit [s]."""
    environment = dict(os.environ)
    for name in _OF_THE_CALLING_MAKE:
        environment.pop(name, None)
    start = time.monotonic()
    with log.open("w", encoding="utf-8") as output:
        process = subprocess.Popen(
            ["make", target],
            cwd=folder,
            env=environment,
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )
        try:
            status = process.wait(limit)
            result = "passed" if status == 0 else "failed"
        except subprocess.TimeoutExpired:
            result = f"ended after {limit / 60:.0f} minutes"
        finally:
            _end_all_of(process)
    seconds = time.monotonic() - start
    return Outcome(target, result, seconds, log.read_text("utf-8", errors="replace"))


def _end_all_of(process: subprocess.Popen[bytes]) -> None:
    """End a target and every process that it left behind in its session."""
    with contextlib.suppress(ProcessLookupError):  # all have ended by themselves
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()


def commit_of(folder: Path) -> str:
    """Return the short name of the commit that a folder has checked out."""
    command = ["git", "describe", "--always", "--dirty"]
    run = subprocess.run(command, cwd=folder, capture_output=True, text=True)
    return run.stdout.strip() or "unknown"


def row(outcome: Outcome, commit: str) -> str:
    """Return the result of a target as a row of the table."""
    minutes = f"{outcome.seconds / 60:.1f}"
    today = f"{datetime.now(UTC):%Y-%m-%d}"
    last_line = outcome.last_line[:_LAST_LINE_WIDTH].replace("|", "\\|")
    cells = (f"`{outcome.target}`", outcome.result, minutes, today, commit, last_line)
    return f"| {' | '.join(cells)} |"


def rows_by_target(page_of_rows: str) -> dict[str, str]:
    """Return the rows of a page's table by the names of their targets, in the page's order."""
    matches = re.finditer(r"^\| `([^`]+)` \|.*$", page_of_rows, re.MULTILINE)
    return {match[1]: match[0] for match in matches}


def table(rows: Iterable[str]) -> str:
    """Return rows as a table, below a sentence that names the machine."""
    machine = f"{platform.system()} {platform.machine()}, {os.cpu_count()} processors"
    lines = [
        f"Last run on {machine}, Python {platform.python_version()}:",
        "",
        "| target | result | minutes | date | commit | last line |",
        "|---|---|---|---|---|---|",
        *rows,
    ]
    return "\n".join(lines)


def page(outcomes: Sequence[Outcome], folder: Path) -> str:
    """Return the page: the results, then the end of the output of each failed target."""
    commit = commit_of(folder)
    parts = ["# Long tests", table(row(outcome, commit) for outcome in outcomes)]
    for outcome in outcomes:
        if outcome.is_passed:
            continue
        last_lines = outcome.output.splitlines()[-_LINES_OF_A_FAILURE:]
        parts.append(f"## {outcome.target}: {outcome.result}")
        parts.append("\n".join(f"    {line}" for line in last_lines))
    return "\n\n".join(parts) + "\n"


def run_targets(
    targets: Sequence[str], folder: Path, *, hours: float, target_hours: float
) -> list[Outcome]:
    """Run targets of the Makefile in a folder, and write the page after each of them."""
    results = folder / "out" / "nightly"
    results.mkdir(parents=True, exist_ok=True)
    deadline = time.monotonic() + hours * _HOUR
    outcomes: list[Outcome] = []
    for target in targets:
        limit = min(target_hours * _HOUR, deadline - time.monotonic())
        if limit > 0.0:
            _say(f"{target} begins")
            outcome = run_target(target, folder, results / f"{target}.log", limit)
        else:
            outcome = Outcome(target, f"not run: {hours:g} hours were up", 0.0, "")
        _say(f"{target} {outcome.result}, {outcome.seconds:.0f} s")
        outcomes.append(outcome)
        (results / "page.md").write_text(page(outcomes, folder), encoding="utf-8")
    return outcomes


def report(outcomes: Sequence[Outcome], folder: Path) -> None:
    """Replace the rows of these targets in the documentation; rows of other targets stay."""
    sys.path.insert(0, str(ROOT))
    from benchmarks.setting import write_parts

    rows = rows_by_target(REPORT.read_text("utf-8"))
    commit = commit_of(folder)
    for outcome in outcomes:
        rows[outcome.target] = row(outcome, commit)
    write_parts(REPORT, {"targets": table(rows.values())})


def _say(text: str) -> None:
    sys.stdout.write(f"nightly: {text}\n")
    sys.stdout.flush()


def main() -> int:
    """Run the targets; the exit status is 1 if any has failed."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("targets", nargs="+", metavar="TARGET")
    parser.add_argument("--folder", type=Path, default=ROOT, help="where the Makefile is")
    parser.add_argument("--hours", type=float, default=3.0, help="for all targets")
    parser.add_argument("--target-hours", type=float, default=1.0, help="for each target")
    parser.add_argument("--report", action="store_true", help="copy the rows to the documentation")
    options = parser.parse_args()

    outcomes = run_targets(
        options.targets,
        options.folder,
        hours=options.hours,
        target_hours=options.target_hours,
    )

    if options.report:
        report(outcomes, options.folder)
    failed = [outcome.target for outcome in outcomes if not outcome.is_passed]
    _say(f"failed: {' '.join(failed) or 'none'}; see out/nightly/page.md")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
