"""The base of laboratory instruments: stops that are lost, and other programs that arm it."""

import asyncio
import json
from collections.abc import Sequence
from dataclasses import replace

import pytest

from drivers import amp_actions, clock
from drivers.amplifier import Amplifier
from drivers.backends.foreign_amplifier import ForeignAmplifier
from drivers.backends.host_lock import HostLock
from drivers.command import DriveCommand
from drivers.errors import LinkError
from drivers.operation.silence import SilenceStatus, stop_and_confirm
from drivers.protocol.messages import AmplifierState, Capabilities, Feature, Identity
from vendor_pages import CAPABILITIES
from virtual_loop import in_virtual_time


class Instrument(ForeignAmplifier):
    """An instrument of one channel; lost: how many of the next OFF lines do not arrive."""

    def __init__(self) -> None:
        super().__init__("instrument of a test")
        self.level = 0.0
        self.off_lines = self.lost = 0

    async def open(self) -> None:
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


@in_virtual_time
async def test_stop_is_not_confirmed_while_another_program_may_play() -> None:
    """Its outputs are off, but the program that has armed it may switch them on again."""
    instrument, other = Instrument(), HostLock("instrument of a test")
    amplifier = Amplifier(instrument)
    await amplifier.connect()
    other.acquire()
    instrument.level = 0.5
    outcome = await stop_and_confirm(amplifier)
    assert instrument.level == 0.0
    assert outcome.silence is SilenceStatus.MAY_PLAY
    assert "instrument of a test" in outcome.cause
    await amplifier.close()
    await amplifier.open(take_over=False)
    assert (await amplifier.status()).state is AmplifierState.OPERATION_ENABLED
    other.release()
    assert (await stop_and_confirm(amplifier)).is_confirmed


@in_virtual_time
async def test_one_program_arms_until_it_closes() -> None:
    """Another one is refused by its Arm, and by its taking over; the first stops it, confirmed."""
    first, second = Amplifier(Instrument()), Amplifier(Instrument())
    await first.open()
    await second.open()
    await first.arm()
    with pytest.raises(LinkError, match="instrument of a test"):
        await second.arm()
    await second.close()
    with pytest.raises(LinkError, match="instrument of a test"):
        await second.open()
    assert (await stop_and_confirm(first)).is_confirmed
    await first.clear()
    await first.arm()
    await first.close()
    await first.open(take_over=False)
    assert (await first.status()).state is AmplifierState.SWITCH_ON_DISABLED
    await first.close()
    await second.open()
    assert (await second.arm()).state is AmplifierState.OPERATION_ENABLED
    await second.close()


@in_virtual_time
async def test_temperature_that_is_not_measured_is_none(monkeypatch: pytest.MonkeyPatch) -> None:
    """No number is invented: NaN in a status, null as JSON."""
    monkeypatch.setattr(amp_actions, "open_backend", lambda url: Instrument())
    rows = await amp_actions.status("instrument://")
    assert rows["temperature_c"] is None
    assert json.loads(json.dumps(rows, allow_nan=False))["state"] == "SWITCH_ON_DISABLED"


@in_virtual_time
async def test_stop_by_command_names_the_program_that_may_play(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """`era amp stop` beside another program: outputs off, not confirmed, with its cause."""
    monkeypatch.setattr(amp_actions, "open_backend", lambda url: Instrument())
    other = HostLock("instrument of a test")
    other.acquire()
    rows = await amp_actions.stop("instrument://")
    other.release()
    assert rows["silence"] == "may_play"
    assert "instrument of a test" in rows["cause"]
