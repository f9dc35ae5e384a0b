"""The pages that tell how to add something: followed to the letter, they work as they say."""

import re
import shutil
import socket
from pathlib import Path

import pytest

from page_commands import Terminal, steps_of

ROOT = Path(__file__).parents[2]
PAGES = ROOT / "docs" / "how-to"
NAMES = [
    "add-a-material",
    "add-a-backend",
    "add-an-element",
    "add-a-touch-source",
    "add-an-effect",
    "write-an-amplifier",
]


def free_port(kind: socket.SocketKind) -> str:
    """A port that nobody holds just now."""
    with socket.socket(socket.AF_INET, kind) as free:
        free.bind(("127.0.0.1", 0))
        return str(free.getsockname()[1])


@pytest.fixture
def terminal(tmp_path: Path, installed: Path) -> Terminal:
    """In a checkout that has nothing but the examples."""
    shutil.copytree(ROOT / "examples", tmp_path / "examples")
    swaps = {"7010": free_port(socket.SOCK_STREAM), "4444": free_port(socket.SOCK_DGRAM)}
    return Terminal(tmp_path, installed=installed, swaps=swaps)


def _run_alone(name: str) -> object:
    """Pages whose amplifiers answer in real time: on a busy machine they would count as lost."""
    has_amplifier = name in ("add-a-backend", "write-an-amplifier")
    return pytest.param(name, marks=pytest.mark.alone) if has_amplifier else name


@pytest.mark.parametrize("name", [_run_alone(name) for name in NAMES])
def test_a_page_is_followed(name: str, terminal: Terminal) -> None:
    """Every command of the page, in order, prints what the page shows."""
    steps = steps_of(PAGES / f"{name}.md")
    assert len(steps) > 2
    with terminal:
        for step in steps:
            terminal.type(step)


@pytest.mark.parametrize("name", NAMES)
def test_a_page_shows_whole_files(name: str) -> None:
    """Code stands on a page by being included, so that page and file cannot differ."""
    text = (PAGES / f"{name}.md").read_text("utf-8")
    included = re.findall(r"^```\{literalinclude\} (\S+)$", text, re.MULTILINE)
    assert included
    assert [path for path in included if not (PAGES / path).is_file()] == []
    assert "```python" not in text
