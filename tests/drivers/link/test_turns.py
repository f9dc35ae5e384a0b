"""Access to a link and to a line, between two iterations of the event loop."""

import asyncio

import pytest

from drivers.backends.line_turns import LineTurns
from drivers.errors import CommandRefused
from drivers.link.turns import RequestPriority, Turns
from drivers.protocol.messages import Disarm, Stop


async def settle() -> None:
    """Let every task run until it waits."""
    for _ in range(10):
        await asyncio.sleep(0)


class Users:
    """Users of a link, and the order of their access."""

    def __init__(self, turns: Turns) -> None:
        self.turns = turns
        self.order: list[str] = []
        self.ends: dict[str, asyncio.Event] = {}

    def take(
        self, name: str, priority: RequestPriority = RequestPriority.ORDINARY
    ) -> "asyncio.Task[None]":
        self.ends[name] = asyncio.Event()

        async def use() -> None:
            async with self.turns.take(priority):
                self.order.append(name)
                await self.ends[name].wait()

        return asyncio.create_task(use(), name=name)


@pytest.fixture
def users() -> Users:
    """Users of a link that is free."""
    return Users(Turns())


async def test_stop_class_outranks_a_request_that_was_granted_the_link(users: Users) -> None:
    """An ordinary request that has not run yet releases the link and is the next."""
    tasks = [users.take(name) for name in ("first", "second", "third")]
    await settle()
    users.ends["first"].set()
    tasks.append(
        users.take("stop", RequestPriority.SILENCE)
    )  # runs after the first and before the second
    await settle()
    for end in users.ends.values():
        end.set()
    await asyncio.gather(*tasks)
    assert users.order == ["first", "stop", "second", "third"]


async def test_stop_outranks_other_stop_class_requests(users: Users) -> None:
    """Queued silent sets and disarms follow it in their order."""
    tasks = [users.take("first")]
    await settle()
    tasks += [users.take(name, RequestPriority.SILENCE) for name in ("zero", "disarm")]
    await settle()
    tasks.append(users.take("stop", RequestPriority.STOP))
    await settle()
    for end in users.ends.values():
        end.set()
    await asyncio.gather(*tasks)
    assert users.order == ["first", "stop", "zero", "disarm"]


async def test_apply_that_was_granted_the_link_is_superseded() -> None:
    """By a disarm, before any of it was sent; other requests follow."""
    users = Users(Turns())
    first, apply = users.take("first"), users.take("apply", RequestPriority.APPLY)
    await settle()
    behind = users.take("behind")
    await settle()
    users.ends["first"].set()
    stop = users.take("stop", RequestPriority.SILENCE)
    await settle()
    for end in users.ends.values():
        end.set()
    await asyncio.gather(first, stop, behind)
    with pytest.raises(CommandRefused, match="superseded"):
        await apply
    assert users.order == ["first", "stop", "behind"]


async def test_released_reservation_wakes_the_next(users: Users) -> None:
    """Waiting and new requests follow a stop-class request that was cancelled."""
    users.turns.reserve("west", RequestPriority.SILENCE)
    early = users.take("early")
    await settle()
    assert users.order == []
    users.turns.release_reservation("west", RequestPriority.SILENCE)
    await settle()
    late = users.take("late")
    for end in users.ends.values():
        end.set()
    await asyncio.gather(early, late)
    assert users.order == ["early", "late"]


async def test_second_reservation_does_not_end_the_first() -> None:
    """Other amplifiers wait until both have ended."""
    line = LineTurns()
    said: list[str] = []

    async def say(what: str) -> None:
        said.append(what)

    with line.silencing(Stop(0.005), 1):
        with line.silencing(Stop(0.005), 1):
            other = asyncio.create_task(
                line.carry_out(RequestPriority.ORDINARY, lambda: say("other"), address=2)
            )
            await settle()
        await settle()
        await line.carry_out(RequestPriority.STOP, lambda: say("stop"), address=1)
    await other
    assert said == ["stop", "other"]


async def test_exchange_is_refused_while_its_amplifier_is_stopped() -> None:
    """The second of two transactions must not wait for the stop; other amplifiers wait."""
    line = LineTurns()
    said: list[str] = []

    async def say(what: str) -> None:
        said.append(what)

    with line.silencing(Disarm(0.05), 1):
        with pytest.raises(CommandRefused, match="superseded"):
            async with asyncio.timeout(5):
                await line.carry_out(RequestPriority.ORDINARY, lambda: say("own"), address=1)
        other = asyncio.create_task(
            line.carry_out(RequestPriority.ORDINARY, lambda: say("other"), address=2)
        )
        await settle()
        assert line.is_unsent(2)
        assert not line.is_unsent(1)
        await line.carry_out(RequestPriority.SILENCE, lambda: say("stop"), address=1)
    await other
    assert said == ["stop", "other"]
    assert not line.is_unsent(2)
