"""Run the tests nearest to what differs from a commit: `make test-changed`.

    python tests/programs/changed_tests.py [--since COMMIT] [--seconds N] [--list]

Order: changed tests; tests in the folder of the changed file; tests that import the file, directly
or through other modules. A file that is no module has the tests that name it. Files reached only
from `pyproject.toml` or an example come last.

The run ends with the first failure, or when the time is up. The time counts from the start of this
program, so that the answer comes within a minute on a busy machine, too; the nearest tests always
run.
"""

import argparse
import ast
import os
import re
import subprocess
import sys
import time
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import cache
from pathlib import Path

import grimp
import psutil
import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "support"))
from cases import SLOWEST
from packages import PACKAGES
from time_limit import TimeLimit

ROOT = Path(__file__).parents[2]
IMPORTED = (*PACKAGES, "benchmarks")
ON_PATH = ("tests/support/", "tests/programs/", "tests/faults/", "docs/generators/", "examples/")
"""Folders of programs, whose modules are imported by their names in the folder."""

ALSO: Sequence[tuple[Sequence[str], Sequence[str]]] = (
    (
        (
            *("controller/", "drivers/", "era_haptics/", "model/", "registry/", "sim/"),
            *("docs/generators/", "tests/errors/cases/"),
        ),
        ("make pages",),
    ),
    (("drivers/wires/",), ("make fuzz",)),
    (("drivers/host/",), ("make fuzz", "make stop-test", "make late-test")),
    (("era_haptics/lab/conformance/", "docs/how-to/", "docs/tutorials/"), ("make test-long",)),
    (("controller/daemon/", "controller/operation/"), ("make fault-test", "make kill-test")),
    (("controller/play/", "drivers/host/group.py"), ("make soak",)),
    (("model/compiled/", "build_libraries.py"), ("make test-kernels",)),
    (("build_libraries.py", "hatch_build.py"), ("make smoke",)),
    (("sim/soft_amp/", "era_haptics/lab/measuring/"), ("make test-long",)),
    (("firmware/",), ("make firmware-test",)),
    (("examples/application/",), ("make qt-test",)),
    (("controller/gateway/",), ("pytest tests/integration/test_dashboard*.py",)),
    (("docs/",), ("make docs",)),
    (
        ("pyproject.toml",),
        (
            *("make smoke", "make smoke-lowest", "make licences"),
            "python docs/generators/constraints.py > constraints.txt",
        ),
    ),
)
"""Prefixes of changed paths, and the commands to run in addition to `make test`."""

_MAX_FILES = 24  # two processors do not finish more within the time, and each costs time to import
_SECONDS = 45.0  # leaves a quarter of a minute for the last test and the planted faults
_MIN_TESTS = 10
"""Tests that run even if the machine is so busy that the time is up before the first."""
OPTIONS = ("-q", "-r", "fE", "-x", "--in-order", "-m", "not long and not alone")
"""Options of pytest."""
_MODULES = (".py", ".pyi")
_WRITER = re.compile(r"<!-- begin: written by \S*?(\w+)\.py")
_LAST = ("pyproject.toml", "examples/")
"""Paths that many tests name or import without depending on their content."""


def table() -> str:
    """Return the rows of ALSO as a Markdown table."""
    lines = ["| changed | run as well |", "|---|---|"]
    for paths, commands in ALSO:
        changed = ", ".join(f"`{path}`" for path in paths)
        run = ", ".join(f"`{command}`" for command in commands)
        lines.append(f"| {changed} | {run} |")
    return "\n".join(lines)


def also(changed: Iterable[str]) -> list[str]:
    """Return the commands to run in addition after a change of these files."""
    files = tuple(changed)
    selected: dict[str, None] = {}
    for prefixes, commands in ALSO:
        if any(path.startswith(tuple(prefixes)) for path in files):
            selected.update(dict.fromkeys(commands))
    return list(selected)


