"""Names for plug-ins: complete and documented."""

import ast
import re
import tomllib
from importlib import import_module
from pathlib import Path

import pytest

import era_haptics.plugins

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
