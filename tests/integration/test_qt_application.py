"""The example of an application, with PySide6 and without a screen."""

import signal
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from controller.api.client import Client
from processes.gateways import TOKEN, gateway_process, real_daemon, wait_for

FOLDER = Path(__file__).parents[2] / "examples" / "application"

Until = Callable[[Callable[[], object]], None]


@pytest.fixture
def until(monkeypatch: pytest.MonkeyPatch) -> Until:
    """Wait for a condition of PySide6 without a screen.

    Its absence is a failure only where `make qt-test` installs it.
    """
    monkeypatch.setenv("QT_QPA_PLATFORM", "offscreen")
    monkeypatch.syspath_prepend(FOLDER)
    try:
        from PySide6.QtWidgets import QApplication
    except ImportError as error:
        reason = f"no PySide6 ({error}): make qt-test installs it, apt libegl1 and libgl1"
        if (Path(sys.prefix) / "installed-qt").exists():
            pytest.fail(reason)
        pytest.skip(reason)
    application = QApplication.instance() or QApplication([])

    def wait(condition: Callable[[], object]) -> None:
        def processed() -> object:
            application.processEvents()
            return condition()

        wait_for(processed)

    return wait


@pytest.mark.real_time
@pytest.mark.long
def test_application_plays_and_comes_back_after_every_loss(tmp_path: Path, until: Until) -> None:
    """By a mouse; after a new daemon, and a gateway that hangs, it follows and stays disarmed."""
    from PySide6.QtCore import QPoint, Qt
    from PySide6.QtTest import QTest
    from qt_plate import Plate, Window

    with gateway_process(tmp_path, tmp_path / "era.sock") as gateway:
        window = Window(Plate(gateway.url, TOKEN, ["state", "pattern", "silence"]))
        window.show()

        def until_said(start: str) -> None:
            until(lambda: window.state.text().startswith(start))

        button, at = Qt.MouseButton.LeftButton, QPoint(100, 150)  # of 400 by 300
        until_said("no connection: the daemon does not respond")
        with real_daemon(tmp_path) as socket, Client.connect(socket) as era:
            until_said("ready: ")
            QTest.mouseClick(window.arm, button)
            until_said("on: armed by 'my application'")
            until(lambda: era.status().state == "OPERATION_ENABLED")
            refused: list[str] = []
            window.plate.refused.connect(refused.append)
            QTest.mouseClick(window.arm, button)  # the lease is kept
            until(lambda: any(refusal.startswith("armed by") for refusal in refused))
            QTest.mousePress(window.surface, button, pos=at)
            until(lambda: window.felt.text().startswith("played by "))
            rig = era.hello("test").rig
            widgets: list[Any] = []
            until(lambda: widgets.extend(era.status().contacts) or widgets)  # repeated by its timer
            contact = widgets[0]
            assert contact.x_m == pytest.approx(rig.length_m / 4, abs=1e-3)
            assert contact.y_m == pytest.approx(rig.width_m / 2, abs=1e-3)
            until(lambda: (era.status().lease_left_s or 0) < 4.2)
            until(lambda: (era.status().lease_left_s or 0) > 4.5)
        until_said("no connection: ")
        with real_daemon(tmp_path) as socket, Client.connect(socket) as era:
            until_said("ready: ")
            until(lambda: len(era.status().contacts) == 1)
            assert era.status().armed_by is None
            gateway.process.send_signal(signal.SIGSTOP)
            until_said("no connection: ")
            gateway.process.send_signal(signal.SIGCONT)
            until_said("ready: ")
            QTest.mouseRelease(window.surface, button, pos=at)
            until(lambda: not era.status().contacts)
            QTest.mouseClick(window.stop, button)
            until_said("stopped: ")
            assert era.status().state == "QUICK_STOP_ACTIVE"


@pytest.mark.real_time
@pytest.mark.long
def test_application_without_its_user_or_connection_lifts_and_disarms(
    tmp_path: Path, until: Until
) -> None:
    """A hidden window, a closed one, and Disarm without a WebSocket; no lease runs out."""
    from PySide6.QtCore import QPoint, Qt
    from PySide6.QtTest import QTest
    from qt_plate import Plate, Window

    with (
        real_daemon(tmp_path) as socket,
        gateway_process(tmp_path, socket) as gateway,
        Client.connect(socket) as era,
    ):
        era.subscribe("state")
        window = Window(Plate(gateway.url, TOKEN, ["state", "pattern", "silence"]))
        button = Qt.MouseButton.LeftButton

        def disarm() -> None:
            window.plate.socket.abort()
            QTest.mouseClick(window.disarm, button)

        for leave in (window.hide, disarm, window.close):
            window.show()
            until(lambda: window.state.text().startswith("ready: "))
            QTest.mouseClick(window.arm, button)
            until(lambda: era.status().armed_by is not None)
            until(lambda: window.state.text().startswith("on: "))
            if leave is not disarm:
                QTest.mousePress(window.surface, button, pos=QPoint(100, 150))
                until(lambda: len(era.status().contacts) == 1)
            leave()
            until(lambda: era.status().armed_by is None and not era.status().contacts)
            causes = [event.data["cause"] for event in era.events(timeout=0.1)]
            assert "the arming lease was not renewed" not in causes
            QTest.mouseRelease(window.surface, button, pos=QPoint(100, 150))
