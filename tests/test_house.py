"""What keeps the house in order: imports of programs, names, retired words, tests of a change.

Import contracts exclude circles within the packages; here the folders beside them are checked. What
a machine lacks skips the tests that use it, by name, and fails them in CI.
"""

import ast
import os
import re
import subprocess
import sys
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

from changed_tests import ALSO, OPTIONS, also, nearest
from checks import vocabulary
from checks.unique_names import repeated_names
from checks.vocabulary import misleading_names, retired_identifiers

ROOT = Path(__file__).parents[1]
FOLDERS = ("tests", "docs", "examples", "firmware")


def imported(file: Path) -> set[str]:
    """Names of modules without a package that a file imports, anywhere in it."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names |= {each.name for each in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names.add(node.module)
    return names


@pytest.mark.long
def test_no_circle_of_programs() -> None:
    """Modules of one name in several folders count as one: none of them is in a circle either."""
    graph: dict[str, set[str]] = {}
    for folder in FOLDERS:
        for file in (ROOT / folder).rglob("*.py"):
            graph.setdefault(file.stem, set()).update(imported(file) - {file.stem})
    assert len([*TopologicalSorter(graph).static_order()]) >= len(graph)


PRODUCT = {
    "sim/line.py": "class Line: ...\nclass _Chosen: ...\nclass _Chosen: ...",
    "model/line.py": "class Table:\n    class Line: ...",
    "model/cli.py": "class Preempted(Refusal): ...\nclass Refusal(LinkError): ...",
    "sim/cli.py": "class Felt: ...",
    "tests/line.py": "class Line: ...",
}


def test_names_that_mislead_are_listed_with_their_places(tmp_path: Path) -> None:
    """Modules of one name, and participles; errors and names of command modules are free."""
    for name, text in PRODUCT.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text, "utf-8")
    found = [re.findall(r"^\w+ \w+|\w+/\S+\d", line) for line in misleading_names(tmp_path)]
    assert found == [
        ["module line"],
        ["class Felt", "sim/cli.py:1"],
        ["class _Chosen", "sim/line.py:2"],
    ]


REPEATED = {
    "model/plate.py": "LIMIT, _OWN = 1, 2\nclass Plate: ...\ndef shown(): ...\nRow = int",
    "sim/plant.py": "if True:\n    LIMIT = 3\n_OWN = 4\nfrom model.plate import shown as shown",
    "drivers/wire.py": "class Wire:\n    class Plate: ...\nRow: TypeAlias = list[int]",
    "model/cli.py": "app = 1\nEXIT_STATUS = {}\ngroup = typer.Typer()\ndef show(): ...",
    "sim/cli.py": "app = 2\nEXIT_STATUS = {}\ngroup = typer.Typer()\ndef show(): ...",
    "era_haptics/lab/conformance/checks/one.py": "@reading('x')\nasync def stop(): ...",
    "era_haptics/lab/conformance/checks/two.py": "@driving('x')\nasync def stop(): ...",
    "era_haptics/tables.py": "def answer(): ...\ndef helper(): ...",
    "era_haptics/__init__.pyi": "from era_haptics.tables import answer as answer",
    "model/plan.py": "def answer(): ...\ndef helper(): ...",
    "tests/plate.py": "LIMIT = 5",
}


def test_names_that_two_modules_define_are_listed_with_their_places(tmp_path: Path) -> None:
    """Constants, classes, aliases, functions; re-exports, commands, checks and the API are free."""
    for name, text in REPEATED.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text, "utf-8")
    found = [re.findall(r"^\w+|[\w/]+\.py:\d+", line) for line in repeated_names(tmp_path)]
    assert found == [
        ["LIMIT", "model/plate.py:1", "sim/plant.py:2"],
        ["Plate", "drivers/wire.py:2", "model/plate.py:2"],
        ["Row", "drivers/wire.py:3", "model/plate.py:4"],
        ["helper", "era_haptics/tables.py:2", "model/plan.py:2"],
    ]


def importing(module: str) -> set[str]:
    """The files of tests with a line that imports something out of a module."""
    line = re.compile(rf"^from {re.escape(module)} import", re.MULTILINE)
    files = ROOT.glob("tests/**/test_*.py")
    found = {path for path in files if line.search(path.read_text("utf-8"))}
    return {path.relative_to(ROOT).as_posix() for path in found}


@pytest.mark.long
@pytest.mark.parametrize(
    "path", ["drivers/wires/can_frames.py", "model/rig/air_gap.py", "sim/cli.py"]
)
def test_tests_of_the_folder_come_before_those_that_import(path: str) -> None:
    """And those before all others, which only import what imports it.

    What the project's file or an example leads to besides comes last.
    """
    reached = nearest([path])
    folder = Path("tests") / Path(path).parent
    beside = {each for each in reached if folder in Path(each).parents}
    direct = importing(path.removesuffix(".py").replace("/", "."))
    assert {each for each in beside | direct if reached[each] <= 1} == beside | direct
    assert {each for each, distance in reached.items() if distance == 0} >= beside
    assert {each for each, distance in reached.items() if distance == 1} >= direct - beside
    order = [*nearest(["pyproject.toml", "examples/plugins/effect/heartbeat.py", path])]
    assert {Path(each).parts[:2] for each in order[: len(beside)]} == {
        ("tests", Path(path).parts[0])
    }
    assert {*order[: len(reached)]} == {*reached} < {*order}


def test_module_of_tests_and_page_lead_to_their_tests() -> None:
    """Over imports within tests/support; a page over its name, whatever folder names it."""
    assert nearest(["tests/support/kit/set_table.py"]).keys() >= importing("kit.set_table")
    assert nearest(["docs/reference/rig.md"])["tests/model/rig/test_rig_summary.py"] == 0
    assert nearest(["tests/docs/test_pages.py"]) == {"tests/docs/test_pages.py": 0}
    assert len(nearest(["tests/conftest.py"])) == len([*ROOT.glob("tests/**/test_*.py")])


def test_tests_of_a_page_that_is_written_anew_come_before_those_that_import() -> None:
    """Of a page whose marks name what writes it, which its test imports without naming the page."""
    module, page = "drivers/protocol/definition.py", "docs/reference/can.md"
    order = [*nearest([module, page])]
    beside = [each for each in order if Path("tests", module).parent in Path(each).parents]
    assert order.index("tests/docs/test_protocol_pages.py") <= len(beside) + 4
    assert nearest([page])["tests/docs/test_protocol_pages.py"] == 0


def test_rows_name_what_there_is() -> None:
    """Files or folders, and targets of the Makefile."""
    targets = re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text("utf-8"), re.MULTILINE)
    for paths, commands in ALSO:
        assert [path for path in paths if not (ROOT / path).exists()] == []
        named = [command.split()[1] for command in commands if command.startswith("make ")]
        assert set(named) <= set(targets)
    assert also(["drivers/wires/can_frames.py"]) == ["make pages", "make fuzz"]


def test_nearest_files_run_first_even_if_others_are_slower() -> None:
    """Only `make test` begins with the slowest files; `make test-changed` keeps its own order."""
    files = ["tests/registry/test_threads.py", "tests/drivers/host/test_ledger.py"]
    command = [sys.executable, "-m", "pytest", *OPTIONS, "--collect-only", *files]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    collected = [line.partition("::")[0] for line in done.stdout.splitlines() if "::" in line]
    assert list(dict.fromkeys(collected)) == files


RUN_WITH_TIME_LIMIT = """
import sys
import pytest
from changed_tests import TimeLimit
options = ["-q", "-x", "-p", "no:cacheprovider", "-p", "no:xdist"]
sys.exit(pytest.main(options, plugins=[TimeLimit(float(sys.argv[1]))]))
"""
NUMBERED_TESTS = """
import pytest

