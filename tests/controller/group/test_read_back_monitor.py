"""Comparison of commanded and reported levels."""

import pytest

from controller.group.read_back_monitor import ReadBackMonitor
from drivers.command import CommandSet, DriveCommand
from drivers.errors import CommandRefused
from drivers.guard import Guard, GuardLimits, SafeCommandSet
from drivers.protocol.messages import Achieved, AmplifierState, Capabilities, Fault, Status

CAPABILITIES = Capabilities(2, 20.0, 600.0, 0.01, 1.0, 0.0001, 0.01, 1.0, 0.1, 2.0, 0)


def tone(*, ramp: float = 0.0, valid_for: float = 0.0) -> SafeCommandSet:
    """Channel 0 at half of full stroke."""
    wanted = CommandSet(1, (DriveCommand(0, 110.0, 0.5),), ramp=ramp, valid_for=valid_for)
    return Guard(GuardLimits(20.0, 600.0, 1.0), CAPABILITIES).check(wanted)


def reported(*levels: float) -> Status:
    """An enabled amplifier with these levels."""
    return Status(AmplifierState.OPERATION_ENABLED, Fault.NONE, 1, True, 25.0, 0.25, levels)


def expecting(safe: SafeCommandSet) -> ReadBackMonitor:
    """Played at 10 s, as asked."""
    read_backs = ReadBackMonitor()
    read_backs.expect({"main": safe}, {"main": Achieved(1, safe.commands)}, now=10.0)
    return read_backs


def test_check_refuses_a_level_that_differs_for_100_ms() -> None:
    """With both levels in the message; during a ramp, or as commanded, none is refused."""
    read_backs = expecting(tone(ramp=0.02))
    read_backs.check("main", reported(0.1, 0.0), now=10.01)  # it fades
    for moment in (10.05, 10.10):
        read_backs.check("main", reported(0.25, 0.0), now=moment)
    with pytest.raises(CommandRefused, match=r"main: .*0\.50, 0\.00, got 0\.25, 0\.00.*clear"):
        read_backs.check("main", reported(0.25, 0.0), now=10.151)
    for moment in (10.0, 11.0, 12.0):
        expecting(tone()).check("main", reported(0.5, 0.0), now=moment)


def test_check_expects_nothing_of_ending_or_forgotten_sets() -> None:
    """Sets that end by themselves may be over at any heartbeat."""
    ends, forgotten = expecting(tone(valid_for=1.0)), expecting(tone())
    forgotten.forget()
    for read_backs in (ends, forgotten):
        for moment in (10.0, 10.2, 10.4):
            read_backs.check("main", reported(0.0, 0.0), now=moment)
