"""Stable names of pseudo-terminals."""

import os
from collections.abc import Iterator
from pathlib import Path

import pytest

from model.errors import InputError
from sim.transport.far_end import linked_urls, links_by_amplifier


@pytest.fixture
def terminal() -> Iterator[str]:
    """The path of a pseudo-terminal."""
    near, far = os.openpty()
    yield os.ttyname(far)
    os.close(near)
    os.close(far)


def test_amplifiers_of_one_line_share_its_link(tmp_path: Path, terminal: str) -> None:
    """The rest of each URL stays; the link leads to the terminal, and goes at the end."""
    link = tmp_path / "line"
    urls = {
        "a": f"serial://{terminal}?address=1",
        "b": f"serial://{terminal}?address=2",
        "c": "modbus+tcp://127.0.0.1:502/1",
    }
    with linked_urls(urls, links_by_amplifier([str(link)], amplifiers=list(urls))) as moved:
        assert moved == {
            "a": f"serial://{link}?address=1",
            "b": f"serial://{link}?address=2",
            "c": "modbus+tcp://127.0.0.1:502/1",
        }
        assert str(link.readlink()) == terminal
    assert not link.is_symlink()


@pytest.mark.parametrize("options", [["d=/tmp/x"], ["a="], ["a=/tmp/x", "/tmp/y"]])
def test_options_that_name_no_line_are_refused(options: list[str]) -> None:
    """An unknown amplifier, no path, and two paths for one amplifier."""
    with pytest.raises(InputError, match="--link"):
        links_by_amplifier(options, amplifiers=["a", "b"])


def test_a_line_has_one_link_and_a_network_none(tmp_path: Path, terminal: str) -> None:
    """Nothing is linked then."""
    urls = {"a": f"serial://{terminal}?address=1", "b": f"serial://{terminal}?address=2"}
    with (
        pytest.raises(InputError, match="one per line"),
        linked_urls(urls, {"a": tmp_path / "a", "b": tmp_path / "b"}),
    ):
        pass
    with (
        pytest.raises(InputError, match="pseudo-terminal"),
        linked_urls({"a": "modbus+tcp://127.0.0.1:502/1"}, {"a": tmp_path / "a"}),
    ):
        pass
    assert not any(path.is_symlink() for path in tmp_path.iterdir())
