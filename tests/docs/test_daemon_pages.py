"""The reference of the daemon's file against what it describes."""

import re
from pathlib import Path

import pytest

from controller.api.schema import headline
from controller.api.server import StateEvent
from controller.daemon.config import (
    DaemonSection,
    DumpSection,
    LogSection,
    TouchSection,
)
from controller.operation.operation_states import DaemonState
from model.config.fields import Section

REFERENCE = Path(__file__).parents[2] / "docs" / "reference"


def rows(page: str, head: str) -> list[list[str]]:
    """The cells of the table that begins with this head, one list a row."""
    text = (REFERENCE / page).read_text("utf-8")
    table = text[text.index(head) :].partition("\n\n")[0]
    return [[cell.strip() for cell in line[1:-1].split("|")] for line in table.splitlines()[2:]]


def test_every_key_of_the_daemons_file_is_in_its_table() -> None:
    """As the configuration's model has them, and no others."""
    keys = [row[0].strip("`") for row in rows("daemon.md", "| key | meaning | default |")]
    assert sorted(keys) == sorted(DaemonSection.model_fields)


def test_people_see_the_word_that_the_page_has_for_each_state() -> None:
    """In the status, in the event of a change, and in a line unless the cause begins with it."""
    shown = {row[0]: row[1].strip("*") for row in rows("daemon.md", "| state | shown |")}
    assert list(shown) == [state.value for state in DaemonState]
    for state, word in shown.items():
        event = StateEvent(old="FAULT", new=state, cause="a cable was cut", remedy=None, epoch=1)
        assert event.model_dump()["word"] == word
        assert headline(state, event.cause) == f"{word}: a cable was cut"
        assert headline(state, f"{word} by 'era'") == f"{word} by 'era'"


@pytest.mark.parametrize(
    ("key", "section"), [("touch", TouchSection), ("log", LogSection), ("dumps", DumpSection)]
)
def test_a_section_is_told_in_its_row(key: str, section: type[Section]) -> None:
    """`{name, url, ...}`: the keys that it takes, and no others."""
    (row,) = [
        row for row in rows("daemon.md", "| key | meaning | default |") if row[0] == f"`{key}`"
    ]
    found = re.search(r"`\{(.*?)\}`", row[1])
    assert found is not None
    assert found[1].split(", ") == list(section.model_fields)
