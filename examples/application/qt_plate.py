"""A Qt application that shows the plate's vibration and sends touches to it over the gateway.

    python qt_plate.py http://127.0.0.1:8137/ TOKEN

It needs PySide6 (`pip install 'era-haptics[qt]'`).
"""

import itertools
import json
import sys
import time
from collections.abc import Callable
from typing import Any

from PySide6.QtCore import QObject, QTimer, QUrl, Signal
from PySide6.QtGui import QHideEvent, QMouseEvent
from PySide6.QtNetwork import (
    QAbstractSocket,
    QNetworkAccessManager,
    QNetworkRequest,
)
from PySide6.QtWebSockets import QWebSocket, QWebSocketHandshakeOptions
from PySide6.QtWidgets import QApplication, QLabel, QPushButton, QVBoxLayout, QWidget

LEASE = 5.0  # s; lifetime of a lease
NO_LEASE = 1002  # error code of the API
MAX_SILENT = 4  # s; without a message or pong from the gateway


class Plate(QObject):
    """The plate over a gateway; reconnects and resubscribes automatically.

    Calls that are pending when the connection is lost fail and are not repeated: the caller decides
    whether to arm, play or clear again. url: base URL of the gateway.
    """

    opened = Signal(dict)  # the daemon's hello
    failed = Signal(str)  # why there is no connection
    event = Signal(str, dict)  # topic and data
    refused = Signal(str)  # message of a call that failed

    def __init__(self, url: str, token: str, topics: list[str]) -> None:
        super().__init__()
        self._address = QUrl(url).resolved(QUrl("api/v1/"))
        address = self._address.resolved(QUrl("ws"))
        address.setScheme({"http": "ws", "https": "wss"}[address.scheme()])
        self._request = QNetworkRequest(address)
        self._request.setRawHeader(b"Authorization", f"Bearer {token}".encode())
        self._network = QNetworkAccessManager(self)
        self._options = QWebSocketHandshakeOptions()
        self._options.setSubprotocols(["era-haptics.v1"])
        self._topics = topics
        self._ids = itertools.count(1)
        self._pending: dict[int, tuple[Callable[[Any], None], object]] = {}
        """Callback and lease of each call that awaits its response, by request id."""
        self._lease: str | None = None
        self._lease_ends = 0.0  # s
        self._touches: list[dict[str, Any]] = []
        self._is_open = False
        self._silent = 0  # s
        self.socket = QWebSocket()
        self.socket.textMessageReceived.connect(self._received)
        self.socket.stateChanged.connect(self._state_changed)
        self.socket.pong.connect(self._heard)
        for interval, action in ((1000, self._check), (1500, self._renew), (50, self._repeat)):
            timer = QTimer(self, interval=interval)
            timer.timeout.connect(action)
            timer.start()
        self._connect()

    def call(
        self, method: str, done: Callable[[Any], None] = lambda result: None, **params: object
    ) -> None:
        """Call an API method; `refused` reports a failure."""
        if not self._is_open:
            self.refused.emit("not connected")
            return
        number = next(self._ids)
        self._pending[number] = done, params.get("lease")
        self._send(method, params, id=number)

    def arm(self, owner: str) -> None:
        """Switch the high voltage on; the lease is renewed until `disarm`, or until it is lost."""
        self.call("arm", self._armed, owner=owner, lease_s=LEASE)

    def disarm(self) -> None:
        """Ramp to silence and switch the high voltage off."""
        self._lease = None
        self._call_with_fallback("disarm")

    def stop(self) -> None:
        """Stop all amplifiers; `refused` names the amplifiers without confirmed silence."""
        self._lease = None
        self._call_with_fallback("stop")

    def leave(self) -> None:
        """Lift all fingers, and disarm if armed or arming: a hidden window offers no Stop."""
        self.touch([])
        is_arming = self._armed in (done for done, _ in self._pending.values())
        if is_arming or self._lease is not None:
            self.disarm()
            self.socket.flush()  # the application may end now

    def touch(self, positions: list[tuple[float, float]]) -> None:
        """Report all fingers at x, y [m], the newest last; repeated until the next call."""
        self._touches = [{"id": id, "x_m": x, "y_m": y} for id, (x, y) in enumerate(positions)]
        if self._is_open:
            self._send("touch", {"source": "qt", "touches": self._touches})

    def _call_with_fallback(self, method: str) -> None:
        """Call a method without parameters, over HTTP if the WebSocket is not connected."""
        if self._is_open:
            self.call(method)
            return
        request = QNetworkRequest(self._request)  # with the token
        request.setUrl(self._address.resolved(QUrl(method)))
        request.setHeader(QNetworkRequest.KnownHeaders.ContentTypeHeader, "application/json")
        request.setTransferTimeout(1000 * MAX_SILENT)
        reply = self._network.post(request, b"{}")
        reply.errorOccurred.connect(lambda _: self.refused.emit(reply.errorString()))
        reply.finished.connect(reply.deleteLater)

    def _connect(self) -> None:
        self._silent = 0
        self.socket.open(self._request, self._options)

    def _send(self, method: str, params: dict[str, Any], **head: int) -> None:
        request = {"jsonrpc": "2.0", **head, "method": method, "params": params}
        self.socket.sendTextMessage(json.dumps(request))

    def _received(self, text: str) -> None:
        self._silent = 0
        message = json.loads(text)
        if message.get("method") == "event":
            self.event.emit(message["params"]["topic"], message["params"]["data"])
        elif not self._is_open:  # the response to the gateway's hello
            self._is_open = True
            self.opened.emit(message["result"])
            self.call("subscribe", topics=self._topics)
            self._renew()
        elif message["id"] in self._pending:
            done, lease = self._pending.pop(message["id"])
            if "error" in message:
                self._fail(message["error"], lease)
            else:
                done(message["result"])

    def _fail(self, error: dict[str, Any], lease: object) -> None:
        if error["code"] == NO_LEASE and lease == self._lease:
            self._lease = None
        self.refused.emit(error["message"])

    def _state_changed(self, state: QAbstractSocket.SocketState) -> None:
        if state is not QAbstractSocket.SocketState.UnconnectedState:
            return
        self._is_open = False
        for _ in range(len(self._pending)):
            self.refused.emit("the connection was lost")
        self._pending.clear()
        self.failed.emit(self.socket.closeReason() or self.socket.errorString())
        QTimer.singleShot(500, self, self._connect)

    def _heard(self) -> None:
        self._silent = 0

    def _check(self) -> None:
        """Drop a silent connection: a network failure does not close the socket."""
        self._silent += 1
        if self._silent > MAX_SILENT:
            self.socket.abort()
        elif self._is_open:
            self.socket.ping()

    def _armed(self, result: dict[str, Any]) -> None:
        self._lease = result["lease"]
        self._lease_ends = time.monotonic() + LEASE

    def _renew(self) -> None:
        """Renew the lease, also after a reconnect; never arm again."""
        now = time.monotonic()
        if self._lease is not None and now >= self._lease_ends:
            self._lease = None
            self.refused.emit("the lease was lost; arm again")
        elif self._lease is not None and self._is_open:
            self.call("renew", lambda _: self._renewed(now + LEASE), lease=self._lease)

    def _renewed(self, ends: float) -> None:
        self._lease_ends = ends

    def _repeat(self) -> None:
        if self._touches and self._is_open:
            self._send("touch", {"source": "qt", "touches": self._touches})


