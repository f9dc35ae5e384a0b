"""The daemon's state as last reported, and the plate's vibration field, for all browsers."""

import asyncio
import concurrent.futures
import json
import logging
import threading
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias

from controller.api.client_protocol import Notification
from controller.api.schema import PlayedTone
from controller.gateway.daemon_link import DaemonLink
from controller.gateway.fields import FieldSolver
from model.errors import InputError
from model.rig.file import parse_rig

FIELD = "field"
"""Topic of the gateway: the plate's vibration, as binary frames; see `fields.Field.encoded`."""

HELLO = "hello"
"""Topic of the gateway: the daemon's `hello` result, null while disconnected."""

_STATEFUL = frozenset(
    {"state", "contacts", "pattern", "silence", "amplifiers", "latency", "layout", "plate"}
)
_NO_FIELD = bytes(8 + 4)  # no columns, no rows, no frequencies, scale 0

_logger = logging.getLogger(__name__)
Publish: TypeAlias = Callable[[str, str | bytes], None]


class DaemonMirror:
    """Mirrors the state of the daemon at a socket and publishes every change by topic.

    publish: called with a topic and its frame: the daemon's own line as text, or a binary field.
    """

    def __init__(self, socket: Path, *, publish: Publish) -> None:
        self.daemon = DaemonLink(socket, on_hello=self._hello, on_event=self._event)
        self._publish = publish
        self._frames: dict[str, str | bytes] = {HELLO: _hello_frame(None)}
        self._rig_text: str | None = None
        self._solver: tuple[str, FieldSolver] | None = None  # by rig; used by the thread alone
        self._drive: dict[str, PlayedTone] = {}
        self._field_due = asyncio.Event()

    async def run(self) -> None:
        """Follow until cancelled."""
        async with asyncio.TaskGroup() as tasks:
            tasks.create_task(self.daemon.run())
            tasks.create_task(self._update_field())

    def current(self, topic: str) -> str | bytes | None:
        """The latest frame of a topic, or None."""
        return self._frames.get(topic)

    def _hello(self, hello: Mapping[str, Any] | None) -> None:
        """Start over with a newly connected daemon, or without one."""
        self._rig_text = None if hello is None else hello["rig_text"]
        self._frames.clear()
        self._store_and_publish(HELLO, _hello_frame(hello))
        self._drive = {}
        self._field_due.set()

    def _event(self, event: Notification) -> None:
        topic, frame = event.topic, event.line.decode()
        if topic in ("pattern", "silence"):
            self._frames.pop("silence" if topic == "pattern" else "pattern", None)
            self._drive = {
                era: PlayedTone.model_validate(tone, extra="ignore")
                for era, tone in event.data.get("drive", {}).items()
            }
            self._field_due.set()
        if topic == "layout":
            self._replace_layout(event.data["layout"])
        if topic in _STATEFUL:
            self._frames[topic] = frame
        self._publish(topic, frame)

    def _replace_layout(self, layout: Mapping[str, Any] | None) -> None:
        """Publish `hello` with the new layout, but skip the initial layout, already in hello."""
        hello = self.daemon.hello
        if hello is not None and ("layout" in self._frames or layout != hello["layout"]):
            self.daemon.hello = {**hello, "layout": layout}
            self._store_and_publish(HELLO, _hello_frame(self.daemon.hello))

    def _store_and_publish(self, topic: str, frame: str | bytes) -> None:
        self._frames[topic] = frame
        self._publish(topic, frame)

    async def _update_field(self) -> None:
        """Compute the field of the newest drive, in a thread, whenever it is due."""
        while True:
            await self._field_due.wait()
            self._field_due.clear()
            try:
                frame = await _in_thread(partial(self._field, self._rig_text, dict(self._drive)))
            except InputError as error:
                _logger.warning("field of the plate not computed: %s", error)
                frame = _NO_FIELD
            except Exception:  # without the picture, but with the stop button
                _logger.exception("field of the plate not computed")
                frame = _NO_FIELD
            if not self._field_due.is_set():
                self._store_and_publish(FIELD, frame)

    def _field(self, rig_text: str | None, drive: dict[str, PlayedTone]) -> bytes:
        if rig_text is None:
            return _NO_FIELD
        if self._solver is None or self._solver[0] != rig_text:
            self._solver = rig_text, FieldSolver(parse_rig("the daemon's rig", rig_text))
        return self._solver[1].field(drive).encoded()


async def _in_thread(work: Callable[[], bytes]) -> bytes:
    """Run work in a daemon thread, for which the process does not wait at its end."""
    future: concurrent.futures.Future[bytes] = concurrent.futures.Future()
    future.set_running_or_notify_cancel()

    def run() -> None:
        try:
            future.set_result(work())
        except Exception as error:
            future.set_exception(error)

    threading.Thread(target=run, name="vibration field", daemon=True).start()
    return await asyncio.wrap_future(future)


def _hello_frame(hello: Mapping[str, Any] | None) -> str:
    """A notification of the gateway's own topic."""
    content = {"jsonrpc": "2.0", "method": "event", "params": {"topic": HELLO, "data": hello}}
    return json.dumps(content, separators=(",", ":"))
