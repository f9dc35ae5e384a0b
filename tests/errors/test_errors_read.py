"""Every error as whoever gets it reads it: provoked, compared with the page, and none forgotten."""

import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest
import yaml

from error_cases import PAGE, Case, Told, filled, page, provoke, subjects
from error_places import Place, places

CASES = [case for subject in subjects() for case in subject.cases]
ELSEWHERE = Path(__file__).with_name("elsewhere.yaml")

INNER = re.compile(
    r"Traceback|File \"|<class |object at 0x|np\.\w+\(|PosixPath\(|\[Errno|Field required|"
    r"(Input|String|List) should"
)
"""What is of no use to a reader: words of Python and of the libraries below."""

told: dict[str, Told] = {}
"""What every case of this run has said, so that the page is compared without a second run."""


@pytest.fixture(scope="module")
def shelf(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Where files lie that are dear to make, and a daemon runs."""
    folder = tmp_path_factory.mktemp("shelf")
    with filled(folder):
        yield folder


@cache
def page_in_a_line() -> str:
    """The page, whatever its lines are."""
    return " ".join(PAGE.read_text("utf-8").split())


def said_on_the_page() -> Iterator[str]:
    """What stands in each box of the page."""
    for box in PAGE.read_text("utf-8").split("```text\n")[1:]:
        lines = box.split("\n```")[0].splitlines()
        typed = ("# ", "#  ", "$ ", ">>> ", "... ")
        yield " ".join(line for line in lines if not line.startswith(typed))


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_an_error_is_a_paragraph_for_people(case: Case, shelf: Path, tmp_path: Path) -> None:
    """Its status; nothing on standard output or in a file, no words of Python; as on the page."""
    answer = told[case.name] = provoke(case, tmp_path, shelf)
    assert answer.status == case.status
    assert answer.out == "" if not case.said else answer.out.startswith(case.said)
    if case.run is not None:
        assert answer.text.startswith("era: error: ")
        assert not answer.changed
    assert not INNER.search(answer.text), answer.text
    assert len(answer.text) < 1500
    assert " ".join(answer.text.split()) in page_in_a_line(), (
        f"{answer.text}\nis not what {PAGE.name} says; read it, and write the page anew:"
        " python tests/support/error_cases.py"
    )


def test_the_page_holds_all_cases_and_no_other() -> None:
    """As many boxes as cases, in their order, each with what is typed."""
    text = PAGE.read_text("utf-8")
    empty = page({case.name: Told("", None, "") for case in CASES})
    for line in empty.splitlines():
        assert line in text
    assert len(list(said_on_the_page())) == len(CASES)


def excused() -> Iterator[tuple[str, str, str]]:
    """Places without a case: the file, how the text begins, and the test that provokes it."""
    for group in yaml.safe_load(ELSEWHERE.read_text("utf-8")):
        for file, begins in group["places"].items():
            for begin, test in begins.items():
                yield file, begin, test


@pytest.mark.parametrize("test", sorted({test for *_, test in excused()}))
def test_what_has_no_case_is_provoked_by_a_test_that_is_there(test: str) -> None:
    """The file and the function that the list names."""
    file, function = test.split("::")
    text = (ELSEWHERE.parents[2] / file).read_text("utf-8")
    assert re.search(rf"^(async )?def {function}\(", text, re.MULTILINE)


def test_every_place_that_makes_an_error_has_a_case_or_a_test() -> None:
    """Found by reading the program: a new error that nothing provokes is told here."""
    reasons = [(file, begin) for file, begin, _ in excused()]
    said = [" ".join(text.split()) for text in said_on_the_page()]
    open_: list[str] = []
    used = set()
    for place in places():
        known = [each for each in reasons if is_at(place, *each)]
        used.update(known)
        if not known and not any(place.is_told_by(text) for text in said):
            open_.append(f"{place.file}:{place.line}: {place.begin[:120]}")
    assert not open_, "\n".join(["no case provokes these:", *open_])
    assert not set(reasons) - used, "these are no places of errors any more"


def is_at(place: Place, file: str, begin: str) -> bool:
    """Whether a line of the list means this place: a file, and how its text begins (* for all)."""
    return place.file == file and (begin == "*" or place.begin.startswith(begin))
