"""Touches, lifts, time-outs, rate limits and renewals of the control loop, in virtual time.

The amplifiers record their requests; all hosts are judged by the rules for hosts.
"""

import asyncio
import math
from collections.abc import Callable, Sequence

import pytest

from controller.effects.kinds import Click
from controller.effects.layout import SurfaceLayout
from controller.effects.player import EffectPlayer
from controller.play.intent import HapticIntent, Target
from controller.sources.contact_tracker import ContactTracker
from controller.sources.touch import Change, Contact, Touch, TouchFrame
from drivers.host.group_states import GroupState
from kit.chain import FINGER, OTHER, set_running
from kit.clock import in_virtual_time
from model.vibration import Tone
from registry import threads
from tests.controller.play.driven_loop import (
    FINGER_ELSEWHERE,
    MOVED_FINGER,
    DrivenLoop,
    Planted,
    but_the_other,
)

NEAR_FINGER = (FINGER[0], FINGER[1] + 0.001, FINGER[2])
AUDIBLE = 1e-3  # of full level
RENEWAL_INTERVAL = 1.0  # s


def press(loop: DrivenLoop, *loads: float) -> None:
    """Have a finger down, and next to it another of each load."""
    others = [Touch(2, 0.9, 0.9, load=load) for load in loads]
    loop.deliver(TouchFrame("panel", threads.now(), (Touch(1, 0.5, 0.5), *others)))


@in_virtual_time
async def test_finger_of_a_silent_source_is_lifted_while_the_link_is_lost() -> None:
    """It is lifted 150 ms after its last frame, as with a link."""
    async with set_running(of=DrivenLoop) as loop:
        await loop.leave(0.05, FINGER)
        loop.far_end.fault("unplug")
        await asyncio.sleep(0.099)
        assert loop.contacts == [1]
        await asyncio.sleep(0.002)
        assert loop.contacts == [1, 0]


@in_virtual_time
async def test_mute_amplifier_is_lost_though_the_finger_was_lifted() -> None:
    """Repeated silence that it does not hear does not postpone the time of its loss."""
    async with set_running("a", "b", of=DrivenLoop) as loop:
        await loop.hold(0.2, down=[FINGER])
        loop.far_ends[1].fault("drop", toward="amplifier")
        await loop.leave(0.6)
        assert len(loop.lost) == 1
        assert loop.state is GroupState.LOST
        assert not loop.is_loud


@in_virtual_time
async def test_latency_counts_to_the_start_with_several_amplifiers() -> None:
    """The frame is 3 ms old; the reply to the stage takes 10 ms, the commits 3.5 to 5 ms.

    The commits wait for the bits, 3 ms for late replies, 0.5 ms, a step of 0.3 ms and a heartbeat.
    The status that is read 10 ms later does not count.
    """
    async with set_running("west", "east", of=DrivenLoop) as loop:
        await asyncio.sleep(4.01)
        loop.delay_replies(0.01)
        await loop.leave(0.04, FINGER, ago=0.003)
        assert loop.latencies == [pytest.approx(0.0175, abs=0.0025)]


@pytest.mark.parametrize(
    ("intents", "late_count"),
    [(lambda: EffectPlayer(SurfaceLayout()), 1), (but_the_other, 0)],
    ids=["effect", "no effect"],
)
@in_virtual_time
async def test_short_touch_during_an_exchange_is_late_if_it_has_an_effect(
    intents: Callable[[], EffectPlayer], late_count: int
) -> None:
    """A second finger comes and lifts while the reply to the set of the first is awaited."""
    async with set_running(of=DrivenLoop, intent_source=intents()) as loop:
        loop.delay_replies(0.015)
        await loop.leave(0.006, FINGER)
        await loop.leave(0.006, FINGER, OTHER)
        await loop.leave(0.1, FINGER)
        assert loop.controller.cycle.clicks_too_late == late_count


@in_virtual_time
async def test_touch_is_being_prepared_until_its_set_is_sent() -> None:
    """Not while its reply is awaited, nor for a frame without a change."""
    async with set_running(of=DrivenLoop) as loop:
        cycle = loop.controller.cycle
        await asyncio.sleep(0.02)
        loop.delay_replies(0.01)
        assert not cycle.is_preparing
        loop.put(FINGER)
        assert cycle.is_preparing
        await asyncio.sleep(0.015)
        assert not cycle.is_preparing
        await asyncio.sleep(0.015)
        loop.put(FINGER)
        assert not cycle.is_preparing

        loop.put(NEAR_FINGER)
        assert cycle.is_preparing
        await asyncio.sleep(0.025)
        assert not cycle.is_preparing
        assert len(loop.vibrations) == 1


