"""Playing one set on several amplifiers."""

from collections.abc import Mapping
from itertools import pairwise

import pytest

from controller.group.synchronized_play import SynchronizedPlay
from controller_bench import FarEnd
from drivers.amplifier import Amplifier
from drivers.command import CommandSet, DriveCommand, Envelope, Knot
from drivers.guard import Guard, GuardLimits
from drivers.operation.checked_amplifier import CheckedAmplifier
from drivers.operation.watchdog import HEARTBEAT
from drivers.protocol.messages import Apply, Arm, Commit, LoadEnvelope, Ping, Request, Stage
from sim.amplifier.amplifier import capabilities
from virtual_loop import in_virtual_time

NAMES = ("a", "b")


async def armed(far_ends: Mapping[str, FarEnd]) -> dict[str, CheckedAmplifier]:
    """Amplifiers at these far ends, armed."""
    amplifiers = {name: CheckedAmplifier(Amplifier(end)) for name, end in far_ends.items()}
    for checked in amplifiers.values():
        await checked.amplifier.open()
        await checked.arm()
    return amplifiers


@pytest.mark.parametrize(("steps", "asked"), [(0, []), (1, [Stage])])
async def test_play_ends_when_silenced_between_steps(
    steps: int, asked: list[type[Request]]
) -> None:
    """Nothing is sent, or nothing committed once all are staged; the set is not incomplete."""
    far_ends = {name: FarEnd() for name in NAMES}
    amplifiers = await armed(far_ends)
    before = len(far_ends["a"].asked)
    guard = Guard(GuardLimits(40.0, 500.0, 1.0), amplifiers["a"].amplifier.capabilities)
    wanted = CommandSet(1, (DriveCommand(0, 110.0, 0.2),), ramp=0.01, valid_for=0.0)
    joint = SynchronizedPlay(amplifiers)
    played = await joint.play(
        dict.fromkeys(NAMES, guard.check(wanted)),
        {},
        may_play=lambda: len(far_ends["b"].asked) < before + steps,
    )
    assert played is None
    assert not joint.is_set_incomplete
    for far_end in far_ends.values():
        assert [type(request) for _, request in far_end.asked[before:]] == asked


@in_virtual_time
async def test_play_reports_when_the_last_commit_was_sent() -> None:
    """The commit on the faster wire is sent 10 ms later."""
    far_ends = {name: FarEnd() for name in NAMES}
    far_ends["a"].commit_takes = 0.010
    amplifiers = await armed(far_ends)
    for far_end in far_ends.values():
        far_end.delay = 0.003
    guard = Guard(GuardLimits(40.0, 500.0, 1.0), amplifiers["a"].amplifier.capabilities)
    wanted = CommandSet(1, (DriveCommand(0, 110.0, 0.2),), ramp=0.01, valid_for=0.0)
    sets = dict.fromkeys(NAMES, guard.check(wanted))
    played = await SynchronizedPlay(amplifiers).play(sets, {}, may_play=lambda: True)
    first, last = sorted(
        time
        for far_end in far_ends.values()
        for time, request in far_end.asked
        if isinstance(request, Commit)
    )
    assert last - first == pytest.approx(0.010)
    assert played is not None
    assert played.sent_at == last


@in_virtual_time
async def test_heartbeat_that_is_due_is_sent_between_envelopes() -> None:
    """Eight of 20 ms each do not feed the watchdog."""
    far_end = FarEnd()
    far_end.amplifier.capabilities = capabilities(2)
    amplifiers = await armed({"a": far_end})
    far_end.delay = 0.020
    guard = Guard(GuardLimits(40.0, 500.0, 1.0), amplifiers["a"].amplifier.capabilities)
    loads = [guard.check_envelope(Envelope(slot, 0.01, (Knot(0.1, 0.0),))) for slot in range(1, 9)]
    safe = guard.check(CommandSet(1, (DriveCommand(0, 110.0, 0.2),), ramp=0.01, valid_for=0.0))
    await SynchronizedPlay(amplifiers).play({"a": safe}, {"a": loads}, may_play=lambda: True)
    fed = [time for time, request in far_end.asked if isinstance(request, Arm | Ping | Apply)]
    assert len(far_end.times(LoadEnvelope)) == 8
    assert max(later - earlier for earlier, later in pairwise(fed)) < HEARTBEAT + 3 * far_end.delay
