"""The control loop, in virtual time, with amplifiers that record their requests."""

import asyncio
import logging
import math
from itertools import count, pairwise

import pytest

from controller.loop.intent import NO_CONTACTS
from controller.loop.observer import Observer
from controller.sources.touch import Touch, TouchFrame
from controller_bench import FINGER, OTHER, Bench, armed, running
from drivers.contents import Tone as Played
from drivers.host.group import GroupState
from drivers.host.timing import HEARTBEAT
from drivers.protocol.records import Values
from model.errors import InputError
from model.vibration.excitation import Excitation, Tone
from virtual_loop import in_virtual_time

NEAR = (FINGER[0], FINGER[1] + 0.001, FINGER[2])  # of the same pattern
BOTH = {"SW": Tone(110.0, 2e-5), "NE": Tone(110.0, 2e-5)}


def now() -> float:
    """The loop's time [s]."""
    return asyncio.get_running_loop().time()


def assert_silenced_within_20_ms(bench: Bench, lifted: float) -> None:
    """Every amplifier is at zero 20 ms after the last lift, ramp included."""
    for far_end in bench.far_ends:
        zero = far_end.sets()[-1]
        assert zero.is_silent
        assert zero.time + zero.ramp - lifted <= 0.020


def first_silence(bench: Bench, since: float) -> float:
    """When the first silent set from a time on was sent [s]."""
    return next(each.time for each in bench.far_end.sets() if each.is_silent and each.time >= since)


@in_virtual_time
async def test_controller_plays_a_touch_within_one_turn() -> None:
    """A touch is on the wire at once, and reported as confirmed, with figures worked out by hand.

    20 of 100 µm is level 0.2; the ramp is that of the pattern; latency counts from the frame.
    """
    async with running() as bench:
        bench.touch(FINGER, ago=0.003)
        await asyncio.sleep(0.001)
        played = bench.far_end.sets()[-1]
        assert [(c.channel, c.frequency, c.phase) for c in played.commands] == [
            (0, 110.0, 90.0),
            (1, 40.0, 0.0),
        ]
        assert [c.level for c in played.commands] == pytest.approx([0.2, 0.0])
        assert played.ramp == 0.015
        (applied,) = bench.reports.applied
        assert applied.latency == pytest.approx(0.003)
        (felt,) = applied.targets
        assert (felt.contact.x, felt.contact.y) == pytest.approx((0.15, 0.1))
        assert (felt.level_db_sl, felt.contrast_db) == (20.0, None)
        assert applied.quiet == ()
        assert applied.pattern.level_db_sl == 20.0
        assert applied.drive == {"SW": Played(0, 110.0, 0.2, 90.0)}
        assert bench.reports.contacts == [1]


@in_virtual_time
async def test_controller_decides_anew_for_a_load_that_doubles_not_for_one_that_wavers() -> None:
    """A panel at 100 Hz whose pressure wavers by a third in load, then doubles, then comes back."""

    def press(*loads: float) -> None:
        touches = (Touch(*FINGER), *(Touch(*OTHER, load=load) for load in loads))
        bench.controller.deliver(TouchFrame("panel", now(), touches))

    async with running() as bench:
        for base, decisions in ((1.0, 1), (2.0, 2), (1.2, 3)):
            for number in range(50):
                press(base * (1.15 if number % 2 else 1 / 1.15))
                await asyncio.sleep(0.01)
            assert len(bench.table.asked) == decisions
        asked = [question.loads for question in bench.table.asked]
    assert asked == [(), (pytest.approx(2 / 1.15), 1.0), (pytest.approx(1.2 / 1.15), 1.0)]


@in_virtual_time
async def test_touch_is_from_rest_400_ms_after_the_last_vibration() -> None:
    """Not while the plate still rings after it, where an onset has another contrast."""
    async with running() as bench:
        for pause in (0.1, 0.3, 0.5):
            await bench.hold(FINGER, seconds=0.2)
            bench.touch()
            await asyncio.sleep(pause)
        await bench.hold(FINGER, seconds=0.1)
        assert [each.from_rest for each in bench.reports.applied] == [True, False, False, True]