@in_virtual_time
async def test_phase_continues_on_the_same_actuator_at_the_same_frequency() -> None:
    """After silence, or on another ERA, it starts again.

    101.33 Hz are 101.35 Hz in the steps of 0.05 Hz of the wire, which is no other frequency.
    """
    async with set_running(of=DrivenLoop) as loop:
        loop.answer_by(SW=Tone(101.33, 30e-6))
        await loop.hold(0.1, down=[FINGER])
        await loop.hold(0.1, down=[MOVED_FINGER])
        loop.answer_by(SW=Tone(101.33, 20e-6), NE=Tone(101.33, 20e-6))
        await loop.hold(0.1, down=[FINGER_ELSEWHERE])
        await loop.leave(0.01)
        await loop.hold(0.1, down=[OTHER])

        silent_start = [False, False, False]
        assert loop.continued_phases == [
            silent_start,
            [True, False, False],
            silent_start,
            silent_start,
        ]
        assert loop.first_commands[0].frequency == loop.first_commands[1].frequency == 2027


@pytest.mark.parametrize(
    ("request_name", "held"), [("Set", 0.0), ("GetStatus", 0.1), ("Ping", 0.1)]
)
@in_virtual_time
async def test_lift_is_silent_while_a_reply_is_awaited(request_name: str, held: float) -> None:
    """Zero is reached within 20 ms although the reply to another request takes 45 ms."""
    async with set_running(of=DrivenLoop) as loop:
        await loop.hold(held, down=[FINGER])
        requested = loop.delay_replies_from(request_name, 0.045)
        loop.put(FINGER)
        await requested.wait()
        await asyncio.sleep(0.001)

        await loop.leave(0.02)
        assert not loop.is_loud

        loop.delay_replies(0.0)
        loop.forget_requests()
        await asyncio.sleep(0.06)
        assert loop.count("Ping") >= 1
        assert loop.silenced[-1].reason == "no contact on the plate"
        assert loop.state is GroupState.ARMED


@in_virtual_time
async def test_touch_right_after_the_lift_of_an_unconfirmed_set_is_felt() -> None:
    """The set that was given up may play: it is silenced, and the next one follows immediately."""
    async with set_running(of=DrivenLoop) as loop:
        requested = loop.delay_replies_from("Set", 0.045)
        loop.put(FINGER)
        await requested.wait()
        await asyncio.sleep(0.001)
        loop.put()
        loop.delay_replies(0.0)
        loop.forget_requests()

        await loop.leave(0.06, OTHER)

        assert loop.is_loud
        assert loop.count("Silence") >= 1
        assert loop.count("Set") >= 1
        assert loop.refused == []


@pytest.mark.parametrize(("age", "time_left"), [(5.0, 0.0079), (0.146, 0.0119)])
@in_virtual_time
async def test_contact_timeout_is_silent_while_a_reply_is_awaited(
    age: float, time_left: float
) -> None:
    """Zero is sent 8 ms after the contact timeout, without waiting for outdated replies.

    The frame is too old when it arrives, or becomes so while the amplifier takes 40 ms to reply.
    """
    async with set_running(of=DrivenLoop) as loop:
        loop.delay_replies(0.04)
        await loop.leave(0.002, FINGER)
        loop.forget_requests()
        await loop.leave(time_left, FINGER, ago=age)
        assert loop.count("Silence") == 0
        await asyncio.sleep(0.0002)
        assert loop.count("Silence") >= 1


@in_virtual_time
async def test_finger_from_before_arming_is_timed_out() -> None:
    """Arming takes 20 ms; zero is sent at the timeout, because nothing is in progress."""
    async with set_running(of=DrivenLoop) as loop:
        await loop.controller.disarm()
        await loop.leave(0.11, FINGER)
        await loop.controller.arm()
        await asyncio.sleep(0.01)
        assert loop.is_loud

        loop.delay_replies(0.04)
        await asyncio.sleep(0.0099)
        loop.forget_requests()
        await asyncio.sleep(0.0002)
        assert loop.count("Silence") >= 1


@in_virtual_time
async def test_heartbeats_stop_when_the_loop_waits_for_one_amplifier() -> None:
    """The other amplifier gets none meanwhile, so that its watchdog can see that the loop hangs."""
    async with set_running("a", "b", of=DrivenLoop) as loop:
        loop.far_ends[0].fault("hang", lasts=0.1)
        await loop.leave(0.002, FINGER)  # lets requests on the wire arrive
        loop.forget_requests()
        await asyncio.sleep(0.08)
        assert loop.count("Ping", of=1) == 0
        await asyncio.sleep(0.5)
        assert loop.count("Ping", of=1) >= 1


