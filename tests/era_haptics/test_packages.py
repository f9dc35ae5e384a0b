"""What hides or replaces a package behind era_haptics is named, in a process of its own each."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
COMMAND = "import sys; sys.argv[0] = '/x/bin/era'; import era_haptics.command"  # as its script does
PROGRAM = "import era_haptics"


def said(program: str, *path: Path) -> tuple[int, list[str]]:
    """The exit status and lines of a program, with folders before others of Python's path."""
    done = subprocess.run(
        [sys.executable, "-P", "-c", program],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(map(str, path))},
    )
    return done.returncode, done.stderr.splitlines()


def written(path: Path, *, distribution: str = "") -> Path:
    """A file of another program, or of an installed distribution."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text('"""Another."""\n', encoding="utf-8")
    if distribution:
        site = path.parents[1]
        info = site / f"{distribution}-1.0.dist-info"
        info.mkdir()
        (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {distribution}\n", "utf-8")
        (info / "RECORD").write_text(f"{path.relative_to(site)},,\n", "utf-8")
    return path


@pytest.mark.parametrize(
    ("hiding", "distribution"),
    [("model.py", ""), ("sim/__init__.py", ""), ("drivers/__init__.py", "other-drivers")],
)
def test_what_hides_a_package_is_named(tmp_path: Path, hiding: str, distribution: str) -> None:
    """A file, a folder and a distribution, to a program as an exception, to `era` as one line."""
    path = written(tmp_path / hiding, distribution=distribution)
    package = Path(hiding).parts[0].removesuffix(".py")
    hidden = ROOT / package
    sentence = f"{tmp_path / Path(hiding).parts[0]} hides {hidden}, "
    status, lines = said(PROGRAM, tmp_path)
    assert (status, path.exists()) == (1, True)
    assert lines[-1].startswith(f"era_haptics.packages.HiddenPackage: {sentence}")
    assert f"the package {package} of era-haptics; " in lines[-1]
    assert (f"by the distribution {distribution}," in lines[-1]) == bool(distribution)
    status, lines = said(COMMAND, tmp_path)
    assert (status, len(lines)) == (2, 1)
    assert lines[0].startswith(f"era: error: {sentence}")


@pytest.mark.parametrize(
    ("replaced", "words"),
    [("model/__init__.py", "is another program's, by the distribution other,"), ("sim", "missing")],
)
def test_replaced_and_missing_packages_are_named(tmp_path: Path, replaced: str, words: str) -> None:
    """In the folder of an installation, into which another distribution was installed later."""
    shutil.copytree(ROOT / "era_haptics", tmp_path / "era_haptics")
    for package in ("controller", "drivers", "model", "registry", "sim"):
        (tmp_path / package).mkdir()
        shutil.copy(ROOT / package / "__init__.py", tmp_path / package)
    assert said(PROGRAM, tmp_path) == (0, [])
    if replaced == "sim":
        (tmp_path / "sim" / "__init__.py").unlink()
    else:
        written(tmp_path / replaced, distribution="other")
    status, lines = said(PROGRAM, tmp_path)
    assert status == 1
    assert f"{tmp_path / replaced} " in lines[-1]
    assert words in lines[-1]


def test_names_that_hide_nothing_do_not_disturb(tmp_path: Path) -> None:
    """A folder without modules, and a file behind ours on the path; `era` answers."""
    (tmp_path / "sim").mkdir()
    assert said(PROGRAM, tmp_path) == (0, [])
    written(tmp_path / "model.py")
    assert said(PROGRAM, ROOT, tmp_path) == (0, [])


NOTEBOOK = "module://ipykernel_of_elsewhere.backend_inline"
BACKEND = (
    "import era_haptics as era; era.draw_map; import matplotlib as m; print(m.rcParams['backend'])"
)


@pytest.mark.parametrize("is_installed", [True, False])
def test_backend_of_a_notebook_is_kept_where_it_is_installed(
    tmp_path: Path, is_installed: bool
) -> None:
    """In the notebook pictures stay inline; what it starts elsewhere loads matplotlib, too."""
    name = f"backend_{tmp_path.name.lower()}"
    if is_installed:
        (tmp_path / f"{name}.py").write_text('"""A backend."""\n', "utf-8")
    given = {"MPLBACKEND": f"module://{name}", "PYTHONPATH": str(tmp_path)}
    done = subprocess.run(
        [sys.executable, "-c", BACKEND],
        capture_output=True,
        text=True,
        check=False,
        env=os.environ | given,
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert (done.stdout.strip() == given["MPLBACKEND"]) == is_installed


@pytest.mark.parametrize("backend", [NOTEBOOK, "module://", "Qt4Agg"])
def test_command_draws_into_files_whatever_backend_is_named(backend: str) -> None:
    """That of a notebook, none, or one that matplotlib has no more; children inherit `agg`."""
    program = (
        "import os, sys; sys.argv[1:] = ['--version']; from era_haptics.command import main; "
        "main(); import model.figures; print(os.environ['MPLBACKEND'])"
    )
    done = subprocess.run(
        [sys.executable, "-c", program],
        capture_output=True,
        text=True,
        check=False,
        env=os.environ | {"MPLBACKEND": backend},
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.splitlines()[-1] == "agg"