@pytest.mark.parametrize("number", range(60))
def test_number(number):
    assert number != FAILING
"""


@pytest.mark.parametrize(
    ("seconds", "failing", "status", "expected"),
    [
        ("600", -1, 0, "60 passed"),
        ("0", 49, 1, "1 failed, 49 passed"),
        ("0", 50, 0, "50 passed"),
    ],
)
def test_time_limit_runs_the_nearest_tests_when_the_time_is_over(
    seconds: str, failing: int, status: int, expected: str, tmp_path: Path
) -> None:
    """The nearest 50 tests run even after the time is up; a failure among them fails the run."""
    program = NUMBERED_TESTS.replace("FAILING", str(failing))
    (tmp_path / "test_numbers.py").write_text(program, "utf-8")
    done = subprocess.run(
        [sys.executable, "-c", RUN_WITH_TIME_LIMIT, seconds],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(ROOT / "tests" / "support")},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == status, done.stdout + done.stderr
    assert f"{expected} in" in done.stdout


def test_what_users_copy_keeps_the_rule(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An example, and a program on a page at its line there; text beside programs is free."""
    files = {
        "examples/one.py": "begin = 1\n",
        "README.md": "begin = 0\n\n```python\nstart = 1\nbegin = start\n```\n",
        "docs/how-to/two.md": "```python\nstart = 1\n```\n```\nbegin = 1\n```\n",
    }
    for name, text in files.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text, "utf-8")
    monkeypatch.setattr(vocabulary, "ROOT", tmp_path)
    found = [each.partition(", use")[0] for each in retired_identifiers()]
    assert found == ["examples/one.py:1: begin", "README.md:5: begin"]


CONFTEST = """
import pytest
from processes.typed_page import needs

@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item):
    for mark in item.iter_markers("needs"):
        needs(*mark.args)
"""
TESTS = """
import pytest

@pytest.fixture
def server():
    raise RuntimeError("started without its library")

@pytest.mark.needs("cc", "no-such-library")
def test_user(server): pass

def test_neighbour(): pass
"""


@pytest.mark.parametrize(
    ("ci", "outcome"),
    [pytest.param("", "1 passed, 1 skipped", marks=pytest.mark.long), ("1", "1 error")],
)
def test_missing_component_skips_its_user_and_not_its_neighbour(
    tmp_path: Path, ci: str, outcome: str
) -> None:
    """Before a fixture fails for it; the reason has its name and the remedy."""
    (tmp_path / "conftest.py").write_text(CONFTEST, "utf-8")
    (tmp_path / "test_users.py").write_text(TESTS, "utf-8")
    more = {"PYTHONPATH": str(Path(__file__).with_name("support")), "CI": ci}
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-rs", "-p", "no:cacheprovider", "-p", "no:xdist"],
        cwd=tmp_path,
        env=os.environ | more | {"PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert outcome in done.stdout.splitlines()[-1]
    missing = "no-such-library is not installed; on Debian: apt install no-such-library"
    assert missing in done.stdout
