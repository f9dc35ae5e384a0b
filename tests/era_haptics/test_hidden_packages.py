"""A file or distribution that hides a package of the product is named."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from packages import PACKAGES

ROOT = Path(__file__).parents[2]
COMMAND = "import sys; sys.argv[0] = '/x/bin/era'; import era_haptics.command"  # as its script does
PROGRAM = "import era_haptics"


def errors_of(program: str, folder: Path) -> tuple[int, list[str]]:
    """Return the exit status and the errors of a program with a folder first on Python's path."""
    completed = subprocess.run(
        [sys.executable, "-P", "-c", program],
        capture_output=True,
        text=True,
        check=False,
        env=os.environ | {"PYTHONPATH": str(folder)},
    )
    return completed.returncode, completed.stderr.splitlines()


def write_module(path: Path, *, distribution: str = "") -> None:
    """Write a file of another program, or of an installed distribution."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text('"""Another."""\n', encoding="utf-8")
    if distribution:
        site = path.parents[1]
        info = site / f"{distribution}-1.0.dist-info"
        info.mkdir()
        (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {distribution}\n", "utf-8")
        (info / "RECORD").write_text(f"{path.relative_to(site)},,\n", "utf-8")


@pytest.mark.parametrize(
    ("file", "package", "distribution"),
    [
        pytest.param("model.py", "model", "", marks=pytest.mark.long),
        pytest.param("sim/__init__.py", "sim", "", marks=pytest.mark.long),
        ("drivers/__init__.py", "drivers", "other-drivers"),
    ],
)
def test_file_that_hides_a_package_is_named(
    tmp_path: Path, file: str, package: str, distribution: str
) -> None:
    """To a program as an exception, to `era` as one line; with the distribution that has it."""
    write_module(tmp_path / file, distribution=distribution)

    status, lines = errors_of(PROGRAM, tmp_path)
    command_status, command_lines = errors_of(COMMAND, tmp_path)

    hiding = tmp_path / Path(file).parts[0]
    sentence = f"{hiding} hides {ROOT / package}, "
    assert status == 1
    assert lines[-1].startswith(f"era_haptics.packages.HiddenPackage: {sentence}")
    assert f"the package {package} of era-haptics; " in lines[-1]
    assert (f"by the distribution {distribution}," in lines[-1]) == bool(distribution)
    assert command_status == 2
    (line,) = command_lines
    assert line.startswith(f"era: error: {sentence}")


@pytest.fixture
def installation(tmp_path: Path) -> Path:
    """The folder of an installation without errors."""
    shutil.copytree(ROOT / "era_haptics", tmp_path / "era_haptics")
    for package in set(PACKAGES) - {"era_haptics"}:
        (tmp_path / package).mkdir()
        shutil.copy(ROOT / package / "__init__.py", tmp_path / package)
    assert errors_of(PROGRAM, tmp_path) == (0, [])
    return tmp_path


def test_missing_package_is_named(installation: Path) -> None:
    """By its folder."""
    (installation / "sim" / "__init__.py").unlink()

    status, lines = errors_of(PROGRAM, installation)

    assert status == 1
    assert f"{installation / 'sim'} " in lines[-1]
    assert "missing" in lines[-1]
