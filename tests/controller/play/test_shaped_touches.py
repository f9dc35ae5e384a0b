"""Vibrations in virtual time: along envelopes, renewed while contacts are confirmed, of taps."""

import asyncio
import cmath
import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import pytest

from chain import FINGER, OTHER, Chain, Sent, set_running
from controller.effects.kinds import Click
from controller.effects.layout import SurfaceLayout
from controller.effects.player import EffectPlayer
from controller.play.intent import HapticIntent, Target
from controller.play.planner import ENDED
from controller.sources.touch import Change, Contact, ContactTracker, Touch, TouchFrame
from drivers.protocol.definition import QUANTITIES
from drivers.protocol.sets import Envelope
from model.answer.answer import Layer
from model.answer.stimulus import Placement
from model.transients.base_motion import BaseEnvelope
from set_table import SetTiming
from virtual_lines import in_virtual_time


class Shapes(SetTiming):
    """A timing whose envelopes are straight lines: up in 21 knots, down in 8."""

    largest = 1.0

    def with_envelopes(
        self, pattern: Layer, placed: Placement, *, onset: bool, ending: bool
    ) -> Layer:
        """The lines, for the ERAs that play; the largest knot of an onset can be set."""
        up = [number / 21 * self.largest for number in range(1, 21)] + [1.0]
        down = [1 - number / 8 for number in range(1, 9)]
        return replace(
            pattern,
            onset=_along(pattern, 0.0, up) if onset else pattern.onset,
            ending=_along(pattern, 1.0, down) if ending else pattern.ending,
        )

    def transient_contrast_db(self, pattern: Layer, placed: Placement) -> float | None:
        """30 dB with an onset, 10 without."""
        return 30.0 if pattern.onset else 10.0


def _along(pattern: Layer, start: float, shares: Sequence[float]) -> dict[str, BaseEnvelope]:
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


def valid_for(one: Sent) -> float:
    """How long a set lasts without another [s], 0 for ever."""
    return QUANTITIES["valid_for"].from_wire(one.layer.valid_for)


@pytest.fixture
def shapes() -> Shapes:
    """A timing whose envelopes are straight lines."""
    return Shapes()


def sets(chain: Chain) -> list[Sent]:
    """Every set since the silence that follows arming."""
    return chain.far_end.sent()[1:]


def level(chain: Chain, channel: int = 0) -> float:
    """What a channel plays now."""
    return chain.far_end.levels[channel]


def levels_of(envelope: object) -> list[float]:
    """Levels of the knots of an envelope."""
    assert isinstance(envelope, Envelope)
    return [level / 10_000 for level, _ in envelope.knots]


@in_virtual_time
async def test_touch_starts_along_its_onset(shapes: Shapes) -> None:
    """Knots of the driven ERA in strokes; the last one is the level of the command.

    By hand: lines from 0 to level 0.2 at 90 degrees, 105 ms long. No touch waits for an ending.
    """
    async with set_running(knots=32, timing=shapes) as chain:
        begin = asyncio.get_running_loop().time()
        await chain.leave(ONSET / 2, FINGER, OTHER)
        (played,) = sets(chain)
        driven, *silent = played.layer.commands
        assert not any(each.onset or each.ending or each.level for each in silent)
        assert driven.level == 2000
        assert levels_of(driven.onset) == pytest.approx(
            [FULL * number / 21 for number in range(1, 21)],
            abs=0.5e-4,  # the wire has steps of 1e-4
        )
        assert driven.ending is None
        assert isinstance(driven.onset, Envelope)
        assert (driven.onset.step, {phase for _, phase in driven.onset.knots}) == (50, {9000})
        assert level(chain) == pytest.approx(FULL / 2, abs=1e-4)
        (applied,) = chain.applied
        assert applied.layer.onset is not None
        # It plays with its last byte: of 60 words and 12 bytes, of ten bits at 921 600 baud.
        assert applied.time - begin == pytest.approx(132 / 92_160, abs=1e-6)
        assert applied.from_rest
        assert applied.transient_contrast_db == 30.0


