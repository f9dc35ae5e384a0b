"""What may happen while a daemon arms, reads its configuration again, or waits for amplifiers."""

import asyncio
import contextlib
import logging
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from controller.api.jsonrpc import ErrorCode, RpcError
from controller.daemon.config import load_daemon_config
from controller.daemon.daemon import Daemon
from controller.daemon.log import LogThread
from controller.daemon.service_manager import ServiceManager
from controller.daemon.socket_lock import SocketLock
from daemon_bench import daemon_table, far_end, running_daemon, until, until_state, write_daemon
from drivers.errors import LinkError
from drivers.protocol.messages import AmplifierState
from sim.faults.fault_window import FaultWindow

READY, ENABLED = "READY_TO_SWITCH_ON", "OPERATION_ENABLED"


def arming_waits(
    daemon: Daemon, monkeypatch: pytest.MonkeyPatch, *, then: Callable[[], None] | None = None
) -> asyncio.Event:
    """What the arming of a daemon waits for; then: what happens before it goes on."""
    arm, goes_on = daemon._controller.arm, asyncio.Event()

    async def slow() -> None:
        await goes_on.wait()
        if then is not None:
            then()
        await arm()

    monkeypatch.setattr(daemon._controller, "arm", slow)
    return goes_on


async def test_arming_that_takes_longer_than_the_lease(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The lease then lasts from when it is armed, and with it the armed state: never without one.

    Meanwhile nobody else gets a lease.
    """
    async with running_daemon(tmp_path) as bench, await bench.client() as era:
        await until_state(era, READY)
        daemon = bench.daemon
        book = daemon._api._lease

        def pass_time() -> None:
            assert book._lease is not None
            book._lease = replace(book._lease, expires_at=0.0)

        goes_on = arming_waits(daemon, monkeypatch, then=pass_time)
        arming = asyncio.ensure_future(era.arm("me", lease_s=1))
        await until_state(era, "SWITCHED_ON")
        async with await bench.client("other") as other:
            with pytest.raises(RpcError) as caught:
                await other.arm("you")
            assert caught.value.code is ErrorCode.LEASE
        goes_on.set()
        lease = await arming
        status = await era.status()
        assert (status.state, status.armed_by) == (ENABLED, "me")
        assert 0.5 < (status.lease_left_s or 0) <= 1
        await era.renew(lease.lease)
        await until_state(era, READY)
        assert bench.far.device.status().state is AmplifierState.SWITCH_ON_DISABLED


async def test_who_hangs_up_while_arming_leaves_nothing_armed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nobody knows the lease then, which would have lasted for a minute: disarmed at once."""
    async with running_daemon(tmp_path) as bench, await bench.client() as era:
        await until_state(era, READY)
        goes_on = arming_waits(bench.daemon, monkeypatch)
        other = await bench.client("other")
        arming = asyncio.ensure_future(other.arm("other", lease_s=60))
        await until_state(era, "SWITCHED_ON")
        await other.close()
        with pytest.raises(LinkError):
            await arming
        goes_on.set()
        await until_state(era, READY)
        assert (await era.status()).armed_by is None
        assert bench.far.device.status().state is AmplifierState.SWITCH_ON_DISABLED


async def test_who_is_cancelled_while_arming_leaves_nothing_armed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its connection stays, and with it a lease that nobody would renew: so it disarms."""
    async with running_daemon(tmp_path) as bench, await bench.client() as era:
        await until_state(era, READY)
        goes_on = arming_waits(bench.daemon, monkeypatch)

        async def use() -> None:
            async with era.armed("me", lease_s=60):
                raise AssertionError("it was cancelled before")

        using = asyncio.create_task(use())
        await until_state(era, "SWITCHED_ON")
        using.cancel()
        await asyncio.sleep(0)
        goes_on.set()
        with pytest.raises(asyncio.CancelledError):
            await using
        await until_state(era, READY)
        assert (await era.status()).armed_by is None


async def test_a_reload_that_fails_in_an_unheard_of_way_is_over_all_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The service manager is told that it is over, and the next one works."""
    async with running_daemon(tmp_path) as bench:
        told: list[str] = []
        manager = bench.daemon._manager
        monkeypatch.setattr(manager, "reloading", lambda: told.append("begins"))
        monkeypatch.setattr(manager, "ready", lambda status: told.append("is over"))

        def broken(path: Path) -> None:
            raise RuntimeError("a disk that makes things up")

        with monkeypatch.context() as patched:
            patched.setattr("controller.daemon.daemon.load_daemon_config", broken)
            await bench.daemon.reload()
        await bench.daemon.reload()
        assert told == ["begins", "is over"] * 2


async def test_an_end_during_a_reload_starts_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Touch sources of a configuration that is still being read are not opened after the end."""
    async with running_daemon(tmp_path) as bench:
        daemon = bench.daemon
        reads = asyncio.Event()

        async def slowly(load: object, *, name: str) -> object:
            reads.set()
            await asyncio.sleep(3600)
            raise AssertionError("it was waited for")

        with monkeypatch.context() as patched:
            patched.setattr("controller.daemon.daemon.in_thread", slowly)
            daemon._request_reload()
            await reads.wait()
        (reload,) = daemon._reloads
        daemon.shut_down("the test is over")
        await until(reload.done)
        with contextlib.suppress(asyncio.CancelledError):
            await reload
        assert reload.cancelled()


async def test_an_end_while_an_amplifier_is_waited_for(tmp_path: Path) -> None:
    """It does not answer when the daemon starts: being told to end ends that at once."""
    async with far_end(tmp_path) as far:
        far.device.inject_fault(FaultWindow("hang"))
        config = load_daemon_config(write_daemon(tmp_path, {"main": far.url}))
        place, log = SocketLock(config.socket), LogThread(tmp_path / "log")
        daemon = Daemon(config, daemon_table(), log=log, manager=ServiceManager({}), dashboard=None)
        running = asyncio.create_task(daemon.run(place))
        try:
            await asyncio.sleep(0.1)
            begin = asyncio.get_running_loop().time()
            daemon.shut_down("told to end")
            await asyncio.wait_for(running, 20)
            assert asyncio.get_running_loop().time() - begin < 1.0
        finally:
            log.close()
            place.release()


async def test_an_end_while_a_lost_amplifier_is_tried_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A connection that never comes about does not hold up the end."""
    async with running_daemon(tmp_path) as bench, await bench.client() as era:
        await until_state(era, READY)
        tries = asyncio.Event()

        async def endless() -> None:
            tries.set()
            await asyncio.Event().wait()

        monkeypatch.setattr(bench.daemon._controller, "open", endless)
        bench.far.device.inject_fault(FaultWindow("hang"))
        await asyncio.wait_for(tries.wait(), 20)


async def test_the_service_manager_hears_of_a_daemon_that_waits_for_an_amplifier(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An attempt to come back may take longer than the service manager's patience of 2 s."""
    async with running_daemon(tmp_path) as bench, await bench.client() as era:
        await until_state(era, READY)
        alive, tries = 0, asyncio.Event()

        async def endless() -> None:
            tries.set()
            await asyncio.Event().wait()

        def count(now: float) -> None:
            nonlocal alive
            alive += 1

        monkeypatch.setattr(bench.daemon._controller, "open", endless)
        bench.far.device.inject_fault(FaultWindow("hang"))
        await asyncio.wait_for(tries.wait(), 20)
        monkeypatch.setattr(bench.daemon._manager, "alive", count)
        await until(lambda: alive >= 3)


async def test_a_name_that_is_no_text_is_told_all_the_same(tmp_path: Path) -> None:
    """A line of the log with a file's name that is not UTF-8 reaches subscribers, escaped."""
    async with running_daemon(tmp_path) as bench, await bench.client() as era:
        await era.subscribe("log")
        record = logging.makeLogRecord({"msg": "written to %s", "args": ("/tmp/\udcff",)})
        record.levelno, record.levelname = logging.WARNING, "WARNING"
        bench.daemon._publisher.logged(record)
        async with asyncio.timeout(20):
            async for told in era.events():
                if told.topic == "log" and "written" in told.data["message"]:
                    assert told.data["message"] == r"written to /tmp/\udcff"
                    break
