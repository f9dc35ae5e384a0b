"""Amplifiers of protocol 3 by their URLs, on real pseudo-terminals."""

import asyncio

import pytest

from drivers.contents import Layer, Tone
from drivers.errors import CommandError, LinkError
from drivers.host.group import Group
from drivers.opening import Lines
from registry.limits import GuardLimits
from sim.amplifier.contract import Amplifier
from sim.far_ends.serial_amplifiers import SerialAmplifiers
from sim.transport.pseudo_terminal import make_terminal

LIMITS = GuardLimits(20.0, 1000.0, 1.0)


async def test_group_plays_over_a_pseudo_terminal_and_stops() -> None:
    """Two amplifiers on one line: 0.5 on both, silent after the stop; a lost line is told."""
    far = {address: Amplifier(str(address), channels=1) for address in (1, 2)}
    loop = asyncio.get_running_loop()
    terminal = make_terminal(lambda data: end.receive(data, loop.time()), unpluggable=False)
    end = SerialAmplifiers(far, terminal.write)
    terminal.listen()
    lines = Lines()
    amplifiers = {
        str(address): await lines.amplifier(
            f"serial://{terminal.port}?address={address}", LIMITS, name=str(address)
        )
        for address in far
    }
    group = Group(amplifiers)
    await group.open()
    await group.arm()
    layers = [Layer(0, (Tone(0, 100.0, 0.5),), 0.0)]
    await group.apply(dict.fromkeys(amplifiers, layers))
    assert [each.playback.level(0, loop.time()) for each in far.values()] == [0.5, 0.5]
    stopped = await group.stop()
    assert all(each.is_confirmed for each in stopped.values())
    terminal.close()
    with pytest.raises(LinkError):
        await amplifiers["1"].read_status()
    await lines.close()


@pytest.mark.parametrize(
    ("url", "error"),
    [
        ("serial:///dev/none-such?address=1", LinkError),
        ("serial:///dev/ttyS0?address=248", CommandError),
        ("serial://nonsense", CommandError),
    ],
)
async def test_line_that_cannot_be_opened_is_refused(url: str, error: type[Exception]) -> None:
    """No such port, an address that cannot be, no URL."""
    with pytest.raises(error):
        await Lines().amplifier(url, LIMITS, name="a")
