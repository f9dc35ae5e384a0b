"""The tests of what differs from a commit, the nearest first, for a minute: `make test-changed`.

    python tests/support/changed_tests.py [--since COMMIT] [--seconds N] [--list]

A test is near what has changed by its folder, then by the number of imports between both. A file
that is no module has the tests that name it and those of its folder. What only `pyproject.toml` or
an example leads to comes last. The first failure ends the run, and so does the end of the minute.
What is left out is printed; exit status 3 where no test had time.
"""

import argparse
import ast
import os
import re
import signal
import subprocess
import sys
import threading
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import cache
from pathlib import Path

import grimp
import pytest

from cases import SLOWEST

ROOT = Path(__file__).parents[2]
PACKAGES = ("registry", "controller", "drivers", "era_haptics", "model", "sim", "benchmarks")
FLAT = ("tests/support", "docs/generators", "examples")
"""Folders whose modules are imported by their bare names."""

ALSO: Sequence[tuple[Sequence[str], Sequence[str]]] = (
    (
        (
            *("drivers/protocol/", "controller/api/", "controller/cli/", "drivers/by_hand/cli.py"),
            *("controller/effects/", "model/cli.py", "model/commands/"),
            *("model/rig/sections.py", "sim/cli.py"),
            *("era_haptics/", "docs/generators/"),
        ),
        ("make pages",),
    ),
    (("drivers/wires/",), ("make pages", "make fuzz")),
    (("drivers/host/",), ("make fuzz", "make stop-test", "make late-test")),
    (("era_haptics/lab/conformance/", "docs/how-to/", "docs/tutorials/"), ("make test-long",)),
    (("controller/daemon/", "controller/operation/"), ("make fault-test", "make kill-test")),
    (("controller/play/", "drivers/host/group.py"), ("make soak",)),
    (("model/compiled/",), ("make test-kernels",)),
    (("sim/soft_amp/", "era_haptics/lab/measuring/"), ("make desk-test",)),
    (("firmware/",), ("make firmware-test",)),
    (("examples/application/",), ("make qt-test",)),
    (
        ("controller/gateway/",),
        (
            "make pages",
            "pytest tests/integration/test_dashboard*.py",
        ),
    ),
    (("docs/",), ("make docs",)),
    (
        ("pyproject.toml",),
        (
            *("make smoke", "make smoke-lowest", "make licences"),
            "python docs/generators/constraints.py > constraints.txt",
        ),
    ),
)
"""What else to run after a change of files that begin so."""

_MAX_FILES = 60  # collecting more leaves no time to run them
_SECONDS = 45.0  # for tests, of a minute
_NOTHING_RAN = 3
_MODULES = (".py", ".pyi")
_WRITER = re.compile(r"<!-- begin: written by \S*?(\w+)\.py")
_LAST = ("pyproject.toml", "examples/")
"""What many tests name or import that its change does not concern."""


def table() -> str:
    """The rows of ALSO, as Markdown."""
    lines = ["| changed | run as well |", "|---|---|"]
    for paths, commands in ALSO:
        cells = (", ".join(f"`{each}`" for each in row) for row in (paths, commands))
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def also(changed: Iterable[str]) -> list[str]:
    """What else to run after changes of these files."""
    rows = [
        commands for paths, commands in ALSO if any(each.startswith((*paths,)) for each in changed)
    ]
    return [*dict.fromkeys(command for commands in rows for command in commands)]


def changed_since(commit: str) -> list[str]:
    """The files that differ from a commit, with those that are not added yet."""
    differing = _git("diff", "--name-only", commit).splitlines()
    return [*differing, *_git("ls-files", "--others", "--exclude-standard").splitlines()]


def default_commit() -> str:
    """Where this branch has left main; on main, or without it, the last commit."""
    known = _git(
        "for-each-ref", "--format=%(refname)", "refs/heads/main", "refs/remotes/origin/main"
    )
    return _git("merge-base", "HEAD", known.splitlines()[0]).strip() if known else "HEAD"


def _git(*arguments: str) -> str:
    return subprocess.run(
        ["git", *arguments], cwd=ROOT, capture_output=True, text=True, check=True
    ).stdout


def nearest(changed: Sequence[str]) -> dict[str, int]:
    """The files of tests that changed files reach, by path: 0 in their folder, then by imports.

    Of a file that is no module those are 0 that name it, then come those of its folder. The order:
    tests that are changed themselves; those of the folders of changed modules and of changed pages;
    the nearest by imports, of as many those of a near folder first, and those that take long last;
    what is reached from _LAST alone.
    """
    last = [path for path in changed if path.startswith(_LAST)]
    near = _reached([path for path in changed if path not in last])
    distances = _reached(last) | near
    modules = [each for each in {*changed} - {*last, *_tests()} if each.endswith(_MODULES)]
    beside = {test for path in modules for test in _tests_beside(path)}
    beside |= {test for path in changed if path.endswith(".md") for test in _tests_of_page(path)}

    def place(test: str) -> tuple[bool, bool, bool, int, int, bool, str]:
        common = (os.path.commonpath([test, f"tests/{path}"]) for path in changed)
        shared = max(len(Path(each).parts) for each in common)
        return (
            *(test not in changed, test not in near, test not in beside, distances[test]),
            *(-shared, Path(test).name in SLOWEST, test),
        )

    order = sorted((path for path in _tests() if path in distances), key=place)
    return {path: distances[path] for path in order}