@in_virtual_time
async def test_opening_again_does_not_reset_the_rate_limit() -> None:
    """Of two sets per second the third is rejected though all was closed and opened before it."""
    async with set_running(of=DrivenLoop, rate=2.0) as loop:
        for _ in range(2):
            await loop.hold(0.01, down=[FINGER])
            await loop.leave(0.01)
            await loop.close()
            await loop.open()
            await loop.controller.arm()
        await loop.hold(0.01, down=[FINGER])
        assert (len(loop.applied), len(loop.refused)) == (2, 1)


@pytest.mark.parametrize("amplifiers", [["main"], ["left", "right"]])
@in_virtual_time
async def test_pattern_is_retried_when_the_rate_limit_permits(amplifiers: Sequence[str]) -> None:
    """Of two sets per second the third is rejected, and played 1.1 s after the first.

    That is a tenth more than a second, in case the first is delayed on its way. The table is not
    queried in between. A finger that has lifted by then is not played.
    """
    async with set_running(*amplifiers, of=DrivenLoop, rate=2.0) as loop:
        loop.answer_by(SW=Tone(110.0, 20e-6), NE=Tone(110.0, 20e-6))
        await loop.tap()
        await loop.tap()
        assert len(loop.table.asked) == 2

        await loop.hold(1.0, down=[FINGER])
        assert "2 command sets" in loop.silenced[-1].reason
        assert not loop.is_loud
        await loop.hold(0.055)
        assert not loop.is_loud
        await loop.hold(0.01)
        assert loop.is_loud
        await loop.hold(0.1)
        assert loop.is_loud
        counts = {
            "refused": len(loop.refused),
            "applied": len(loop.applied),
            "asked": len(loop.table.asked),
        }
        assert counts == {"refused": 1, "applied": 3, "asked": 3}

        await loop.leave(0.01)
        await loop.tap()
        assert len(loop.refused) == 1
        await loop.tap()
        assert len(loop.refused) == 2
        await asyncio.sleep(2.0)
        assert not loop.is_loud
        assert len(loop.applied) == 4


class Always:
    """An intent source for which every contact is a target, unless it fails."""

    fails = False

    def intent(self, contacts: Sequence[Contact], now: float) -> HapticIntent:
        """Return an intent with all contacts."""
        if self.fails:
            raise Planted("no intent")
        targets = [Target(contact.key, 20.0) for contact in contacts]
        return HapticIntent(tuple(targets))

    def has_effect_at(self, contact: Contact) -> bool:
        """Return True: every contact has one."""
        return True


@in_virtual_time
async def test_failing_intent_source_silences_until_it_recovers() -> None:
    """Heartbeats continue meanwhile, and touches are felt again later."""
    intents = Always()
    async with set_running(of=DrivenLoop, intent_source=intents) as loop:
        await loop.hold(0.2, down=[FINGER])
        assert loop.is_loud

        intents.fails = True
        await loop.hold(0.3, down=[FINGER, OTHER])
        assert not loop.is_loud
        assert "Planted: no intent" in loop.silenced[-1].reason
        assert loop.amplifier_states == ["OPERATION_ENABLED"]

        intents.fails = False
        await loop.hold(0.2, down=[FINGER_ELSEWHERE])
        assert loop.is_loud


@in_virtual_time
async def test_loop_survives_failing_observers(caplog: pytest.LogCaptureFixture) -> None:
    """Their exceptions are logged; pattern, silence and heartbeats are sent all the same."""

    def fail(*_: object) -> None:
        raise RuntimeError("no disk space for this row")

    async with set_running(of=DrivenLoop) as loop:
        observers = loop.controller.cycle.observers
        observers.contacts_changed.insert(0, fail)
        observers.reported.insert(0, fail)
        await loop.leave(0.01, FINGER)
        await loop.leave(0.2)
        assert [sent.is_silent for sent in loop.far_end.sent()] == [True, False, True]
        assert loop.count("Ping") >= 4
        assert "no disk space for this row" in caplog.text


@in_virtual_time
async def test_tap_within_one_iteration_is_felt_as_a_click() -> None:
    """The 40 ms of the click and a ramp are played, and the plate is silent 80 ms after the tap."""
    click = SurfaceLayout(effects={"click": Click()}, elsewhere="click")
    async with set_running(of=DrivenLoop, intent_source=EffectPlayer(click)) as loop:
        tapped = threads.now()
        loop.put(FINGER)
        loop.put()
        looks = await loop.look(0.3)
        audible = [time - tapped for time, level in looks if level > AUDIBLE]
        assert 0.035 <= audible[-1] - audible[0] <= 0.06
        assert audible[-1] < 0.08