@in_virtual_time
async def test_touch_is_being_prepared_until_its_set_is_sent() -> None:
    """Not while its reply is awaited; nor for a frame without a change or without a new set."""
    async with running() as bench:
        await asyncio.sleep(0.02)
        bench.far_end.delay = 0.010
        is_preparing = [bench.controller.is_preparing]
        bench.touch(FINGER)
        is_preparing.append(bench.controller.is_preparing)
        await asyncio.sleep(0.015)
        is_preparing.append(bench.controller.is_preparing)
        await asyncio.sleep(0.015)
        bench.touch(FINGER)
        is_preparing.append(bench.controller.is_preparing)
        before = len(bench.far_end.sets())
        bench.touch(NEAR)
        is_preparing.append(bench.controller.is_preparing)
        await asyncio.sleep(0.025)
        assert len(bench.far_end.sets()) == before
        is_preparing.append(bench.controller.is_preparing)
    assert is_preparing == [False, True, False, False, True, False]


@in_virtual_time
async def test_latency_counts_to_the_commit_with_several_amplifiers() -> None:
    """To its last byte, 10 ms after the stage, whose reply takes as long; not to the read-back."""
    async with running("west", "east") as bench:
        for far_end in bench.far_ends:
            far_end.delay = 0.010
        bench.touch(FINGER, ago=0.003)
        await asyncio.sleep(0.040)
        (applied,) = bench.reports.applied
        assert applied.latency == pytest.approx(0.013)


@in_virtual_time
async def test_controller_keeps_phase_when_a_finger_moves() -> None:
    """The same ERA at the same frequency continues; after silence or another ERA it restarts."""
    async with running() as bench:
        await bench.hold(FINGER, seconds=0.1)
        bench.table.excitation = {"SW": Tone(110.0, 30e-6)}
        await bench.hold((1, 0.6, 0.5), seconds=0.1)
        bench.table.excitation = BOTH
        await bench.hold((1, 0.7, 0.5), seconds=0.1)
        bench.touch()
        await asyncio.sleep(0.01)
        await bench.hold((2, 0.7, 0.5), seconds=0.1)
        played = [each for each in bench.far_end.sets() if not each.is_silent]
        assert [[c.keep_phase for c in each.commands] for each in played] == [
            [False, False],
            [True, False],
            [False, False],
            [False, False],
        ]


@in_virtual_time
async def test_controller_restarts_phase_after_a_disarm() -> None:
    """What plays is unknown then: the next pattern counts its phase from its commit."""
    async with armed() as bench:
        bench.touch(FINGER)
        await bench.controller.step()
        await bench.controller.disarm()
        await bench.controller.arm()
        await bench.controller.step()
        assert [each.commands[0].keep_phase for each in bench.far_end.sets()] == [False, False]


@pytest.mark.parametrize("kind", ["Set", "Commit", "GetStatus", "Ping"])
@in_virtual_time
async def test_controller_silences_a_lift_while_a_reply_is_awaited(kind: str) -> None:
    """Zero is reached within 20 ms also while the reply to another request is missing."""
    async with running() as bench:
        if kind in ("GetStatus", "Ping"):
            await bench.hold(FINGER, seconds=0.1)
        awaited = asyncio.Event()

        def note(name: str, values: Values) -> None:
            if name == kind:
                bench.far_end.delay = 0.045
                awaited.set()

        bench.far_end.answer = note
        bench.touch(FINGER)
        await awaited.wait()
        bench.far_end.answer = lambda name, values: None
        await asyncio.sleep(0.001)
        lifted = now()
        bench.touch()
        await asyncio.sleep(0.02)
        assert_silenced_within_20_ms(bench, lifted)
        bench.far_end.delay = 0.0
        beats = len(bench.far_end.times("Ping"))
        await asyncio.sleep(0.06)
        assert bench.reports.silenced[-1].reason == NO_CONTACTS
        assert len(bench.far_end.times("Ping")) > beats
        assert bench.controller.group_state is GroupState.ARMED


@in_virtual_time
async def test_controller_repeats_no_aborted_request() -> None:
    """A heartbeat without a reply yields to silence, and to the pattern of a finger that comes.

    The last finger lifts 25 ms after it, and another comes at once.
    """
    async with running() as bench:
        await bench.hold(FINGER, seconds=0.1)
        due = bench.far_end.times("Ping")[-1] + HEARTBEAT
        bench.touch(FINGER)
        await asyncio.sleep(due - 0.001 - now())
        bench.far_end.is_mute = True
        asked = len(bench.far_end.asked)
        await asyncio.sleep(0.026)
        bench.touch()
        bench.touch(OTHER)
        await asyncio.sleep(0.002)
        bench.far_end.is_mute = False
        await asyncio.sleep(0.030)
        assert bench.far_end.names(asked)[:3] == ["GetStatus", "Set", "Commit"]
        assert bench.controller.group_state is GroupState.ARMED
        assert bench.reports.refused == []


