"""The arming lease, and interruptions while a daemon arms, reloads or waits for amplifiers."""

import asyncio
import logging
import threading
from dataclasses import replace
from pathlib import Path

import pytest
import serial

from controller.api.jsonrpc import ErrorCode, RpcError
from controller.daemon.handlers import check_lease
from controller.operation.operation_states import (
    ENERGISED,
    DaemonEvent,
    DaemonState,
    Lease,
    Operation,
    Trigger,
    step,
)
from daemons import (
    PATIENCE,
    READY,
    daemon_at,
    far_end,
    next_event,
    ready_daemon,
    running_daemon,
    until,
)
from virtual_lines import in_virtual_time


@in_virtual_time
async def test_event_read_late_takes_nothing_back_that_was_seen(tmp_path: Path) -> None:
    """Of this connection or one before, even if this daemon counts from less."""
    async with ready_daemon(tmp_path) as (bench, era):
        await era.subscribe("state")
        await era.stop()
        epoch = (await era.stop()).epoch
        assert (await next_event(era, "state")).data["epoch"] < epoch
        await era.clear()
        supervisor = bench.daemon._supervisor
        supervisor.operation = replace(supervisor.operation, epoch=0)
        assert era._link is not None
        era._link.abort()
        await era.stop()
        assert (await next_event(era, "state")).data["epoch"] >= epoch - 1
        await era.clear()
        assert (await era.status()).state == READY


@in_virtual_time
async def test_reload_ends_after_unexpected_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The service manager gets the end of it, and the next reload works."""
    async with ready_daemon(tmp_path) as (bench, _):
        notices: list[str] = []
        await bench.daemon._supervisor.started.wait()
        for _ in range(10):  # the start is reported within three cycles of the event loop
            await asyncio.sleep(0)
        manager = bench.daemon._manager
        monkeypatch.setattr(manager, "notify", lambda first, *_: notices.append(first))

        def fail(*_: object) -> None:
            raise RuntimeError("injected")

        with monkeypatch.context() as patched:
            patched.setattr("controller.daemon.layouts.read_in_child", fail)
            await bench.daemon.reload()
        await bench.daemon.reload()
        assert notices == ["RELOADING=1", "READY=1"] * 2


@in_virtual_time
async def test_shutdown_cancels_reload(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """One whose configuration is still being read applies nothing."""
    async with running_daemon(tmp_path) as bench:
        daemon, is_reading = bench.daemon, asyncio.Event()

        async def read_for_ever(load: object, *, name: str) -> object:
            is_reading.set()
            await asyncio.Event().wait()
            raise AssertionError("unreachable")

        monkeypatch.setattr("controller.daemon.daemon.in_thread", read_for_ever)
        daemon._reload_requested.set()
        await is_reading.wait()
        daemon.shut_down("end of the test")
        await until(daemon._reloading.cancelled)


async def test_shutdown_while_a_port_is_opened_leaves_none_open(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The system takes its time; the port is closed at last, free for others, not opened again."""
    opened: list[serial.Serial] = []
    may_open, open_now = threading.Event(), serial.Serial.open

    def slow(port: serial.Serial) -> None:
        opened.append(port)
        assert may_open.wait(PATIENCE)
        open_now(port)

    monkeypatch.setattr("serial.Serial.open", slow)
    async with far_end(tmp_path) as far:
        async with daemon_at(far, tmp_path) as bench:
            await until(lambda: opened)
            bench.daemon.shut_down("end of the test")
            await until(lambda: bench.daemon._supervisor._closing.is_set())
            asyncio.get_running_loop().call_later(0.1, may_open.set)
        await until(lambda: not opened[0].is_open)
        assert len(opened) == 1
        with serial.Serial(opened[0].port, exclusive=True):
            pass


@in_virtual_time
async def test_log_event_escapes_bytes_that_are_not_text(tmp_path: Path) -> None:
    """A file name that is not UTF-8 reaches subscribers."""
    async with running_daemon(tmp_path) as bench, await bench.client() as era:
        await era.subscribe("log")
        record = logging.makeLogRecord({"msg": "wrote %s", "args": ("/tmp/\udcff",)})
        record.levelno, record.levelname = logging.WARNING, "WARNING"
        bench.daemon._publisher.logged(record)
        while "wrote" not in (event := await next_event(era, "log")).data["message"]:
            pass
        assert event.data["message"] == r"wrote /tmp/\udcff"


def test_lease_lasts_its_duration_from_each_renewal() -> None:
    """5 s from when it is armed and 5 s from the renewal, but not from an attempt after its end."""
    lease = Lease("me", 5).renewed(100)
    assert check_lease(lease, lease.token, 104.999) == lease
    renewed = check_lease(lease, lease.token, 104).renewed(104)
    assert (renewed.token, renewed.expires_at) == (lease.token, 109)
    with pytest.raises(RpcError) as caught:
        check_lease(renewed, lease.token, 109)
    assert caught.value.code is ErrorCode.LEASE


@pytest.mark.parametrize("token", ["", "x", "ü" * 32])
def test_lease_is_renewed_by_its_token_only(token: str) -> None:
    """A refusal names the owner, not the token; without a lease every token is refused."""
    lease = Lease("me", 5).renewed(0)
    with pytest.raises(RpcError, match="'me'") as caught:
        check_lease(lease, token, 1)
    assert caught.value.code is ErrorCode.LEASE
    assert lease.token not in str(caught.value)
    with pytest.raises(RpcError) as caught:
        check_lease(None, token, 1)
    assert caught.value.code is ErrorCode.LEASE


@pytest.mark.parametrize("state", DaemonState)
@pytest.mark.parametrize("trigger", Trigger)
def test_lease_exists_while_energised_alone(state: DaemonState, trigger: Trigger) -> None:
    """Whatever happens; and what may not go on afterwards is told by the epoch."""
    lease = Lease("me", 5, expires_at=10.0) if state in ENERGISED else None
    before = Operation(state, lease=lease, epoch=7)
    after, _ = step(before, DaemonEvent(trigger, "a test", lease=Lease("you", 3)), 6.0)
    if after.state in ENERGISED:
        is_new = after.state is not state
        owner = "you" if is_new and trigger is Trigger.ARM else "me"
        end = {"you": 9.0, "me": 11.0}[owner] if is_new else 10.0
        assert after.lease is not None
        assert (after.lease.owner, after.lease.expires_at) == (owner, end)
    else:
        assert after.lease is None
    if state in ENERGISED and after.state not in ENERGISED:
        assert after.epoch == 8
