"""`era stop` and what it says of amplifiers."""

from pathlib import Path

import pytest

from controller.cli.main import run
from gateway_bench import UNCONFIRMED, ScriptedDaemon


def test_stop_exits_with_3_and_names_amplifiers_unless_all_are_silent(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Success only if every amplifier is confirmed silent, or else the unconfirmed ones."""
    modules = ["controller.cli.daemon"]
    with ScriptedDaemon(tmp_path) as daemon:
        command = ["stop", "--socket", str(daemon.socket)]
        assert run(command, modules) == 0
        daemon.silence = UNCONFIRMED
        assert run(command, modules) == 3
        errors = capsys.readouterr().err
        assert "side" in errors
        assert "main" not in errors
    assert run(command, modules) == 3