def changed_since(commit: str) -> list[str]:
    """Return the files that differ from a commit, including files that git does not track yet."""
    differing = _git("diff", "--name-only", commit).splitlines()
    untracked = _git("ls-files", "--others", "--exclude-standard").splitlines()
    return differing + untracked


def default_commit() -> str:
    """Return the commit at which this branch left main; HEAD on main or without a main."""
    branches = ("refs/heads/main", "refs/remotes/origin/main")
    present = _git("for-each-ref", "--format=%(refname)", *branches).splitlines()
    return _git("merge-base", "HEAD", present[0]).strip() if present else "HEAD"


def _git(*arguments: str) -> str:
    command = ["git", *arguments]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout


def nearest(changed: Sequence[str]) -> dict[str, int]:
    """Return the test files that changed files reach, nearest first, with their distance.

    The distance is 0 in the folder of a changed module and for tests that name a changed page,
    otherwise the number of imports in between.
    """
    last = [path for path in changed if path.startswith(_LAST)]
    first = [path for path in changed if path not in last]
    near = _reached(first)
    distances = _reached(last) | near
    beside: set[str] = set()
    for path in first:
        if path.endswith(_MODULES) and path not in _tests():
            beside.update(_tests_beside(path))
        elif path.endswith(".md"):
            beside.update(_tests_of_page(path))

    def rank(test: str) -> tuple[bool, bool, bool, int, int, bool, str]:
        common_paths = [os.path.commonpath([test, f"tests/{path}"]) for path in changed]
        common_folders = max(len(Path(path).parts) for path in common_paths)
        return (
            test not in changed,
            test not in near,
            test not in beside,
            distances[test],
            -common_folders,
            Path(test).name in SLOWEST,
            test,
        )

    reached = [test for test in _tests() if test in distances]
    return {test: distances[test] for test in sorted(reached, key=rank)}


def _reached(changed: Sequence[str]) -> dict[str, int]:
    """Return the least number of imports from each module and test to one of the changed files."""
    distances: dict[str, int] = {}
    for path in changed:
        direct = [_node(path)]
        beside = [] if path in _tests() else list(_tests_beside(path))
        if path.endswith(_MODULES):
            direct += beside
            beside = []
        else:
            direct += _modules_in(Path(path).parent)
            direct += _tests_of_page(path)
        for node in beside:
            distances.setdefault(node, 1)
        for node in direct:
            distances[node] = 0
    is_for_all_tests = "conftest" in distances
    queue = sorted(distances, key=lambda node: distances[node])
    for node in queue:  # grows while it is read: breadth first
        for importer in sorted(_importers().get(node, ())):
            if importer not in distances:
                distances[importer] = distances[node] + 1
                queue.append(importer)
    if is_for_all_tests:
        return dict.fromkeys(_tests(), 1) | distances
    return distances


def _modules_in(folder: Path) -> list[str]:
    """Return the imported modules in a folder, for a data file among them."""
    package = str(folder).replace("/", ".")
    return [module for module in _importers() if module.rpartition(".")[0] == package]


@cache
def _tests() -> list[str]:
    return sorted(path.relative_to(ROOT).as_posix() for path in ROOT.glob("tests/**/test_*.py"))


def _node(path: str) -> str:
    """Return the name of a file in the graph of imports: that of its module; a test's path."""
    name = path.rpartition(".")[0].removesuffix("/__init__")
    if path.partition("/")[0] in IMPORTED:
        return name.replace("/", ".")
    if path.startswith("tests/support/"):
        return name.removeprefix("tests/support/").replace("/", ".")
    if path in _tests():
        return path
    is_on_path = path.startswith(ON_PATH) or name.endswith("conftest")
    return name.rpartition("/")[2] if is_on_path else name.replace("/", ".")


def _tests_beside(path: str) -> Iterator[str]:
    """Yield the tests in the folder of tests/ that corresponds to a file's, or in one above."""
    folder = Path("tests") / Path(path.removeprefix("tests/")).parent
    while folder != Path("tests"):
        tests = [test for test in _tests() if test.startswith(f"{folder}/")]
        if tests:
            yield from tests
            return
        folder = folder.parent


