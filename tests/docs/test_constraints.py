"""The file of tested versions."""

from importlib.metadata import requires
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

import constraints

FILE = Path(constraints.__file__).parents[2] / "constraints.txt"


def test_constraints_pin_every_dependency_within_its_bounds() -> None:
    """One tested version of each that the extras for users require, directly or not."""
    lines = [line for line in FILE.read_text("utf-8").splitlines() if not line.startswith("#")]
    pinned = dict(line.split("==") for line in lines)
    assert constraints.closure("era-haptics", *constraints.EXTRAS).keys() == pinned.keys()
    for text in requires("era-haptics") or ():
        required = Requirement(text)
        if required.marker is None or required.marker.evaluate({"extra": "gateway"}):
            assert pinned[canonicalize_name(required.name)] in required.specifier
