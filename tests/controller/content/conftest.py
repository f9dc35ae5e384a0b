"""Files of content that a test writes and reads."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from controller.content.formats import read_content
from controller.content.pattern import Pattern


@pytest.fixture
def read(tmp_path: Path) -> Callable[..., Pattern]:
    """Write a file of an ending, text, bytes or an object as JSON, and read it."""

    def write_and_read(ending: str, given: Any, channel: int | None = None) -> Pattern:
        path = tmp_path / f"content.{ending}"
        text = given if isinstance(given, str | bytes) else json.dumps(given, indent=1)
        path.write_bytes(text if isinstance(text, bytes) else text.encode("utf-8"))
        return read_content(path, channel)

    return write_and_read
