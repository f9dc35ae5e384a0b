"""What browsers are shown of the daemon, from what it tells the gateway."""

import asyncio
import json
from pathlib import Path
from typing import Any

import pytest

from controller.api.client_protocol import Notification
from controller.api.jsonrpc import RpcError
from controller.api.methods import HelloResult
from controller.api.schema import API_VERSION, Empty, Message, RigSummary, TableSummary
from controller.gateway.mirror import DaemonMirror
from gateway_bench import PATIENCE, ScriptedDaemon


def hello(layout: dict[str, Any] | None) -> HelloResult:
    """A daemon with a layout."""
    return HelloResult(
        api_version=API_VERSION,
        software_version="1",
        rig=RigSummary(
            length_m=0.3, width_m=0.2, eras=[], simulated=True, frequency_hz=[40.0, 500.0]
        ),
        table=TableSummary(
            fingerprint="0", mode="switched", frequencies_hz=[110.0], cells_x=4, cells_y=3
        ),
        rig_text="",
        layout=layout,
    )


def test_another_layout_is_another_hello(tmp_path: Path) -> None:
    """Not at the first telling, which is what hello has said; then whatever is told, each time.

    What else was shown stays, and the gateway answers hello by the new one.
    """
    shown: list[Any] = []

    def tell(topic: str, frame: str | bytes) -> None:
        if topic == "hello":
            said = json.loads(frame)["params"]["data"]
            shown.append(None if said is None else said["layout"])

    picture = DaemonMirror(tmp_path / "nowhere", tell=tell)
    one, other = {"regions": [{"name": "a"}]}, {"regions": [{"name": "b"}]}
    picture.daemon.hello = hello(one)
    picture._hello(picture.daemon.hello)
    picture._event(Notification("state", 1.0, 0, {"new": "FAULT"}))
    picture._event(Notification("layout", 1.0, 0, {"layout": one}))
    assert shown == [one]
    picture._event(Notification("layout", 2.0, 0, {"layout": other}))
    picture._event(Notification("layout", 3.0, 0, {"layout": other}))  # other effects
    assert shown == [one, other, other]
    assert picture.daemon.hello.layout == other
    assert picture.current("state") is not None

    # Exchanged between hello and the subscription: the first telling is news already.
    shown.clear()
    picture.daemon.hello = hello(one)
    picture._hello(picture.daemon.hello)
    picture._event(Notification("layout", 4.0, 0, {"layout": None}))
    assert shown == [one, None]


class PatternOfTomorrow(Message):
    """What a daemon of another version could say of a pattern."""

    drive: dict[str, dict[str, str]] = {"SW": {"tone": "110 Hz"}}  # noqa: RUF012  pydantic copies it


async def test_what_a_daemon_of_another_version_tells_is_said_with_what_to_update(
    daemon: ScriptedDaemon, caplog: pytest.LogCaptureFixture
) -> None:
    """It is asked anew, for what else it tells may be understood."""
    picture = DaemonMirror(daemon.socket, tell=lambda topic, frame: None)

    async def connected() -> None:
        while True:
            try:
                await picture.daemon.call("status", Empty())
            except RpcError:
                await asyncio.sleep(0.005)
            else:
                return

    following = asyncio.create_task(picture.daemon.run())
    async with asyncio.timeout(PATIENCE):
        await connected()
        daemon.publish("pattern", PatternOfTomorrow())
        while picture.daemon.hello is not None:  # noqa: ASYNC110  what is waited for tells nobody
            await asyncio.sleep(0.005)
        await connected()
    following.cancel()
    await asyncio.gather(following, return_exceptions=True)
    assert "tells cannot be understood; update the older of daemon and gateway" in caplog.text
