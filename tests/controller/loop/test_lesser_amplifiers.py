"""A controller over amplifiers that lack something."""

import asyncio
from collections.abc import Sequence
from dataclasses import replace

import pytest

from controller.loop.intent import HapticIntent, Pulse, Target
from controller.sources.contacts import Contact
from controller_bench import FINGER, OTHER, FarEnd, armed, make_bench, running
from drivers import clock
from drivers.errors import CommandError
from drivers.operation.silence import SilenceStatus
from drivers.protocol.messages import (
    AmplifierState,
    Apply,
    Commit,
    Feature,
    GetStatus,
    Stage,
    Status,
    Stop,
)
from model.vibration.excitation import Tone
from virtual_loop import in_virtual_time

LASTS = 0.1  # s


class OnePulse:
    """Targets the first contact for a while."""

    def __init__(self) -> None:
        self.pulse: Pulse | None = None

    def intent(self, contacts: Sequence[Contact], now: float) -> HapticIntent:
        """One pulse, from the first touch."""
        if not contacts:
            return HapticIntent(())
        self.pulse = self.pulse or Pulse(LASTS, now, is_raised=False)
        if now >= self.pulse.end:
            return HapticIntent((), "over")
        target = Target(contacts[0].key, pulse=self.pulse)
        return HapticIntent((target,), until=self.pulse.end)


def without(feature: Feature, channels: int = 2) -> FarEnd:
    """An amplifier that lacks a feature."""
    far_end = FarEnd(channels)
    able = far_end.amplifier.capabilities
    far_end.amplifier.capabilities = replace(able, features=able.features & ~feature)
    far_end.amplifier.restart(0.0)
    return far_end


@in_virtual_time
async def test_host_ends_a_pulse_that_the_amplifier_does_not_end() -> None:
    """Its set is without end; the host silences it after its time and says how late."""
    far_ends = [without(Feature.VALID_FOR)]
    async with running(far_ends=far_ends, intent_source=OnePulse()) as bench:
        bench.touch(FINGER)
        await bench.hold(FINGER, seconds=2 * LASTS)
        playing, silent = bench.far_end.sets()[1:]
        sent = bench.far_end.times(Apply)[1:]
        assert (playing.valid_for, silent.is_silent) == (0.0, True)
        assert sent[1] - sent[0] == pytest.approx(LASTS, abs=0.002)
        silenced = bench.reports.silenced[-1]
        assert silenced.late == pytest.approx(sent[1] - sent[0] - LASTS, abs=1e-6)
        assert not any(bench.far_end.levels)


@in_virtual_time
async def test_amplifier_that_ends_a_pulse_is_not_late() -> None:
    """The set says for how long; nothing is measured."""
    async with running(intent_source=OnePulse()) as bench:
        bench.touch(FINGER)
        await bench.hold(FINGER, seconds=2 * LASTS)
        assert bench.far_end.sets()[1].valid_for == LASTS
        assert {silenced.late for silenced in bench.reports.silenced} == {None}


@in_virtual_time
async def test_amplifiers_without_staging_apply() -> None:
    """Two that cannot start together: one ERA at a time is asked of the table."""
    far_ends = [without(Feature.STAGING), FarEnd()]
    async with running("left", "right", far_ends=far_ends) as bench:
        await bench.hold(FINGER, seconds=0.1)
        for far_end in far_ends:
            assert not far_end.requests(Stage, Commit)
            assert far_end.sets()
        assert {(one.drive_mode, one.eras_at_most) for one in bench.table.asked} == {
            ("switched", 1)
        }


async def test_amplifier_without_watchdog_is_refused() -> None:
    """It stays disarmed, and is closed."""
    far_end = without(Feature.WATCHDOG)
    bench = make_bench(far_ends=[far_end])
    with pytest.raises(CommandError, match="supervised"):
        await bench.controller.open()
    assert not far_end.is_open
    assert far_end.state is AmplifierState.SWITCH_ON_DISABLED


@in_virtual_time
async def test_supervised_amplifier_without_watchdog_plays_until_switched_off() -> None:
    """A stop without a confirming status is not a success, however long nothing was sent."""
    far_end = without(Feature.WATCHDOG)
    async with armed(far_ends=[far_end], is_supervised=True) as bench:
        assert far_end.state is AmplifierState.OPERATION_ENABLED
        confirmed = (await bench.controller.stop())["main"]
        assert confirmed.silence is SilenceStatus.CONFIRMED
        stopped = far_end.status()
        far_end.answer = lambda request: _playing_on(request, stopped)
        outcome = (await bench.controller.stop())["main"]
        assert (outcome.silence, outcome.may_play_until) == (SilenceStatus.MAY_PLAY, None)
        assert "switch it off" in outcome.cause
        far_end.answer = lambda request: None


def _playing_on(request: object, stopped: Status) -> Status | None:
    """The status of an amplifier that does not obey stops."""
    is_asked = isinstance(request, Stop | GetStatus)
    return replace(stopped, levels=(0.5, 0.0)) if is_asked else None


@in_virtual_time
async def test_amplifier_without_cross_fades_goes_out_then_in() -> None:
    """Another frequency comes after a silent set and its fade; nobody is told of a refusal."""
    far_end = FarEnd()
    far_end.amplifier.capabilities = replace(far_end.amplifier.capabilities, has_cross_fades=False)
    async with running(far_ends=[far_end]) as bench:
        bench.table.excitation = {"SW": Tone(110.0, 2e-5), "NE": Tone(110.0, 2e-5)}
        await bench.hold(FINGER, seconds=0.2)
        bench.table.excitation = {"SW": Tone(250.0, 2e-5), "NE": Tone(250.0, 2e-5)}
        bench.touch(FINGER, OTHER)
        sounding = []
        for _ in range(40):
            await asyncio.sleep(0.002)
            bench.far_end.status()
            sounding += [
                {tone.frequency for tone in output if tone.silent_from > clock.now()}
                for output in bench.far_end.amplifier.outputs
            ]
        assert {110.0} in sounding
        assert {250.0} in sounding
        assert max(map(len, sounding)) == 1
        assert [each.is_silent for each in bench.far_end.sets()[-3:]] == [False, True, False]
        assert bench.reports.refused == []
        assert bench.reports.applied[-1].pattern.excitation["SW"].frequency == 250.0
        begun = bench.far_end.times(Apply)
        assert begun[-1] - begun[-2] == pytest.approx(0.020, abs=0.005)
