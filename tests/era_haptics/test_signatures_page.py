"""The signatures in the reference of the Python API against the code."""

import re
from pathlib import Path

from page_part import insert
from signatures_page import WRITER, signatures

PAGE = Path(__file__).parents[2] / "docs" / "reference" / "python-api.md"


def without_comments(text: str) -> str:
    """Signatures alone: the first sentences beside them may wait for the next writing."""
    return re.sub(r" *# .*", "", text)


def test_page_has_the_signatures_of_the_code() -> None:
    """Written anew by the program that the page names."""
    page = PAGE.read_text("utf-8")
    remedy = f"python {WRITER} docs/reference/python-api.md"
    anew = insert(page, signatures(page), writer=WRITER)
    assert without_comments(anew) == without_comments(page), remedy
