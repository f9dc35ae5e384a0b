"""Daemons killed at random moments over every wire: all channels are silent in time."""

import pytest

from kills import PLACES, kill_everywhere

pytestmark = pytest.mark.real_time

KILLS = 8  # `make kill-test` takes two hundred


async def test_channels_are_silent_in_time_when_daemon_is_killed() -> None:
    """At most 255 ms after the last sign of life by the amplifier's own clock, and for good.

    SIGKILL while starting, armed, playing or stopping; nothing arrives but what was on the wire,
    and the next daemon at the same amplifiers requires an acknowledgement, then plays.
    """
    kills = await kill_everywhere(KILLS, seed=4, serial=1 / 3)
    assert len(kills) == KILLS
    assert {kill.wire for kill in kills} == {name for name, _, _ in PLACES}
    assert not [kill for kill in kills if not kill.is_good]
    # The test is void unless many were energised, and some of them audibly.
    assert sum(kill.energised > 0 for kill in kills) >= KILLS // 3
    assert any(kill.level > 0 for kill in kills)
