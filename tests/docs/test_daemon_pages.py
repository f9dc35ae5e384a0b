"""The references of the daemon's file and metrics against what they describe."""

import re
from pathlib import Path

import pytest
from prometheus_client.parser import text_string_to_metric_families

from controller.api.learning_status import LearningStatus
from controller.api.schema import TouchInputStatus, headline
from controller.api.topics import StateEvent
from controller.daemon.config_sections import (
    DaemonSection,
    DumpSection,
    LogSection,
    TouchSection,
)
from controller.daemon.messages import learning_summary
from controller.gateway.metrics import exposition
from controller.operation.states import DaemonState
from daemon_bench import running_daemon, until_state
from model.config.sections import Section

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


async def test_every_metric_is_on_its_page(tmp_path: Path) -> None:
    """Name, kind, labels and meaning, as a daemon that plays would serve them."""
    async with running_daemon(tmp_path) as bench, await bench.client() as era:
        await until_state(era, "READY_TO_SWITCH_ON")
        status = await era.status()
    playing = {
        "robust_felt_contrast_db": 15.0,
        "predicted_felt_contrast_db": 20.0,
        "predicted_level_db_sl": 20.0,
    }
    learning = learning_summary(LearningStatus(last_at=1.0), status.latency_ms, now=2.0)
    panel = TouchInputStatus(name="panel", url="tuio:", state="open")
    counts = {"rejected_touches": {"off_plate": 1}, "lost_events": {"log": 1}, "inputs": [panel]}
    touched = status.model_copy(update={**playing, **counts, "learning": learning})
    served = []
    for family in text_string_to_metric_families(exposition(touched).decode()):
        name = family.name + ("_total" if family.type == "counter" else "")
        labels = sorted({label for sample in family.samples for label in sample.labels} - {"le"})
        listed = ", ".join(f"`{label}`" for label in labels)
        served.append([f"`{name}`", family.type, listed, family.documentation])
    assert rows("metrics.md", "| metric | kind | labels | |") == served
