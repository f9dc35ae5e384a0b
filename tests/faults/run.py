"""Judge the tests by planted faults: plant each in a copy of the tree, run the tests that find it.

    python tests/faults/run.py [--only PATTERN] [--workers N] [--json FILE]
    python tests/faults/run.py --check [FILE ...]      list faults that cannot be planted any more
    python tests/faults/run.py --nightly               list faults that `make test` does not find

Faults are data, in the files `AREA.yaml` beside this one:

    - fault: a name that occurs once in the area
      behaviour: What the product then does, in words that do not depend on the code.
      change:                   # edits; each text to find occurs once in its file
        - {file: drivers/wires/modbus.py, find: "text", replace: "other text"}
      found_by: ["tests/drivers/test_a.py::test_b[{where}]"]   # the quickest; each must fail
      where: [serial, modbus]   # optional: what stands for {where}
      shows: text               # optional: in the first line of each failure
      missed: reason            # only in missed.yaml: why no test finds it yet

A fault is *found* if each of its tests fails and shows what it must, *missed* if one of them passes
or takes too long, and *stale* if it cannot be planted: a text to find does not occur once in its
file, or a test cannot be run. Who rewrites a text or renames a test does so in the fault, too, and
never drops the fault. Exit status 1 for a fault that is missed or stale, and for one of missed.yaml
that is found.
"""

import argparse
import ast
import contextlib
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from difflib import get_close_matches
from functools import cache, partial
from importlib import import_module
from multiprocessing import get_context
from multiprocessing.connection import Connection
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import pytest
import yaml

HERE = Path(__file__).parent
ROOT = HERE.parents[1]
TIME_LIMIT = 120.0  # s; for the tests of one fault
SOUND_TIME_LIMIT = 1800.0  # s; for all tests in the tree as it is
_FORK = get_context("fork")
_NOT_COPIED = shutil.ignore_patterns(
    ".git", ".venv", ".*_cache", ".hypothesis", "out", "dist", "_build"
)
_PRELOADED = (
    *("numpy", "scipy.linalg", "scipy.sparse.linalg", "scipy.special"),
    *("hypothesis", "pydantic", "can", "canopen"),
)
"""Modules of others that most tests load: processes are forked once they are loaded."""
_PRELOADED_FOR_MANY = (
    *("scipy.optimize", "scipy.interpolate", "scipy.signal", "scipy.ndimage"),
    *("pint", "rich.console", "matplotlib.figure"),
)
"""Modules that some tests load, preloaded for more than so many faults."""
_MANY = 20
_BROKEN = "cannot be run", "ImportError", "ModuleNotFoundError", "NameError", '  File "'
"""Begin how a test ends of a fault that does not plant what it says; the last, a SyntaxError."""


@dataclass(frozen=True)
class PlantedFault:
    """A fault in words of behaviour, the edits (file, find, replace) that plant it, and its tests.

    name: AREA/NAME; source: the file that describes it; shows: what the first line of each failure
    must contain; missed: why no test finds it yet, empty for all others.
    """

    name: str
    source: str
    behaviour: str
    edits: tuple[tuple[str, str, str], ...]
    tests: tuple[str, ...]
    shows: str
    missed: str


@dataclass(frozen=True)
class Judgement:
    """What became of a fault: found, missed or stale; how its tests ended, or what is stale."""

    fault: str
    result: str
    seconds: float
    tests: Mapping[str, str]

    def __str__(self) -> str:
        lines = [f"{self.result:6} {self.seconds:5.1f} s  {self.fault}"]
        if self.result != "found":
            lines += [f"    {subject}: {outcome}" for subject, outcome in self.tests.items()]
        return "\n".join(lines)


