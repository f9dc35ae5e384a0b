"""Where the calibrated rig is written, as all results are: whole, or not at all."""

import errno
import os
from pathlib import Path

import pytest

from model.commands.calibrate_cli import _write

FULL = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


@pytest.mark.parametrize("problem", [FULL, KeyboardInterrupt()], ids=["full", "interrupted"])
def test_what_comes_between_costs_nothing_that_was_there(
    problem: BaseException, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A full disk or Ctrl-C before the last byte is safe: the rig of before stays as it was.

    Nothing half written is beside it, and a full disk is told with the file's name.
    """

    def fail(_: int) -> None:
        raise problem

    rig = tmp_path / "rig2.yaml"
    rig.write_text("before", encoding="utf-8")
    monkeypatch.setattr(os, "fsync", fail)
    with pytest.raises(type(problem)) as told:
        _write(rig, "after" * 1000)
    if isinstance(told.value, OSError):
        assert (told.value.errno, told.value.filename) == (errno.ENOSPC, str(rig))
    assert rig.read_text("utf-8") == "before"
    assert [path.name for path in tmp_path.iterdir()] == ["rig2.yaml"]
