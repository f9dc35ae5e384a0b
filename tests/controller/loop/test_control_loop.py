"""The control loop, in virtual time, with amplifiers that record their requests."""

import asyncio

import pytest

from controller.loop.intent import NO_CONTACTS
from controller.loop.observer import Observer
from controller.sources.touch import Touch, TouchFrame
from controller_bench import FINGER, OTHER, Bench, armed, running
from drivers.host.members import GroupState
from drivers.host.timing import HEARTBEAT
from drivers.protocol.records import Values
from model.vibration.excitation import Tone
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
            await bench.touches(rest=pause)
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
        await bench.touches(FINGER, ago=0.003, rest=0.040)
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
        await bench.touches(rest=0.01)
        await bench.hold((2, 0.7, 0.5), seconds=0.1)
        played = [each for each in bench.far_end.sets() if not each.is_silent]
        assert [[c.keep_phase for c in each.commands] for each in played] == [
            [False, False],
            [True, False],
            [False, False],
            [False, False],
        ]


@in_virtual_time
async def test_controller_keeps_phase_at_a_frequency_that_the_wire_rounds() -> None:
    """101.33 Hz are 101.35 Hz in its steps of 0.05 Hz: what plays is what was asked for before."""
    async with running() as bench:
        bench.table.excitation = {"SW": Tone(101.33, 30e-6)}
        await bench.hold(FINGER, seconds=0.1)
        await bench.hold((1, 0.6, 0.5), seconds=0.1)
        tones = [each.commands[0] for each in bench.far_end.sets() if not each.is_silent]
        assert [tone.frequency for tone in tones] == [101.35, 101.35]
        assert [tone.keep_phase for tone in tones] == [False, True]


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
        await bench.touches(rest=0.02)
        assert_silenced_within_20_ms(bench, lifted)
        bench.far_end.delay = 0.0
        beats = len(bench.far_end.times("Ping"))
        await asyncio.sleep(0.06)
        assert bench.reports.silenced[-1].reason == NO_CONTACTS
        assert len(bench.far_end.times("Ping")) > beats
        assert bench.controller.group.state is GroupState.ARMED


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
        await bench.touches(FINGER, rest=0.05)
        for far_end, count in zip(bench.far_ends, before, strict=True):
            sent = far_end.names(count)
            assert sent.index("Silence") < sent.index("Ping")


@pytest.mark.parametrize("ago", [5.0, 0.146])
@in_virtual_time
async def test_controller_silences_a_timeout_while_a_reply_is_awaited(ago: float) -> None:
    """Zero is sent 8 ms after the contact timeout, without waiting for outdated replies.

    The frame is too old when it arrives, or becomes so while the amplifier takes 40 ms to reply.
    """
    async with running() as bench:
        bench.far_end.delay = 0.04
        await bench.touches(FINGER, rest=0.002)
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
async def test_heartbeat_stops_when_the_loop_hangs() -> None:
    """While the loop waits for one amplifier, the other gets no heartbeat."""
    async with running("a", "b") as bench:
        slow, other = bench.far_ends
        slow.delay = 0.2
        hung = now()
        await bench.touches(FINGER, rest=0.08)
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
        assert bench.controller.group.state is GroupState.ARMED


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
            await bench.touches(FINGER, rest=0.010)
            await bench.touches(rest=0.010)
        asked = len(bench.table.asked)
        await bench.hold(FINGER, seconds=1.0)
        (refusal,) = bench.reports.refused
        assert "2 command sets" in refusal
        assert bench.reports.silenced[-1].reason == refusal
        assert not any(bench.far_end.levels())
        await bench.hold(FINGER, seconds=0.2)
        assert any(bench.far_end.levels())
        assert len(bench.reports.refused) == 1
        assert len(bench.table.asked) == asked + 1
        assert bench.reports.applied[-1].time == pytest.approx(begin + 1.1, abs=1e-3)
        for refused in (1, 2):
            await bench.touches(rest=0.010)
            await bench.touches(FINGER, rest=0.010)
            assert len(bench.reports.refused) == refused
        await bench.touches(rest=2)
        assert not any(bench.far_end.levels())
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
        await bench.touches(FINGER, rest=0.01)
        await bench.touches(rest=0.2)
        assert bench.silences() == [True, False, True]
        assert len(bench.far_end.requests("Ping")) > 3
    assert "no disk space for this row" in caplog.text
