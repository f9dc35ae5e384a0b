from itertools import islice

import pytest

from drivers.amplifier import Amplifier
from drivers.backends.serial_line.backend import SerialBackend
from drivers.errors import LinkError
from drivers.operation.supervision import assume_energised, pauses, reopen
from drivers.protocol.messages import Arm, Disarm
from scripted_amplifier import FarEnd


def test_pauses_grow_up_to_a_limit() -> None:
    """Each twice the one before: 0.1, 0.2, ... 5 s."""
    assert list(islice(pauses(), 8)) == pytest.approx([0.1, 0.2, 0.4, 0.8, 1.6, 3.2, 5.0, 5.0])


def test_a_lost_amplifier_may_still_play_until_its_watchdog_has_passed() -> None:
    """And a margin of 100 ms."""
    assert assume_energised(10.0, 10.3, watchdog=0.25)
    assert not assume_energised(10.0, 10.36, watchdog=0.25)


async def test_reopening_disarms_what_still_plays_and_arms_nothing(far_end: FarEnd) -> None:
    """An amplifier that was lost for less than its watchdog is armed still: it is disarmed."""
    amplifier = Amplifier(SerialBackend(far_end.url), reply_timeout=1.0)
    await amplifier.open()
    await amplifier.close()
    assert await reopen(amplifier) == 1
    kinds = [type(request) for request in far_end.requests]
    assert Arm not in kinds
    assert kinds[-1] is Disarm
    assert not amplifier.lost
    await amplifier.close()


async def test_reopening_goes_on_until_the_pauses_run_out() -> None:
    """Attempts that fail are told; the last error is raised."""
    failures: list[LinkError] = []
    amplifier = Amplifier(SerialBackend("serial:///dev/no-such-port"))
    with pytest.raises(LinkError, match="no such port"):
        await reopen(amplifier, waits=iter([0.0, 0.0]), on_failure=failures.append)
    assert len(failures) == 3