class _Outcomes:
    """How each test ended: passed, or the first line of why it failed."""

    def __init__(self) -> None:
        self.by_test: dict[str, str] = {}

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Note a failure in any phase; pytest calls it for each."""
        crash = getattr(report.longrepr, "reprcrash", None)
        if report.failed:
            self.by_test[report.nodeid] = crash.message.split("\n")[0] if crash else "failed"
        elif report.when == "call":
            self.by_test[report.nodeid] = report.outcome


def load_faults() -> list[PlantedFault]:
    """Return the faults of all areas; ValueError for a name that occurs twice."""
    faults: list[PlantedFault] = []
    for path in sorted(HERE.glob("*.yaml")):
        rows = yaml.load(path.read_text("utf-8"), Loader=yaml.CSafeLoader) or ()
        faults += [_fault_of(path, row) for row in rows]
    counts = Counter(fault.name for fault in faults)
    twice = [name for name, count in counts.items() if count > 1]
    if twice:
        raise ValueError(f"names of faults must be unique, got {', '.join(twice)} twice")
    return faults


def _fault_of(path: Path, row: dict[str, Any]) -> PlantedFault:
    wires = row.get("where", [""])
    tests = [test.replace("{where}", wire) for test in row["found_by"] for wire in wires]
    edits = [(edit["file"], edit["find"], edit["replace"]) for edit in row["change"]]
    return PlantedFault(
        name=f"{path.stem}/{row['fault']}",
        source=path.relative_to(ROOT).as_posix(),
        behaviour=row["behaviour"],
        edits=tuple(edits),
        tests=tuple(dict.fromkeys(tests)),
        shows=row.get("shows", ""),
        missed=row.get("missed", ""),
    )


def run_tests(folder: Path, tests: Sequence[str], *, limit: float) -> dict[str, str]:
    """Run tests in a tree, in a process of their own; return how those ended that came to an end.

    limit: time [s] after which the process is killed, with those that it has started.
    """
    receiving, sending = _FORK.Pipe(duplex=False)
    process = _FORK.Process(target=_run_pytest, args=(folder, tests, sending))
    process.start()
    sending.close()
    try:
        outcomes = receiving.recv() if receiving.poll(limit) else dict.fromkeys(tests, "timed out")
    except EOFError:
        outcomes = {}
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid or 0, signal.SIGKILL)
    process.join()
    return outcomes


def _run_pytest(folder: Path, tests: Sequence[str], sending: Connection) -> None:
    os.setsid()
    os.chdir(folder)
    os.environ["PYTHONPATH"] = str(folder)
    sys.path[0] = str(folder)
    null = os.open(os.devnull, os.O_RDWR)
    for number in (0, 1, 2):
        os.dup2(null, number)
    outcomes = _Outcomes()
    pytest.main(["-q", "-p", "no:cacheprovider", "--assert=plain", *tests], plugins=[outcomes])
    sending.send(outcomes.by_test)


def stale_edits(fault: PlantedFault, tree: Path) -> dict[str, str]:
    """Return why a fault cannot be planted in a tree, by file; empty if it can.

    A text must occur once; a module in which several lines replace it must still be Python.
    """
    stale: dict[str, str] = {}
    planted: dict[str, str] = {}
    for file, find, replace in fault.edits:
        if file not in planted:
            planted[file] = _text(tree / file) if (tree / file).is_file() else ""
        count = planted[file].count(find)
        planted[file] = planted[file].replace(find, replace)
        if count != 1:
            stale[file] = f"must contain once, got {count} times: {find.strip()}"
        elif file.endswith(".py") and "\n" in replace:
            try:
                ast.parse(planted[file])
            except SyntaxError as error:
                stale[file] = f"must be Python once it is changed, got {error}"
    return stale


def stale_report(faults: Iterable[PlantedFault], tree: Path) -> list[str]:
    """Describe each fault that cannot be planted in a tree: where, why, and what to do."""
    reports = []
    for fault in faults:
        for file, reason in stale_edits(fault, tree).items():
            reports.append(
                f"{fault.source}: fault {fault.name.partition('/')[2]} cannot be planted:\n"
                f"    {file} {reason}\n"
                f"    Change `find` and `replace` there to the present code, so that again:\n"
                f"    {fault.behaviour}\n"
                f"    Then: python tests/faults/run.py --only {fault.name}"
            )
    return reports


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


def _concerns(fault: PlantedFault, files: Sequence[str]) -> bool:
    """Whether a fault is described in, or planted in, one of these files; in any without files."""
    places = {fault.source, *(file for file, _, _ in fault.edits)}
    return not files or not places.isdisjoint(files)


def collected(*arguments: str) -> set[str]:
    """Return the ids of the tests that pytest collects in this checkout."""
    command = [sys.executable, "-m", "pytest", "--collect-only", "-q", "-p", "no:cacheprovider"]
    done = subprocess.run([*command, *arguments], cwd=ROOT, capture_output=True, text=True)
    if done.returncode:
        raise RuntimeError(done.stdout + done.stderr)
    return {*done.stdout.splitlines()}


def _list_nightly(faults: Sequence[PlantedFault]) -> None:
    beside = "tests/faults/one_conformance.py"  # pytest leaves it out of a folder, even if named
    short = collected("-m", "not long") | collected("-m", "not long", beside)
    nightly = [one for one in faults if one.tests and short.isdisjoint(one.tests)]
    for one in nightly:
        sys.stdout.write(f"{one.name}: {', '.join(one.tests)}\n")
    sys.stdout.write(f"{len(nightly)} of {len(faults)} faults are found by `make nightly` alone\n")


def judge(fault: PlantedFault, sound: Path) -> Judgement:
    """Plant a fault into this worker's copy of a sound tree, run its tests, and repair the copy."""
    folder, began = _own_copy(sound), time.monotonic()
    try:
        if stale := stale_edits(fault, folder):
            return Judgement(fault.name, "stale", 0.0, stale)
        for file, find, replacement in fault.edits:
            text = _text(folder / file).replace(find, replacement)
            (folder / file).unlink()  # or the sound tree would have the fault
            (folder / file).write_text(text, "utf-8")
        ended = run_tests(folder, fault.tests, limit=TIME_LIMIT) if fault.tests else {}
    finally:
        for file, *_ in fault.edits:
            (folder / file).unlink(missing_ok=True)
            (folder / file).hardlink_to(sound / file)
    ended = {test: ended.get(test, "cannot be run") for test in fault.tests}
    result = "found"
    if any(how.startswith(_BROKEN) for how in ended.values()):
        result = "stale"
    elif not ended or not all(_is_finding(how, fault.shows) for how in ended.values()):
        result = "missed"
    return Judgement(fault.name, result, time.monotonic() - began, ended)