@in_virtual_time
async def test_controller_commits_no_set_after_its_finger_lifted() -> None:
    """The finger lifts while one of two amplifiers takes 5 ms to stage."""
    async with running("a", "b") as bench:
        bench.far_ends[0].delay = 0.005
        bench.touch(FINGER)
        await asyncio.sleep(0.003)
        bench.touch()
        await asyncio.sleep(0.010)
        for far_end in bench.far_ends:
            assert far_end.requests("Commit") == []
            assert far_end.sets()[-1].is_silent
        assert bench.controller.group_state is GroupState.ARMED
        assert bench.reports.refused == []


@in_virtual_time
async def test_controller_silences_before_a_due_heartbeat() -> None:
    """On several amplifiers at once."""
    async with running("a", "b") as bench:
        await asyncio.sleep(0.045)
        for far_end in bench.far_ends:
            far_end.delay = 0.004
        bench.touch(FINGER)
        await asyncio.sleep(0.002)
        lifted = now()
        bench.touch()
        await asyncio.sleep(0.02)
        assert_silenced_within_20_ms(bench, lifted)
        for far_end in bench.far_ends:
            assert lifted < far_end.times("Silence")[-1] < far_end.times("Ping")[-1]


@pytest.mark.parametrize("later", range(3))
@in_virtual_time
async def test_lift_as_a_set_is_confirmed_precedes_a_due_heartbeat(later: int) -> None:
    """In whichever of the last iterations of the event loop before the exchange ends it comes."""
    async with running("a", "b") as bench:
        before: list[int] = []  # requests to each amplifier before the lift

        def lift(after: int) -> None:
            if after:
                asyncio.get_running_loop().call_soon(lift, after - 1)
            else:
                before.extend(len(far_end.asked) for far_end in bench.far_ends)
                bench.touch()

        def answer(name: str, values: Values) -> None:
            if name == "Commit" and not before:  # until its reply arrives
                asyncio.get_running_loop().call_later(bench.far_ends[-1].delay, lift, later)

        await asyncio.sleep(0.046)
        for far_end in bench.far_ends:
            far_end.delay = 0.002
        bench.far_ends[-1].answer = answer
        bench.touch(FINGER)
        await asyncio.sleep(0.05)
        for far_end, count in zip(bench.far_ends, before, strict=True):
            sent = far_end.names(count)
            assert sent.index("Silence") < sent.index("Ping")