def _reached(changed: Sequence[str]) -> dict[str, int]:
    """The least number of imports from each module and test to one of the changed files."""
    distances: dict[str, int] = {}
    for path in changed:
        first, second = [_node(path)], [] if path in _tests() else [*_tests_beside(path)]
        if path.endswith(_MODULES):
            first, second = [*first, *second], []
        else:
            package = str(Path(path).parent).replace("/", ".")
            first += [each for each in _importers() if each.rpartition(".")[0] == package]
            first += _tests_of_page(path)
        distances = dict.fromkeys(second, 1) | distances | dict.fromkeys(first, 0)
    is_for_all, found = "conftest" in distances, sorted(distances, key=lambda one: distances[one])
    for node in found:
        for importer in sorted(_importers().get(node, ())):
            if importer not in distances:
                distances[importer] = distances[node] + 1
                found.append(importer)
    return dict.fromkeys(_tests(), 1) | distances if is_for_all else distances


@cache
def _tests() -> list[str]:
    return sorted(path.relative_to(ROOT).as_posix() for path in ROOT.glob("tests/**/test_*.py"))


def _node(path: str) -> str:
    """The name of a module, in the graph of imports; that of a test is its path."""
    name = path.rpartition(".")[0].removesuffix("/__init__")
    if path.partition("/")[0] in PACKAGES:
        return name.replace("/", ".")
    if path.startswith("tests/support/"):
        return name.removeprefix("tests/support/").replace("/", ".")
    return path if path in _tests() else name.rpartition("/")[2]


def _tests_beside(path: str) -> Iterator[str]:
    """The tests of the folder in tests/ with the path of a file's folder, or of the one above."""
    folder = Path("tests") / Path(path.removeprefix("tests/")).parent
    while folder != Path("tests"):
        if found := [each for each in _tests() if each.startswith(f"{folder}/")]:
            yield from found
            return
        folder = folder.parent


def _tests_of_page(path: str) -> Iterator[str]:
    """The tests that name a file, and those that import what writes parts of it, by its marks."""
    yield from (test for test in _tests() if Path(path).name in (ROOT / test).read_text("utf-8"))
    if path.endswith(".md") and (ROOT / path).exists():
        for writer in {*_WRITER.findall((ROOT / path).read_text("utf-8"))}:
            yield from _importers().get(writer, set()) & {*_tests()}


@cache
def _importers() -> Mapping[str, set[str]]:
    """The modules and tests that import each module: of the packages by grimp, others by ast."""
    graph = grimp.build_graph(*PACKAGES, cache_dir=str(ROOT / ".import_linter_cache"))
    importers: dict[str, set[str]] = defaultdict(set)
    for module in graph.modules:
        importers[module] = graph.find_modules_that_directly_import(module)
    files = [ROOT / path for path in _tests()]
    files += [path for folder in FLAT for path in (ROOT / folder).rglob("*.py")]
    for file in files:
        node = _node(file.relative_to(ROOT).as_posix())
        for name in _imports(file):
            importers[name].add(node)
    return importers


def _imports(file: Path) -> set[str]:
    """The modules that a file imports, and the names that may be such."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(file.read_text("utf-8"))):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
    return names


def _run(files: Sequence[str], *, seconds: float) -> int:
    """Run tests for some seconds, as if Ctrl-C ended them; return pytest's status, or another.

    _NOTHING_RAN where no test had time; 0 where those that had time have passed.
    """
    options = ["-q", "-r", "fE", "-x", "-m", "not long and not alone"]
    spread = ["--numprocesses", "2", "--dist", "loadfile", "--no-loadscope-reorder"]
    command = [sys.executable, "-m", "pytest", *options, *spread, *files]
    said = ""
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True) as process:
        timer = threading.Timer(seconds, process.send_signal, [signal.SIGINT])
        timer.start()
        for said in process.stdout or ():
            sys.stdout.write(said)
        timer.cancel()
    if process.returncode not in (pytest.ExitCode.INTERRUPTED, -signal.SIGINT):
        return process.returncode
    return 0 if " passed" in said else _NOTHING_RAN


def main() -> int:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--since", metavar="COMMIT", help="by default where this branch left main")
    parser.add_argument("--seconds", type=float, default=_SECONDS, help="for tests")
    parser.add_argument("--list", action="store_true", help="list the tests, and run none")
    options = parser.parse_args()
    since = options.since or default_commit()
    changed = changed_since(since)
    reached = nearest(changed)
    chosen, status = [*reached][:_MAX_FILES], 0
    if options.list:
        sys.stdout.writelines(f"{distance} {path}\n" for path, distance in reached.items())
        return 0
    sys.stdout.write(f"{len(changed)} files differ from {since}; tests in {len(chosen)} files\n")
    sys.stdout.flush()
    if chosen:
        status = _run(chosen, seconds=options.seconds)
    sys.stdout.write(
        f"Left out: tests in {len(reached) - len(chosen)} files that more imports lead to and in "
        f"{len(_tests()) - len(reached)} that none do, and all that is long or loads the machine.\n"
        f"Next: {', '.join([*also(changed), 'make test'])}\n"
    )
    if status == _NOTHING_RAN:
        sys.stdout.write(
            f"No test had time within {options.seconds:g} s: nothing is tested. Run them without "
            f"other load, or with more time: python {Path(__file__).relative_to(ROOT)} --seconds "
            f"{4 * options.seconds:g}\n"
        )
    return 0 if status == pytest.ExitCode.NO_TESTS_COLLECTED else status


if __name__ == "__main__":
    sys.exit(main())
