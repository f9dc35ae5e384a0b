"""A daemon whose answers hang: stopped, reloaded and ended meanwhile, and what it says."""

import os
import signal
from pathlib import Path

import pytest

from controller.api.async_client import AsyncClient
from controller.loop.content import BEING_CHOSEN
from controller.loop.intent import NO_CONTACTS
from controller.loop.selection import GIVEN_UP
from daemon_bench import ENABLED, READY, holding, ready_daemon, until, until_state
from drivers import clock
from several_fingers import answers_take
from virtual_loop import in_virtual_time

LEFT, RIGHT = (0.08, 0.1), (0.22, 0.1)
_HALF = "{rectangle: {start: [%s m, 0 m], end: [%s m, 0.2 m]}, on_press: %s}"
_LAYOUT = f"regions: {{west: {_HALF % (0, 0.15, 'buzz')}, east: {_HALF % (0.15, 0.3, '%s')}}}\n"


async def said(era: AsyncClient) -> set[str | None]:
    """Why fingers feel nothing; the status says the same where nothing plays though it is armed."""
    status = await era.status()
    reasons = {each.held_back for each in status.contacts}
    if status.state == ENABLED:
        assert {status.silence_reason} == reasons
    return reasons


@in_virtual_time
async def test_a_daemon_goes_on_while_answers_hang(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every reason is the present one; a stop is at once, and the end within a second."""
    layout = tmp_path / "layout.yaml"
    layout.write_text(_LAYOUT % "buzz", "utf-8")
    async with ready_daemon(tmp_path, "layout: layout.yaml\n") as (bench, era):
        asked = answers_take(monkeypatch, 1e6)
        async with holding(era, LEFT, RIGHT):
            await until(lambda: bench.daemon._controller._tracker.contacts)
            assert await said(era) == {"ready: arm first (era arm)"}
            await era.arm("test", lease_s=60)
            await until(lambda: asked)
            assert await said(era) == {BEING_CHOSEN}
            begin = clock.now()
            await until(lambda: clock.now() > begin + 1.1)
            assert await said(era) == {GIVEN_UP}
            begin = clock.now()
            await era.stop()
            assert clock.now() - begin < 0.05
            assert await said(era) == {"stopped: clear (era clear), then arm again"}
            layout.write_text(_LAYOUT % "click", "utf-8")
            os.kill(os.getpid(), signal.SIGHUP)
            await until(lambda: bench.daemon._layout.layout.regions[1].on_press == "click")
            await era.clear()
            await until_state(era, READY)
            await era.arm("test", lease_s=60)
            assert len(asked) == 1
        await until(lambda: not bench.daemon._controller._tracker.contacts)
        await until(lambda: not any(bench.far.summary().levels))
        assert (await era.status()).silence_reason == NO_CONTACTS
        async with holding(era, LEFT, far=bench.far):  # one alone needs no thread
            assert await said(era) == {None}
        layout.write_text(_LAYOUT % "buzz", "utf-8")
        os.kill(os.getpid(), signal.SIGHUP)
        await until(lambda: bench.daemon._layout.layout.regions[1].on_press == "buzz")
        async with holding(era, LEFT, RIGHT):
            await until(lambda: len(asked) == 2)
            begin = clock.now()
            os.kill(os.getpid(), signal.SIGTERM)
            await until(bench.running.done)
            assert clock.now() - begin < 1
