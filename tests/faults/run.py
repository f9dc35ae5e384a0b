"""Plant each fault in a copy of the tree, and run the tests that must fail because of it.

    python tests/faults/run.py [--only PATTERN] [--workers N] [--json FILE]
    python tests/faults/run.py --check [FILE ...]      list faults that do not fit the code any more
    python tests/faults/run.py --nightly               list faults that `make test` does not find

Faults are data, in the files SUBJECT.yaml in this folder:

    - fault: a name that occurs once in the file
      behaviour: What the product does then, in words that do not depend on the code.
      in: drivers/host/ledger.py
      of: Ledger.admit          # optional: the class, function or method that contains the code
      find: level > self._limit           # Python, compared by syntax (planting.py has the rules)
      replace: False
      found_by: ["tests/drivers/test_a.py::test_b[{where}]"]   # the quickest; each must fail
      where: [serial, modbus]   # optional: values of {where}
      shows: text               # optional: part of the first line of each failure

A fault of several places has `edits`, a list of `in`, `of`, `find` and `replace`.

A fault is *found* if each of its tests fails and shows what it must, *missed* if one of them passes
or takes too long, and *stale* if it cannot be planted or a test cannot be run. The exit status is 1
unless all faults are found.
"""

import argparse
import json
import re
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from difflib import get_close_matches
from functools import partial
from pathlib import Path
from typing import Any

import yaml

from copies import FORK, ROOT, changed_copy, prepare, run_tests, sound_copy
from planting import Edit, StaleEdit, planted

HERE = Path(__file__).parent
TIME_LIMIT = 120.0  # s; for the tests of one fault
SOUND_TIME_LIMIT = 1800.0  # s; for all tests in the tree as it is
_MANY = 20
"""From this number of faults on, modules that only some tests need are imported in advance."""
_BROKEN = "cannot be run", "ImportError", "ModuleNotFoundError", "NameError", '  File "'
"""First words of a failure that shows that a fault was planted wrongly; the last: SyntaxError."""
_KEYS = {"fault", "behaviour", "edits", "in", "of", "find", "replace", "found_by", "where", "shows"}


@dataclass(frozen=True)
class PlantedFault:
    """A fault: what the product does then, the edits that plant it, and the tests that find it.

    name: SUBJECT/NAME; source: the file that describes it; shows: what the first line of each
    failure must contain.
    """

    name: str
    source: str
    behaviour: str
    edits: tuple[Edit, ...]
    tests: tuple[str, ...]
    shows: str


@dataclass(frozen=True)
class Judgment:
    """The result for a fault (found, missed or stale); how its tests ended, or what is stale."""

    fault: str
    result: str
    seconds: float
    tests: Mapping[str, str]

    def __str__(self) -> str:
        lines = [f"{self.result:6} {self.seconds:5.1f} s  {self.fault}"]
        if self.result != "found":
            lines += [f"    {subject}: {outcome}" for subject, outcome in self.tests.items()]
        return "\n".join(lines)


def load_faults() -> list[PlantedFault]:
    """Return the faults of all files; ValueError for an unknown key or a name that occurs twice."""
    faults: list[PlantedFault] = []
    for path in sorted(HERE.glob("*.yaml")):
        # The base loader leaves every value a string: `replace: 1` and `replace: True` are code.
        rows = yaml.load(path.read_text("utf-8"), Loader=yaml.CBaseLoader) or ()
        faults += [_fault_of(path, row) for row in rows]
    counts = Counter(fault.name for fault in faults)
    repeated = [name for name, count in counts.items() if count > 1]
    if repeated:
        raise ValueError(f"names of faults must be unique, got {', '.join(repeated)} twice")
    return faults


def _fault_of(path: Path, row: dict[str, Any]) -> PlantedFault:
    unknown = row.keys() - _KEYS
    if unknown:
        name = row.get("fault")
        raise ValueError(f"{path.name}: {name}: keys must be {_KEYS}, got {unknown}")
    variants = row.get("where", [""])
    tests = []
    for test in row["found_by"]:
        tests += [test.replace("{where}", variant) for variant in variants]
    edits = [
        Edit(edit["in"], edit.get("of", ""), edit["find"], edit["replace"])
        for edit in row.get("edits", [row])
    ]
    return PlantedFault(
        name=f"{path.stem}/{row['fault']}",
        source=path.relative_to(ROOT).as_posix(),
        behaviour=row["behaviour"],
        edits=tuple(edits),
        tests=tuple(dict.fromkeys(tests)),
        shows=row.get("shows", ""),
    )


