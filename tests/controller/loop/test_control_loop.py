"""The control loop, on a virtual clock and with an amplifier that records what it is asked."""

import asyncio
import logging
import math
import re
from collections.abc import Callable
from itertools import pairwise

import pytest

from controller.group.amplifier_group import Phase
from controller.loop.intent import NO_CONTACTS
from controller.loop.observer import Observer
from controller.sources.touch import Touch, TouchFrame, TouchSource
from controller_bench import FINGER, OTHER, make_bench, running
from drivers.errors import LinkTimeout
from drivers.operation.watchdog import HEARTBEAT
from drivers.protocol.messages import (
    AmplifierState,
    Apply,
    Arm,
    Commit,
    GetCaps,
    Hello,
    Ping,
    Reply,
    Request,
)
from model.errors import InputError
from model.vibration.excitation import Excitation, Tone
from virtual_loop import in_virtual_time


@in_virtual_time
async def test_controller_plays_a_touch_within_one_turn() -> None:
    """A touch is on the wire in the same moment, as worked out by hand, and is told as confirmed.

    20 of 100 µm is level 0.2; the pattern's own ramp goes with it; latency counts from the frame.
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
        (applied,) = bench.told.applied
        assert applied.latency == pytest.approx(0.003)
        (felt,) = applied.targets
        assert (felt.contact.x, felt.contact.y) == pytest.approx((0.15, 0.1))
        assert (felt.wanted_db_sl, felt.level_db_sl, felt.contrast_db) == (20.0, 20.0, None)
        assert applied.quiet == ()
        assert applied.pattern.level_db_sl == 20.0
        assert applied.drive == {"SW": played.commands[0]}
        assert bench.told.contacts == [1]


@in_virtual_time
async def test_latency_counts_to_the_commit_with_several_amplifiers() -> None:
    """To its last byte, 10 ms after the stage whose answer takes as long; not to the read-back."""
    async with running("west", "east") as bench:
        for far_end in bench.far_ends:
            far_end.delay = 0.010
        bench.touch(FINGER, ago=0.003)
        await asyncio.sleep(0.040)
        (applied,) = bench.told.applied
        assert applied.latency == pytest.approx(0.013)


@in_virtual_time
async def test_controller_keeps_phase_when_a_finger_moves() -> None:
    """The same ERA at the same frequency runs on, another level or not; after silence it starts."""
    async with running() as bench:
        await bench.hold(FINGER, seconds=0.1)
        bench.table.excitation = {"SW": Tone(110.0, 30e-6)}
        await bench.hold((1, 0.6, 0.5), seconds=0.1)
        bench.table.excitation = {"SW": Tone(110.0, 30e-6), "NE": Tone(110.0, 30e-6)}
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
async def test_controller_restarts_phase_after_an_unconfirmed_set() -> None:
    """After a disarm nobody knows what plays: the next pattern counts from its commit."""
    bench = make_bench()
    await bench.controller.open()
    await bench.controller.arm()
    bench.touch(FINGER)
    await bench.controller.step()
    await bench.controller.disarm()
    await bench.controller.arm()
    await bench.controller.step()
    assert [each.commands[0].keep_phase for each in bench.far_end.sets()] == [False, False]
    await bench.controller.close()


@in_virtual_time
async def test_controller_silences_after_the_last_lift() -> None:
    """When the last finger lifts, every channel is at zero within 20 ms, ramp included."""
    async with running() as bench:
        bench.touch(FINGER, OTHER)
        await asyncio.sleep(0.02)
        lifted = asyncio.get_running_loop().time()
        bench.touch()
        await asyncio.sleep(0.02)
        zero = bench.far_end.sets()[-1]
        assert zero.is_silent
        assert {command.channel for command in zero.commands} == {0, 1}
        assert bench.far_end.times(Apply)[-1] + zero.ramp - lifted <= 0.020
        assert bench.told.silenced[-1].reason == NO_CONTACTS
        assert bench.told.silenced[-1].latency == 0.0


@pytest.mark.parametrize("kind", [Apply, Ping])
@in_virtual_time
async def test_controller_silences_a_lift_while_a_reply_is_awaited(kind: type[Request]) -> None:
    """Zero is reached within 20 ms also where the answer to something else does not come."""
    async with running() as bench:
        due = asyncio.get_running_loop().time()
        if kind is Ping:
            await bench.hold(FINGER, seconds=0.1)
            due = bench.far_end.times(Ping)[-1] + HEARTBEAT
        bench.far_end.delay = 0.045
        bench.touch(FINGER)
        await asyncio.sleep(due + 0.001 - asyncio.get_running_loop().time())
        assert isinstance(bench.far_end.asked[-1][1], kind)
        lifted = asyncio.get_running_loop().time()
        bench.touch()
        await asyncio.sleep(0.02)
        zero = bench.far_end.sets()[-1]
        assert zero.is_silent
        assert bench.far_end.times(Apply)[-1] + zero.ramp - lifted <= 0.020
        bench.far_end.delay = 0.0
        beats = len(bench.far_end.times(Ping))
        await asyncio.sleep(0.06)
        assert len(bench.far_end.times(Ping)) > beats
        assert bench.controller.phase is Phase.ARMED


@in_virtual_time
async def test_controller_repeats_no_aborted_request() -> None:
    """A Ping that nobody has answered in time gives way to what is due since, and is no fault.

    The last finger lifts 25 ms after it, and another comes at once, so that a pattern is due.
    """
    async with running() as bench:
        await bench.hold(FINGER, seconds=0.1)
        beat = bench.far_end.times(Ping)[-1] + HEARTBEAT
        bench.touch(FINGER)
        await asyncio.sleep(beat - 0.001 - asyncio.get_running_loop().time())

        def nobody(request: Request) -> Reply | None:
            if isinstance(request, Ping):
                raise LinkTimeout("no answer")
            return None

        bench.far_end.delay, bench.far_end.answer = 0.030, nobody
        asked = len(bench.far_end.asked)
        await asyncio.sleep(0.026)
        bench.touch()
        bench.touch(OTHER)
        await asyncio.sleep(0.010)
        bench.far_end.delay, bench.far_end.answer = 0.0, lambda request: None
        (first, ping), (second, pattern), *_ = bench.far_end.asked[asked:]
        assert isinstance(ping, Ping)
        assert isinstance(pattern, Apply)
        assert not pattern.command_set.is_silent
        assert second == pytest.approx(first + 0.030)
        assert bench.controller.phase is Phase.ARMED
        assert bench.told.refused == []


@in_virtual_time
async def test_controller_commits_no_set_after_its_finger_lifted() -> None:
    """Two amplifiers, one of which takes 5 ms to stage: the finger lifts meanwhile."""
    async with running("a", "b") as bench:
        bench.far_ends[0].delay = 0.005
        bench.touch(FINGER)
        await asyncio.sleep(0.003)
        bench.touch()
        await asyncio.sleep(0.010)
        for far_end in bench.far_ends:
            assert far_end.requests(Commit) == []
            assert far_end.sets()[-1].is_silent
        assert bench.controller.phase is Phase.ARMED
        assert bench.told.refused == []


@in_virtual_time
async def test_controller_silences_before_a_due_heartbeat() -> None:
    """Silence goes before a heartbeat that is due, and several amplifiers fall silent at once."""
    async with running("a", "b") as bench:
        await asyncio.sleep(0.045)
        for far_end in bench.far_ends:
            far_end.delay = 0.004
        bench.touch(FINGER)
        await asyncio.sleep(0.002)
        lifted = asyncio.get_running_loop().time()
        bench.touch()
        await asyncio.sleep(0.02)
        for far_end in bench.far_ends:
            assert far_end.sets()[-1].is_silent
            assert far_end.times(Apply)[-1] + 0.010 - lifted <= 0.020
            silent, beat = far_end.times(Apply)[-1], far_end.times(Ping)[-1]
            assert lifted < silent < beat


@in_virtual_time
async def test_controller_resends_cancelled_silence() -> None:
    """A loop that takes over from one that was cancelled does not count on its last command."""
    bench = make_bench()
    await bench.controller.open()
    await bench.controller.arm()
    bench.touch(FINGER)
    await bench.controller.step()
    bench.far_end.delay = 0.01
    bench.touch()
    first = asyncio.create_task(bench.controller.run())
    await asyncio.sleep(0.001)
    first.cancel()
    await asyncio.gather(first, return_exceptions=True)
    second = asyncio.create_task(bench.controller.run())
    await asyncio.sleep(0.001)
    assert [each.is_silent for each in bench.far_end.sets()] == [False, True, True]
    await bench.controller.close()
    await second


@in_virtual_time
async def test_controller_silences_when_a_source_times_out() -> None:
    """150 ms after the last news the contact counts as lifted, and zero is on the wire."""
    async with running() as bench:
        bench.touch(FINGER)
        start = asyncio.get_running_loop().time()
        await asyncio.sleep(0.3)
        assert [each.is_silent for each in bench.far_end.sets()] == [True, False, True]
        assert bench.far_end.times(Apply)[-1] == pytest.approx(start + 0.150, abs=1e-6)


@in_virtual_time
async def test_controller_sends_no_set_twice() -> None:
    """A finger at rest, repeated by its source, costs the wire heartbeats only."""
    async with running() as bench:
        await bench.hold(FINGER, seconds=1.0)
        assert len(bench.far_end.sets()) == 2  # silence after arming, then the pattern


@in_virtual_time
async def test_heartbeat_keeps_its_interval() -> None:
    """While armed a heartbeat goes out every 50 ms, whether or not anybody touches."""
    async with running() as bench:
        await asyncio.sleep(0.5)
        await bench.hold(FINGER, seconds=0.5)
        times = bench.far_end.times(Ping)
        pauses = [later - earlier for earlier, later in pairwise(times)]
        assert len(pauses) in (19, 20)  # within a second, by rounding
        assert pauses == pytest.approx([0.05] * len(pauses), abs=1e-6)


@in_virtual_time
async def test_heartbeat_is_sent_only_after_the_loop_has_run() -> None:
    """Nothing but a turn of the loop beats, once per turn, and after what the turn had to send."""
    bench = make_bench()
    await bench.controller.open()
    await bench.controller.arm()
    await asyncio.sleep(1.0)
    assert bench.far_end.requests(Ping) == []
    bench.touch(FINGER)
    await bench.controller.step()
    kinds = [type(request) for _, request in bench.far_end.asked]
    assert kinds == [Hello, GetCaps, Arm, Apply, Ping]
    await asyncio.sleep(1.0)
    assert len(bench.far_end.requests(Ping)) == 1
    await bench.controller.close()


@in_virtual_time
async def test_heartbeat_stops_when_the_loop_hangs() -> None:
    """While the loop waits for an amplifier that does not answer, the other gets no heartbeat."""
    async with running("a", "b") as bench:
        slow, other = bench.far_ends
        slow.delay = 0.4
        hung = asyncio.get_running_loop().time()
        bench.touch(FINGER)
        await asyncio.sleep(0.35)
        assert [time for time in other.times(Ping) if time > hung] == []
        slow.delay = 0.0
        await asyncio.sleep(0.5)
        assert [time for time in other.times(Ping) if time > hung] != []


@in_virtual_time
async def test_controller_uses_the_latest_frame() -> None:
    """Frames that come while a command is on the wire are not sent one by one."""
    async with running() as bench:
        bench.far_end.delay = 0.02
        bench.touch(FINGER)
        for step in range(1, 10):
            await asyncio.sleep(0.001)
            bench.touch((1, 0.5 + 0.04 * step, 0.5))
        await asyncio.sleep(0.1)
        touched = [applied.targets[0].contact.x for applied in bench.told.applied]
        assert touched == pytest.approx([0.15, 0.258])


@pytest.mark.parametrize(
    ("error", "reason", "logged"),
    [
        (InputError("no pattern reaches 20 dB SL there"), "no pattern reaches 20 dB SL there", 0),
        (ZeroDivisionError("a bug"), "ZeroDivisionError: a bug", 1),
    ],
)
@in_virtual_time
async def test_controller_silences_when_the_table_fails(
    caplog: pytest.LogCaptureFixture, error: Exception, reason: str, logged: int
) -> None:
    """No answer is silence with its reason; a bug is logged once; the next touch is felt again."""
    async with running() as bench:
        await bench.hold(FINGER, seconds=0.1)
        excitation, bench.table.excitation = bench.table.excitation, error
        await bench.hold(FINGER, OTHER, seconds=0.2)
        assert [each.is_silent for each in bench.far_end.sets()] == [True, False, True]
        assert bench.told.silenced[-1].reason == reason
        bench.table.excitation = excitation
        bench.touch(FINGER)
        bench.touch(FINGER, (3, 0.1, 0.1))
        await asyncio.sleep(0.01)
        assert not bench.far_end.sets()[-1].is_silent
    assert len([r for r in caplog.records if r.levelno == logging.ERROR]) == logged


@pytest.mark.parametrize(
    ("excitation", "complaint"),
    [
        ({"SW": Tone(110.0, 101e-6)}, r"main: level of channel 0 .*1\.01"),
        ({"SW": Tone(39.0, 10e-6)}, "main: frequency of channel 0 .*39 Hz"),
        ({"SW": Tone(110.0, math.nan)}, "main: level of channel 0 .*nan"),
    ],
)
@in_virtual_time
async def test_controller_silences_when_the_guard_refuses(
    excitation: Excitation, complaint: str
) -> None:
    """A pattern that the guard does not let through becomes a zero command, and is told."""
    async with running() as bench:
        await bench.hold(FINGER, seconds=0.1)
        bench.table.excitation = excitation
        await bench.hold(FINGER, OTHER, seconds=0.1)
        assert [each.is_silent for each in bench.far_end.sets()] == [True, False, True]
        (refusal,) = bench.told.refused
        assert re.match(complaint, refusal)
        assert bench.told.silenced[-1].reason == refusal
        assert bench.controller.phase is Phase.ARMED


@pytest.mark.parametrize("amplifiers", [["main"], ["left", "right"]])
@in_virtual_time
async def test_controller_retries_a_pattern_when_the_rate_limit_permits(
    amplifiers: list[str],
) -> None:
    """Two sets a second: the third touch is refused, and half a second after it is felt, resting.

    Nothing is asked in vain before; and a finger that has left meanwhile is not felt any more.
    """
    loop = asyncio.get_running_loop()
    async with running(*amplifiers, rate=2.0) as bench:
        bench.table.excitation = {"SW": Tone(110.0, 2e-5), "NE": Tone(110.0, 2e-5)}
        begin = loop.time()
        for _ in range(2):
            bench.touch(FINGER)
            await asyncio.sleep(0.010)
            bench.touch()
            await asyncio.sleep(0.010)
        asked = len(bench.table.asked)
        await bench.hold(FINGER, seconds=0.4)
        (refusal,) = bench.told.refused
        assert "2 command sets" in refusal
        assert bench.told.silenced[-1].reason == refusal
        assert not any(bench.far_end.levels)
        await bench.hold(FINGER, seconds=0.2)
        assert any(bench.far_end.levels)
        assert len(bench.told.refused) == 1
        assert len(bench.table.asked) == asked + 1
        assert bench.told.applied[-1].time == pytest.approx(begin + 0.5, abs=1e-3)
        bench.touch()
        await asyncio.sleep(0.010)
        bench.touch(FINGER)
        await asyncio.sleep(0.010)
        assert len(bench.told.refused) == 2
        bench.touch()
        await asyncio.sleep(2)
        assert not any(bench.far_end.levels)
        assert len(bench.told.applied) == 3


@in_virtual_time
async def test_controller_silences_for_an_unknown_era() -> None:
    """A table that drives an unknown ERA makes silence, not half a pattern."""
    async with running() as bench:
        bench.table.excitation = {"SW": Tone(110.0, 1e-6), "XX": Tone(110.0, 1e-6)}
        await bench.hold(FINGER, seconds=0.1)
        assert all(each.is_silent for each in bench.far_end.sets())
        assert "got XX" in bench.told.silenced[-1].reason


@in_virtual_time
async def test_controller_sends_no_silence_twice() -> None:
    """From one silence to another, for another reason, costs nothing but the telling."""
    async with running() as bench:
        bench.table.excitation = InputError("nothing is felt there")
        await bench.hold(FINGER, seconds=0.1)
        assert [each.is_silent for each in bench.far_end.sets()] == [True]
        told = [(silenced.reason, silenced.latency is None) for silenced in bench.told.silenced]
        assert told == [(NO_CONTACTS, False), ("nothing is felt there", True)]


@in_virtual_time
async def test_controller_rejects_a_touch_at_nan() -> None:
    """A touch that is nowhere sends nothing and is counted."""
    async with running() as bench:
        before = len(bench.far_end.sets())
        await bench.hold((1, math.nan, 0.5), (2, 0.5, 1.2), seconds=0.1)
        assert len(bench.far_end.sets()) == before
        assert bench.told.contacts == []
        assert bench.controller.rejected_touches == {"not_finite": 2, "off_plate": 2}


@in_virtual_time
async def test_controller_survives_a_failing_observer(caplog: pytest.LogCaptureFixture) -> None:
    """Whatever an observer raises is logged, and the finger feels what it should."""

    def fail(*_: object) -> None:
        raise RuntimeError("no disk space for this row")

    observer = Observer(contacts_changed=fail, pattern_applied=fail, silenced=fail)
    async with running(observer=observer) as bench:
        bench.touch(FINGER)
        await asyncio.sleep(0.01)
        bench.touch()
        await asyncio.sleep(0.2)
        assert [each.is_silent for each in bench.far_end.sets()] == [True, False, True]
        assert len(bench.far_end.requests(Ping)) > 3
    assert "no disk space for this row" in caplog.text


class FailingSource(TouchSource):
    """A touch source that sees one finger and then breaks."""

    async def run(self, deliver: Callable[[TouchFrame], None]) -> None:
        """Break after 10 ms."""
        deliver(TouchFrame("weak", asyncio.get_running_loop().time(), (Touch(1, 0.5, 0.5),)))
        await asyncio.sleep(0.01)
        raise OSError("the panel was unplugged")


@in_virtual_time
async def test_controller_survives_a_failing_source(caplog: pytest.LogCaptureFixture) -> None:
    """A source that breaks is told; its finger expires; other sources go on."""
    async with running(sources=[FailingSource()]) as bench:
        await asyncio.sleep(0.2)
        assert bench.told.failed == ["OSError: the panel was unplugged"]
        assert bench.far_end.sets()[-1].is_silent
        assert len(bench.told.applied) == 1
        bench.touch(FINGER)
        await asyncio.sleep(0.01)
        assert len(bench.told.applied) == 2
    assert "the panel was unplugged" in caplog.text


@pytest.mark.parametrize("ago", [5.0, 0.146])
@in_virtual_time
async def test_controller_silences_a_timeout_while_a_reply_is_awaited(
    ago: float,
) -> None:
    """Nobody waits for an answer to what is stale: 8 ms after the lease has ended, zero goes out.

    The frame is stale when it comes, or gets so while the amplifier takes 40 ms over its answer.
    """
    loop = asyncio.get_running_loop()
    async with running() as bench:
        bench.far_end.delay = 0.04
        bench.touch((1, 0.5, 0.5))
        await asyncio.sleep(0.002)
        bench.touch((1, 0.5, 0.5), ago=ago)
        over = max(loop.time(), loop.time() - ago + 0.15)
        await asyncio.sleep(0.1)
        silenced = [
            time
            for time, request in bench.far_end.asked
            if isinstance(request, Apply) and request.command_set.is_silent and time >= over
        ]
        assert silenced[0] - over == pytest.approx(0.008, abs=1e-4)


@in_virtual_time
async def test_arm_aborts_no_heartbeat() -> None:
    """Arm has silenced all: a heartbeat that waited behind it gets its answer, as slow as that is.

    Each answer takes 20 ms, and nothing is asked before it has come.
    """
    async with running() as bench:
        await asyncio.sleep(2.5 * HEARTBEAT)
        last = max(time for time, request in bench.far_end.asked if isinstance(request, Ping))
        await asyncio.sleep(last + 0.9 * HEARTBEAT - asyncio.get_running_loop().time())
        bench.far_end.delay = 0.02
        bench.far_end.state = (
            AmplifierState.SWITCH_ON_DISABLED
        )  # from where this one lets itself be armed
        begin = len(bench.far_end.asked)
        await bench.controller.arm()
        await asyncio.sleep(0.1)
        times, requests = zip(*bench.far_end.asked[begin:], strict=True)
        assert [type(request) for request in requests[:3]] == [Arm, Ping, Apply]
        assert min(after - before for before, after in pairwise(times)) > 0.0199


@in_virtual_time
async def test_controller_times_out_a_finger_from_before_arming() -> None:
    """Its lease is watched from the arming on: 8 ms after it has ended, zero goes out."""
    loop = asyncio.get_running_loop()
    async with running() as bench:
        await bench.controller.disarm()
        bench.touch(FINGER)
        over = loop.time() + 0.15
        await asyncio.sleep(0.13)
        await bench.controller.arm()
        bench.far_end.delay = 0.04
        await asyncio.sleep(0.2)
        silenced = [
            time
            for time, request in bench.far_end.asked
            if isinstance(request, Apply) and request.command_set.is_silent and time >= over
        ]
        assert silenced[0] - over == pytest.approx(0.008, abs=1e-4)
