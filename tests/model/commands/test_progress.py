"""Progress of long work where standard error is no terminal."""

import pytest

from model.commands import options
from model.commands.options import progress_bar


def test_log_gets_a_line_every_two_seconds(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Of ten steps of half a second those at 2 and 4 s are printed, without a bar."""
    now = [0.0]
    monkeypatch.setattr(options.time, "monotonic", lambda: now[0])
    with progress_bar("cells") as update:
        for done in range(1, 11):
            now[0] = 0.5 * done
            update(done, 10)
    assert capsys.readouterr().err.splitlines() == ["4 of 10 cells", "8 of 10 cells"]
