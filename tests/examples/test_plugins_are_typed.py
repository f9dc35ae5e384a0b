"""The example plug-ins as a type checker sees them, and what of ours they import."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PLUGINS = ROOT / "examples" / "plugins"
MODULES = sorted(PLUGINS.glob("*/*.py"))


@pytest.mark.parametrize("path", MODULES, ids=[path.stem for path in MODULES])
def test_a_plug_in_imports_stable_names_only(path: Path) -> None:
    """Of this project `era_haptics` alone, whose names stay while modules move."""
    brought = re.findall(r"^\s*(?:from|import) ([\w.]+)", path.read_text("utf-8"), re.MULTILINE)
    homes = {name.partition(".")[0] for name in brought}
    assert homes & {"registry", "controller", "drivers", "model", "sim"} == set()


def test_plug_ins_pass_mypy_strict(tmp_path: Path) -> None:
    """Each of them, as it would in a project of its own, without our settings."""
    options = ["--strict", "--config-file=", f"--cache-dir={tmp_path}"]
    said = subprocess.run(
        [sys.executable, "-m", "mypy", *options, *MODULES],
        cwd=PLUGINS,
        capture_output=True,
        text=True,
        check=False,
    )
    assert (said.returncode, said.stderr) == (0, ""), said.stdout
    assert f"no issues found in {len(MODULES)} source files" in said.stdout