def changed_texts(fault: PlantedFault, tree: Path) -> dict[str, str]:
    """Return the texts of the files that a fault changes; raise StaleEdit, naming the file."""
    texts: dict[str, str] = {}
    for edit in fault.edits:
        path = tree / edit.file
        if not path.is_file():
            raise StaleEdit(f"{edit.file} does not exist")
        source = texts.get(edit.file) or path.read_text("utf-8")
        try:
            texts[edit.file] = planted(edit, source)
        except StaleEdit as error:
            raise StaleEdit(f"{edit.file} {error}") from error
    return texts


def _first_file(fault: PlantedFault) -> str:
    return fault.edits[0].file


def stale_report(faults: Iterable[PlantedFault], tree: Path) -> list[str]:
    """Describe each fault that cannot be planted in a tree, or whose code has undefined names."""
    reports = []
    changed = []
    for fault in sorted(faults, key=_first_file):
        try:
            changed.append((fault, changed_texts(fault, tree)))
        except StaleEdit as error:
            reason = "\n    ".join(str(error).splitlines())
            reports.append(
                f"{fault.source}: fault {fault.name.partition('/')[2]} cannot be planted:\n"
                f"    {reason}\n"
                f"    Change `of`, `find` and `replace` there to the present code, so that again:\n"
                f"    {fault.behaviour}\n"
                f"    Then: python tests/faults/run.py --only {fault.name}"
            )
    return reports + _undefined_names(changed)


def _undefined_names(changed: Iterable[tuple[PlantedFault, Mapping[str, str]]]) -> list[str]:
    """Describe each undefined name and syntax error in changed files, as ruff finds it."""
    described = {}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for fault, texts in changed:
            for file, text in texts.items():
                if file.endswith(".py"):
                    path = folder / f"{len(described)}.py"
                    path.write_text(text, "utf-8")
                    described[str(path)] = f"{fault.source}: fault {fault.name}: {file}"
        command = [sys.executable, "-m", "ruff", "check", "--isolated", "--no-cache"]
        command += ["--select", "F821", "--output-format", "json", name]
        completed = subprocess.run(command, capture_output=True, text=True, check=False)
    findings = json.loads(completed.stdout)
    return [f"{described[finding['filename']]}: {finding['message']}" for finding in findings]


def missing_tests_report(faults: Iterable[PlantedFault], existing: set[str]) -> list[str]:
    """Describe each test that a fault names and that does not exist, with the nearest one."""
    reports = []
    for fault in faults:
        for test in fault.tests:
            if test in existing:
                continue
            file = test.partition("::")[0]
            candidates = [name for name in existing if name.startswith(f"{file}::")]
            similar = get_close_matches(test, candidates, n=1)
            hint = f"\n    Did you mean {similar[0]}?" if similar else ""
            name = fault.name.partition("/")[2]
            reports.append(f"{fault.source}: fault {name} names no existing test: {test}{hint}")
    return reports


def missing_imports(faults: Iterable[PlantedFault]) -> list[str]:
    """Describe each import in the code of a fault that fails."""
    reports = []
    for fault in faults:
        for edit in fault.edits:
            for line in re.findall(r"^ *((?:from [\w.]+ )?import [\w, ]+)$", edit.replace, re.M):
                try:
                    exec(line, {})
                except ImportError as error:
                    reports.append(f"{fault.source}: fault {fault.name}: {line}: {error}")
    return reports


def _concerns(fault: PlantedFault, files: Sequence[str]) -> bool:
    """Return whether a fault is described in, or changes, one of these files (or none given)."""
    own_files = {fault.source, *(edit.file for edit in fault.edits)}
    return not files or not own_files.isdisjoint(files)


def collected(*arguments: str) -> set[str]:
    """Return the ids of the tests that pytest collects in this checkout."""
    command = [sys.executable, "-m", "pytest", "--collect-only", "-q", "-p", "no:cacheprovider"]
    done = subprocess.run([*command, *arguments], cwd=ROOT, capture_output=True, text=True)
    if done.returncode:
        raise RuntimeError(done.stdout + done.stderr)
    return {*done.stdout.splitlines()}


