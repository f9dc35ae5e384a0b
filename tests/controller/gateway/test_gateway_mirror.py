"""What the gateway shows of the daemon, from the daemon's events."""

import asyncio
import json
from pathlib import Path
from typing import Any

import pytest

from controller.api.client_protocol import Notification
from controller.api.jsonrpc import RpcError
from controller.api.schema import Empty, Message
from controller.gateway.mirror import DaemonMirror
from daemon_bench import PATIENCE
from gateway_bench import ScriptedDaemon


def event(topic: str, data: dict[str, Any]) -> Notification:
    """An event as the client receives it."""
    content = {"method": "event", "params": {"topic": topic, "data": data}}
    return Notification(topic, 1.0, 0, data, json.dumps(content).encode())


def test_mirror_publishes_hello_anew_when_the_layout_is_replaced(tmp_path: Path) -> None:
    """At every `layout` event but the first that repeats what `hello` had; the rest is kept."""
    layouts: list[Any] = []

    def publish(topic: str, frame: str | bytes) -> None:
        if topic == "hello":
            layouts.append(json.loads(frame)["params"]["data"]["layout"])

    mirror = DaemonMirror(tmp_path / "nowhere", publish=publish)
    one, other = {"regions": [{"name": "a"}]}, {"regions": [{"name": "b"}]}
    mirror.daemon.hello = {"rig_text": "", "layout": one}
    mirror._hello(mirror.daemon.hello)
    mirror._event(event("state", {"new": "FAULT"}))
    mirror._event(event("layout", {"layout": one}))
    assert layouts == [one]
    mirror._event(event("layout", {"layout": other}))
    mirror._event(event("layout", {"layout": other}))  # with other effects
    assert layouts == [one, other, other]
    assert mirror.daemon.hello["layout"] == other
    assert mirror.current("state") is not None

    # Replaced between hello and the subscription.
    layouts.clear()
    mirror.daemon.hello = {"rig_text": "", "layout": one}
    mirror._hello(mirror.daemon.hello)
    mirror._event(event("layout", {"layout": None}))
    assert layouts == [one, None]


class UnknownPattern(Message):
    """A pattern of an incompatible daemon."""

    drive: dict[str, dict[str, str]] = {"SW": {"tone": "110 Hz"}}  # noqa: RUF012  pydantic copies it


async def test_mirror_reconnects_after_an_event_it_does_not_understand(
    daemon: ScriptedDaemon, caplog: pytest.LogCaptureFixture
) -> None:
    """The remedy is in the log; the daemon may send others that are understood."""
    mirror = DaemonMirror(daemon.socket, publish=lambda topic, frame: None)

    async def connected() -> None:
        while True:
            try:
                await mirror.daemon.call("status", Empty())
            except RpcError:
                await asyncio.sleep(0.005)
            else:
                return

    following = asyncio.create_task(mirror.daemon.run())
    async with asyncio.timeout(PATIENCE):
        await connected()
        daemon.publish("pattern", UnknownPattern())
        while mirror.daemon.hello is not None:  # noqa: ASYNC110  nothing signals it
            await asyncio.sleep(0.005)
        await connected()
    following.cancel()
    await asyncio.gather(following, return_exceptions=True)
    assert "update the older of daemon and gateway" in caplog.text


async def test_mirror_goes_on_without_the_field_when_drawing_fails(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A bug in the picture must not end the gateway with its stop button."""
    frames: asyncio.Queue[str] = asyncio.Queue()
    mirror = DaemonMirror(tmp_path / "nowhere", publish=lambda topic, _: frames.put_nowait(topic))

    def fail(*_: object) -> bytes:
        raise ZeroDivisionError

    monkeypatch.setattr(mirror, "_field", fail)
    following = asyncio.create_task(mirror.run())
    for _ in range(2):
        mirror._field_due.set()
        getting = asyncio.create_task(frames.get())
        await asyncio.wait({getting, following}, return_when=asyncio.FIRST_COMPLETED)
        assert not following.done()
        assert getting.result() == "field"
    following.cancel()
    await asyncio.wait({following})
