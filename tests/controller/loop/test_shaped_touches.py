"""Vibrations in virtual time: along envelopes, renewed while contacts are confirmed, of taps."""

import asyncio
import cmath
import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import pytest

from controller.effects.click import Click
from controller.effects.layout import SurfaceLayout
from controller.effects.player import EffectPlayer
from controller.loop.decision import ENDED
from controller.loop.intent import HapticIntent, Target
from controller.sources.contacts import Change, Contact, ContactTracker
from controller.sources.touch import Touch, TouchFrame
from controller_bench import ENABLED, FINGER, OTHER, Bench, Sent, make_bench, running
from drivers.protocol.sets import Envelope
from model.table.pattern import Pattern
from model.table.question import Question
from model.transients.base_motion import BaseEnvelope
from set_table import SetTiming
from virtual_loop import in_virtual_time


class Shapes(SetTiming):
    """A timing whose envelopes are straight lines: up in 21 knots, down in 8."""

    largest = 1.0

    def with_envelopes(
        self, question: Question, pattern: Pattern, *, onset: bool, ending: bool
    ) -> Pattern:
        """The lines, for the ERAs that play; the largest knot of an onset can be set."""
        up = [number / 21 * self.largest for number in range(1, 21)] + [1.0]
        down = [1 - number / 8 for number in range(1, 9)]
        return replace(
            pattern,
            onset=_along(pattern, 0.0, up) if onset else pattern.onset,
            ending=_along(pattern, 1.0, down) if ending else pattern.ending,
        )

    def with_transient_measures(self, question: Question, pattern: Pattern) -> Pattern:
        """30 dB with an onset, 10 without."""
        return replace(pattern, transient_contrast_db=30.0 if pattern.onset else 10.0)


def _along(pattern: Pattern, start: float, shares: Sequence[float]) -> dict[str, BaseEnvelope]:
    tones = {
        name: (tone.frequency, cmath.rect(tone.amplitude, tone.phase))
        for name, tone in pattern.excitation.items()
    }
    return {
        name: BaseEnvelope(frequency, start * full, tuple(share * full for share in shares))
        for name, (frequency, full) in tones.items()
    }


ONSET = 0.105  # s; 21 steps
FULL = 0.2  # the level that the table's pattern has


@pytest.fixture
def shapes() -> Shapes:
    """A timing whose envelopes are straight lines."""
    return Shapes()


def sets(bench: Bench) -> list[Sent]:
    """Every set since the silence that follows arming."""
    return bench.far_end.sets()[1:]


def level(bench: Bench, channel: int = 0) -> float:
    """What a channel plays now."""
    return bench.far_end.levels()[channel]


def levels_of(envelope: object) -> list[float]:
    """Levels of the knots of an envelope."""
    assert isinstance(envelope, Envelope)
    return [level / 10_000 for level, _ in envelope.knots]


@in_virtual_time
async def test_touch_starts_along_its_onset(shapes: Shapes) -> None:
    """Knots of the driven ERA in strokes; the last one is the level of the command.

    By hand: lines from 0 to level 0.2 at 90 degrees, 105 ms long, and down in 40 ms.
    """
    async with running(knots=32, timing=shapes) as bench:
        begin = asyncio.get_running_loop().time()
        await bench.touches(FINGER, OTHER, rest=ONSET / 2)
        (played,) = sets(bench)
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
        assert level(bench) == pytest.approx(FULL / 2, abs=1e-4)
        (applied,) = bench.reports.applied
        assert applied.pattern.onset is not None
        assert (applied.time, applied.from_rest) == (pytest.approx(begin), True)
        assert applied.transient_contrast_db == 30.0


@in_virtual_time
async def test_lifted_target_fades_along_its_ending(shapes: Shapes) -> None:
    """While another finger stays; reported as silence."""
    async with running(knots=32, timing=shapes) as bench:
        await bench.hold(OTHER, FINGER, seconds=0.3)
        await bench.touches(OTHER, rest=0.020)
        assert level(bench) == pytest.approx(FULL / 2, abs=1e-3)
        await asyncio.sleep(0.0205)
        assert bench.far_end.levels() == [0, 0]
        assert bench.reports.silenced[-1].reason == "the target was lifted"
        await bench.touches(rest=0.001)
        assert bench.far_end.names()[-1] == "Silence"


