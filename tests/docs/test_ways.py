"""The ways that docs/architecture.md follows through the files are those that the code takes."""

import pytest

from ways import WAYS, steps_of

MOST_FILES = {"touch": 25, "stop": 9, "question": 11, "build": 25}


@pytest.mark.parametrize("name", WAYS)
def test_page_follows_the_code(name: str) -> None:
    """The functions to break at are called in the order of the page, in files that can be read."""
    steps, called = steps_of(name), [*WAYS[name]().functions]
    assert [step for step in steps if step not in called] == []
    assert steps == sorted(steps, key=called.index)
    assert 5 <= len({file for file, _ in steps}) <= MOST_FILES[name]
