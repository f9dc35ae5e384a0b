"""Check the packages that `era_haptics` needs before loading them.

Their names are common, and Python imports the first match on its path: a file next to a program, or
a package of another distribution.
"""

import os
import sys
from importlib.metadata import distributions
from importlib.util import find_spec
from pathlib import Path

PACKAGES = ("controller", "drivers", "model", "registry", "sim")
_OWN = "of era-haptics"  # in every package's docstring


class HiddenPackage(ImportError):
    """A package of era-haptics is hidden or replaced by a file, folder or other distribution."""


def check_packages() -> None:
    """Raise HiddenPackage for the first package that was not installed with `era_haptics`.

    The command `era` prints the message and exits with the status for invalid input instead.
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
    """Remove `MPLBACKEND` if a notebook started this program and its backend is not installed here.

    matplotlib cannot be imported with a missing backend. In the notebook itself the variable stays.
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
    loaded = sys.modules.get(package)  # can lack a specification
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
    """Return the name of another installed distribution that contains a file; None without one."""
    for each in distributions():
        files = map(str, map(each.locate_file, each.files or ()))
        if each.name != "era-haptics" and str(file) in files:
            return each.name
    return None
