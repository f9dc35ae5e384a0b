"""The names that programs and plug-ins import: all there, typed, documented, loaded one by one."""

import ast
import re
import subprocess
import sys
import tomllib
from importlib import import_module
from pathlib import Path

import pytest

import era_haptics as era
import era_haptics.plugins

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
                ("plugins.content_formats", "sim scipy matplotlib drivers"),
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


ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "reference" / "plugins.md").read_text("utf-8")
PACKAGE = Path(era_haptics.plugins.__file__).parent
KINDS = sorted(path.stem for path in PACKAGE.glob("[!_]*.py"))


def test_module_names_are_entry_point_groups() -> None:
    """The examples register plug-ins in the groups that the modules are named for."""
    groups = {
        group.removeprefix("era_haptics.")
        for path in (ROOT / "examples" / "plugins").glob("*/pyproject.toml")
        for group in tomllib.loads(path.read_text("utf-8"))["project"]["entry-points"]
    }
    assert groups == set(KINDS)


@pytest.mark.parametrize("kind", KINDS)
def test_module_exports_its_imports_and_page_documents_them(kind: str) -> None:
    """Exactly the imported names are exported and documented."""
    tree = ast.parse((PACKAGE / f"{kind}.py").read_text("utf-8"))
    imported = {
        alias.name for node in tree.body if isinstance(node, ast.ImportFrom) for alias in node.names
    }
    module = import_module(f"era_haptics.plugins.{kind}")
    assert imported == set(module.__all__)
    documented = re.findall(
        rf"^\.\. (?:auto|py:)\w+:: era_haptics\.plugins\.{kind}\.(\w+)", PAGE, re.M
    )
    assert sorted(documented) == sorted(module.__all__)
    # Where the directive is not filled in, a link leads to the docstrings.
    assert f"](../../era_haptics/plugins/{kind}.py)" in PAGE
