"""Pipes and devices where a file is expected: refused by every reader, not waited for."""

import os
from collections.abc import Callable
from pathlib import Path

import pytest

from controller.effects.layout_file import load_layout
from controller.sources.capture import MAX_BYTES, read_capture
from model.calibration.responses_file import read_functions
from model.errors import InputError
from model.rig.file import load_rig
from model.table.file import load_table

READERS: dict[str, Callable[[Path], object]] = {
    "rig.yaml": load_rig,
    "layout.yaml": lambda path: load_layout(path, None),
    "taps.tuio": read_capture,
    "measured.csv": read_functions,
    "measured.uff": read_functions,
    "table.npz": load_table,
}


@pytest.mark.parametrize("name", READERS)
@pytest.mark.parametrize("kind", ["pipe", "device"])
def test_reader_refuses_what_is_no_regular_file(tmp_path: Path, name: str, kind: str) -> None:
    """A pipe into which nothing writes, and a device that never ends; the error names the file."""
    path = tmp_path / name
    if kind == "pipe":
        os.mkfifo(path)
    else:
        path.symlink_to("/dev/zero")
    with pytest.raises(InputError, match=name) as caught:
        READERS[name](path)
    assert "Errno" not in str(caught.value)


def test_capture_has_a_maximum_size(tmp_path: Path) -> None:
    """A sparse file one byte above it is refused before it is read as text."""
    path = tmp_path / "long"
    with path.open("wb") as stream:
        stream.truncate(MAX_BYTES + 1)
    with pytest.raises(InputError, match="16 MiB"):
        read_capture(path)