@in_virtual_time
async def test_load_that_doubles_is_answered_again_and_one_that_wavers_is_not() -> None:
    """A panel at 100 Hz reports a load that wavers by a third, then doubles, then returns."""
    async with set_running(of=DrivenLoop) as loop:
        for lower, higher in ((0.87, 1.15), (1.74, 2.3), (1.04, 1.38)):
            for load in [lower, higher] * 25:
                press(loop, load)
                await asyncio.sleep(0.01)
        loads = [[finger.load for finger in question] for question in loop.table.asked]
        assert loads == [[1, 1], [1.74, 1], [1.04, 1]]


@in_virtual_time
async def test_hand_is_asked_for_with_its_load_and_feels_nothing() -> None:
    """The newest contact is to buzz; a hand that comes after a finger is none of those."""
    async with set_running(of=DrivenLoop) as loop:
        for loads in ([], [12.0], []):
            for _ in range(10):
                press(loop, *loads)
                await asyncio.sleep(0.01)
        questions = [
            [(finger.load, finger.stimulus is not None) for finger in question]
            for question in loop.table.asked
        ]
        assert questions == [[(1, True)], [(1, True), (12, False)], [(1, True)]]


@in_virtual_time
async def test_vibration_of_a_silent_sender_is_not_renewed() -> None:
    """It lasts a little longer than its contact; any frame of the sender prolongs both."""
    async with set_running(of=DrivenLoop) as loop:
        began = threads.now()
        loop.timeout = 3.0
        await loop.leave(2.5, FINGER)
        assert [end - began for end in loop.expiries] == [pytest.approx(3.15, abs=0.15)]

        await loop.leave(0.1, FINGER)
        assert loop.expiries[1] - began == pytest.approx(5.65, abs=0.15)
        assert loop.gaps == []
        await asyncio.sleep(5.0)
        assert len(loop.vibrations) == 2
        assert not loop.is_loud


@in_virtual_time
async def test_vibration_is_renewed_while_its_contact_is_confirmed() -> None:
    """It lasts two seconds; before its end its time begins again, without any command."""
    async with set_running(of=DrivenLoop) as loop:
        await loop.hold(10.0, down=[FINGER])
        assert loop.expiries[0] - loop.vibrations[0].time == pytest.approx(2.0)
        assert loop.pauses == [pytest.approx(RENEWAL_INTERVAL, abs=0.1)] * 9
        first, *renewals = [vibration.layer for vibration in loop.vibrations]
        assert not first.renew
        assert [(layer.renew, len(layer.commands)) for layer in renewals] == [(True, 0)] * 9
        assert len(loop.applied) == 1
        await asyncio.sleep(0.2)
        assert not loop.is_loud


@in_virtual_time
async def test_renewal_keeps_to_a_rate_limit_of_one_set_per_second() -> None:
    """There is no gap although each second permits only one set."""
    async with set_running(of=DrivenLoop, rate=1.0) as loop:
        await loop.hold(10.0, down=[FINGER])
        assert min(loop.pauses) >= 0.999
        assert loop.gaps == []
        assert loop.refused == []


@pytest.mark.parametrize("on_time", [1.5, 3.0])
@in_virtual_time
async def test_renewal_keeps_to_the_on_time_limit(on_time: float) -> None:
    """The vibration ends by itself a little earlier, which is reported, and does not begin again.

    Otherwise it would be shown as if it continued.
    """
    async with set_running(of=DrivenLoop, on_time=on_time) as loop:
        await loop.hold(12.0, down=[FINGER])
        end = max(loop.expiries)
        duration = end - loop.vibrations[0].time
        assert 0.8 * on_time <= duration <= on_time
        assert loop.silenced[-1].time - end == pytest.approx(0.03, abs=0.03)
        assert "the vibration has ended" in loop.silenced[-1].reason


@in_virtual_time
async def test_vibration_ends_by_itself_if_a_contact_of_a_dead_panel_stays(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """If it were never lifted, heartbeats alone would keep nothing active."""
    async with set_running(of=DrivenLoop, breaks="lift") as loop:
        never = property(lambda tracker: math.inf, lambda tracker, at: None)
        monkeypatch.setattr(ContactTracker, "next_expiry", never, raising=False)
        monkeypatch.setattr(ContactTracker, "expire", lambda tracker, now: Change())
        began = threads.now()
        await loop.leave(60.0, FINGER)
        assert not loop.far_end.sent()[-1].is_silent
        assert 0.0 < max(loop.expiries) - began < 2.1
