"""The demonstration to be touched."""

import os
import signal
import subprocess
import sys
from pathlib import Path

from typer.testing import CliRunner

import live_demonstration
from controller.api.client import Client
from controller.cli.demo import app
from model.errors import InputError


def test_page_and_daemon(tmp_path: Path) -> None:
    """It says where its page is, its daemon is disarmed and answers; Ctrl-C leaves nothing."""
    environment = os.environ | {"XDG_RUNTIME_DIR": str(tmp_path)}
    socket = tmp_path / "era-haptics" / "daemon.sock"
    with subprocess.Popen(
        [sys.executable, live_demonstration.__file__],
        env=environment,
        stdout=subprocess.PIPE,
        text=True,
    ) as process:
        try:
            assert process.stdout is not None
            assert process.stdout.readline().startswith("dashboard: http://127.0.0.1:")
            with Client.connect(socket, timeout=60) as daemon:
                daemon.subscribe("state")
                while (state := daemon.status().state) != "READY_TO_SWITCH_ON":
                    assert state != "OPERATION_ENABLED"
                    next(daemon.events(timeout=60))
                assert daemon.hello("test").rig.simulated
                assert daemon.status().watchdog_s == 2.0
            process.send_signal(signal.SIGINT)
            assert process.wait(60) == 0
        finally:
            process.kill()
    assert not socket.exists()


def test_touches_come_from_the_page() -> None:
    """A recording, or JSON of its rows, is refused beside it."""
    for option in (["--touches", "x.tuio"], ["--json"]):
        done = CliRunner().invoke(app, ["demo", "--dashboard", *option])
        assert isinstance(done.exception, InputError)
