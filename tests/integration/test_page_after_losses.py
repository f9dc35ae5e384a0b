"""The dashboard in a browser after losses of an amplifier, the daemon or the gateway."""

import asyncio
import contextlib
import signal
from itertools import pairwise
from pathlib import Path
from unittest.mock import Mock

import pytest

from controller.api.hub import Hub
from controller.api.jsonrpc import ErrorCode, RpcError
from controller.api.methods import LayoutEvent, PatternEvent, StateEvent
from controller.api.schema import ContactStatus, DaemonStateName
from controller.gateway.app import MAX_SESSIONS
from dashboard_pictures import REASON, SCREENS, STATE, open_dashboard
from processes.daemons import (
    PATIENCE,
    ready,
    running_daemon,
)
from processes.gateways import (
    UNCONFIRMED,
    Page,
    RawWebSocket,
    ScriptedDaemon,
    gateway_process,
)
from processes.patient_daemon import LONG_WATCHDOG
from sim.faults import FaultWindow

DESKTOP = SCREENS[0]
BANNER = "document.querySelector('#banner').innerText"
EVENTS = "[...document.querySelectorAll('#log li')].map(e => e.innerText)"
NOTES = "document.querySelectorAll('#log li:first-child .note').length"
TILE = "document.querySelector('.tile')?.innerText ?? ''"
PROBES = Path(__file__).with_name("page_probes.js").read_text(encoding="utf-8")


@pytest.mark.long
@pytest.mark.asyncio(loop_scope="module")
async def test_lost_link_is_one_event_with_its_attempts(tab: Page, tmp_path: Path) -> None:
    """The banner has the watchdog time; outdated values are hidden; attempts and the return are
    listed below the loss.
    """
    async with running_daemon(tmp_path) as bench, await bench.client() as era:
        await ready(era)
        with gateway_process(tmp_path, bench.socket) as gateway:
            await open_dashboard(tab, gateway, DESKTOP)
            # Disarmed: no watchdog can make it another fault on a busy machine.
            assert "%" in await tab.until(TILE)
            events = await tab.evaluate(EVENTS)
            earlier_events = events[-1:]  # a short loss on a busy machine joins this one
            bench.far.device.inject_fault(FaultWindow(fault="hang"))
            await tab.until(f"{STATE} === 'COMM_LOST'")
            assert await tab.evaluate(REASON) == "link-lost"
            await tab.until(BANNER, lambda text: f"after {LONG_WATCHDOG:g}\u00a0s" in text)
            await tab.until("document.querySelector('.tile.bad') !== null")
            tile = await tab.evaluate(TILE)
            assert "%" not in tile
            assert "°C" not in tile
            assert await tab.evaluate("document.querySelector('.plate.unknown') !== null")
            ratios = await tab.evaluate(f"({PROBES}).contrasts()")
            assert [ratio for ratio in ratios if ratio[0] < 4.5] == []
            await tab.until(f"{NOTES} > 1")
            assert (await tab.evaluate(EVENTS))[1:] == earlier_events
            bench.far.device.recover()
            await tab.until(f"{STATE} === 'READY_TO_SWITCH_ON'")
            assert (await tab.evaluate(EVENTS))[1:] == earlier_events
            assert await tab.evaluate(f"{NOTES} === 1")
            assert await tab.evaluate(REASON) == "simulated"
            await tab.until("document.querySelector('.tile.bad') === null")
            assert "%" in await tab.evaluate(TILE)


@pytest.mark.long
@pytest.mark.asyncio(loop_scope="module")
async def test_what_the_daemon_reports_is_shown(tab: Page, tmp_path: Path) -> None:
    """Which amplifiers a stop did not silence: beside the button and in the list of events.

    Until a stop is confirmed. The end of the daemon after a loss is an event of its own. Regions
    are those of the layout in use, and the level is that at the finger.
    """
    problem = "document.querySelector('#problem').innerText"
    states: list[tuple[DaemonStateName, str]] = [
        ("READY_TO_SWITCH_ON", ""),
        ("COMM_LOST", "amplifier main: cut"),
        ("NOT_READY", "told to end"),
    ]
    with ScriptedDaemon(tmp_path) as daemon, gateway_process(tmp_path, daemon.socket) as gateway:
        await open_dashboard(tab, gateway, DESKTOP)
        knob = {"name": "knob", "shape": "circle", "x_m": 0.1, "y_m": 0.1, "radius_m": 0.03}
        daemon.publish("layout", LayoutEvent(layout={"regions": [knob]}))
        await tab.until("document.querySelectorAll('.region').length === 1")
        finger = ContactStatus(
            source="a", id=1, x_m=0.1, y_m=0.1, role="target", promised_level_db_sl=18.0
        )
        pattern = PatternEvent(
            contacts=[finger],
            drive={},
            latency_ms=2.0,
            predicted_level_db_sl=22.0,
            predicted_contrast_db=None,
        )
        daemon.publish("pattern", pattern)
        await tab.until("document.querySelector('#summary').textContent.includes('≥ 18 dB SL')")
        daemon.silence = UNCONFIRMED
        await tab.click("#stop")
        report = await tab.until(problem, lambda text: "side" in text)
        assert "main" not in report
        assert report in (await tab.evaluate(EVENTS))[0]
        daemon.silence = {}
        await tab.click("#stop")
        await tab.until(f"{problem} === ''")
        for (old, _), (new, cause) in pairwise(states):
            daemon.publish("state", StateEvent(old=old, new=new, cause=cause, remedy=None, epoch=1))
            events = await tab.until(EVENTS, lambda events, cause=cause: cause in events[0])
        assert "told to end" in events[0]
        assert events[1].endswith("amplifier main: cut")


@pytest.mark.asyncio(loop_scope="module")
async def test_page_connects_again_and_reports_a_stop_without_an_answer(
    tab: Page, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A full gateway is shown as full, not as unreachable.

    So is one without a place at the daemon, instead of a state that no event changes. A stop is not
    confirmed, after the time in which an answer may come, when the gateway hangs.
    """
    busy = RpcError(ErrorCode.BUSY, "too many clients", remedy="try again later")
    with ScriptedDaemon(tmp_path) as daemon, gateway_process(tmp_path, daemon.socket) as gateway:
        with contextlib.ExitStack() as connections:
            for _ in range(MAX_SESSIONS):
                last = RawWebSocket(gateway).connection
                connections.callback(last.close)
            await tab.show(f"{gateway.url}#token={gateway.token}")
            await tab.until(f"{REASON} === 'gateway-full'")
            last.close()
            await tab.until(f"{REASON} === 'simulated'")
        with monkeypatch.context() as full:
            full.setattr(Hub, "subscribe", Mock(side_effect=busy))
            await tab.show(f"{gateway.url}#token={gateway.token}")
            async with asyncio.timeout(PATIENCE / 6):
                await tab.until(f"{REASON} === 'gateway-full'")
        await tab.until(f"{REASON} === 'simulated'")
        gateway.process.send_signal(signal.SIGSTOP)
        await tab.click("#stop")
        async with asyncio.timeout(PATIENCE / 6):
            await tab.until("document.querySelector('#problem').textContent.includes('by hand')")
