"""Print the versions of all dependencies in this environment, as constraints for pip.

    python docs/generators/constraints.py > constraints.txt

The output covers the plain installation and the extras for users, without development tools.
"""

import sys
from importlib.metadata import PackageNotFoundError, requires, version

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

EXTRAS = ("gateway", "cluster", "sound", "frames")


def closure(name: str, *extras: str) -> dict[str, str]:
    """Return versions of all dependencies of a distribution with these extras, by name."""
    found: dict[str, str] = {}
    pending = [(name, extras)]
    while pending:
        package, wanted = pending.pop()
        for text in requires(package) or ():
            required = Requirement(text)
            markers = [{"extra": extra} for extra in wanted or ("",)]
            if required.marker and not any(map(required.marker.evaluate, markers)):
                continue
            child = canonicalize_name(required.name)
            try:
                is_new = child not in found
                found[child] = version(child)
            except PackageNotFoundError:
                continue
            if is_new or required.extras:
                pending.append((child, tuple(sorted(required.extras))))
    return dict(sorted(found.items()))


if __name__ == "__main__":
    sys.stdout.write("# Tested versions: pip install --constraint constraints.txt ...\n")
    for name, number in closure("era-haptics", *EXTRAS).items():
        sys.stdout.write(f"{name}=={number}\n")