def _is_finding(how: str, shows: str) -> bool:
    return how not in ("passed", "skipped", "timed out") and shows in how


def _text(path: Path) -> str:
    return path.read_text("utf-8")


@cache
def _own_copy(sound: Path) -> Path:
    """This process's copy of a tree, by hard links; all is compiled, and nothing is again."""
    sys.dont_write_bytecode = True
    os.environ["PYTHONDONTWRITEBYTECODE"] = "1"
    own = sound.with_name(str(os.getpid()))
    return Path(shutil.copytree(sound, own, symlinks=True, copy_function=os.link))


def _unsound(
    pool: ProcessPoolExecutor, sound: Path, tests: Sequence[str], shares: int
) -> list[str]:
    """Tests that do not pass in a sound tree, with how they ended."""
    run = partial(run_tests, sound, limit=SOUND_TIME_LIMIT)
    ended: dict[str, str] = {}
    for outcomes in pool.map(run, [tests[at::shares] for at in range(shares) if tests[at:]]):
        ended |= outcomes
    how = {test: ended.get(test, "cannot be run") for test in tests}
    return [f"{test}: {ended}" for test, ended in how.items() if ended != "passed"]


def judge_all(faults: Sequence[PlantedFault], *, workers: int) -> Iterable[Judgement]:
    """Judge faults by turns; RuntimeError if a test of theirs does not pass without them."""
    with TemporaryDirectory() as folder, ProcessPoolExecutor(workers, _FORK) as pool:
        sound = Path(shutil.copytree(ROOT, Path(folder) / "sound", ignore=_NOT_COPIED))
        tests = sorted({test for fault in faults for test in fault.tests})
        if unsound := _unsound(pool, sound, tests, workers):
            raise RuntimeError("\n    ".join(["these must pass without faults:", *unsound]))
        yield from pool.map(partial(judge, sound=sound), faults)


def main() -> int:
    """Judge the faults asked for; print each, then the totals."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--only", default="", help="part of AREA/NAME of faults")
    parser.add_argument("--nightly", action="store_true", help="list what `make test` leaves")
    parser.add_argument(
        "--check", nargs="*", metavar="FILE", help="list faults of these files that are stale"
    )
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--json", type=Path, help="file for the judgements")
    asked = parser.parse_args()
    for variable in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ[variable] = "1"  # before numpy loads
    faults = [one for one in load_faults() if asked.only in one.name]
    if asked.nightly:
        _list_nightly(faults)
        return 0
    if asked.check is not None:
        reports = stale_report([one for one in faults if _concerns(one, asked.check)], ROOT)
        sys.stdout.writelines(f"{report}\n" for report in reports)
        return 1 if reports else 0
    for module in (*_PRELOADED, *(_PRELOADED_FOR_MANY if len(faults) > _MANY else ())):
        import_module(module)
    known = {one.name for one in faults if one.missed}
    began, judgements = time.monotonic(), []
    for judgement in judge_all(faults, workers=asked.workers):
        sys.stdout.write(f"{judgement}\n")
        sys.stdout.flush()
        judgements.append(judgement)
    results = Counter(one.result for one in judgements)
    now_found = [one for one in judgements if one.fault in known and one.result != "missed"]
    newly_missed = [one for one in judgements if one.fault not in known and one.result != "found"]
    sys.stdout.write(
        f"{len(faults)} faults: {results['found']} found, {results['missed']} missed "
        f"({len(known)} known), {results['stale']} stale; {time.monotonic() - began:.0f} s\n"
    )
    for text, wrong in (("not found", newly_missed), ("not missed as known", now_found)):
        sys.stdout.writelines(f"{text}: {one.fault}\n" for one in wrong)
    if asked.json:
        asked.json.write_text(json.dumps([asdict(one) for one in judgements], indent=1), "utf-8")
    return 1 if newly_missed or now_found else 0


if __name__ == "__main__":
    sys.exit(main())
