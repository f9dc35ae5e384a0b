"""Envelopes from the table to the amplifier, in virtual time."""

import asyncio
import logging
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import pytest

from controller.loop.intent import HapticIntent, Target
from controller.sources.contacts import Contact
from controller_bench import FINGER, OTHER, make_bench, running
from drivers.protocol.messages import AmplifierState, Apply, LoadEnvelope
from model.table.pattern import Pattern
from model.table.question import Question
from model.vibration.excitation import Tone
from shaped_link import Link, Shapes
from virtual_loop import in_virtual_time

ONSET = 0.105  # s; 21 steps
FULL = 0.2  # the level that the table's pattern has


@pytest.fixture
def link() -> Link:
    """The amplifier."""
    return Link()


@pytest.fixture
def shapes() -> Shapes:
    """A timing whose envelopes are straight lines."""
    return Shapes()


def sets(link: Link) -> list[Any]:
    """Every set that was applied since the silence that follows arming."""
    return [apply.command_set for apply in link.requests(Apply)][1:]


def loaded(link: Link) -> list[Any]:
    """Every envelope that was loaded."""
    return [load.envelope for load in link.requests(LoadEnvelope)]


@in_virtual_time
async def test_touch_starts_along_its_onset(link: Link, shapes: Shapes) -> None:
    """Knots of the driven ERA in strokes; the last one is the level of the command.

    By hand: lines from 0 to level 0.2 at 90 degrees, 105 ms long.
    """
    async with running(far_ends=[link], timing=shapes) as bench:
        begin = asyncio.get_running_loop().time()
        bench.touch(FINGER, OTHER)
        await asyncio.sleep(ONSET / 2)
        (onset,) = loaded(link)
        assert onset.step == 0.005
        assert [knot.level for knot in onset.knots] == pytest.approx(
            [FULL * number / 21 for number in range(1, 21)],
            abs=0.5e-4,  # the wire has steps of 1e-4
        )
        assert {knot.phase for knot in onset.knots} == {90.0}
        (played,) = sets(link)
        assert [(each.onset, each.level) for each in played.commands] == [
            (onset.slot, pytest.approx(FULL)),
            (0, 0.0),
        ]
        assert link.levels()[0] == pytest.approx(FULL / 2, abs=1e-4)
        (applied,) = bench.reports.applied
        assert applied.pattern.onset is not None
        assert (applied.time, applied.from_rest) == (pytest.approx(begin), True)
        assert applied.transient_contrast_db == 30.0


@in_virtual_time
async def test_endings_are_loaded_once_the_onset_is_over(link: Link, shapes: Shapes) -> None:
    """The same tone continues undisturbed, now with an ending; no pattern is reported again."""
    async with running(far_ends=[link], timing=shapes) as bench:
        await bench.hold(FINGER, OTHER, seconds=0.1)
        assert len(loaded(link)) == 1
        seen = []
        for _ in range(40):
            bench.touch(FINGER, OTHER)
            await asyncio.sleep(0.002)
            seen.append(link.levels()[0])
        onset, ending = loaded(link)
        assert ending.slot != onset.slot
        loadings = [t for t, each in link.asked if isinstance(each, LoadEnvelope)]
        assert loadings[1] - loadings[0] == pytest.approx(ONSET)
        assert [knot.level for knot in ending.knots] == pytest.approx(
            [FULL * (1 - number / 8) for number in range(1, 8)]
        )
        first, again = sets(link)
        (tone,) = [each for each in again.commands if each.level]
        assert (tone.ending, tone.onset, tone.keep_phase) == (ending.slot, 0, True)
        assert tone.phase == first.commands[0].phase
        assert seen[-30:] == pytest.approx([FULL] * 30, abs=1e-4)
        assert len(bench.reports.applied) == 1


@in_virtual_time
async def test_ending_is_computed_once_when_there_is_none(link: Link, shapes: Shapes) -> None:
    """Not again at each turn of the loop."""
    computed = 0

    def look(question: Question, pattern: Pattern, *, onset: bool, ending: bool) -> Pattern:
        nonlocal computed
        computed += ending
        return find(question, pattern, onset=onset, ending=False)

    async with running(far_ends=[link], timing=shapes) as bench:
        find, shapes.with_envelopes = shapes.with_envelopes, look  # type: ignore[method-assign]
        await bench.hold(FINGER, OTHER, seconds=0.4)
        assert computed == 1
        assert len(sets(link)) == 1


