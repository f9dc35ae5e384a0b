"""Retired words do not return as identifiers."""

from vocabulary import retired_identifiers


def test_identifiers_avoid_retired_words() -> None:
    """Each word of the list has a replacement; the glossary of CONTRIBUTING defines it."""
    assert list(retired_identifiers()) == []