@in_virtual_time
async def test_ending_follows_and_changes_nothing_that_plays(shapes: Shapes) -> None:
    """Once the onset is over, within 10 ms: the level stays at 0.2 to its step meanwhile.

    By hand: a line down in 40 ms, of eight steps of which the last is silence.
    """
    async with set_running(knots=32, timing=shapes) as chain:
        begin = asyncio.get_running_loop().time()
        chain.put(FINGER, OTHER)
        await chain.leave(ONSET + 0.002, FINGER, OTHER)
        assert len(sets(chain)) == 1
        for _ in range(12):
            assert level(chain) == pytest.approx(FULL, abs=1e-4)
            await asyncio.sleep(0.001)
        _, follows = sets(chain)
        assert ONSET < follows.time - begin < ONSET + 0.012
        driven, *silent = follows.layer.commands
        assert (driven.level, driven.keep_phase, driven.onset) == (2000, True, None)
        assert levels_of(driven.ending) == pytest.approx(
            [FULL * (1 - number / 8) for number in range(1, 8)]
        )
        assert not any(each.ending or each.level for each in silent)


@in_virtual_time
async def test_ending_gives_way_to_a_touch(shapes: Shapes) -> None:
    """On two amplifiers, whose replies take 2 ms: it is staged when the finger slides.

    The set of that is the next one to play, and has its ending afterwards.
    """
    async with set_running("main", "side", knots=32, timing=shapes) as chain:
        chain.far_end.delay(0.002)
        chain.put(FINGER, OTHER)
        await asyncio.sleep(ONSET)
        count = len(chain.far_end.requests("Set"))
        for _ in range(1000):
            await asyncio.sleep(0.0001)
            if len(chain.far_end.requests("Set")) > count:
                break
        chain.put((1, 0.18, 0.1), OTHER)
        await asyncio.sleep(0.1)
        _, *others = (each.layer.commands[0] for each in sets(chain))
        assert [len(levels_of(each.ending)) for each in others if each.ending] == [7]
        assert len(others) == 2
        assert not chain.refused


@in_virtual_time
async def test_lifted_target_fades_along_its_ending(shapes: Shapes) -> None:
    """While another finger stays; reported as silence."""
    async with set_running(knots=32, timing=shapes) as chain:
        await chain.hold(0.3, down=[OTHER, FINGER])
        await chain.leave(0.020, OTHER)
        assert level(chain) == pytest.approx(FULL / 2, abs=1e-3)
        await asyncio.sleep(0.0205)
        assert not any(chain.far_end.levels)
        assert chain.silenced[-1].reason == "the target was lifted"
        await chain.leave(0.001)
        assert chain.far_end.names()[-1] == "Silence"


@in_virtual_time
async def test_last_lift_skips_the_ending(shapes: Shapes) -> None:
    """Zero within 20 ms: endings are for fingers that stay."""
    async with set_running(knots=32, timing=shapes) as chain:
        await chain.hold(0.3, down=[FINGER])
        await chain.leave(0.020)
        assert not any(chain.far_end.levels)


@in_virtual_time
async def test_lift_before_the_onset_is_over_skips_the_ending(shapes: Shapes) -> None:
    """An ending leads from the full level; lifted half way up the target fades along 20 ms."""
    async with set_running(knots=32, timing=shapes) as chain:
        await chain.hold(0.05, down=[OTHER, FINGER])
        chain.put(OTHER)
        highest = 0.0
        for _ in range(21):
            highest = max(highest, level(chain))
            await asyncio.sleep(0.001)
        assert highest <= FULL / 2 + 1e-3
        assert not any(chain.far_end.levels)


@in_virtual_time
async def test_continued_tone_has_no_onset(shapes: Shapes) -> None:
    """A finger that slides feels the same frequency without a gap, with an ending again."""
    async with set_running(knots=32, timing=shapes) as chain:
        await chain.hold(0.2, down=[FINGER, OTHER])
        await chain.hold(0.2, down=[(1, 0.18, 0.1), OTHER])
        first, _, moved, follows = (each.layer.commands[0] for each in sets(chain))
        assert (first.keep_phase, moved.keep_phase) == (False, True)
        assert moved.onset is None
        assert len(levels_of(follows.ending)) == 7
        _, reported = chain.applied
        assert reported.layer.onset is None
        assert reported.transient_contrast_db is None


class Always:
    """An intent source for which every contact is a target."""

    def intent(self, contacts: Sequence[Contact], now: float) -> HapticIntent:
        """Return an intent with all contacts."""
        return HapticIntent(tuple(Target(each.key, 20.0) for each in contacts))


