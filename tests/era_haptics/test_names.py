"""The names that programs import: all there, typed, and loaded one by one."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import era_haptics as era

STUB = Path(era.__file__).with_suffix(".pyi")


def modules_after(program: str) -> set[str]:
    """Names of the modules that a program has loaded."""
    done = subprocess.run(
        [sys.executable, "-c", f"import sys; {program}; print(*sys.modules)"],
        capture_output=True,
        text=True,
        check=True,
    )
    return set(done.stdout.split())


def test_every_name_is_loaded_from_where_type_checkers_find_it() -> None:
    """The table of homes against the imports of the stub."""
    homes = {
        alias.name: node.module
        for node in ast.parse(STUB.read_text("utf-8")).body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }
    assert homes == era._HOMES
    assert sorted(homes) == sorted(era.__all__) == sorted(dir(era))
    for name in era.__all__:
        assert getattr(era, name).__name__ == name


@pytest.mark.parametrize(("name", "hidden"), [("model.py", "model"), ("sim/__init__.py", "sim")])
def test_file_that_hides_a_package_is_named(tmp_path: Path, name: str, hidden: str) -> None:
    """Beside a program, which Python looks in first."""
    hiding = tmp_path / name
    hiding.parent.mkdir(exist_ok=True)
    hiding.touch()
    (tmp_path / "mine.py").write_text("import era_haptics", encoding="utf-8")
    done = subprocess.run(
        [sys.executable, tmp_path / "mine.py"], capture_output=True, text=True, check=False
    )
    last = done.stderr.splitlines()[-1]
    assert last.startswith(f"ImportError: {hiding} hides the package {hidden} ")


def test_unknown_name_lists_the_known_ones() -> None:
    """As an AttributeError."""
    with pytest.raises(AttributeError, match=r"laod_rig; .*load_rig"):
        _ = era.laod_rig


@pytest.mark.parametrize(
    ("module", "not_loaded"),
    [
        ("Client", "scipy matplotlib sim serial"),
        ("load_rig", "matplotlib sim controller"),
        ("plugins.wires", "model controller sim numpy scipy"),
        *(
            pytest.param(*row, marks=pytest.mark.long)
            for row in (
                ("SolvedPlate", "matplotlib controller"),
                ("draw_map", "matplotlib.pyplot"),
                ("plugins.touch_sources", "sim numpy scipy matplotlib pythonosc"),
                ("plugins.effects", "sim scipy matplotlib drivers.backend"),
                ("plugins.materials", "sim controller drivers numpy"),
            )
        ),
    ],
)
def test_name_loads_only_what_it_needs(module: str, not_loaded: str) -> None:
    """A client of the daemon is loaded without linear algebra, a plate without pyplot."""
    names = module.partition(".")
    load = f"import era_haptics.{module}" if names[1] else f"import era_haptics as e; e.{module}"
    assert modules_after(load) & set(not_loaded.split()) == set()
