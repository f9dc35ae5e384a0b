"""Numbers of things as sentences say them."""

import pytest

from model.counting import counted


@pytest.mark.parametrize(
    ("number", "said"),
    [(0, "0 touches, 0 cells"), (1, "1 touch, 1 cell"), (2, "2 touches, 2 cells")],
)
def test_one_is_no_plural(number: int, said: str) -> None:
    """And none is one."""
    assert f"{counted(number, 'touch', plural='touches')}, {counted(number, 'cell')}" == said