@in_virtual_time
async def test_lifted_target_fades_along_its_ending(link: Link, shapes: Shapes) -> None:
    """While another finger stays; reported as silence."""
    async with running(far_ends=[link], timing=shapes) as bench:
        await bench.hold(OTHER, FINGER, seconds=0.3)
        bench.touch(OTHER)
        await asyncio.sleep(0.020)
        assert link.levels()[0] == pytest.approx(FULL / 2, abs=1e-3)
        await asyncio.sleep(0.0205)
        assert link.levels() == (0.0, 0.0)
        assert bench.reports.silenced[-1].reason == "the target was lifted"
        bench.touch()
        await asyncio.sleep(0.001)
        assert [each.skip_ending for each in sets(link)[-1].commands] == [True, True]


@pytest.mark.parametrize("held", [0.05, 0.3])
@in_virtual_time
async def test_last_lift_skips_the_ending(link: Link, shapes: Shapes, held: float) -> None:
    """Zero at once and within 20 ms, whether the onset is over or not."""
    async with running(far_ends=[link], timing=shapes) as bench:
        await bench.hold(FINGER, seconds=held)
        bench.touch()
        await asyncio.sleep(0)
        await asyncio.sleep(0.020)
        assert link.levels() == (0.0, 0.0)


@in_virtual_time
async def test_last_lift_interrupts_an_ending(link: Link, shapes: Shapes) -> None:
    """The target lifts, 5 ms later the other finger: silent 20 ms after that, not 35."""
    async with running(far_ends=[link], timing=shapes) as bench:
        await bench.hold(OTHER, FINGER, seconds=0.3)
        bench.touch(OTHER)
        await asyncio.sleep(0.005)
        assert link.levels()[0] > 0.15
        bench.touch()
        await asyncio.sleep(0.020)
        assert link.levels() == (0.0, 0.0)


@in_virtual_time
async def test_lift_before_the_onset_is_over_skips_the_ending(link: Link, shapes: Shapes) -> None:
    """An ending leads from the full level; lifted half way up the target fades along 20 ms."""
    async with running(far_ends=[link], timing=shapes) as bench:
        await bench.hold(OTHER, FINGER, seconds=0.05)
        bench.touch(OTHER)
        highest = 0.0
        for _ in range(21):
            highest = max(highest, link.levels()[0])
            await asyncio.sleep(0.001)
        assert highest <= FULL / 2 + 1e-3
        assert link.levels() == (0.0, 0.0)
        assert len(loaded(link)) == 1


@in_virtual_time
async def test_silence_does_not_wait_for_envelopes(link: Link, shapes: Shapes) -> None:
    """The finger lifts while its onset is loaded slowly: zero is on the wire within 20 ms."""
    link.delay = lambda request: 0.020 if isinstance(request, LoadEnvelope) else 0.0
    async with running(far_ends=[link], timing=shapes) as bench:
        bench.touch(FINGER)
        await asyncio.sleep(0.005)
        lifted = asyncio.get_running_loop().time()
        bench.touch()
        await asyncio.sleep(0.1)
        (silent,) = sets(link)
        assert silent.is_silent
        _, sent = [time for time, request in link.asked if isinstance(request, Apply)]
        assert sent - lifted < 0.020
        assert link.amplifier.state is AmplifierState.OPERATION_ENABLED


@in_virtual_time
async def test_continued_tone_has_no_onset(link: Link, shapes: Shapes) -> None:
    """A finger that slides feels the same frequency without a gap; its ending is loaded again."""
    async with running(far_ends=[link], timing=shapes) as bench:
        await bench.hold(FINGER, OTHER, seconds=0.2)
        await bench.hold((1, 0.6, 0.5), OTHER, seconds=0.2)
        lengths = [len(envelope.knots) for envelope in loaded(link)]
        assert lengths == [20, 7, 7]
        assert [command_set.commands[0].keep_phase for command_set in sets(link)] == [
            *(False, True),
            *(True, True),
        ]
        _, moved = bench.reports.applied
        assert moved.pattern.onset is None
        assert moved.transient_contrast_db is None


