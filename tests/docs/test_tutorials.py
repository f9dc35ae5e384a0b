"""The tutorials, followed to the letter."""

import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from typed_page import Reader, Typed, Written, read_steps

ROOT = Path(__file__).parents[2]
PAGES = ROOT / "docs" / "tutorials"
SHORT = "own-plate"
"""Followed by every run of the tests; the others by `make test-long`."""


@pytest.fixture
def home() -> Iterator[Path]:
    """A short path: a Unix socket's has room for a hundred letters."""
    folder = Path(tempfile.mkdtemp(prefix="era"))
    yield folder
    shutil.rmtree(folder)


@pytest.mark.parametrize(
    "page",
    [
        pytest.param(page, marks=[] if page == SHORT else [pytest.mark.long])
        for page in sorted(path.stem for path in PAGES.glob("*.md"))
    ],
)
def test_a_reader_sees_what_the_page_shows(page: str, tmp_path: Path, home: Path) -> None:
    """A tutorial typed from an empty folder beside the examples prints what it shows."""
    folder = tmp_path / "my_plate"
    folder.mkdir()
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    steps = read_steps(PAGES / f"{page}.md")
    assert sum(isinstance(step, Typed) and step.shown is not None for step in steps) >= 3
    with Reader(folder, home=home) as reader:
        for step in steps:
            reader.follow(step)


def test_the_first_tutorial_writes_the_rig_of_the_others() -> None:
    """Who skipped it copies the same file from the examples."""
    written = [step for step in read_steps(PAGES / "own-plate.md") if isinstance(step, Written)]
    example = (ROOT / "examples" / "tutorial_rig.yaml").read_text("utf-8")
    assert [(step.name, step.text) for step in written] == [("my_rig.yaml", example)]
