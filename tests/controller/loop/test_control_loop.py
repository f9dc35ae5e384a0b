"""The control loop, in virtual time, with amplifiers that record their requests."""

import asyncio

import pytest

from chain import Chain
from controller.loop.intent import NO_CONTACTS
from controller.loop.observer import Observer
from controller.sources.touch import Touch, TouchFrame
from drivers.host.members import GroupState
from drivers.host.timing import HEARTBEAT
from drivers.protocol.records import Values
from model.vibration.excitation import Tone
from set_chain import FINGER, set_chain, set_running
from virtual_loop import in_virtual_time

NEAR = (FINGER[0], FINGER[1] + 0.001, FINGER[2])  # of the same pattern
BOTH = {"SW": Tone(110.0, 2e-5), "NE": Tone(110.0, 2e-5)}


def now() -> float:
    """The loop's time [s]."""
    return asyncio.get_running_loop().time()


def first_silence(chain: Chain, since: float) -> float:
    """When the first silent set from a time on was sent [s]."""
    return next(each.time for each in chain.far_end.sent() if each.is_silent and each.time >= since)


@in_virtual_time
async def test_controller_decides_anew_for_a_load_that_doubles_not_for_one_that_wavers() -> None:
    """A panel at 100 Hz whose pressure wavers by a third in load, then doubles, then comes back."""

    def press(*loads: float) -> None:
        touches = (Touch(1, 0.5, 0.5), *(Touch(2, 0.9, 0.9, load=load) for load in loads))
        chain.controller.deliver(TouchFrame("panel", now(), touches))

    async with set_running() as chain:
        for base, decisions in ((1.0, 1), (2.0, 2), (1.2, 3)):
            for number in range(50):
                press(base * (1.15 if number % 2 else 1 / 1.15))
                await asyncio.sleep(0.01)
            assert len(chain.table.asked) == decisions
        asked = [question.loads for question in chain.table.asked]
    assert asked == [(), (pytest.approx(2 / 1.15), 1.0), (pytest.approx(1.2 / 1.15), 1.0)]


@in_virtual_time
async def test_touch_is_from_rest_400_ms_after_the_last_vibration() -> None:
    """Not while the plate still rings after it, where an onset has another contrast."""
    async with set_running() as chain:
        for pause in (0.1, 0.3, 0.5):
            await chain.hold(0.2, down=[FINGER])
            await chain.leave(pause)
        await chain.hold(0.1, down=[FINGER])
        assert [each.from_rest for each in chain.applied] == [True, False, False, True]


@in_virtual_time
async def test_touch_is_being_prepared_until_its_set_is_sent() -> None:
    """Not while its reply is awaited; nor for a frame without a change or without a new set."""
    async with set_running() as chain:
        await asyncio.sleep(0.02)
        chain.far_end.delay(0.010)
        is_preparing = [chain.controller.is_preparing]
        chain.put(FINGER)
        is_preparing.append(chain.controller.is_preparing)
        await asyncio.sleep(0.015)
        is_preparing.append(chain.controller.is_preparing)
        await asyncio.sleep(0.015)
        chain.put(FINGER)
        is_preparing.append(chain.controller.is_preparing)
        before = len(chain.far_end.sent())
        chain.put(NEAR)
        is_preparing.append(chain.controller.is_preparing)
        await asyncio.sleep(0.025)
        assert len(chain.far_end.sent()) == before
        is_preparing.append(chain.controller.is_preparing)
    assert is_preparing == [False, True, False, False, True, False]


@in_virtual_time
async def test_latency_counts_to_the_commit_with_several_amplifiers() -> None:
    """To its last byte, 10 ms after the stage, whose reply takes as long; not to the read-back."""
    async with set_running("west", "east") as chain:
        for end in chain.far_ends:
            end.delay(0.010)
        await chain.leave(0.040, FINGER, ago=0.003)
        (applied,) = chain.applied
        assert applied.latency == pytest.approx(0.013)