@in_virtual_time
async def test_ending_belongs_to_its_own_pattern(link: Link, shapes: Shapes) -> None:
    """Lifted right after it moved: what plays now has no ending yet, and fades."""
    async with running(far_ends=[link], timing=shapes) as bench:
        await bench.hold(OTHER, FINGER, seconds=0.2)
        bench.touch(OTHER, (1, 0.6, 0.5))
        await asyncio.sleep(0.005)
        bench.touch(OTHER)
        await asyncio.sleep(0.005)
        assert sets(link)[-1].is_silent
        assert [each.skip_ending for each in sets(link)[-1].commands] == [True, True]


class Always:
    """An intent source for which every contact is a target."""

    def intent(self, contacts: Sequence[Contact], now: float) -> HapticIntent:
        """Return an intent with all contacts."""
        return HapticIntent(tuple(Target(each.key, 20.0) for each in contacts))


@in_virtual_time
async def test_disarm_ends_loading_and_playing(link: Link, shapes: Shapes) -> None:
    """Nothing is loaded or played after a disarm during the first of two onsets."""
    link.delay = lambda request: 0.005 if isinstance(request, LoadEnvelope) else 0.0
    async with running(far_ends=[link], timing=shapes) as bench:
        bench.table.excitation = {"SW": Tone(110.0, 2e-5), "NE": Tone(110.0, 4e-5)}
        bench.touch(FINGER)
        await asyncio.sleep(0.002)
        await bench.controller.disarm()
        await asyncio.sleep(0.05)
        assert len(loaded(link)) == 1
        assert sets(link) == []


def without_envelopes(link: Link) -> None:
    """Let the amplifier play no envelopes."""
    capabilities = link.amplifier.capabilities
    link.amplifier.capabilities = replace(capabilities, envelope_knots=0, envelope_slots=0)


def with_few_knots(link: Link) -> None:
    """An amplifier whose envelopes are one knot too short."""
    link.amplifier.capabilities = replace(link.amplifier.capabilities, envelope_knots=6)


def on_a_slow_wire(link: Link) -> None:
    """Two ERAs on one wire: 32 ms, and a touch may wait for 30."""
    link.loading = 0.016


@pytest.mark.parametrize("poorer", [without_envelopes, with_few_knots, on_a_slow_wire])
@in_virtual_time
async def test_ramps_replace_envelopes_when_amplifiers_cannot_play_them(
    link: Link, shapes: Shapes, poorer: Callable[[Link], None]
) -> None:
    """None is loaded; ramp and its contrast are reported."""
    poorer(link)
    async with running(far_ends=[link], timing=shapes) as bench:
        assert not bench.controller.capabilities.envelope_support
        await bench.hold(FINGER, OTHER, seconds=0.3)
        assert loaded(link) == []
        (applied,) = bench.reports.applied
        assert applied.pattern.onset is None
        assert applied.pattern.ramp == sets(link)[0].ramp == 0.015
        assert applied.transient_contrast_db == 10.0


@in_virtual_time
async def test_ramps_replace_envelopes_when_loading_is_slow(
    link: Link, shapes: Shapes, caplog: pytest.LogCaptureFixture
) -> None:
    """After three slow loadings in a row, for 30 s."""
    slow = 0.0
    link.delay = lambda request: slow if isinstance(request, LoadEnvelope) else 0.0
    caplog.set_level(logging.WARNING)
    async with running(far_ends=[link], timing=shapes, max_loading_time=0.020) as bench:

        async def is_shaped(duration: float) -> bool:
            nonlocal slow
            slow = duration
            await bench.hold(FINGER, seconds=0.1)
            await bench.hold(seconds=0.05)
            return bench.reports.applied[-1].pattern.onset is not None

        shaped = []
        for duration in (0.021, 0.021, 0.001, 0.021, 0.021):
            shaped.append(await is_shaped(duration))
            assert bench.controller.ramp_only_reason is None
        for duration in (0.021, 0.001):
            shaped.append(await is_shaped(duration))
        assert shaped == [True] * 6 + [False]
        assert "30 s" in bench.controller.ramp_only_reason
        await asyncio.sleep(30)
        assert bench.controller.ramp_only_reason is None
        assert await is_shaped(0.001)
    assert "loading envelopes took 21 ms" in caplog.text


