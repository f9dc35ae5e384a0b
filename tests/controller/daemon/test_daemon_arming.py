"""Clients that arm a daemon: their leases, stops, and losses of amplifiers."""

import asyncio
from types import SimpleNamespace
from typing import Any, cast
from unittest.mock import Mock

import pytest

from controller.api.client import AsyncClient
from controller.api.jsonrpc import ErrorCode, RpcError
from controller.api.methods import ArmParams, StatusResult
from controller.operation.operation_states import ENERGISED
from kit.clock import in_virtual_time
from processes.daemons import ENABLED, READY, error_code, until
from registry import threads
from tests.controller.daemon.served_daemon import (
    Planted,
    ServedDaemon,
    require_shown,
    served_daemon,
)

STOPPED = "QUICK_STOP_ACTIVE"
DISARMED = "SWITCH_ON_DISABLED"


@in_virtual_time
async def test_clear_acknowledges_no_stop_that_its_client_has_not_seen() -> None:
    """Another client's stop is seen once the status was read; its own was seen at once."""
    async with served_daemon() as daemon:
        era = daemon.era
        await era.stop()
        await daemon.guest.stop()

        with pytest.raises(RpcError, match="another stop"):
            await era.clear()

        assert (await era.status()).state == STOPPED
        await era.clear()
        assert (await era.status()).state == READY


@in_virtual_time
async def test_client_that_follows_events_may_clear_after_a_second_stop() -> None:
    """The second stop changes no state, but what an acknowledgement must name."""
    async with served_daemon() as daemon:
        await daemon.era.subscribe("state")
        await daemon.guest.stop()
        stop = await daemon.guest.stop()
        await daemon.hear("state", epoch=stop.epoch)

        await daemon.era.clear()

        assert (await daemon.era.status()).state == READY


@in_virtual_time
async def test_lease_lasts_from_the_armed_state_when_arming_takes_longer() -> None:
    """The armed state has a lease at every moment, and no other client gets one meanwhile."""
    async with served_daemon() as daemon:
        era = daemon.era
        going_on = daemon.hold_back_arming()
        arming = asyncio.create_task(era.arm("me", lease_s=1))
        await daemon.reach("SWITCHED_ON")
        assert await error_code(daemon.guest.arm("you")) is ErrorCode.LEASE
        daemon.expire_lease()

        going_on.set()
        lease = (await arming).lease

        status = await era.status()
        assert (status.state, status.armed_by) == (ENABLED, "me")
        assert 0.5 <= status.lease_left_s <= 1
        await era.renew(lease)
        await daemon.reach(READY)
        assert daemon.amplifier_state == DISARMED


async def use_armed(client: AsyncClient) -> None:
    """Arm for a minute, which must not succeed."""
    async with client.armed("other", lease_s=60):
        raise AssertionError("must not be armed")


@pytest.mark.parametrize("is_cancelled", [True, False], ids=["cancelled", "left"])
@in_virtual_time
async def test_daemon_disarms_when_the_client_that_arms_gives_up(*, is_cancelled: bool) -> None:
    """Its lease of a minute ends at once, although it did not get it yet."""
    async with served_daemon() as daemon:
        going_on = daemon.hold_back_arming()
        arming = asyncio.create_task(use_armed(daemon.guest))
        await daemon.reach("SWITCHED_ON")
        if is_cancelled:
            arming.cancel()
            await asyncio.sleep(0)
        else:
            await daemon.guest.close()
        going_on.set()
        await asyncio.gather(arming, return_exceptions=True)

        async with asyncio.timeout(20):
            await daemon.reach(READY)

        assert (await daemon.era.status()).armed_by is None
        assert daemon.amplifier_state == DISARMED


@in_virtual_time
async def test_arming_that_is_cancelled_leaves_nothing_armed_without_a_lease() -> None:
    """The lease ends with the transition to disarmed, before another client may arm."""
    async with served_daemon() as daemon:
        going_on = daemon.hold_back_arming()
        client = cast(Any, SimpleNamespace(has_left=False))
        params = ArmParams(owner="me", lease_s=60)
        arming = asyncio.create_task(daemon.bench.daemon.api.arm(client, params))
        await daemon.reach("SWITCHED_ON")

        arming.cancel()
        await asyncio.gather(arming, return_exceptions=True)

        assert daemon.operation.state not in ENERGISED
        assert daemon.operation.lease is None
        going_on.set()
        await daemon.reach(READY)


