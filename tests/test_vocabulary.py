"""Retired words do not return as identifiers."""

from pathlib import Path

import pytest

import vocabulary
from vocabulary import retired_identifiers


def test_identifiers_avoid_retired_words() -> None:
    """Each word of the list has a replacement; the glossary of CONTRIBUTING defines it."""
    assert list(retired_identifiers()) == []


def test_what_users_copy_keeps_the_rule(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An example, and a program on a page at its line there; text beside programs is free."""
    files = {
        "examples/one.py": "begin = 1\n",
        "README.md": "begin = 0\n\n```python\nstart = 1\nbegin = start\n```\n",
        "docs/how-to/two.md": "```python\nstart = 1\n```\n```\nbegin = 1\n```\n",
    }
    for name, text in files.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text, "utf-8")
    monkeypatch.setattr(vocabulary, "ROOT", tmp_path)
    found = [each.partition(", use")[0] for each in retired_identifiers()]
    assert found == ["examples/one.py:1: begin", "README.md:5: begin"]
