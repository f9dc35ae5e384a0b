"""A part of a documentation page that a program writes, between two marks."""

import re

END = "<!-- end -->"


def begin(writer: str) -> str:
    """The mark above the part; writer: the file of the program."""
    return f"<!-- begin: written by {writer} -->"


def insert(page: str, text: str, *, writer: str) -> str:
    """The page with this text between the marks; ValueError for a page without them."""
    found = re.fullmatch(rf"(.*{begin(writer)}\n).*?({END}\n.*)", page, re.DOTALL)
    if found is None:
        raise ValueError(f"the page has no lines {begin(writer)} and {END}")
    return f"{found[1]}\n{text.rstrip()}\n\n{found[2]}"