@in_virtual_time
async def test_client_that_arms_after_the_end_of_a_lease_inherits_nothing(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Between the end of a lease and its event, the plate is disarmed first, then armed anew."""
    async with served_daemon() as daemon:
        monkeypatch.setattr(daemon.supervisor.current, "check_lease", lambda: None)
        await daemon.era.arm("me", lease_s=60)
        await daemon.era.subscribe("state")
        await daemon.hear("state", new=ENABLED)
        daemon.expire_lease()

        await daemon.guest.arm("you", lease_s=60)

        status = await daemon.era.status()
        assert (status.state, status.armed_by) == (ENABLED, "you")
        await daemon.hear("state", new=READY)


@pytest.mark.parametrize("is_latched", [True, False], ids=["method", "method and transition"])
@in_virtual_time
async def test_stop_that_fails_on_its_way_stops_the_amplifiers(
    monkeypatch: pytest.MonkeyPatch, *, is_latched: bool
) -> None:
    """By a bug in its method: it is latched and ends the lease.

    With another bug in the transition it cannot be latched; the amplifiers stop all the same.
    """
    async with served_daemon() as daemon:
        await daemon.era.arm("me", lease_s=60)
        with monkeypatch.context() as bug:
            bug.setattr(daemon.supervisor, "stop", Mock(side_effect=Planted))
            if not is_latched:
                bug.setattr(daemon.supervisor.current, "apply", Mock(side_effect=Planted))

            assert await error_code(daemon.era.stop()) is ErrorCode.INTERNAL

            assert daemon.operation.state.name == (STOPPED if is_latched else ENABLED)
            assert (daemon.operation.lease is None) is is_latched
            await until(lambda: daemon.amplifier_state == STOPPED)


@in_virtual_time
async def test_daemon_stays_disarmed_and_latched_after_a_loss_while_armed() -> None:
    """COMM_LOST ends pattern and lease; with the amplifier back there is a fault to clear."""
    async with served_daemon() as daemon:
        era = daemon.era
        await era.arm("me", lease_s=30)
        daemon.hold(era, "pad")
        await until(lambda: daemon.is_loud)
        await era.subscribe("state", "link", "silence")
        await daemon.hear("state", new=ENABLED)

        daemon.hang()
        await daemon.hear("link", event="degraded", amplifier="main")
        await daemon.hear("link", event="lost", amplifier="main")
        silence = await daemon.hear("silence")
        assert "no reply within 30 ms" in silence["reason"]
        await daemon.reach("COMM_LOST")
        daemon.lift()
        status = await era.status()
        assert (status.armed_by, status.drive) == (None, {})
        assert "cable" in status.remedy
        assert await error_code(era.arm("me")) is ErrorCode.WRONG_STATE
        assert await error_code(era.clear()) is ErrorCode.LINK
        assert await error_code(era.stop()) is ErrorCode.NOT_SILENT

        daemon.recover()
        await daemon.reach("FAULT")
        assert not (await era.status()).assume_energised
        await era.clear()
        await daemon.reach(READY)
        await era.arm("me")


def connections_of(status: StatusResult) -> dict[str, str]:
    """For each amplifier whether it is lost, closed because another is lost, or present."""
    connections = dict[str, str]()
    for amplifier in status.amplifiers:
        connections[amplifier.name] = "present"
        if amplifier.lost:
            connections[amplifier.name] = "lost"
        elif amplifier.closed_with_lost:
            connections[amplifier.name] = "closed"
    return connections


async def wait_for_connections(daemon: ServedDaemon, **expected: str) -> None:
    """Wait until the status says this of the amplifiers."""
    await daemon.status_when(lambda status: connections_of(status) == expected)


@in_virtual_time
async def test_status_tells_a_lost_amplifier_from_one_that_is_closed_with_it() -> None:
    """While one is lost, during attempts to open them again, and once both are."""
    async with served_daemon(has_side_amplifier=True) as daemon:
        era = daemon.era
        assert connections_of(await era.status()) == {"main": "present", "side": "present"}

        daemon.hang("side")
        await wait_for_connections(daemon, main="closed", side="lost")
        await era.subscribe("link")
        end = threads.now() + 0.6
        while threads.now() < end:
            status = await era.status()
            assert connections_of(status) == {"main": "closed", "side": "lost"}
            await asyncio.sleep(0.01)
        await daemon.hear("link", event="retry", amplifier="side")
        require_shown(status, r"amplifier main .*\): closed ", r"amplifier side .*\): LOST, ")

        daemon.hang("main")
        await wait_for_connections(daemon, main="lost", side="lost")
        daemon.recover("side")
        await wait_for_connections(daemon, main="lost", side="closed")
        assert await error_code(era.disarm()) is ErrorCode.NOT_SILENT
