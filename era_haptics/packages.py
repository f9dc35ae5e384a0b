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
_MARK = "of era-haptics"  # in every package's docstring


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
    backend = os.environ.get("MPLBACKEND", "").partition("module://")[2]
    try:
        is_foreign = backend != "" and find_spec(backend) is None
    except ImportError:
        is_foreign = True
    if is_foreign:
        del os.environ["MPLBACKEND"]


def _check(package: str) -> None:
    """Raise HiddenPackage unless Python imports the package that belongs to this program."""
    own_file = Path(__file__).resolve().parents[1] / package / "__init__.py"
    origin = _origin(package) or own_file
    if not own_file.exists():
        problem = f"{own_file.parent} is missing"
    elif origin.resolve() != own_file:
        hiding = origin.parent if origin.name == own_file.name else origin
        problem = f"{hiding} hides {own_file.parent}"
    elif _MARK not in own_file.read_text(encoding="utf-8"):
        problem = f"{own_file} is another program's"
    else:
        return
    name = _distribution(origin)
    source = "" if name is None else f", by the distribution {name}"
    raise HiddenPackage(
        f"{problem}{source}, the package {package} of "
        "era-haptics; rename the other, or install era-haptics in an environment of its own",
        name=package,
    )


def _origin(package: str) -> Path | None:
    """Return the file that Python has imported or would import as a package; None without one."""
    module = sys.modules.get(package)  # can lack a specification
    if module is not None:
        file = getattr(module, "__file__", None)
    else:
        spec = find_spec(package)
        file = None if spec is None else spec.origin
    return Path(file) if file else None


def _distribution(file: Path) -> str | None:
    """Return the name of another installed distribution that contains a file; None without one."""
    for distribution in distributions():
        paths = map(distribution.locate_file, distribution.files or ())
        if distribution.name != "era-haptics" and str(file) in map(str, paths):
            return distribution.name
    return None