def _tests_of_page(path: str) -> Iterator[str]:
    """Yield the tests that name a file, and those that import a generator of parts of it."""
    name = Path(path).name
    for test in _tests():
        if name in (ROOT / test).read_text("utf-8"):
            yield test
    page = ROOT / path
    if path.endswith(".md") and page.exists():
        for generator in set(_WRITER.findall(page.read_text("utf-8"))):
            yield from _importers().get(generator, set()) & set(_tests())


@cache
def _importers() -> Mapping[str, set[str]]:
    """Return the importers of each module: packages according to grimp, other files to `ast`."""
    graph = grimp.build_graph(*IMPORTED, cache_dir=str(ROOT / ".import_linter_cache"))
    importers: dict[str, set[str]] = defaultdict(set)
    for module in graph.modules:
        importers[module] = graph.find_modules_that_directly_import(module)
    files: list[Path] = []
    for folder in ("tests", "docs/generators", "examples"):
        files += (ROOT / folder).rglob("*.py")
    for file in files:
        node = _node(file.relative_to(ROOT).as_posix())
        for name in _imports(file):
            importers[name].add(node)
    return importers


def _imports(file: Path) -> set[str]:
    """Return the modules that a file imports, and imported names that may be modules."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(file.read_text("utf-8"))):
        if isinstance(node, ast.Import):
            names.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            names.add(node.module)
            names.update(f"{node.module}.{alias.name}" for alias in node.names)
    return names


def _run(tests: Sequence[str], *, seconds: float) -> int:
    """Run test files, nearest first, until a failure or until the time is up; return the status."""
    workers = ["--numprocesses", str(_workers()), "--dist", "loadfile", "--no-loadscope-reorder"]
    age = time.time() - psutil.Process().create_time()
    limit = TimeLimit(seconds, start=time.monotonic() - age, min_tests=_MIN_TESTS)
    status = pytest.main([*OPTIONS, *workers, *tests], plugins=[limit])
    return 0 if status == pytest.ExitCode.NO_TESTS_COLLECTED else int(status)


def _workers() -> int:
    """Return the number of worker processes; 0 on a busy machine, where each delays the start."""
    processors = len(os.sched_getaffinity(0))
    is_busy = os.getloadavg()[0] > processors
    return 0 if is_busy else processors


def _check_planted_faults(changed: Sequence[str]) -> int:
    """List the planted faults that changed files have made stale; return 1 for any."""
    command = [sys.executable, "tests/faults/run.py", "--check", *changed]
    return subprocess.run(command, cwd=ROOT, check=False).returncode


def main() -> int:
    """Run the command."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--since", metavar="COMMIT", help="default: where this branch left main")
    parser.add_argument("--seconds", type=float, default=_SECONDS, help="time from the start on")
    parser.add_argument("--list", action="store_true", help="list the test files, and run none")
    options = parser.parse_args()
    since = options.since or default_commit()
    changed = changed_since(since)
    reached = nearest(changed)
    if options.list:
        sys.stdout.writelines(f"{distance} {path}\n" for path, distance in reached.items())
        return 0
    selected = list(reached)[:_MAX_FILES]
    sys.stdout.write(f"{len(changed)} files differ from {since}; tests in {len(selected)} files\n")
    sys.stdout.flush()
    os.chdir(ROOT)
    status = _run(selected, seconds=options.seconds) if selected else 0
    if changed:
        status = max(status, _check_planted_faults(changed))
    farther = len(reached) - len(selected)
    unreached = len(_tests()) - len(reached)
    sys.stdout.write(
        f"Not run: {farther} test files farther away, {unreached} that do not depend on the "
        "change, tests marked `long` or `alone`, and what the time did not allow.\n"
        f"Next: {', '.join([*also(changed), 'make lint', 'make test'])}\n"
    )
    return status


if __name__ == "__main__":
    sys.exit(main())
