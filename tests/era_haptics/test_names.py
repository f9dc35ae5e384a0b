"""The names that programs import: all there, typed, and loaded one by one."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import era_haptics as era

SOURCE = Path(era.__file__)


def test_every_name_is_there_once() -> None:
    """What type checkers are told of a name's home is where it is loaded from."""
    (told,) = (
        node
        for node in ast.parse(SOURCE.read_text("utf-8")).body
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"
    )
    homes = {
        alias.name: node.module
        for node in told.body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }
    assert homes == era._HOMES
    assert sorted(homes) == sorted(era.__all__) == sorted(dir(era))
    for name in era.__all__:
        assert getattr(era, name).__name__ == name


def test_a_name_that_is_none_is_told_the_others() -> None:
    """As a spelling mistake in a notebook would find it."""
    with pytest.raises(AttributeError, match=r"laod_rig; .*load_rig"):
        _ = era.laod_rig


@pytest.mark.parametrize(
    ("name", "never"),
    [
        ("Client", ("scipy", "matplotlib", "sim", "pymodbus")),
        ("load_rig", ("matplotlib", "sim", "controller")),
        ("SolvedPlate", ("matplotlib", "controller")),
    ],
)
def test_a_name_brings_nothing_that_it_does_not_need(name: str, never: tuple[str, ...]) -> None:
    """A client of the daemon waits for no linear algebra, a plate for no pictures."""
    program = f"import sys, era_haptics; era_haptics.{name}; print(*sys.modules)"
    said = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    ).stdout.split()
    assert set(said) & set(never) == set()


def test_the_commands_do_without() -> None:
    """`era --help` does not load it."""
    program = (
        "import sys, contextlib\nsys.argv = ['era', '--help']\n"
        "from controller.cli.main import main\n"
        "with contextlib.suppress(SystemExit):\n    main()\nprint('era_haptics' in sys.modules)"
    )
    said = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    )
    assert said.stdout.splitlines()[-1] == "False"


@pytest.mark.parametrize(
    "package", ["registry", "controller", "drivers", "era_haptics", "model", "sim"]
)
def test_every_package_says_that_it_is_typed(package: str) -> None:
    """By the marker that type checkers look for."""
    assert (SOURCE.parents[1] / package / "py.typed").is_file()
