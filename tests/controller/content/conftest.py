"""Content files that a test writes and reads."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from controller.content.formats import read_content
from controller.content.pattern import Pattern


@pytest.fixture
def read(tmp_path: Path) -> Callable[..., Pattern]:
    """Return a function that writes a file with an ending and reads it.

    Its content is text, bytes, or an object that becomes JSON.
    """

    def write_and_read(ending: str, content: Any, channel: int | None = None) -> Pattern:
        path = tmp_path / f"content.{ending}"
        if isinstance(content, bytes):
            path.write_bytes(content)
        else:
            text = content if isinstance(content, str) else json.dumps(content, indent=1)
            path.write_text(text, "utf-8")
        return read_content(path, channel)

    return write_and_read
