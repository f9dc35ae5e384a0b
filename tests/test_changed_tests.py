"""Which tests `make test-changed` takes, and what it does without time."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

import changed_tests
from changed_tests import ALSO, ROOT, also, nearest


def importing(module: str) -> set[str]:
    """The files of tests with a line that imports something out of a module."""
    line = re.compile(rf"^from {re.escape(module)} import", re.MULTILINE)
    files = ROOT.glob("tests/**/test_*.py")
    found = {path for path in files if line.search(path.read_text("utf-8"))}
    return {path.relative_to(ROOT).as_posix() for path in found}


@pytest.mark.parametrize("path", ["drivers/protocol/sets.py", "model/rig/air_gap.py", "sim/cli.py"])
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
    assert nearest(["tests/support/set_table.py"]).keys() >= importing("set_table")
    assert nearest(["docs/reference/rig.md"])["tests/model/rig/test_rig_summary.py"] == 0
    assert nearest(["tests/test_docs_site.py"]) == {"tests/test_docs_site.py": 0}
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


def test_tests_run_in_the_order_given_until_the_time_is_over(tmp_path: Path) -> None:
    """What has no time is counted apart, and its files are named."""
    for name in ("test_a.py", "test_b.py"):
        (tmp_path / name).write_text("def test_one(): pass\n", "utf-8")
    command = [
        sys.executable,
        "-m",
        "pytest",
        "-v",
        "-p",
        "changed_tests",
        "test_b.py",
        "test_a.py",
    ]
    for until, outcome in (("inf", "2 passed"), ("0", "2 without time")):
        more = {"PYTHONPATH": str(ROOT / "tests" / "support"), "ERA_TESTS_UNTIL": until}
        more["PYTEST_DISABLE_PLUGIN_AUTOLOAD"] = "1"  # they take seconds to load
        done = subprocess.run(
            command,
            cwd=tmp_path,
            env=os.environ | more,
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == (3 if until == "0" else 0)
        assert re.findall(r"^test_(.)\.py::", done.stdout, re.MULTILINE) == ["b", "a"]
        assert outcome in done.stdout.splitlines()[-1]
        assert ("test_b.py test_a.py" in done.stdout.splitlines()) == (until == "0")


def test_command_fails_where_no_test_had_time(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """And its last line says so, which nothing passed would not."""
    monkeypatch.setattr(changed_tests, "changed_since", lambda commit: ["tests/test_vocabulary.py"])
    monkeypatch.setattr(sys, "argv", ["changed_tests", "--seconds", "0"])
    assert changed_tests.main() == 3
    assert capfd.readouterr().out.splitlines()[-1].startswith("No test had time")