class Window(QWidget):
    """Buttons, the daemon's state with its cause, and a surface to touch with the mouse."""

    def __init__(self, plate: Plate) -> None:
        super().__init__()
        self.setWindowTitle("My application")
        self.plate = plate
        self.arm = QPushButton("Arm")
        self.disarm = QPushButton("Disarm")
        self.stop = QPushButton("Stop")
        self.state = QLabel("connecting")
        self.felt = QLabel()
        self.surface = Surface(plate)
        column = QVBoxLayout(self)
        for widget in (self.arm, self.disarm, self.stop, self.state, self.felt, self.surface):
            column.addWidget(widget)
        self.arm.clicked.connect(lambda: plate.arm("my application"))
        self.disarm.clicked.connect(plate.disarm)
        self.stop.clicked.connect(plate.stop)
        plate.failed.connect(lambda why: self.state.setText(f"no connection: {why}"))
        plate.refused.connect(self.felt.setText)
        plate.event.connect(self._show)

    def hideEvent(self, event: QHideEvent) -> None:  # noqa: N802 (Qt's name)
        """Leave the plate; closing a window also hides it."""
        self.plate.leave()

    def _show(self, topic: str, data: dict[str, Any]) -> None:
        if topic == "state":
            self.state.setText(f"{data['word']}: {data['cause']}")
        elif topic == "pattern":
            self.felt.setText(f"played by {', '.join(sorted(data['drive']))}")
        elif topic == "silence":
            self.felt.setText(f"silent: {data['reason']}")


class Surface(QWidget):
    """The plate's surface; the pressed mouse button is a finger."""

    def __init__(self, plate: Plate) -> None:
        super().__init__()
        self._plate = plate
        self._size = (0.0, 0.0)  # m; length and width
        self.setFixedSize(400, 300)
        plate.opened.connect(self._measure)

    def mousePressEvent(self, event: QMouseEvent) -> None:  # noqa: N802 (Qt's name)
        """Touch with the finger, or move it."""
        x = event.position().x() / self.width()
        y = 1 - event.position().y() / self.height()
        length, width = self._size
        self._plate.touch([(x * length, y * width)])

    mouseMoveEvent = mousePressEvent

    def mouseReleaseEvent(self, event: QMouseEvent) -> None:  # noqa: N802 (Qt's name)
        """Lift the finger."""
        self._plate.touch([])

    def _measure(self, hello: dict[str, Any]) -> None:
        self._size = hello["rig"]["length_m"], hello["rig"]["width_m"]


if __name__ == "__main__":
    application = QApplication(sys.argv)
    window = Window(Plate(*sys.argv[1:3], ["state", "pattern", "silence"]))
    window.show()
    sys.exit(application.exec())