@in_virtual_time
async def test_controller_keeps_phase_when_a_finger_moves() -> None:
    """The same ERA at the same frequency continues; after silence or another ERA it restarts."""
    async with set_running() as chain:
        await chain.hold(0.1, down=[FINGER])
        chain.table.excitation = {"SW": Tone(110.0, 30e-6)}
        await chain.hold(0.1, down=[(1, 0.18, 0.1)])
        chain.table.excitation = BOTH
        await chain.hold(0.1, down=[(1, 0.21, 0.1)])
        await chain.leave(0.01)
        await chain.hold(0.1, down=[(2, 0.21, 0.1)])
        played = [each for each in chain.far_end.sent() if not each.is_silent]
        assert [[c.keep_phase for c in each.layer.commands] for each in played] == [
            [False] * 3,
            [True, False, False],
            [False] * 3,
            [False] * 3,
        ]


@in_virtual_time
async def test_controller_keeps_phase_at_a_frequency_that_the_wire_rounds() -> None:
    """101.33 Hz are 101.35 Hz in its steps of 0.05 Hz: what plays is what was asked for before."""
    async with set_running() as chain:
        chain.table.excitation = {"SW": Tone(101.33, 30e-6)}
        await chain.hold(0.1, down=[FINGER])
        await chain.hold(0.1, down=[(1, 0.18, 0.1)])
        tones = [each.layer.commands[0] for each in chain.far_end.sent() if not each.is_silent]
        assert [tone.frequency for tone in tones] == [2027, 2027]
        assert [tone.keep_phase for tone in tones] == [False, True]


@pytest.mark.parametrize("kind", ["Set", "Commit", "GetStatus", "Ping"])
@in_virtual_time
async def test_controller_silences_a_lift_while_a_reply_is_awaited(kind: str) -> None:
    """Zero is reached within 20 ms also while the reply to another request is missing."""
    async with set_running(breaks="answer") as chain:
        if kind in ("GetStatus", "Ping"):
            await chain.hold(0.1, down=[FINGER])
        awaited = asyncio.Event()

        def note(name: str, values: Values) -> None:
            if name == kind:
                chain.far_end.delay(0.045)
                awaited.set()

        chain.far_end.answer = note
        chain.put(FINGER)
        await awaited.wait()
        chain.far_end.answer = lambda name, values: None
        await asyncio.sleep(0.001)
        await chain.leave(0.02)
        assert not any(chain.far_end.levels)
        chain.far_end.delay(0.0)
        beats = len(chain.far_end.times("Ping"))
        await asyncio.sleep(0.06)
        assert chain.silenced[-1].reason == NO_CONTACTS
        assert len(chain.far_end.times("Ping")) > beats
        assert chain.controller.group.state is GroupState.ARMED


@pytest.mark.parametrize("later", range(3))
@in_virtual_time
async def test_lift_as_a_set_is_confirmed_precedes_a_due_heartbeat(later: int) -> None:
    """In whichever of the last iterations of the event loop before the exchange ends it comes."""
    async with set_running("a", "b") as chain:
        before: list[int] = []  # requests to each amplifier before the lift

        def lift(after: int) -> None:
            if after:
                asyncio.get_running_loop().call_soon(lift, after - 1)
            else:
                before.extend(len(end.asked) for end in chain.far_ends)
                chain.put()

        def answer(name: str, values: Values) -> None:
            if name == "Commit" and not before:  # until its reply arrives
                asyncio.get_running_loop().call_later(0.002, lift, later)

        await asyncio.sleep(0.046)
        for end in chain.far_ends:
            end.delay(0.002)
        chain.far_ends[-1].answer = answer
        await chain.leave(0.05, FINGER)
        for end, count in zip(chain.far_ends, before, strict=True):
            sent = end.names(count)
            assert sent.index("Silence") < sent.index("Ping")


@pytest.mark.parametrize("ago", [5.0, 0.146])
@in_virtual_time
async def test_controller_silences_a_timeout_while_a_reply_is_awaited(ago: float) -> None:
    """Zero is sent 8 ms after the contact timeout, without waiting for outdated replies.

    The frame is too old when it arrives, or becomes so while the amplifier takes 40 ms to reply.
    """
    async with set_running(breaks="answer") as chain:
        chain.far_end.delay(0.04)
        await chain.leave(0.002, FINGER)
        chain.put(FINGER, ago=ago)
        over = max(now(), now() - ago + 0.15)
        await asyncio.sleep(0.1)
        assert first_silence(chain, over) - over == pytest.approx(0.008, abs=1e-4)


