"""Errors as a user meets them: exit status, place, remedy, nothing written, no traceback."""

import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from error_cases import Case, Outcome, Quotation, cases, filled, provoke, quotations

INTERNALS = re.compile(
    r"Traceback|File \"|<class |object at 0x|np\.\w+\(|PosixPath\(|\[Errno|Field required|"
    r"(Input|String|List) should"
)
"""Words of Python and of libraries, which help no user."""

REMEDY = re.compile(
    r";|must|expected|did you mean|see |try|give|use|write|check|known|add|first|make|install", re.I
)
"""A message of the page says what is right, or what to do next, in one of these ways."""


@pytest.fixture(scope="module")
def shelf(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Files that are slow to make, and a daemon that runs."""
    folder = tmp_path_factory.mktemp("shelf")
    with filled(folder):
        yield folder


@pytest.fixture(scope="module")
def outcomes() -> dict[str, Outcome]:
    """How cases ended, by name: those of the page are provoked once for both tests."""
    return {}


@pytest.mark.parametrize("case", cases(), ids=lambda case: case.name)
def test_error_has_its_status_and_place(
    case: Case, shelf: Path, outcomes: dict[str, Outcome], tmp_path: Path
) -> None:
    """A command that fails says where, in one paragraph, and writes nothing."""
    outcome = outcomes[case.name] = provoke(case, tmp_path, shelf)
    assert outcome.status == case.status
    assert outcome.text.startswith("era: error: ")
    for place in case.at:
        assert place in outcome.text.replace(", line ", ":")
    assert not INTERNALS.search(outcome.text)
    assert len(outcome.text) < 1500
    assert outcome.out == "" if not case.said else outcome.out.startswith(case.said)
    assert not outcome.changed


SHOWN = {tuple(case.typed): case for case in cases() if case.shown}


@pytest.mark.parametrize("quoted", quotations(), ids=lambda quoted: quoted.typed[-1])
def test_page_quotes_message_and_remedy(
    quoted: Quotation, shelf: Path, outcomes: dict[str, Outcome], tmp_path: Path
) -> None:
    """A quoted message is the present one; `python tests/support/error_cases.py` quotes anew."""
    case = SHOWN[tuple(quoted.typed)]
    assert case.status == quoted.status
    assert REMEDY.search(quoted.text)
    outcome = outcomes.get(case.name) or provoke(case, tmp_path, shelf)
    assert outcome.text.rstrip("\n") == quoted.text


def test_page_quotes_every_case_that_is_shown() -> None:
    """Each shown case has a box of its own."""
    assert sorted(tuple(quoted.typed) for quoted in quotations()) == sorted(SHOWN)
