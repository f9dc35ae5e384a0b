"""Where the calibrated rig is written: whole, or not at all."""

import errno
import os
from pathlib import Path

import pytest

from model.commands.calibrate_cli import _write


def test_a_full_disk_costs_nothing_that_was_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The rig of before stays as it was, nothing half written is beside it, the cause is told."""

    def full(_: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    rig = tmp_path / "rig2.yaml"
    rig.write_text("before", encoding="utf-8")
    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space left") as told:
        _write(rig, "after" * 1000)
    assert told.value.filename == str(rig)
    assert rig.read_text("utf-8") == "before"
    assert [path.name for path in tmp_path.iterdir()] == ["rig2.yaml"]
