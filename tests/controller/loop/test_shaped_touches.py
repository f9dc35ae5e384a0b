"""Envelopes from the table to the amplifier, in virtual time."""

import asyncio
from collections.abc import Sequence

import pytest

from controller.loop.intent import HapticIntent, Target
from controller.sources.contacts import Contact
from controller_bench import ENABLED, FINGER, OTHER, FarEnd, Sent, make_bench, running
from drivers.protocol.sets import Envelope
from straight_shapes import Shapes
from virtual_loop import in_virtual_time

ONSET = 0.105  # s; 21 steps
FULL = 0.2  # the level that the table's pattern has


@pytest.fixture
def link() -> FarEnd:
    """The amplifier."""
    return FarEnd(knots=32)


@pytest.fixture
def shapes() -> Shapes:
    """A timing whose envelopes are straight lines."""
    return Shapes()


def sets(link: FarEnd) -> list[Sent]:
    """Every set since the silence that follows arming."""
    return link.sets()[1:]


def level(link: FarEnd, channel: int = 0) -> float:
    """What a channel plays now."""
    return link.levels[channel] / 10_000


def levels_of(envelope: object) -> list[float]:
    """Levels of the knots of an envelope."""
    assert isinstance(envelope, Envelope)
    return [level / 10_000 for level, _ in envelope.knots]


@in_virtual_time
async def test_touch_starts_along_its_onset(link: FarEnd, shapes: Shapes) -> None:
    """Knots of the driven ERA in strokes; the last one is the level of the command.

    By hand: lines from 0 to level 0.2 at 90 degrees, 105 ms long, and down in 40 ms.
    """
    async with running(far_ends=[link], timing=shapes) as bench:
        begin = asyncio.get_running_loop().time()
        bench.touch(FINGER, OTHER)
        await asyncio.sleep(ONSET / 2)
        (played,) = sets(link)
        driven, silent = played.commands
        assert (silent.onset, silent.ending, silent.level) == (None, None, 0.0)
        assert driven.level == pytest.approx(FULL)
        assert levels_of(driven.onset) == pytest.approx(
            [FULL * number / 21 for number in range(1, 21)],
            abs=0.5e-4,  # the wire has steps of 1e-4
        )
        assert levels_of(driven.ending) == pytest.approx(
            [FULL * (1 - number / 8) for number in range(1, 8)]
        )
        assert isinstance(driven.onset, Envelope)
        assert (driven.onset.step, {phase for _, phase in driven.onset.knots}) == (50, {9000})
        assert level(link) == pytest.approx(FULL / 2, abs=1e-4)
        (applied,) = bench.reports.applied
        assert applied.pattern.onset is not None
        assert (applied.time, applied.from_rest) == (pytest.approx(begin), True)
        assert applied.transient_contrast_db == 30.0


@in_virtual_time
async def test_lifted_target_fades_along_its_ending(link: FarEnd, shapes: Shapes) -> None:
    """While another finger stays; reported as silence."""
    async with running(far_ends=[link], timing=shapes) as bench:
        await bench.hold(OTHER, FINGER, seconds=0.3)
        bench.touch(OTHER)
        await asyncio.sleep(0.020)
        assert level(link) == pytest.approx(FULL / 2, abs=1e-3)
        await asyncio.sleep(0.0205)
        assert link.levels == (0, 0)
        assert bench.reports.silenced[-1].reason == "the target was lifted"
        bench.touch()
        await asyncio.sleep(0.001)
        assert link.names()[-1] == "Silence"


@pytest.mark.parametrize("held", [0.05, 0.3])
@in_virtual_time
async def test_last_lift_skips_the_ending(link: FarEnd, shapes: Shapes, held: float) -> None:
    """Zero at once and within 20 ms, whether the onset is over or not."""
    async with running(far_ends=[link], timing=shapes) as bench:
        await bench.hold(FINGER, seconds=held)
        bench.touch()
        await asyncio.sleep(0)
        await asyncio.sleep(0.020)
        assert link.levels == (0, 0)