@in_virtual_time
async def test_touch_does_not_wait_for_an_onset_that_loads_too_slowly(
    link: Link, shapes: Shapes
) -> None:
    """Of two envelopes of 8 ms each the second would be late: it plays a plain ramp after 8 ms."""
    link.delay = lambda request: 0.008 if isinstance(request, LoadEnvelope) else 0.0
    async with running(far_ends=[link], timing=shapes) as bench:
        bench.table.excitation = {"SW": Tone(110.0, 2e-5), "NE": Tone(110.0, 4e-5)}
        begin = asyncio.get_running_loop().time()
        bench.touch(FINGER, OTHER)
        await asyncio.sleep(0.020)
        assert len(loaded(link)) == 1
        (played,) = sets(link)
        assert [command.onset for command in played.commands] == [0, 0]
        (applied,) = bench.reports.applied
        assert applied.pattern.onset is None
        assert applied.time - begin == pytest.approx(0.008)


@in_virtual_time
async def test_pattern_plays_on_when_its_endings_load_too_slowly(
    link: Link, shapes: Shapes
) -> None:
    """For as long as the finger rests; the next pattern replaces it and starts from there."""
    async with running(far_ends=[link], timing=shapes) as bench:
        bench.table.excitation = {"SW": Tone(110.0, 2e-5), "NE": Tone(110.0, 4e-5)}
        await bench.hold(FINGER, OTHER, seconds=0.1)
        link.delay = lambda request: 0.008 if isinstance(request, LoadEnvelope) else 0.0
        await bench.hold(FINGER, OTHER, seconds=10.0)
        assert len(loaded(link)) == 3  # two onsets, and one ending of two
        assert link.levels() == pytest.approx((0.2, 0.4), abs=1e-3)
        await bench.hold((1, 0.6, 0.5), OTHER, seconds=0.05)
        assert [applied.from_rest for applied in bench.reports.applied] == [True, False]
        assert [command.keep_phase for command in sets(link)[-1].commands] == [True, True]


@in_virtual_time
async def test_ramp_replaces_an_onset_that_the_guard_refuses(link: Link, shapes: Shapes) -> None:
    """A knot beyond full stroke is not sent; the pattern is played."""
    shapes.largest = 6.0
    async with running(far_ends=[link], timing=shapes) as bench:
        await bench.hold(FINGER, OTHER, seconds=0.05)
        assert [len(envelope.knots) for envelope in loaded(link)] == [7]  # its ending
        (applied,) = bench.reports.applied
        assert applied.pattern.onset is None
        assert applied.transient_contrast_db == 10.0
        assert bench.reports.refused == []


@in_virtual_time
async def test_open_prepares_table_and_envelopes(link: Link, shapes: Shapes) -> None:
    """Mode and frequencies, when the controller is opened."""
    bench = make_bench(far_ends=[link], timing=shapes)
    await bench.controller.open()
    assert bench.table.prepared == ["phased"]
    assert shapes.prepared == [110.0, 250.0]
    await bench.controller.close()


@in_virtual_time
async def test_amplifiers_start_onsets_together(shapes: Shapes) -> None:
    """Each has the envelope of its ERA before any commits."""
    links = [Link(), Link()]
    for link in links:
        link.delay = lambda request: 0.002
    async with running("left", "right", far_ends=links, timing=shapes) as bench:
        bench.table.excitation = {"SW": Tone(110.0, 2e-5), "NE": Tone(110.0, 4e-5)}
        bench.touch(FINGER)
        await asyncio.sleep(0.012 + ONSET / 2)
        for link, channel, level in ((links[0], 0, 0.2), (links[1], 1, 0.4)):
            (onset,) = loaded(link)
            assert onset.slot == 1
            assert link.levels()[channel] == pytest.approx(level / 2, rel=0.1)


@in_virtual_time
async def test_failing_intent_source_silences_until_it_recovers(
    link: Link, shapes: Shapes, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Along the ramp, without endings; heartbeats continue, and touches are felt again later."""
    async with running(far_ends=[link], timing=shapes, intent_source=Always()) as bench:
        await bench.hold(FINGER, seconds=0.2)
        assert link.levels()[0] > 0
        with monkeypatch.context() as patch:
            patch.setattr(Always, "intent", lambda self, contacts, now: 1 / 0)
            await bench.hold(FINGER, OTHER, seconds=0.3)
        assert [each.skip_ending for each in sets(link)[-1].commands] == [True, True]
        assert link.levels() == (0.0, 0.0)
        assert bench.reports.silenced[-1].reason.startswith("ZeroDivisionError")
        assert link.amplifier.state is AmplifierState.OPERATION_ENABLED
        await bench.hold((3, 0.2, 0.2), seconds=0.2)
        assert link.levels()[0] > 0