@in_virtual_time
async def test_ramps_replace_envelopes_when_amplifiers_cannot_play_them(shapes: Shapes) -> None:
    """None is sent; ramp and its contrast are reported."""
    async with set_running(timing=shapes) as chain:
        await chain.hold(0.3, down=[FINGER, OTHER])
        assert [each.onset for each in sets(chain)[0].layer.commands] == [None] * 3
        (applied,) = chain.applied
        assert applied.layer.onset is None
        assert (applied.layer.ramp, sets(chain)[0].layer.ramp) == (0.015, 15)
        assert applied.transient_contrast_db == 10.0


@in_virtual_time
async def test_ramp_replaces_an_onset_that_the_ledger_refuses(shapes: Shapes) -> None:
    """A knot beyond full stroke is not sent; the pattern is played."""
    shapes.largest = 6.0
    async with set_running(knots=32, timing=shapes) as chain:
        await chain.hold(0.05, down=[FINGER, OTHER])
        (played,) = sets(chain)
        assert (played.layer.commands[0].onset, played.layer.commands[0].level) == (None, 2000)
        (applied,) = chain.applied
        assert applied.layer.onset is None
        assert applied.transient_contrast_db == 10.0
        assert chain.refused == []


@in_virtual_time
async def test_open_prepares_table_and_envelopes(shapes: Shapes) -> None:
    """Mode and frequencies, when the controller is opened."""
    async with set_running(knots=32, timing=shapes) as chain:
        assert chain.table.prepared == ["phased"]
    assert shapes.prepared == [90.0, 110.0, 150.0, 250.0]


