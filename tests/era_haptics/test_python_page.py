"""The entries of the reference of the Python API against the code."""

from pathlib import Path

import pytest

PAGE = Path(__file__).parents[2] / "docs" / "reference" / "python-api.md"


@pytest.mark.parametrize(
    "fact",
    [
        "Raises InputError for a missing, damaged or foreign file, with",  # errors of a function
        "slew [1/s]: highest rise of a level;",  # units of a class's fields
        "peak acceleration [m/s²] at raster points x (nx,), y (ny,) [m]",  # shapes
        "- `disarm() -> None`: Fall silent, then switch the high voltage off.",  # a method
        "- `is_reached: bool`: Whether all vibrations have their levels",  # a property
        "- `async events() -> AsyncIterator[Notification]`: Yield notifications",  # a coroutine
        "`stop(*, client: str | None=None) -> StopResult`",  # a method of the stub
        "`SolvedPlate(rig: Rig, *, seed: int | None=None)`: A rig's plate",  # a constructor
    ],
)
def test_page_has_what_docstrings_say(fact: str) -> None:
    """As it is read in a checkout: shapes, units and errors, not first sentences alone."""
    assert fact.casefold() in " ".join(PAGE.read_text("utf-8").casefold().split())