@pytest.mark.parametrize("held", [0.05, 0.3])
@in_virtual_time
async def test_last_lift_skips_the_ending(shapes: Shapes, held: float) -> None:
    """Zero at once and within 20 ms, whether the onset is over or not."""
    async with running(knots=32, timing=shapes) as bench:
        await bench.hold(FINGER, seconds=held)
        await bench.touches(rest=0)
        await asyncio.sleep(0.020)
        assert bench.far_end.levels() == [0, 0]


@in_virtual_time
async def test_lift_before_the_onset_is_over_skips_the_ending(shapes: Shapes) -> None:
    """An ending leads from the full level; lifted half way up the target fades along 20 ms."""
    async with running(knots=32, timing=shapes) as bench:
        await bench.hold(OTHER, FINGER, seconds=0.05)
        bench.touch(OTHER)
        highest = 0.0
        for _ in range(21):
            highest = max(highest, level(bench))
            await asyncio.sleep(0.001)
        assert highest <= FULL / 2 + 1e-3
        assert bench.far_end.levels() == [0, 0]


@in_virtual_time
async def test_continued_tone_has_no_onset(shapes: Shapes) -> None:
    """A finger that slides feels the same frequency without a gap, with an ending again."""
    async with running(knots=32, timing=shapes) as bench:
        await bench.hold(FINGER, OTHER, seconds=0.2)
        await bench.hold((1, 0.6, 0.5), OTHER, seconds=0.2)
        first, moved = (each.commands[0] for each in sets(bench))
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
    async with running(timing=shapes) as bench:
        await bench.hold(FINGER, OTHER, seconds=0.3)
        assert [each.onset for each in sets(bench)[0].commands] == [None, None]
        (applied,) = bench.reports.applied
        assert applied.pattern.onset is None
        assert applied.pattern.ramp == sets(bench)[0].ramp == 0.015
        assert applied.transient_contrast_db == 10.0


@in_virtual_time
async def test_ramp_replaces_an_onset_that_the_ledger_refuses(shapes: Shapes) -> None:
    """A knot beyond full stroke is not sent; the pattern is played."""
    shapes.largest = 6.0
    async with running(knots=32, timing=shapes) as bench:
        await bench.hold(FINGER, OTHER, seconds=0.05)
        (played,) = sets(bench)
        assert (played.commands[0].onset, played.commands[0].level) == (None, FULL)
        (applied,) = bench.reports.applied
        assert applied.pattern.onset is None
        assert applied.transient_contrast_db == 10.0
        assert bench.reports.refused == []


@in_virtual_time
async def test_open_prepares_table_and_envelopes(shapes: Shapes) -> None:
    """Mode and frequencies, when the controller is opened."""
    bench = make_bench(knots=32, timing=shapes)
    await bench.controller.open()
    assert bench.table.prepared == ["phased"]
    assert shapes.prepared == [90.0, 110.0, 150.0, 250.0]
    await bench.controller.close()


