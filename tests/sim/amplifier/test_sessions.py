"""Sessions and numbered stops of a simulated amplifier, against the words of the wire protocol."""

import pytest

from drivers.command import CommandSet, DriveCommand
from drivers.protocol.messages import (
    Achieved,
    AmplifierState,
    Apply,
    Arm,
    Clear,
    Commit,
    Disarm,
    Fault,
    GetStatus,
    Nak,
    NakCode,
    Ping,
    Request,
    Stage,
    Status,
    Stop,
)
from sim.amplifier.amplifier import SimulatedAmplifier

OWN, OTHER = 9, 10
ARMED = AmplifierState.OPERATION_ENABLED
STOPPED = AmplifierState.QUICK_STOP_ACTIVE


def playing(token: int) -> CommandSet:
    """A set with one loud channel."""
    return CommandSet(token, (DriveCommand(0, 110.0, 0.5),), ramp=0.0, valid_for=0.0)


@pytest.fixture
def amplifier() -> SimulatedAmplifier:
    """Armed by the session OWN at 0 s with a watchdog of 0.25 s, and playing token 1."""
    amplifier = SimulatedAmplifier("main", channels=4)
    assert isinstance(amplifier.handle(Arm(0.25, OWN), 0.0), Status)
    assert isinstance(amplifier.handle(Apply(playing(1), OWN), 0.0), Achieved)
    return amplifier


def status(amplifier: SimulatedAmplifier, now: float) -> Status:
    """Its status."""
    reply = amplifier.handle(GetStatus(), now)
    assert isinstance(reply, Status)
    return reply


@pytest.mark.parametrize(
    "foreign",
    [
        *(Ping(OTHER), Arm(2.0, OTHER), Commit(1, OTHER)),
        *(Stage(playing(2), OTHER), Apply(playing(2), OTHER)),
    ],
    ids=lambda request: type(request).__name__,
)
def test_foreign_session_neither_plays_nor_feeds(
    amplifier: SimulatedAmplifier, foreign: Request
) -> None:
    """It is refused; the watchdog trips 0.25 s after the last request of the own session."""
    assert amplifier.handle(foreign, 0.2) == Nak(NakCode.WRONG_SESSION)
    now = status(amplifier, 0.2)
    assert (now.token, now.levels[0], now.watchdog_left) == (1, 0.5, pytest.approx(0.05))
    assert status(amplifier, 0.26).fault is Fault.WATCHDOG


def test_same_arm_again_restarts_the_watchdog_only(amplifier: SimulatedAmplifier) -> None:
    """With its time; what plays goes on."""
    assert isinstance(amplifier.handle(Arm(1.0, OWN), 0.2), Status)
    now = status(amplifier, 0.3)
    assert (now.state, now.token, now.levels[0]) == (ARMED, 1, 0.5)
    assert now.watchdog_left == pytest.approx(0.9)


@pytest.mark.parametrize("ending", [Disarm(0.0), Stop(0.0), None], ids=["disarm", "stop", "fault"])
def test_session_that_has_ended_does_not_arm(
    amplifier: SimulatedAmplifier, ending: Request | None
) -> None:
    """However it ended; another number does."""
    if ending is not None:
        amplifier.handle(ending, 0.1)
    amplifier.handle(Clear(status(amplifier, 0.5).latch), 0.5)
    assert amplifier.handle(Arm(0.25, OWN), 0.6) == Nak(NakCode.WRONG_SESSION)
    assert status(amplifier, 0.6).state is AmplifierState.SWITCH_ON_DISABLED
    assert isinstance(amplifier.handle(Arm(0.25, OTHER), 0.7), Status)
    assert amplifier.handle(Ping(OWN), 0.8) == Nak(NakCode.WRONG_SESSION)


def test_anyone_stops_and_disarms(amplifier: SimulatedAmplifier) -> None:
    """A ping of any session is answered while disarmed."""
    amplifier.handle(Disarm(0.0), 0.1)
    assert status(amplifier, 0.1).state is AmplifierState.SWITCH_ON_DISABLED
    assert isinstance(amplifier.handle(Ping(OTHER), 0.2), Status)


def test_clear_of_an_earlier_stop_acknowledges_no_newer_one(amplifier: SimulatedAmplifier) -> None:
    """Neither of a stop nor of a fault; each has the next number, also if it is stopped already."""
    latches = []
    for moment in (0.1, 0.2):
        amplifier.handle(Stop(0.0), moment)
        latches.append(status(amplifier, moment).latch)
    assert latches == [1, 2]
    assert amplifier.handle(Clear(1), 0.3) == Nak(NakCode.WRONG_LATCH)
    assert status(amplifier, 0.3).state is STOPPED
    amplifier.handle(Clear(2), 0.4)
    amplifier.handle(Arm(0.25, OTHER), 0.5)
    amplifier.trip(Fault.ARC, 0.6)
    assert status(amplifier, 0.7).latch == 3
    assert amplifier.handle(Clear(2), 0.7) == Nak(NakCode.WRONG_LATCH)
    assert status(amplifier, 0.7).fault is Fault.ARC
    amplifier.handle(Clear(3), 0.8)
    assert status(amplifier, 0.8).fault is Fault.NONE


def test_latches_run_from_1_to_255() -> None:
    """0 is that of none since power-up; a Clear of any number is harmless where nothing is."""
    amplifier = SimulatedAmplifier("main", channels=4)
    assert status(amplifier, 0.0).latch == 0
    assert isinstance(amplifier.handle(Clear(77), 0.0), Status)
    for _ in range(255):
        amplifier.handle(Stop(0.0), 0.0)
    assert status(amplifier, 0.0).latch == 255
    amplifier.handle(Stop(0.0), 0.0)
    assert status(amplifier, 0.0).latch == 1
