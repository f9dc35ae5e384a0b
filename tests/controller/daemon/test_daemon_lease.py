"""The arming lease: duration, owner, token."""

import asyncio
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest

from controller.api.jsonrpc import ErrorCode, RpcError
from controller.api.methods import ArmParams
from controller.daemon.lease import LeaseHolder
from controller.daemon.states import ENERGISED, DaemonEvent, Trigger
from daemon_bench import error_code, ready_daemon, until_state


async def test_client_that_arms_after_the_end_of_a_lease_inherits_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Between the end of a lease and its event: disarmed first, then armed anew."""
    async with ready_daemon(tmp_path) as (bench, era):
        api = bench.daemon._api
        monkeypatch.setattr(api, "_check_lease", lambda: None)  # its event comes later
        states: list[str] = []
        await era.arm("me", lease_s=60)
        monkeypatch.setattr(api._lease, "_lease", replace(api._lease._lease, expires_at=0.0))
        monkeypatch.setattr(
            bench.daemon._publisher, "state_changed", lambda old, new: states.append(new.state.name)
        )
        async with await bench.client() as other:
            await other.arm("you", lease_s=60)
            assert (await other.status()).state == "OPERATION_ENABLED"
        assert "READY_TO_SWITCH_ON" in states


@pytest.mark.parametrize("trigger", [Trigger.DISARM, Trigger.LEASE_LOST, Trigger.FAULT])
async def test_lease_ends_within_the_transition_from_armed(
    tmp_path: Path, trigger: Trigger
) -> None:
    """Not with the next look at it; its token is refused from that moment on."""
    async with ready_daemon(tmp_path) as (bench, era):
        leases, supervisor = bench.daemon._api._lease, bench.daemon._supervisor
        lease = await era.arm("me", lease_s=60)
        await era.status()
        assert leases.is_granted(lease.lease)
        supervisor.post(DaemonEvent(trigger, "a test"))
        assert supervisor.machine.state not in ENERGISED
        assert not leases.is_granted(lease.lease)
        assert await error_code(era.renew(lease.lease)) is ErrorCode.LEASE


async def test_arming_that_is_cancelled_leaves_nothing_armed_without_a_lease(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its lease ends with the transition to disarmed, before another client may arm."""
    async with ready_daemon(tmp_path) as (bench, era):
        api, controller, released = bench.daemon._api, bench.daemon._controller, asyncio.Event()
        arm = controller.arm

        async def slow() -> None:
            await released.wait()
            await arm()

        monkeypatch.setattr(controller, "arm", slow)
        client = SimpleNamespace(has_left=False)
        arming = asyncio.create_task(api._arm(client, ArmParams(owner="me", lease_s=60)))  # type: ignore[arg-type]
        await until_state(era, "SWITCHED_ON")
        arming.cancel()
        with pytest.raises(asyncio.CancelledError):
            await arming
        assert bench.daemon._supervisor.machine.state not in ENERGISED
        assert api._lease.expires_at is None
        released.set()
        await until_state(era, "READY_TO_SWITCH_ON")


def test_lease_lasts_its_duration_from_each_renewal() -> None:
    """5 s from the grant and 5 s from the renewal, but not from an attempt after its end."""
    leases = LeaseHolder()
    lease = leases.grant("me", duration=5, now=100)
    assert leases.current(104.999) == lease
    assert leases.renew(lease.token, now=104).expires_at == 109
    assert leases.current(108.999) is not None
    assert leases.current(109) is None
    with pytest.raises(RpcError) as caught:
        leases.renew(lease.token, now=109)
    assert caught.value.code is ErrorCode.LEASE


def test_lease_is_granted_to_one_owner_at_a_time() -> None:
    """A refusal names the owner and the time left, not the token."""
    leases = LeaseHolder()
    lease = leases.grant("me", duration=5, now=0)
    with pytest.raises(RpcError, match=r"'me'.*2\.0 s") as caught:
        leases.grant("you", duration=5, now=3)
    assert lease.token not in str(caught.value)
    assert leases.grant("you", duration=5, now=5).owner == "you"


@pytest.mark.parametrize("token", ["", "x", "ü" * 32])
def test_lease_is_renewed_by_its_token_only(token: str) -> None:
    """Any other token leaves its end as it is."""
    leases = LeaseHolder()
    leases.grant("me", duration=5, now=0)
    with pytest.raises(RpcError) as caught:
        leases.renew(token, now=1)
    assert caught.value.code is ErrorCode.LEASE
    assert leases.expires_at == 5


def test_lease_cannot_be_renewed_or_restarted_when_ended() -> None:
    """After a stop the old token is of no use."""
    leases = LeaseHolder()
    lease = leases.grant("me", duration=5, now=0)
    leases.end()
    assert (leases.current(1), leases.expires_at) == (None, None)
    for attempt in (leases.renew, leases.restart):
        with pytest.raises(RpcError) as caught:
            attempt(lease.token, now=1)
        assert caught.value.code is ErrorCode.LEASE


def test_lease_tokens_are_random() -> None:
    """128 bits each, no two alike."""
    leases = LeaseHolder()
    tokens = {leases.grant("me", duration=1, now=2 * n).token for n in range(100)}
    assert len(tokens) == 100
    assert all(len(bytes.fromhex(token)) == 16 for token in tokens)