@in_virtual_time
async def test_failing_intent_source_silences_until_it_recovers(
    shapes: Shapes, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Along the ramp, without endings; heartbeats continue, and touches are felt again later."""
    async with running(knots=32, timing=shapes, intent_source=Always()) as bench:
        await bench.hold(FINGER, seconds=0.2)
        assert bench.far_end.levels()[0] > 0
        with monkeypatch.context() as patch:
            patch.setattr(Always, "intent", lambda self, contacts, now: 1 / 0)
            await bench.hold(FINGER, OTHER, seconds=0.3)
        assert sets(bench)[-1].token == 0  # a Silence
        assert bench.far_end.levels() == [0, 0]
        assert bench.reports.silenced[-1].reason.startswith("ZeroDivisionError")
        assert bench.far_end.state == ENABLED
        await bench.hold((3, 0.2, 0.2), seconds=0.2)
        assert bench.far_end.levels()[0] > 0


PROMISED = 0.001  # s; rounding of times


def vibrations(bench: Bench) -> list[tuple[float, Sent]]:
    """When each set that vibrates was sent [s], and the set."""
    return [(each.time, each) for each in bench.far_end.sets() if not each.is_silent]


def frame(*touches: Touch, timeout: float) -> TouchFrame:
    """A frame of a source that is silent while fingers rest."""
    return TouchFrame("panel", asyncio.get_running_loop().time(), touches, timeout)


@in_virtual_time
async def test_vibration_of_a_silent_sender_is_not_renewed() -> None:
    """It lasts as long as the contact does, and a little; any frame of the sender prolongs both."""
    async with running() as bench:
        begin = asyncio.get_running_loop().time()
        bench.controller.deliver(frame(Touch(*FINGER), timeout=3.0))
        await asyncio.sleep(2.5)
        ((sent, only),) = vibrations(bench)
        assert 3.0 <= sent - begin + only.valid_for <= 3.3
        bench.controller.deliver(frame(Touch(*FINGER), timeout=3.0))
        await asyncio.sleep(0.1)
        _, (again, renewed) = vibrations(bench)
        assert 5.5 <= again - begin + renewed.valid_for <= 5.8
        assert again < sent + only.valid_for
        await asyncio.sleep(5.0)
        assert len(vibrations(bench)) == 2
        assert bench.silences()[-1]


@in_virtual_time
async def test_vibration_ends_by_itself_if_a_contact_of_a_dead_panel_stays(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Were it never lifted, heartbeats alone would keep nothing playing."""
    async with running() as bench:
        never = property(lambda tracker: math.inf, lambda tracker, at: None)
        monkeypatch.setattr(ContactTracker, "next_expiry", never, raising=False)
        monkeypatch.setattr(ContactTracker, "expire", lambda tracker, now: Change())
        begin = asyncio.get_running_loop().time()
        await bench.touches(FINGER, rest=60.0)
        assert not bench.silences()[-1]
        ends = [time - begin + (each.valid_for or math.inf) for time, each in vibrations(bench)]
        assert max(ends) < 2.1


@in_virtual_time
async def test_renewal_keeps_to_a_rate_limit_of_one_set_a_second() -> None:
    """There is no gap although each second allows one set."""
    async with running(rate=1.0) as bench:
        await bench.hold(FINGER, seconds=10.0)
        sent = vibrations(bench)
        for (time, each), (following, _) in pairwise(sent):
            assert time + 1.0 - PROMISED <= following <= time + each.valid_for
        assert sent[-1][0] + sent[-1][1].valid_for >= asyncio.get_running_loop().time()
        assert bench.reports.refused == []


@pytest.mark.parametrize("on_time", [1.5, 2.5, 3.0, 5.5])
@in_virtual_time
async def test_renewal_keeps_to_the_on_time_limit(on_time: float) -> None:
    """The vibration ends by itself a little before, and does not begin again while fingers rest."""
    async with running(on_time=on_time) as bench:
        await bench.hold(FINGER, seconds=12.0)
        sent = vibrations(bench)
        begin, end = sent[0][0], max(time + each.valid_for for time, each in sent)
        assert 0.8 * on_time < end - begin <= on_time
        # Or it would be shown as if it played on.
        (silenced,) = [each for each in bench.reports.silenced if each.reason == ENDED]
        assert end <= silenced.time <= end + 0.06


AUDIBLE = 1e-3  # of full level


def _clicking() -> EffectPlayer:
    return EffectPlayer(SurfaceLayout(effects={"click": Click()}, elsewhere="click"))


async def _playing_times(bench: Bench, seconds: float) -> list[float]:
    """Times [s] from now on at which a channel plays, by the millisecond."""
    began = asyncio.get_running_loop().time()
    times = []
    while (now := asyncio.get_running_loop().time()) < began + seconds:
        if max(bench.far_end.levels()) > AUDIBLE:
            times.append(now - began)
        await asyncio.sleep(0.001)
    return times


@in_virtual_time
async def test_tap_within_one_iteration_is_felt_as_a_click() -> None:
    """Its 40 ms and a ramp are played, and silent is the plate 80 ms after the tap."""
    async with running(intent_source=_clicking()) as bench:
        bench.touch((1, 0.5, 0.5))
        bench.touch()
        times = await _playing_times(bench, 0.3)
        assert 0.035 <= times[-1] - times[0] <= 0.060
        assert times[-1] < 0.080


@in_virtual_time
async def test_vibration_is_renewed_while_its_contact_is_confirmed() -> None:
    """It lasts two seconds, and before its end its time begins anew, without any command.

    No other pattern is reported.
    """
    async with running() as bench:
        await bench.hold(FINGER, seconds=10.0)
        sent = vibrations(bench)
        (first, *later) = [each for _, each in sent]
        assert 9 <= len(later) <= 10
        assert {each.valid_for for _, each in sent} == {2.0}
        assert not first.renew
        for each in later:
            assert each.renew
            assert each.token not in (first.token, 0)
            assert each.commands == ()
        assert max(b - a for (a, _), (b, _) in pairwise(sent)) < 1.1
        assert len(bench.reports.applied) == 1
        await asyncio.sleep(0.2)
        assert bench.silences()[-1]