@in_virtual_time
async def test_new_pattern_waits_until_all_amplifiers_reply(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The other amplifier, too, is sent nothing but heartbeats; then it is played at once."""
    async with running("a", "b") as bench:
        step, steps = bench.controller.step, count()

        async def counted() -> None:
            assert next(steps) < 1000, "the loop must not run without pause"
            await step()

        monkeypatch.setattr(bench.controller, "step", counted)
        await bench.hold(FINGER, seconds=0.1)
        silent, other = bench.far_ends

        silent.is_mute = True
        while not bench.controller.degraded:
            bench.touch(FINGER)
            await asyncio.sleep(0.005)
        assert bench.controller.degraded == ("a",)
        begin, applied = now(), len(bench.reports.applied)
        bench.touch(OTHER)
        await asyncio.sleep(0.02)
        sent = {name for time, name, _ in other.asked if time > begin}
        assert sent <= {"Ping", "GetStatus"}
        silent.is_mute = False
        await bench.hold(OTHER, seconds=0.1)
        assert len(bench.reports.applied) == applied + 1


@in_virtual_time
async def test_controller_resends_cancelled_silence() -> None:
    """A loop that replaces a cancelled one does not rely on its last command."""
    async with armed() as bench:
        bench.touch(FINGER)
        await bench.controller.step()
        bench.far_end.delay = 0.01
        bench.touch()
        first = asyncio.create_task(bench.controller.run())
        await asyncio.sleep(0.001)
        first.cancel()
        await asyncio.gather(first, return_exceptions=True)
        second = asyncio.create_task(bench.controller.run())
        await asyncio.sleep(0.012)
        assert bench.silences() == [False, True, True]
    await second


@pytest.mark.parametrize("ago", [5.0, 0.146])
@in_virtual_time
async def test_controller_silences_a_timeout_while_a_reply_is_awaited(ago: float) -> None:
    """Zero is sent 8 ms after the contact timeout, without waiting for outdated replies.

    The frame is too old when it arrives, or becomes so while the amplifier takes 40 ms to reply.
    """
    async with running() as bench:
        bench.far_end.delay = 0.04
        bench.touch(FINGER)
        await asyncio.sleep(0.002)
        bench.touch(FINGER, ago=ago)
        over = max(now(), now() - ago + 0.15)
        await asyncio.sleep(0.1)
        assert first_silence(bench, over) - over == pytest.approx(0.008, abs=1e-4)


@in_virtual_time
async def test_controller_times_out_a_finger_from_before_arming() -> None:
    """Zero is sent at once, since nothing is under way."""
    async with running() as bench:
        await bench.controller.disarm()
        bench.touch(FINGER)
        over = now() + 0.15
        await asyncio.sleep(0.13)
        await bench.controller.arm()
        bench.far_end.delay = 0.04
        await asyncio.sleep(0.2)
        assert first_silence(bench, over) == pytest.approx(over, abs=1e-4)


@in_virtual_time
async def test_resting_finger_costs_heartbeats_only() -> None:
    """A heartbeat every 50 ms with and without a finger, and no set twice."""
    async with running() as bench:
        await asyncio.sleep(0.5)
        await bench.hold(FINGER, seconds=0.5)
        assert bench.silences() == [True, False]
        pauses = [after - before for before, after in pairwise(bench.far_end.times("Ping"))]
        assert len(pauses) in (19, 20)  # within a second, by rounding
        assert pauses == pytest.approx([0.05] * len(pauses), abs=1e-6)


@in_virtual_time
async def test_heartbeat_is_sent_only_after_the_loop_has_run() -> None:
    """Only a turn of the loop sends it, once, after what the turn had to send."""
    async with armed() as bench:
        await asyncio.sleep(4 * HEARTBEAT)
        assert bench.far_end.requests("Ping") == []
        bench.touch(FINGER)
        await bench.controller.step()
        kinds = bench.far_end.names()
        identified = ["GetCaps", "GetStatus"]  # as after each loss of supply
        assert kinds == [*identified * 2, "Arm", "Set", "Commit", "GetStatus", "Ping"]
        await asyncio.sleep(1.0)
        assert len(bench.far_end.requests("Ping")) == 1


@in_virtual_time
async def test_heartbeat_stops_when_the_loop_hangs() -> None:
    """While the loop waits for one amplifier, the other gets no heartbeat."""
    async with running("a", "b") as bench:
        slow, other = bench.far_ends
        slow.delay = 0.2
        hung = now()
        bench.touch(FINGER)
        await asyncio.sleep(0.08)
        assert [time for time in other.times("Ping") if time > hung] == []
        slow.delay = 0.0
        await asyncio.sleep(0.5)
        assert [time for time in other.times("Ping") if time > hung] != []


@in_virtual_time
async def test_arm_changes_nothing_while_armed() -> None:
    """No second Arm is sent, for it would begin another session; heartbeats go on."""
    async with running() as bench:
        begin = len(bench.far_end.asked)
        await asyncio.gather(*(bench.controller.arm() for _ in range(2)))
        await asyncio.sleep(2.5 * HEARTBEAT)
        kinds = bench.far_end.names(begin)
        assert "Arm" not in kinds
        assert "Ping" in kinds
        assert bench.controller.group_state is GroupState.ARMED


@in_virtual_time
async def test_controller_uses_the_latest_frame() -> None:
    """Frames that arrive during a command are not sent one by one."""
    async with running() as bench:
        bench.far_end.delay = 0.02
        bench.touch(FINGER)
        for step in range(1, 10):
            await asyncio.sleep(0.001)
            bench.touch((1, 0.5 + 0.04 * step, 0.5))
        await asyncio.sleep(0.1)
        touched = [applied.targets[0].contact.x for applied in bench.reports.applied]
        assert touched == pytest.approx([0.15, 0.258])


@pytest.mark.parametrize(
    ("answer", "reason", "logged"),
    [
        (InputError("no pattern reaches 20 dB SL there"), "no pattern reaches 20 dB SL there", 0),
        (ZeroDivisionError("a bug"), "ZeroDivisionError: a bug", 1),
        ({"SW": Tone(110.0, 1e-6), "XX": Tone(110.0, 1e-6)}, "XX", 1),
    ],
)
@in_virtual_time
async def test_controller_silences_when_the_table_fails(
    caplog: pytest.LogCaptureFixture, answer: Excitation | Exception, reason: str, logged: int
) -> None:
    """The reason is reported, a bug logged once; the next silence is not sent, the next touch is.

    A pattern that drives an ERA unknown to the rig is silence as a whole.
    """
    async with running() as bench:
        await bench.hold(FINGER, seconds=0.1)
        excitation, bench.table.excitation = bench.table.excitation, answer
        await bench.hold(FINGER, OTHER, seconds=0.2)
        assert bench.silences() == [True, False, True]
        assert reason in bench.reports.silenced[-1].reason
        bench.touch()
        await asyncio.sleep(0.01)
        assert bench.silences() == [True, False, True]
        assert bench.reports.silenced[-1].latency is None
        bench.table.excitation = excitation
        bench.touch((3, 0.1, 0.1))
        await asyncio.sleep(0.01)
        assert not bench.far_end.sets()[-1].is_silent
    assert len([r for r in caplog.records if r.levelno == logging.ERROR]) == logged


@pytest.mark.parametrize("tone", [(110.0, 101e-6), (39.0, 10e-6), (110.0, math.nan)])
@in_virtual_time
async def test_controller_silences_when_the_guard_refuses(tone: tuple[float, float]) -> None:
    """A pattern that the guard refuses becomes silence, and is reported with its channel."""
    async with running() as bench:
        await bench.hold(FINGER, seconds=0.1)
        bench.table.excitation = {"SW": Tone(*tone)}
        await bench.hold(FINGER, OTHER, seconds=0.1)
        assert bench.silences() == [True, False, True]
        (refusal,) = bench.reports.refused
        assert refusal.startswith("main: ")
        assert "channel 0" in refusal
        assert bench.reports.silenced[-1].reason == refusal
        assert bench.controller.group_state is GroupState.ARMED


@pytest.mark.parametrize("amplifiers", [["main"], ["left", "right"]])
@in_virtual_time
async def test_controller_retries_a_pattern_when_the_rate_limit_permits(
    amplifiers: list[str],
) -> None:
    """Of two sets a second the third is refused, and played 1.1 s after the first.

    A tenth more than a second, in case the first is delayed on its way.

    The table is not queried in between; a finger that has lifted by then is not played.
    """
    async with running(*amplifiers, rate=2.0) as bench:
        bench.table.excitation = BOTH
        begin = now()
        for _ in range(2):
            bench.touch(FINGER)
            await asyncio.sleep(0.010)
            bench.touch()
            await asyncio.sleep(0.010)
        asked = len(bench.table.asked)
        await bench.hold(FINGER, seconds=1.0)
        (refusal,) = bench.reports.refused
        assert "2 command sets" in refusal
        assert bench.reports.silenced[-1].reason == refusal
        assert not any(bench.far_end.levels)
        await bench.hold(FINGER, seconds=0.2)
        assert any(bench.far_end.levels)
        assert len(bench.reports.refused) == 1
        assert len(bench.table.asked) == asked + 1
        assert bench.reports.applied[-1].time == pytest.approx(begin + 1.1, abs=1e-3)
        for refused in (1, 2):
            bench.touch()
            await asyncio.sleep(0.010)
            bench.touch(FINGER)
            await asyncio.sleep(0.010)
            assert len(bench.reports.refused) == refused
        bench.touch()
        await asyncio.sleep(2)
        assert not any(bench.far_end.levels)
        assert len(bench.reports.applied) == 4


@in_virtual_time
async def test_opening_again_gives_no_limit_anew() -> None:
    """Of two sets a second the third is refused though all was closed and opened before it."""
    async with armed(rate=2.0) as bench:
        for _ in range(3):
            await bench.controller.close()
            await bench.controller.open()
            await bench.controller.arm()
            for touches in ((FINGER,), ()):
                bench.touch(*touches)
                await bench.controller.step()
        assert len(bench.reports.applied) == 2
        assert len(bench.reports.refused) == 1


@in_virtual_time
async def test_controller_survives_a_failing_observer(caplog: pytest.LogCaptureFixture) -> None:
    """Its exceptions are logged; pattern, silence and heartbeats are sent all the same."""

    def fail(*_: object) -> None:
        raise RuntimeError("no disk space for this row")

    observer = Observer(contacts_changed=fail, pattern_applied=fail, silenced=fail)
    async with running(observer=observer) as bench:
        bench.touch(FINGER)
        await asyncio.sleep(0.01)
        bench.touch()
        await asyncio.sleep(0.2)
        assert bench.silences() == [True, False, True]
        assert len(bench.far_end.requests("Ping")) > 3
    assert "no disk space for this row" in caplog.text
