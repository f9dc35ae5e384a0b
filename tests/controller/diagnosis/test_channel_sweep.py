"""A sweep over channels when an amplifier does not play what was commanded."""

import asyncio
from dataclasses import replace

import numpy as np
import pytest

from controller.diagnosis.channel_sweep import ChannelSweep
from controller.diagnosis.sensors import Sensors
from controller_bench import make_bench
from drivers.amplifier import Amplifier
from drivers.errors import CommandRefused
from drivers.protocol.messages import Achieved, AmplifierState, Apply, Reply, Request
from virtual_loop import in_virtual_time


class Deaf(Sensors):
    """One sensor at a corner, which reads zero."""

    def __init__(self) -> None:
        self.names = ("P1",)
        self.points = np.zeros((1, 2))

    async def wait(self, seconds: float) -> None:
        """Of virtual time."""
        await asyncio.sleep(seconds)

    async def time(self) -> float:
        """The loop's."""
        return asyncio.get_running_loop().time()

    async def tone(self, frequency: float, *, since: float, until: float) -> "np.ndarray":
        """Nothing."""
        return np.zeros(1, dtype=complex)


@in_virtual_time
async def test_channel_sweep_ends_when_a_level_is_not_played() -> None:
    """Half the level would look like a dead channel; refused with both levels, then disarmed."""
    bench = make_bench()
    far_end = bench.far_end

    def warm(request: Request) -> Reply | None:
        if not isinstance(request, Apply):
            return None
        played = request.command_set.commands
        return Achieved(
            request.command_set.token,
            tuple(type(each)(each.channel, each.frequency, each.level / 2) for each in played),
        )

    far_end.answer = warm
    sweep = ChannelSweep(
        bench.rig, {"main": Amplifier(far_end)}, Deaf(), level=0.1, settle=0.1, listen=0.1
    )
    with pytest.raises(CommandRefused, match=r"main: .*channel 0 .*0\.1, got 0\.05; .*--level"):
        await sweep.run([110.0])
    assert far_end.state is not AmplifierState.OPERATION_ENABLED
    assert not far_end.is_open


@in_virtual_time
async def test_channel_sweep_of_an_amplifier_without_ramps_and_cross_fades() -> None:
    """Every tone comes after silence; nothing is refused."""
    bench = make_bench()
    far_end = bench.far_end
    far_end.amplifier.capabilities = replace(
        far_end.amplifier.capabilities, has_cross_fades=False, ramp_max=0.0
    )
    far_end.amplifier.restart(0.0)
    sweep = ChannelSweep(
        bench.rig, {"main": Amplifier(far_end)}, Deaf(), level=0.1, settle=0.1, listen=0.1
    )
    await sweep.run([110.0, 130.0])
    silences = [each.is_silent for each in far_end.sets()]
    assert silences[::2] == [True] * len(silences[::2])
    assert not any(silences[1:-1:2])
    assert {each.ramp for each in far_end.sets()} == {0.0}