@in_virtual_time
async def test_failing_intent_source_silences_until_it_recovers(
    shapes: Shapes, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Along the ramp, without endings; heartbeats continue, and touches are felt again later."""
    async with set_running(knots=32, timing=shapes, intent_source=Always()) as chain:
        await chain.hold(0.2, down=[FINGER])
        assert chain.far_end.levels[0] > 0
        with monkeypatch.context() as patch:
            patch.setattr(Always, "intent", lambda self, contacts, now: 1 / 0)
            await chain.hold(0.3, down=[FINGER, OTHER])
        assert sets(chain)[-1].token == 0  # a Silence
        assert not any(chain.far_end.levels)
        assert chain.silenced[-1].reason.startswith("ZeroDivisionError")
        assert chain.far_end.state == "OPERATION_ENABLED"
        await chain.hold(0.2, down=[(3, 0.06, 0.16)])
        assert chain.far_end.levels[0] > 0


PROMISED = 0.001  # s; rounding of times


def vibrations(chain: Chain) -> list[tuple[float, Sent]]:
    """When each set that vibrates was sent [s], and the set."""
    return [(each.time, each) for each in chain.far_end.sent() if not each.is_silent]


def frame(*touches: Touch, timeout: float) -> TouchFrame:
    """A frame of a source that is silent while fingers rest."""
    return TouchFrame("panel", asyncio.get_running_loop().time(), touches, timeout)


@in_virtual_time
async def test_vibration_of_a_silent_sender_is_not_renewed() -> None:
    """It lasts as long as the contact does, and a little; any frame of the sender prolongs both."""
    async with set_running() as chain:
        begin = asyncio.get_running_loop().time()
        chain.deliver(frame(Touch(*FINGER), timeout=3.0))
        await asyncio.sleep(2.5)
        ((sent, only),) = vibrations(chain)
        assert 3.0 <= sent - begin + valid_for(only) <= 3.3
        chain.deliver(frame(Touch(*FINGER), timeout=3.0))
        await asyncio.sleep(0.1)
        _, (again, renewed) = vibrations(chain)
        assert 5.5 <= again - begin + valid_for(renewed) <= 5.8
        assert again < sent + valid_for(only)
        await asyncio.sleep(5.0)
        assert len(vibrations(chain)) == 2
        assert chain.far_end.sent()[-1].is_silent


@in_virtual_time
async def test_vibration_ends_by_itself_if_a_contact_of_a_dead_panel_stays(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Were it never lifted, heartbeats alone would keep nothing playing."""
    async with set_running(breaks="lift") as chain:
        never = property(lambda tracker: math.inf, lambda tracker, at: None)
        monkeypatch.setattr(ContactTracker, "next_expiry", never, raising=False)
        monkeypatch.setattr(ContactTracker, "expire", lambda tracker, now: Change())
        begin = asyncio.get_running_loop().time()
        await chain.leave(60.0, FINGER)
        assert not chain.far_end.sent()[-1].is_silent
        ends = [time - begin + (valid_for(each) or math.inf) for time, each in vibrations(chain)]
        assert max(ends) < 2.1


@in_virtual_time
async def test_renewal_keeps_to_a_rate_limit_of_one_set_a_second() -> None:
    """There is no gap although each second allows one set."""
    async with set_running(rate=1.0) as chain:
        await chain.hold(10.0, down=[FINGER])
        sent = vibrations(chain)
        for (time, each), (following, _) in pairwise(sent):
            assert time + 1.0 - PROMISED <= following <= time + valid_for(each)
        assert sent[-1][0] + valid_for(sent[-1][1]) >= asyncio.get_running_loop().time()
        assert chain.refused == []


@in_virtual_time
async def test_vibration_of_a_finger_that_moves_whenever_the_loop_turns_is_renewed() -> None:
    """By half a millimetre, which changes nothing else: there is no gap."""
    async with set_running() as chain:
        number, x, y = FINGER
        step, chain.at = chain.controller.cycle.step, {number: (x, y)}

        async def turn() -> None:
            await asyncio.sleep(0.002)
            chain.put((number, x + 0.0005 * (chain.at[number][0] == x), y))
            await step()

        chain.controller.cycle.step = turn  # type: ignore[method-assign]
        await asyncio.sleep(6.0)
        sent = vibrations(chain)
        assert len(sent) > 3
        assert all(later <= time + valid_for(one) for (time, one), (later, _) in pairwise(sent))
        assert level(chain) == FULL


@pytest.mark.parametrize("on_time", [1.5, 2.5, 3.0, 5.5])
@in_virtual_time
async def test_renewal_keeps_to_the_on_time_limit(on_time: float) -> None:
    """The vibration ends by itself a little before, and does not begin again while fingers rest."""
    async with set_running(on_time=on_time) as chain:
        await chain.hold(12.0, down=[FINGER])
        sent = vibrations(chain)
        begin, end = sent[0][0], max(time + valid_for(each) for time, each in sent)
        assert 0.8 * on_time < end - begin <= on_time
        # Or it would be shown as if it played on.
        (silenced,) = [each for each in chain.silenced if each.reason == ENDED]
        assert end <= silenced.time <= end + 0.06


AUDIBLE = 1e-3  # of full level


def _clicking() -> EffectPlayer:
    return EffectPlayer(SurfaceLayout(effects={"click": Click()}, elsewhere="click"))


async def _playing_times(chain: Chain, seconds: float) -> list[float]:
    """Times [s] from now on at which a channel plays, by the millisecond."""
    began = asyncio.get_running_loop().time()
    times = []
    while (now := asyncio.get_running_loop().time()) < began + seconds:
        if max(chain.far_end.levels) > AUDIBLE:
            times.append(now - began)
        await asyncio.sleep(0.001)
    return times


@in_virtual_time
async def test_tap_within_one_iteration_is_felt_as_a_click() -> None:
    """Its 40 ms and a ramp are played, and silent is the plate 80 ms after the tap."""
    async with set_running(intent_source=_clicking()) as chain:
        chain.put(FINGER)
        chain.put()
        times = await _playing_times(chain, 0.3)
        assert 0.035 <= times[-1] - times[0] <= 0.060
        assert times[-1] < 0.080


@in_virtual_time
async def test_vibration_is_renewed_while_its_contact_is_confirmed() -> None:
    """It lasts two seconds, and before its end its time begins anew, without any command.

    No other pattern is reported.
    """
    async with set_running() as chain:
        await chain.hold(10.0, down=[FINGER])
        sent = vibrations(chain)
        (first, *later) = [each for _, each in sent]
        assert 9 <= len(later) <= 10
        assert {valid_for(each) for _, each in sent} == {2.0}
        assert not first.layer.renew
        for each in later:
            assert each.layer.renew
            assert each.token not in (first.token, 0)
            assert each.layer.commands == ()
        assert max(b - a for (a, _), (b, _) in pairwise(sent)) < 1.1
        assert len(chain.applied) == 1
        await asyncio.sleep(0.2)
        assert chain.far_end.sent()[-1].is_silent
