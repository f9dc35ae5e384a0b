"""The base of laboratory instruments: stops that are lost."""

import asyncio
from collections.abc import Sequence
from dataclasses import replace

from drivers import clock
from drivers.amplifier import Amplifier
from drivers.backends.foreign_amplifier import ForeignAmplifier
from drivers.command import DriveCommand
from drivers.operation.silence import stop_and_confirm
from drivers.protocol.messages import Capabilities, Feature, Identity
from vendor_pages import CAPABILITIES
from virtual_loop import in_virtual_time


class Instrument(ForeignAmplifier):
    """An instrument of one channel; lost: how many of the next OFF lines do not arrive."""

    def __init__(self) -> None:
        super().__init__()
        self.level = 0.0
        self.off_lines = self.lost = 0

    async def open(self) -> None:
        """There is no wire."""

    async def close(self) -> None:
        """There is no wire."""

    async def identify(self) -> Identity:
        return Identity("Test", "Instrument", "1", "1", versions=(2,))

    def capabilities(self) -> Capabilities:
        return replace(CAPABILITIES, channels=1, channel_limits=(), features=Feature.PHASE)

    async def prepare(self) -> None:
        self.level = 0.0

    async def play(self, commands: Sequence[DriveCommand]) -> Sequence[DriveCommand]:
        self.level = max((one.level for one in commands), default=0.0)
        return commands

    async def silence(self) -> None:
        self._last_sent_at = clock.now()
        self.off_lines += 1
        if self.off_lines <= self.lost:
            await asyncio.Event().wait()  # for a reply that never comes
        self.level = 0.0

    async def levels(self) -> Sequence[float]:
        return (self.level,)


@in_virtual_time
async def test_lost_stop_is_repeated_within_one_confirmation() -> None:
    """The first two OFF lines are lost; the third one silences, and is confirmed."""
    instrument = Instrument()
    amplifier = Amplifier(instrument)
    await amplifier.open()
    instrument.level, instrument.off_lines, instrument.lost = 0.5, 0, 2
    outcome = await stop_and_confirm(amplifier)
    assert instrument.off_lines == 3
    assert instrument.level == 0.0
    assert outcome.is_confirmed