@in_virtual_time
async def test_controller_times_out_a_finger_from_before_arming() -> None:
    """Zero is sent at once, since nothing is under way."""
    async with set_running(breaks="answer") as chain:
        await chain.controller.disarm()
        chain.put(FINGER)
        over = now() + 0.15
        await asyncio.sleep(0.13)
        await chain.controller.arm()
        chain.far_end.delay(0.04)
        await asyncio.sleep(0.2)
        assert first_silence(chain, over) == pytest.approx(over, abs=1e-4)


@in_virtual_time
async def test_heartbeat_stops_when_the_loop_hangs() -> None:
    """While the loop waits for one amplifier, the other gets no heartbeat."""
    async with set_running("a", "b") as chain:
        slow, other = chain.far_ends
        slow.fault("hang", lasts=0.1)
        hung = now()
        await chain.leave(0.08, FINGER)
        assert [time for time in other.times("Ping") if time > hung] == []
        await asyncio.sleep(0.5)
        assert [time for time in other.times("Ping") if time > hung] != []


@in_virtual_time
async def test_arm_changes_nothing_while_armed() -> None:
    """No second Arm is sent, for it would begin another session; heartbeats go on."""
    async with set_running() as chain:
        begin = len(chain.far_end.asked)
        await asyncio.gather(*(chain.controller.arm() for _ in range(2)))
        await asyncio.sleep(2.5 * HEARTBEAT)
        kinds = chain.far_end.names(begin)
        assert "Arm" not in kinds
        assert "Ping" in kinds
        assert chain.controller.group.state is GroupState.ARMED


@pytest.mark.parametrize("amplifiers", [["main"], ["left", "right"]])
@in_virtual_time
async def test_controller_retries_a_pattern_when_the_rate_limit_permits(
    amplifiers: list[str],
) -> None:
    """Of two sets a second the third is refused, and played 1.1 s after the first.

    A tenth more than a second, in case the first is delayed on its way.

    The table is not queried in between; a finger that has lifted by then is not played.
    """
    async with set_running(*amplifiers, rate=2.0) as chain:
        chain.table.excitation = BOTH
        begin = now()
        for _ in range(2):
            await chain.leave(0.010, FINGER)
            await chain.leave(0.010)
        asked = len(chain.table.asked)
        await chain.hold(1.0, down=[FINGER])
        (refusal,) = chain.refused
        assert "2 command sets" in refusal
        assert chain.silenced[-1].reason == refusal
        assert not any(chain.far_end.levels)
        await chain.hold(0.2, down=[FINGER])
        assert any(chain.far_end.levels)
        assert len(chain.refused) == 1
        assert len(chain.table.asked) == asked + 1
        assert chain.applied[-1].time == pytest.approx(begin + 1.1, abs=1e-3)
        for refused in (1, 2):
            await chain.leave(0.010)
            await chain.leave(0.010, FINGER)
            assert len(chain.refused) == refused
        await chain.leave(2)
        assert not any(chain.far_end.levels)
        assert len(chain.applied) == 4


@in_virtual_time
async def test_opening_again_gives_no_limit_anew() -> None:
    """Of two sets a second the third is refused though all was closed and opened before it."""
    async with set_chain(rate=2.0) as chain:
        for _ in range(3):
            await chain.controller.open()
            await chain.controller.arm()
            for touches in ((FINGER,), ()):
                chain.put(*touches)
                await chain.controller.step()
            await chain.controller.close()
        assert len(chain.applied) == 2
        assert len(chain.refused) == 1


@in_virtual_time
async def test_controller_survives_a_failing_observer(caplog: pytest.LogCaptureFixture) -> None:
    """Its exceptions are logged; pattern, silence and heartbeats are sent all the same."""

    def fail(*_: object) -> None:
        raise RuntimeError("no disk space for this row")

    observer = Observer(contacts_changed=fail, pattern_applied=fail, silenced=fail)
    async with set_running(observer=observer) as chain:
        await chain.leave(0.01, FINGER)
        await chain.leave(0.2)
        assert [each.is_silent for each in chain.far_end.sent()] == [True, False, True]
        assert len(chain.far_end.requests("Ping")) > 3
    assert "no disk space for this row" in caplog.text
