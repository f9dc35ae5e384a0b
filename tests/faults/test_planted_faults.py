"""The judge of planted faults: it judges rightly, and no fault of today is stale."""

import json
import re
import runpy
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from cases import COLLECTED

RUN = Path(__file__).with_name("run.py")
FAULT = """
- fault: {name}
  behaviour: Two and two are {result}.
  where: [two, three]
  change: [{{file: sums.py, find: "{find}", replace: "{result}"}}]
  found_by: ["tests/test_sums.py::test_sum[{{where}}]"]
"""
TESTS = """
import pytest
@pytest.mark.parametrize("below", [pytest.param(2, id="two"), pytest.param(3, id="three")])
def test_sum(below):
    from sums import SUM
    assert below < SUM < 5
"""


def judged(run: Path, *options: str) -> tuple[int, dict[str, str]]:
    """Exit status of the judge, and what became of each fault."""
    report = run.with_name("judged.json")
    command = [sys.executable, run, "--workers", "1", "--json", report, *options]
    status = subprocess.run(command, stdout=subprocess.PIPE).returncode
    return status, {row["fault"]: row["result"] for row in json.loads(report.read_text("utf-8"))}


def test_no_fault_is_stale(request: pytest.FixtureRequest) -> None:
    """A text to change occurs once in its file; what is imported and all tests are there."""
    judge = runpy.run_path(str(RUN))
    faults = judge["load_faults"]()
    reports = judge["stale_report"](faults, judge["ROOT"])
    assert not reports, "\n".join(reports)
    lines = {line.strip() for one in faults for edit in one.edits for line in edit[2].split("\n")}
    exec("\n".join(line for line in lines if re.fullmatch(r"(from [\w.]+ )?import [\w, ]+", line)))
    folder = request.node.getparent(pytest.Dir)
    beside = pytest.Module.from_parent(folder, path=RUN.with_name("one_conformance.py"))
    existing = request.config.stash[COLLECTED] | {test.nodeid for test in beside.collect()}
    root = RUN.parents[2]
    unknown = {test for one in faults for test in one.tests} - existing
    others = {test.partition("::")[0] for test in unknown}
    files = [file for file in sorted(others) if (root / file).is_file()]
    if files:  # of tests that were not asked for
        existing |= judge["collected"](*files)
    missing = judge["missing_tests_report"](faults, existing)
    assert not missing, "\n".join(missing)


def test_stale_fault_is_reported_with_its_file_and_the_remedy(tmp_path: Path) -> None:
    """The report of a fault whose text is gone names both files, the text and the behaviour."""
    folder = tmp_path / "tests" / "faults"
    folder.mkdir(parents=True)
    shutil.copy(RUN, folder)
    (tmp_path / "sums.py").write_text("SUM = 2 + 2\n")
    faults = [("sound", "2 + 2"), ("gone", "2 + 1")]
    texts = [FAULT.format(name=name, find=find, result="5") for name, find in faults]
    (folder / "sums.yaml").write_text("".join(texts))
    command = [sys.executable, folder / "run.py", "--check"]
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True)
    assert done.returncode == 1
    assert done.stdout.splitlines() == [
        "tests/faults/sums.yaml: fault gone cannot be planted:",
        "    sums.py must contain once, got 0 times: 2 + 1",
        "    Change `find` and `replace` there to the present code, so that again:",
        "    Two and two are 5.",
        "    Then: python tests/faults/run.py --only sums/gone",
    ]
    assert subprocess.run([*command, "other.py"]).returncode == 0


def test_fault_without_its_test_is_reported_with_the_nearest_name() -> None:
    """A renamed test is named with the fault, its file and the test that comes closest."""
    judge = runpy.run_path(str(RUN))
    fault = judge["PlantedFault"](
        name="sums/gone",
        source="tests/faults/sums.yaml",
        behaviour="Two and two are 5.",
        edits=(),
        tests=("tests/test_sums.py::test_sum[four]",),
        shows="",
        missed="",
    )
    existing = {"tests/test_sums.py::test_sum[for]", "tests/test_other.py::test_sum[four]"}
    assert judge["missing_tests_report"]([fault], existing) == [
        "tests/faults/sums.yaml: fault gone names no existing test: "
        "tests/test_sums.py::test_sum[four]\n"
        "    Did you mean tests/test_sums.py::test_sum[for]?"
    ]


@pytest.mark.long
def test_fault_is_found_only_if_every_test_of_it_fails(tmp_path: Path) -> None:
    """It is missed where one passes, stale where it cannot be planted or tested."""
    folder = tmp_path / "tests" / "faults"
    folder.mkdir(parents=True)
    shutil.copy(RUN, folder)
    (tmp_path / "sums.py").write_text("SUM = 2 + 2\n")
    (tmp_path / "tests" / "test_sums.py").write_text(TESTS)
    rows = [
        ("found", "2 + 2", "5"),
        ("missed-by-one", "2 + 2", "3"),
        ("moved", "2 + 1", "5"),
        ("twice", "2", "5"),
        ("no-code", "2 + 2", "5 +"),
        ("no-name", "SUM = 2 + 2", "SUM = 2 + two"),
    ]
    texts = [FAULT.format(name=name, find=find, result=result) for name, find, result in rows]
    (folder / "sums.yaml").write_text("".join(texts))
    status, results = judged(folder / "run.py")
    assert (status, *results.values()) == (1, "found", "missed", "stale", "stale", "stale", "stale")
