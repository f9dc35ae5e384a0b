"""Parts of pages that programs write."""

import pytest

from page_part import insert

BEGIN, END = "<!-- begin: written by a.py -->", "<!-- end -->"


def test_the_text_stands_between_the_marks_of_its_writer() -> None:
    """What was there is replaced, what stands around stays, and again it changes nothing."""
    page = insert(f"a\n{BEGIN}\nold\n{END}\nb\n", "new\n", writer="a.py")
    assert page == f"a\n{BEGIN}\n\nnew\n\n{END}\nb\n"
    assert insert(page, "new\n", writer="a.py") == page


@pytest.mark.parametrize("page", ["a\nb\n", f"a\n<!-- begin: written by b.py -->\n{END}\n"])
def test_a_page_without_these_marks_is_left_alone(page: str) -> None:
    """Another writer's marks are none of its own."""
    with pytest.raises(ValueError, match="no lines"):
        insert(page, "new", writer="a.py")
