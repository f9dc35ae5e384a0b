"""Arming and clearing when the reply is lost: the repeated request does what the first did."""

from unittest.mock import Mock

import pytest

from drivers import clock
from drivers.amplifier import Amplifier
from drivers.errors import CommandRefused, LinkTimeout
from drivers.protocol.messages import AmplifierState, Arm, Clear, GetSensors, Request, Stop
from lossy_backend import Fate, LossyBackend
from sim.amplifier.amplifier import SimulatedAmplifier
from virtual_loop import in_virtual_time


def loses_first_reply(backend: LossyBackend, kind: type[Request]) -> None:
    """Lose the reply to the first request of a kind from now on."""
    begin = len(backend.sent)
    backend.fate = lambda request: (
        Fate.REPLY_LOST
        if isinstance(request, kind) and kind not in map(type, backend.sent[begin:-1])
        else Fate.DELIVERED
    )


async def opened() -> tuple[Amplifier, LossyBackend]:
    """An amplifier that is open and disarmed."""
    backend = LossyBackend(SimulatedAmplifier("main", channels=4))
    amplifier = Amplifier(backend)
    await amplifier.open()
    return amplifier, backend


@in_virtual_time
async def test_repeated_arm_is_of_the_same_session() -> None:
    """So it is granted, and a heartbeat of it as well."""
    amplifier, backend = await opened()
    loses_first_reply(backend, Arm)
    assert (await amplifier.arm()).state is AmplifierState.OPERATION_ENABLED
    sessions = [request.session for request in backend.sent if isinstance(request, Arm)]
    assert sessions == [amplifier.session] * 2
    assert (await amplifier.heartbeat()).watchdog_left == pytest.approx(0.25)


@in_virtual_time
async def test_repeated_clear_does_not_acknowledge_a_newer_stop() -> None:
    """By another host, between the two."""
    amplifier, backend = await opened()
    await amplifier.stop(0.0)
    loses_first_reply(backend, Clear)
    fate = backend.fate

    def stop_between(request: Request) -> Fate:
        if len([one for one in backend.sent if isinstance(one, Clear)]) == 2:
            backend.amplifier.handle(Stop(0.0), clock.now())
            backend.fate = lambda _: Fate.DELIVERED
        return fate(request)

    backend.fate = stop_between
    with pytest.raises(CommandRefused, match="newer stop"):
        await amplifier.clear()
    assert backend.amplifier.state is AmplifierState.QUICK_STOP_ACTIVE
    assert backend.amplifier.latch == 2


@in_virtual_time
async def test_second_arming_is_refused_and_keeps_the_first() -> None:
    """The heartbeat still has the session that is held."""
    amplifier, _ = await opened()
    await amplifier.arm()
    held = amplifier.session
    with pytest.raises(CommandRefused, match="another host"):
        await amplifier.arm()
    assert amplifier.session == held
    assert (await amplifier.heartbeat()).state is AmplifierState.OPERATION_ENABLED


@in_virtual_time
async def test_unanswered_reading_loses_no_link() -> None:
    """An amplifier that states sensors and never tells of them is tried thrice, then played on."""
    backend = LossyBackend(SimulatedAmplifier("main", channels=4))
    backend.amplifier.attach(Mock())
    amplifier = Amplifier(backend)
    await amplifier.open()
    await amplifier.arm()
    backend.fate = lambda request: (
        Fate.REQUEST_LOST if isinstance(request, GetSensors) else Fate.DELIVERED
    )
    for _ in range(2):
        with pytest.raises(LinkTimeout):
            await amplifier.sensors()
    assert [type(one) for one in backend.sent].count(GetSensors) == 6
    assert (await amplifier.heartbeat()).state is AmplifierState.OPERATION_ENABLED
