"""What all browsers are shown: the daemon's state as it was last told, and the plate's field."""

import asyncio
import contextlib
import json
import logging
import threading
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias

from controller.api.client_protocol import Notification
from controller.api.methods import HelloResult
from controller.api.schema import PlayedTone
from controller.gateway.daemon_link import DaemonLink
from controller.gateway.fields import FieldMaker
from controller.gateway.topics import FIELD, HELLO
from model.errors import InputError
from model.rig.file import parse_rig

_KEPT = frozenset({"state", "contacts", "pattern", "silence", "amplifiers", "latency", "layout"})
_NO_FIELD = bytes(8 + 4)  # no columns, no rows, no frequencies, scale 0

_logger = logging.getLogger(__name__)
Tell: TypeAlias = Callable[[str, str | bytes], None]


class DaemonMirror:
    """Follows the daemon at a socket and tells every change, topic by topic.

    tell: called with a topic and its frame, text as the daemon sent it, binary for the field.
    """

    def __init__(self, socket: Path, *, tell: Tell) -> None:
        self.daemon = DaemonLink(socket, on_hello=self._hello, on_event=self._event)
        self._tell = tell
        self._frames: dict[str, str | bytes] = {HELLO: _event_frame(HELLO, None)}
        self._rig_text: str | None = None
        self._drawn: tuple[str, FieldMaker] | None = None  # of which rig; the thread's alone
        self._drive: dict[str, PlayedTone] = {}
        self._wanted = asyncio.Event()

    async def run(self) -> None:
        """Follow until cancelled."""
        async with asyncio.TaskGroup() as tasks:
            tasks.create_task(self.daemon.run())
            tasks.create_task(self._draw())

    def current(self, topic: str) -> str | bytes | None:
        """What is so now of a topic, None if nothing was told."""
        return self._frames.get(topic)

    def _hello(self, hello: HelloResult | None) -> None:
        """The daemon is there, another one perhaps, or gone."""
        self._frames.clear()
        said = None if hello is None else hello.model_dump(mode="json")
        self._show(HELLO, _event_frame(HELLO, said))
        self._rig_text = None if hello is None else hello.rig_text
        self._drive = {}
        self._wanted.set()

    def _event(self, told: Notification) -> None:
        """Something happened."""
        topic = told.topic
        frame = _event_frame(topic, told.data, time_s=told.time, lost=told.lost)
        if topic in ("pattern", "silence"):
            self._frames.pop("silence" if topic == "pattern" else "pattern", None)
            drive = told.data.get("drive", {})
            self._drive = {
                name: PlayedTone.model_validate(tone, extra="ignore")
                for name, tone in drive.items()
            }
            self._wanted.set()
        if topic == "layout":
            self._exchange(told.data["layout"])
        if topic in _KEPT:
            self._frames[topic] = frame
        self._tell(topic, frame)

    def _exchange(self, layout: dict[str, Any] | None) -> None:
        """Say hello again if touches mean something else; at first it is what hello has said."""
        hello = self.daemon.hello
        if hello is not None and ("layout" in self._frames or layout != hello.layout):
            self.daemon.hello = hello.model_copy(update={"layout": layout})
            self._show(HELLO, _event_frame(HELLO, self.daemon.hello.model_dump(mode="json")))

    def _show(self, topic: str, frame: str | bytes) -> None:
        self._frames[topic] = frame
        self._tell(topic, frame)

    async def _draw(self) -> None:
        """Draw the field that is wanted last, in a thread: the routes go on meanwhile."""
        while True:
            await self._wanted.wait()
            self._wanted.clear()
            try:
                frame = await _beside(partial(self._field, self._rig_text, dict(self._drive)))
            except InputError as error:
                _logger.warning("the plate cannot be drawn: %s", error)
                frame = _NO_FIELD
            if not self._wanted.is_set():
                self._show(FIELD, frame)

    def _field(self, rig_text: str | None, drive: dict[str, PlayedTone]) -> bytes:
        """The field under a drive."""
        if rig_text is None:
            return _NO_FIELD
        if self._drawn is None or self._drawn[0] != rig_text:
            self._drawn = rig_text, FieldMaker(parse_rig("the daemon's rig", rig_text))
        return self._drawn[1].field(drive).encoded()


async def _beside(work: Callable[[], bytes]) -> bytes:
    """Do work in a thread that the process does not wait for at its end, unlike a pool's."""
    loop = asyncio.get_running_loop()
    done: asyncio.Future[bytes] = loop.create_future()

    def settle(result: bytes, error: Exception | None) -> None:
        if done.cancelled():
            return
        if error is None:
            done.set_result(result)
        else:
            done.set_exception(error)

    def run() -> None:
        result, failure = b"", None
        try:
            result = work()
        except Exception as error:
            failure = error
        with contextlib.suppress(RuntimeError):  # the loop may be over
            loop.call_soon_threadsafe(settle, result, failure)

    threading.Thread(target=run, name="the plate's field", daemon=True).start()
    return await done


def _event_frame(topic: str, data: Mapping[str, Any] | None, **when: float) -> str:
    """A notification, the daemon's or the gateway's own."""
    said = {"jsonrpc": "2.0", "method": "event", "params": {"topic": topic, **when, "data": data}}
    return json.dumps(said, separators=(",", ":"))
