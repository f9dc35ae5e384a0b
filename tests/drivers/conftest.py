"""Fixtures of the driver tests: a scripted far end, a guard, guarded sets."""

from collections.abc import AsyncIterator, Callable

import pytest

from drivers.command import CommandSet, DriveCommand
from drivers.guard import Guard, GuardLimits, SafeCommandSet
from scripted_amplifier import FarEnd
from vendor_pages import CAPABILITIES


@pytest.fixture
async def far_end() -> AsyncIterator[FarEnd]:
    """A scripted amplifier on a pty, well-behaved by default."""
    end = FarEnd()
    yield end
    end.close()


@pytest.fixture
def guard() -> Guard:
    """Limits of 40 to 500 Hz and level 0.8 for four channels."""
    return Guard(GuardLimits(40.0, 500.0, 0.8), CAPABILITIES)


@pytest.fixture
def safe(guard: Guard) -> Callable[..., SafeCommandSet]:
    """A guarded set of one channel under a token."""

    def make(token: int, level: float = 0.2) -> SafeCommandSet:
        command = DriveCommand(channel=0, frequency=110.0, level=level)
        return guard.check(CommandSet(token=token, commands=(command,), ramp=0.01, valid_for=0.0))

    return make