@in_virtual_time
async def test_lift_before_the_onset_is_over_skips_the_ending(link: FarEnd, shapes: Shapes) -> None:
    """An ending leads from the full level; lifted half way up the target fades along 20 ms."""
    async with running(far_ends=[link], timing=shapes) as bench:
        await bench.hold(OTHER, FINGER, seconds=0.05)
        bench.touch(OTHER)
        highest = 0.0
        for _ in range(21):
            highest = max(highest, level(link))
            await asyncio.sleep(0.001)
        assert highest <= FULL / 2 + 1e-3
        assert link.levels == (0, 0)


@in_virtual_time
async def test_continued_tone_has_no_onset(link: FarEnd, shapes: Shapes) -> None:
    """A finger that slides feels the same frequency without a gap, with an ending again."""
    async with running(far_ends=[link], timing=shapes) as bench:
        await bench.hold(FINGER, OTHER, seconds=0.2)
        await bench.hold((1, 0.6, 0.5), OTHER, seconds=0.2)
        first, moved = (each.commands[0] for each in sets(link))
        assert (first.keep_phase, moved.keep_phase) == (False, True)
        assert moved.onset is None
        assert len(levels_of(moved.ending)) == 7
        _, reported = bench.reports.applied
        assert reported.pattern.onset is None
        assert reported.transient_contrast_db is None


class Always:
    """An intent source for which every contact is a target."""

    def intent(self, contacts: Sequence[Contact], now: float) -> HapticIntent:
        """Return an intent with all contacts."""
        return HapticIntent(tuple(Target(each.key, 20.0) for each in contacts))


@in_virtual_time
async def test_ramps_replace_envelopes_when_amplifiers_cannot_play_them(shapes: Shapes) -> None:
    """None is sent; ramp and its contrast are reported."""
    link = FarEnd()
    async with running(far_ends=[link], timing=shapes) as bench:
        await bench.hold(FINGER, OTHER, seconds=0.3)
        assert [each.onset for each in sets(link)[0].commands] == [None, None]
        (applied,) = bench.reports.applied
        assert applied.pattern.onset is None
        assert applied.pattern.ramp == sets(link)[0].ramp == 0.015
        assert applied.transient_contrast_db == 10.0


@in_virtual_time
async def test_ramp_replaces_an_onset_that_the_ledger_refuses(link: FarEnd, shapes: Shapes) -> None:
    """A knot beyond full stroke is not sent; the pattern is played."""
    shapes.largest = 6.0
    async with running(far_ends=[link], timing=shapes) as bench:
        await bench.hold(FINGER, OTHER, seconds=0.05)
        (played,) = sets(link)
        assert (played.commands[0].onset, played.commands[0].level) == (None, FULL)
        (applied,) = bench.reports.applied
        assert applied.pattern.onset is None
        assert applied.transient_contrast_db == 10.0
        assert bench.reports.refused == []


@in_virtual_time
async def test_open_prepares_table_and_envelopes(link: FarEnd, shapes: Shapes) -> None:
    """Mode and frequencies, when the controller is opened."""
    bench = make_bench(far_ends=[link], timing=shapes)
    await bench.controller.open()
    assert bench.table.prepared == ["phased"]
    assert shapes.prepared == [90.0, 110.0, 150.0, 250.0]
    await bench.controller.close()


@in_virtual_time
async def test_failing_intent_source_silences_until_it_recovers(
    link: FarEnd, shapes: Shapes, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Along the ramp, without endings; heartbeats continue, and touches are felt again later."""
    async with running(far_ends=[link], timing=shapes, intent_source=Always()) as bench:
        await bench.hold(FINGER, seconds=0.2)
        assert link.levels[0] > 0
        with monkeypatch.context() as patch:
            patch.setattr(Always, "intent", lambda self, contacts, now: 1 / 0)
            await bench.hold(FINGER, OTHER, seconds=0.3)
        assert sets(link)[-1].token == 0  # a Silence
        assert link.levels == (0, 0)
        assert bench.reports.silenced[-1].reason.startswith("ZeroDivisionError")
        assert link.state == ENABLED
        await bench.hold((3, 0.2, 0.2), seconds=0.2)
        assert link.levels[0] > 0
