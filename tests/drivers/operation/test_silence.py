"""What a stop reports about an amplifier's silence."""

import asyncio
from dataclasses import replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers import clock
from drivers.amplifier import Amplifier
from drivers.command import CommandSet, DriveCommand
from drivers.errors import LinkError
from drivers.guard import Guard, GuardLimits
from drivers.operation.silence import SilenceStatus, StopOutcome, stop_and_confirm, stop_outcome
from drivers.protocol.messages import Status, Stop
from lossy_backend import Fate, LossyBackend
from sim.amplifier.amplifier import SimulatedAmplifier
from vendor_pages import ARMED, OFF, PLAYING, STOPPED
from virtual_loop import in_virtual_time

NOW = 100.0
WATCHDOG = 0.25
SLACK = 0.026  # s; the protocol's 5 ms to fall silent, and an amplifier's reaction


@pytest.mark.parametrize(
    ("status", "last_fed_at", "watchdog", "silence", "until"),
    [
        (replace(STOPPED, levels=(0.0,) * 4), None, None, SilenceStatus.CONFIRMED, None),
        (OFF, 99.9, WATCHDOG, SilenceStatus.MAY_PLAY, 100.15),  # cleared: a late Arm might follow
        (replace(STOPPED, levels=(0.0,) * 4), 99.99, WATCHDOG, SilenceStatus.CONFIRMED, None),
        (STOPPED, 99.9, WATCHDOG, SilenceStatus.MAY_PLAY, 100.15),  # still on its ramp
        (ARMED, 99.9, WATCHDOG, SilenceStatus.MAY_PLAY, 100.15),  # silent, and ready to play
        (PLAYING, 90.0, WATCHDOG, SilenceStatus.MAY_PLAY, None),  # another host feeds it
        (None, 99.9, WATCHDOG, SilenceStatus.MAY_PLAY, 100.15),
        (None, 99.7, WATCHDOG, SilenceStatus.WATCHDOG_ELAPSED, None),
        (None, 90.0, WATCHDOG, SilenceStatus.WATCHDOG_ELAPSED, None),
        (None, 90.0, None, SilenceStatus.MAY_PLAY, None),  # no watchdog
        (None, None, WATCHDOG, SilenceStatus.MAY_PLAY, None),  # never reached
    ],
)
def test_stop_outcome_by_status_and_watchdog(
    status: Status | None,
    last_fed_at: float | None,
    watchdog: float | None,
    silence: SilenceStatus,
    until: float | None,
) -> None:
    """Only a status in a state that plays nothing confirms; only a known watchdog ends it."""
    outcome = stop_outcome(
        status, latch_before=0, last_fed_at=last_fed_at, watchdog=watchdog, now=NOW
    )
    assert outcome.silence is silence
    assert outcome.is_confirmed is (silence is SilenceStatus.CONFIRMED)
    assert (outcome.cause == "") is outcome.is_confirmed
    if until is None:
        assert outcome.may_play_until is None
    else:
        assert outcome.may_play_until is not None
        assert until <= outcome.may_play_until <= until + SLACK


@pytest.mark.parametrize(
    ("latch", "before", "is_confirmed"),
    [
        (1, 0, True),
        (1, 255, True),
        (127, 255, True),
        (9, 9, False),
        (8, 9, False),
        (9, None, False),
    ],
)
def test_only_a_newer_latch_confirms(latch: int, before: int | None, is_confirmed: bool) -> None:
    """They count from 1 to 255, then from 1 again; what was read before no Stop proves nothing."""
    status = replace(STOPPED, levels=(0.0,) * 4, latch=latch)
    outcome = stop_outcome(status, latch_before=before, last_fed_at=NOW, watchdog=WATCHDOG, now=NOW)
    assert outcome.is_confirmed is is_confirmed


def test_outcome_as_json() -> None:
    """The time left is relative, and never negative."""
    outcome = StopOutcome(SilenceStatus.MAY_PLAY, 100.2, "no reply")
    expected = {"silence": "may_play", "may_play_for_s": 0.2, "cause": "no reply"}
    assert outcome.to_json(100.0) == expected
    assert outcome.to_json(101.0)["may_play_for_s"] == 0.0
    assert StopOutcome(SilenceStatus.CONFIRMED).to_json(0.0)["may_play_for_s"] is None


async def playing(backend: LossyBackend) -> Amplifier:
    """An amplifier that plays at half level on channel 0."""
    amplifier = Amplifier(backend)
    await amplifier.open()
    await amplifier.arm(WATCHDOG)
    guard = Guard(GuardLimits(40.0, 500.0, 1.0), amplifier.capabilities)
    command = DriveCommand(0, 110.0, 0.5)
    await amplifier.apply(guard.check(CommandSet(1, (command,), ramp=0.0, valid_for=0.0)))
    return amplifier