def _list_nightly(faults: Sequence[PlantedFault]) -> None:
    single_checks = "tests/faults/one_conformance.py"  # pytest collects it only if it is named
    short = collected("-m", "not long") | collected("-m", "not long", single_checks)
    nightly = [fault for fault in faults if fault.tests and short.isdisjoint(fault.tests)]
    for fault in nightly:
        sys.stdout.write(f"{fault.name}: {', '.join(fault.tests)}\n")
    sys.stdout.write(f"{len(nightly)} of {len(faults)} faults are found by `make nightly` alone\n")


def judge(fault: PlantedFault, sound: Path) -> Judgment:
    """Plant a fault into this worker's copy of a sound tree, and run its tests there."""
    started = time.monotonic()
    try:
        texts = changed_texts(fault, sound)
    except StaleEdit as error:
        return Judgment(fault.name, "stale", 0.0, {"fault": str(error)})
    with changed_copy(sound, texts) as folder:
        outcomes = run_tests(folder, fault.tests, limit=TIME_LIMIT)
    if outcomes is None:
        outcomes = dict.fromkeys(fault.tests, "timed out")
    outcomes = {test: outcomes.get(test, "cannot be run") for test in fault.tests}
    result = "found"
    if any(outcome.startswith(_BROKEN) for outcome in outcomes.values()):
        result = "stale"
    elif not all(_is_finding(outcome, fault.shows) for outcome in outcomes.values()):
        result = "missed"
    return Judgment(fault.name, result, time.monotonic() - started, outcomes)


def _is_finding(outcome: str, shows: str) -> bool:
    return outcome not in ("passed", "skipped", "timed out") and shows in outcome


def _failures(
    pool: ProcessPoolExecutor, sound: Path, tests: Sequence[str], shares: int
) -> list[str]:
    """Return the tests that do not pass in a sound tree, with how they ended."""
    run = partial(run_tests, sound, limit=SOUND_TIME_LIMIT)
    ended: dict[str, str] = {}
    for outcomes in pool.map(run, [tests[share::shares] for share in range(shares)]):
        ended |= outcomes or {}
    outcomes_by_test = {test: ended.get(test, "cannot be run") for test in tests}
    return [
        f"{test}: {outcome}" for test, outcome in outcomes_by_test.items() if outcome != "passed"
    ]


def judge_all(faults: Sequence[PlantedFault], *, workers: int) -> Iterable[Judgment]:
    """Judge faults in parallel; RuntimeError if one of their tests fails without them."""
    with sound_copy() as sound, ProcessPoolExecutor(workers, FORK) as pool:
        tests = sorted({test for fault in faults for test in fault.tests})
        failures = _failures(pool, sound, tests, min(workers, len(tests) or 1))
        if failures:
            raise RuntimeError("\n    ".join(["these tests must pass without faults:", *failures]))
        yield from pool.map(partial(judge, sound=sound), faults)


def main() -> int:
    """Judge the selected faults; print each, then the totals."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--only", default="", help="part of SUBJECT/NAME of faults")
    parser.add_argument("--nightly", action="store_true", help="list what `make test` leaves")
    parser.add_argument(
        "--check", nargs="*", metavar="FILE", help="list faults of these files that are stale"
    )
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--json", type=Path, help="file for the judgements")
    options = parser.parse_args()
    faults = [fault for fault in load_faults() if options.only in fault.name]
    if options.nightly:
        _list_nightly(faults)
        return 0
    if options.check is not None:
        selected = [fault for fault in faults if _concerns(fault, options.check)]
        reports = stale_report(selected, ROOT)
        sys.stdout.writelines(f"{report}\n" for report in reports)
        return 1 if reports else 0
    prepare(are_many=len(faults) > _MANY)
    started = time.monotonic()
    judgments: list[Judgment] = []
    for judgment in judge_all(faults, workers=options.workers):
        sys.stdout.write(f"{judgment}\n")
        sys.stdout.flush()
        judgments.append(judgment)
    results = Counter(judgment.result for judgment in judgments)
    sys.stdout.write(
        f"{len(faults)} faults: {results['found']} found, {results['missed']} missed, "
        f"{results['stale']} stale; {time.monotonic() - started:.0f} s\n"
    )
    not_found = [judgment for judgment in judgments if judgment.result != "found"]
    sys.stdout.writelines(f"not found: {judgment.fault}\n" for judgment in not_found)
    if options.json:
        rows = [asdict(judgment) for judgment in judgments]
        options.json.write_text(json.dumps(rows, indent=1), "utf-8")
    return 1 if not_found else 0


if __name__ == "__main__":
    sys.exit(main())
