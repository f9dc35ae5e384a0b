"""Errors as a user meets them: exit status, nothing written, no traceback."""

import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from error_cases import Case, filled, provoke, subjects

CASES = [case for subject in subjects() for case in subject.cases]

INNER = re.compile(
    r"Traceback|File \"|<class |object at 0x|np\.\w+\(|PosixPath\(|\[Errno|Field required|"
    r"(Input|String|List) should"
)
"""What is of no use to a reader: words of Python and of the libraries below."""


@pytest.fixture(scope="module")
def shelf(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Where files lie that are dear to make, and a daemon runs."""
    folder = tmp_path_factory.mktemp("shelf")
    with filled(folder):
        yield folder


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_an_error_is_a_paragraph_for_people(case: Case, shelf: Path, tmp_path: Path) -> None:
    """Its exit status; nothing on standard output or in a file; no words of Python."""
    answer = provoke(case, tmp_path, shelf)
    assert answer.status == case.status
    assert answer.out == "" if not case.said else answer.out.startswith(case.said)
    if case.run is not None:
        assert answer.text.startswith("era: error: ")
        assert not answer.changed
    assert not INNER.search(answer.text), answer.text
    assert len(answer.text) < 1500