def simulated() -> LossyBackend:
    """A backend over a simulated amplifier of its own."""
    return LossyBackend(SimulatedAmplifier("main", channels=4))


@given(
    st.lists(st.sampled_from([Fate.DELIVERED, Fate.REQUEST_LOST, Fate.REPLY_LOST]), max_size=12),
    st.sampled_from([Fate.DELIVERED, Fate.REQUEST_LOST, Fate.CUT]),
    st.floats(0.0, 0.4),
)
@settings(max_examples=100, deadline=None)
@in_virtual_time
async def test_confirmed_silence_is_never_wrong(
    fates: list[Fate], last: Fate, pause: float
) -> None:
    """Whatever is lost: confirmed means silent, and after the stated time it is silent."""
    backend = simulated()
    amplifier = await playing(backend)
    await asyncio.sleep(pause)
    remaining = iter(fates)
    backend.fate = lambda request: next(remaining, last)
    outcome = await stop_and_confirm(amplifier)
    if outcome.silence is SilenceStatus.MAY_PLAY:
        assert outcome.may_play_until is not None
        await asyncio.sleep(outcome.may_play_until - clock.now())
    far_end = backend.amplifier
    far_end.tick(clock.now())
    assert not any(far_end.status(clock.now()).levels)
    assert outcome.is_confirmed or outcome.cause


@in_virtual_time
async def test_stop_is_repeated_on_a_lost_link() -> None:
    """A link lost before the stop, whose wire is open: its stop still arrives and is confirmed."""
    backend = simulated()
    amplifier = await playing(backend)
    backend.fate = lambda request: Fate.REQUEST_LOST
    while not amplifier.is_lost:
        with pytest.raises(LinkError):
            await amplifier.heartbeat()
    backend.sent.clear()
    backend.fate = lambda request: (
        Fate.DELIVERED if backend.sent.count(Stop(0.005)) > 2 else Fate.REQUEST_LOST
    )
    outcome = await stop_and_confirm(amplifier)
    assert outcome.is_confirmed
    assert set(map(type, backend.sent)) == {Stop}
    assert amplifier.is_lost


@in_virtual_time
async def test_further_request_is_sent_before_the_ramp_has_ended() -> None:
    """Within a millisecond, although the stop before it is not confirmed yet."""
    backend = simulated()
    amplifier = await playing(backend)
    backend.sent.clear()
    requested = asyncio.Event()
    stopping = asyncio.create_task(stop_and_confirm(amplifier, requested=requested))
    await asyncio.sleep(0.003)
    assert list(map(type, backend.sent)) == [Stop]
    requested.set()
    await asyncio.sleep(0.001)
    assert list(map(type, backend.sent)) == [Stop, Stop]
    assert (await stopping).is_confirmed


@in_virtual_time
async def test_outcome_long_after_a_loss() -> None:
    """Its watchdog has elapsed; nothing says that it is silent."""
    backend = simulated()
    amplifier = await playing(backend)
    backend.fate = lambda request: Fate.CUT
    with pytest.raises(LinkError):
        await amplifier.heartbeat()
    await asyncio.sleep(3600.0)
    outcome = await stop_and_confirm(amplifier)
    assert outcome.silence is SilenceStatus.WATCHDOG_ELAPSED
    assert "the wire is cut" in outcome.cause


@in_virtual_time
async def test_never_armed_amplifier_may_play() -> None:
    """Another host may have armed it, and its watchdog is unknown."""
    outcome = await stop_and_confirm(Amplifier(simulated()))
    assert (outcome.silence, outcome.may_play_until) == (SilenceStatus.MAY_PLAY, None)


@in_virtual_time
async def test_time_of_the_last_feed_is_an_upper_bound() -> None:
    """While a feeding request is under way it is now; a status does not feed."""
    backend = simulated()
    amplifier = Amplifier(backend)
    await amplifier.open()
    await amplifier.status()
    assert (amplifier.last_fed_at, amplifier.watchdog) == (None, None)
    await amplifier.arm(WATCHDOG)
    armed_at = amplifier.last_fed_at
    assert armed_at == clock.now()
    assert amplifier.watchdog == WATCHDOG
    backend.fate = lambda request: Fate.REPLY_LOST
    beating = asyncio.create_task(amplifier.heartbeat())
    await asyncio.sleep(0.01)
    assert amplifier.last_fed_at == clock.now() > armed_at
    beating.cancel()
    await asyncio.gather(beating, return_exceptions=True)
    fed_at = clock.now()
    backend.fate = lambda request: Fate.DELIVERED
    await asyncio.sleep(0.05)
    await amplifier.status()
    assert amplifier.last_fed_at == fed_at
