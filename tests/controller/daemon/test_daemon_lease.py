"""The arming lease: duration, owner, token."""

import asyncio
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest

from controller.api.jsonrpc import ErrorCode, RpcError
from controller.api.methods import ArmParams
from controller.daemon.lease import Lease, check_lease
from controller.daemon.states import (
    ENERGISED,
    DaemonEvent,
    DaemonState,
    StateMachine,
    Trigger,
    step,
)
from controller.daemon.supervisor import Supervisor
from daemon_bench import ready_daemon, until_state


def expire(supervisor: Supervisor) -> None:
    """Let the lease have expired."""
    assert supervisor.machine.lease is not None
    lease = replace(supervisor.machine.lease, expires_at=0.0)
    supervisor.machine = replace(supervisor.machine, lease=lease)


async def test_client_that_arms_after_the_end_of_a_lease_inherits_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Between the end of a lease and its event: disarmed first, then armed anew."""
    async with ready_daemon(tmp_path) as (bench, era):
        supervisor = bench.daemon._supervisor
        monkeypatch.setattr(supervisor, "tick", lambda: None)  # its event comes later
        states: list[str] = []
        await era.arm("me", lease_s=60)
        expire(supervisor)
        monkeypatch.setattr(
            bench.daemon._publisher, "state_changed", lambda old, new: states.append(new.state.name)
        )
        async with await bench.client() as other:
            await other.arm("you", lease_s=60)
            assert (await other.status()).state == "OPERATION_ENABLED"
        assert "READY_TO_SWITCH_ON" in states


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
        assert bench.daemon._supervisor.machine.lease is None
        released.set()
        await until_state(era, "READY_TO_SWITCH_ON")


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


def test_lease_tokens_are_random() -> None:
    """128 bits each, no two alike."""
    tokens = {Lease("me", 1).token for _ in range(100)}
    assert len(tokens) == 100
    assert all(len(bytes.fromhex(token)) == 16 for token in tokens)


@pytest.mark.parametrize("state", DaemonState)
@pytest.mark.parametrize("trigger", Trigger)
def test_lease_exists_while_energised_alone(state: DaemonState, trigger: Trigger) -> None:
    """Whatever happens; and what may not go on afterwards is told by the epoch."""
    lease = Lease("me", 5, expires_at=10.0) if state in ENERGISED else None
    before = StateMachine(state, lease=lease, epoch=7)
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
