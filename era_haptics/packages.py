"""Checks of the packages behind `era_haptics`, before any of them is loaded.

Their names are common, and Python takes the first one on its path: a file beside a program, or the
package of another distribution.
"""

import os
import sys
from importlib.metadata import distributions
from importlib.util import find_spec
from pathlib import Path

PACKAGES = ("controller", "drivers", "model", "registry", "sim")
_OWN = "of era-haptics"  # in the docstring of each


class HiddenPackage(ImportError):
    """A package of era-haptics that a file, a folder or another distribution hides or replaced."""


def check_packages() -> None:
    """Raise HiddenPackage for the first package that is not found beside `era_haptics`.

    In the command `era`, end with the sentence and its exit status of invalid input instead.
    """
    for package in PACKAGES:
        try:
            _check(package)
        except HiddenPackage as error:
            if Path(sys.argv[0]).name in ("era", "era.exe"):
                sys.stderr.write(f"era: error: {error}\n")
                sys.exit(2)
            raise


def drop_foreign_backend() -> None:
    """Remove the `MPLBACKEND` of a notebook that started this program if it is not installed here.

    matplotlib refuses to be imported with it. In a notebook it stays, and draws inline.
    """
    named = os.environ.get("MPLBACKEND", "").partition("module://")[2]
    try:
        is_foreign = named != "" and find_spec(named) is None
    except ImportError:
        is_foreign = True
    if is_foreign:
        del os.environ["MPLBACKEND"]


def _check(package: str) -> None:
    own = Path(__file__).resolve().parents[1] / package / "__init__.py"
    loaded = sys.modules.get(package)  # which need not have a specification
    found = find_spec(package) if loaded is None else None
    origin = Path(getattr(loaded, "__file__", None) or (found and found.origin) or own)
    if not own.exists():
        why = f"{own.parent} is missing"
    elif origin.resolve() != own:
        why = f"{origin.parent if origin.name == own.name else origin} hides {own.parent}"
    elif _OWN not in own.read_text(encoding="utf-8"):
        why = f"{own} is another program's"
    else:
        return
    other = _distribution(origin)
    by = "" if other is None else f", by the distribution {other}"
    raise HiddenPackage(
        f"{why}{by}, the package {package} of "
        "era-haptics; rename the other, or install era-haptics in an environment of its own",
        name=package,
    )


def _distribution(file: Path) -> str | None:
    """The name of another installed distribution that has a file, None without one."""
    for each in distributions():
        files = map(str, map(each.locate_file, each.files or ()))
        if each.name != "era-haptics" and str(file) in files:
            return each.name
    return None
