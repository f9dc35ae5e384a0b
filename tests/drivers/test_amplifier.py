import asyncio
from collections import deque
from collections.abc import Callable, Coroutine
from dataclasses import replace
from typing import Any, TypeVar

import pytest

from drivers import clock
from drivers.amplifier import Amplifier
from drivers.backend import Backend
from drivers.command import CommandSet
from drivers.errors import CommandError, CommandRefused, FrameError, LinkError, LinkTimeout
from drivers.guard import SafeCommandSet
from drivers.guard.recorder import PlayRecorder
from drivers.line import priority
from drivers.operation.watchdog import check_watchdog
from drivers.protocol.messages import (
    Achieved,
    Apply,
    Arm,
    Clear,
    Disarm,
    GetCaps,
    GetStatus,
    Hello,
    Loaded,
    Nak,
    NakCode,
    Ping,
    Reply,
    Request,
    Stop,
)
from vendor_pages import ARMED as STATUS
from vendor_pages import CAPABILITIES, IDENTITY, SHAPE, usual_reply

MakeSafe = Callable[..., SafeCommandSet]
T = TypeVar("T")


class ScriptedBackend(Backend):
    """Replies at once and well, unless `script` holds a step.

    An exception is raised, a reply returned, a future awaited.
    """

    def __init__(self) -> None:
        self.identity = IDENTITY
        self.script: deque[Exception | Reply | asyncio.Future[Reply]] = deque()
        self.requests: list[Request] = []
        self._last_sent_at = 0.0
        self.at_once = 0
        self.closed = 0

    async def open(self) -> None:
        """Nothing to open."""

    async def close(self) -> None:
        self.closed += 1

    async def exchange(self, request: Request, *, timeout: float) -> Reply:
        """Return the next step of the script, or a good reply."""
        self.requests.append(request)
        self._last_sent_at = clock.now()
        self.at_once += 1
        assert self.at_once == 1, "two requests on the wire at once"
        try:
            await asyncio.sleep(0)
            if not self.script:
                return self.identity if isinstance(request, Hello) else usual_reply(request)
            step = self.script.popleft()
            if isinstance(step, Exception):
                raise step
            return await step if isinstance(step, asyncio.Future) else step
        finally:
            self.at_once -= 1

    @property
    def last_sent_at(self) -> float:
        return self._last_sent_at


@pytest.fixture
def backend() -> ScriptedBackend:
    """A scripted backend."""
    return ScriptedBackend()


@pytest.fixture
async def amplifier(backend: ScriptedBackend) -> Amplifier:
    """An open amplifier over it; the requests of opening are removed."""
    amplifier = Amplifier(backend)
    await amplifier.open()
    backend.requests.clear()
    return amplifier


@pytest.fixture(autouse=True)
def never_preempt(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let every request on the wire wait for its reply."""
    monkeypatch.setattr(priority, "PREEMPTION_GRACE", 60.0)


async def settle() -> None:
    """Run every task until it waits for the test."""
    for _ in range(20):
        await asyncio.sleep(0)


async def started(call: Coroutine[Any, Any, T]) -> "asyncio.Task[T]":
    """Start a call and let it run until it waits."""
    task = asyncio.create_task(call)
    await settle()
    return task


def pending_reply(backend: ScriptedBackend) -> "asyncio.Future[Reply]":
    """Let the next request wait for this reply."""
    reply: asyncio.Future[Reply] = asyncio.get_running_loop().create_future()
    backend.script.append(reply)
    return reply


def kinds(backend: ScriptedBackend) -> list[type[Request]]:
    """Types of the requests sent."""
    return [type(request) for request in backend.requests]


@pytest.mark.parametrize("take_over", [True, False])
async def test_open_identifies_and_disarms(backend: ScriptedBackend, take_over: bool) -> None:
    """Identity and capabilities are known afterwards; a caller that only looks disarms nothing."""
    amplifier = Amplifier(backend)
    with pytest.raises(LinkError, match="not open"):
        await amplifier.status()
    for name in ("identity", "capabilities"):
        with pytest.raises(CommandError, match=rf"{name} .*open\(\)"):
            getattr(amplifier, name)
    await amplifier.open(take_over=take_over)
    assert backend.requests == [Hello(), GetCaps(), *([Disarm(0.05)] if take_over else [])]
    assert amplifier.identity == IDENTITY
    assert amplifier.capabilities == CAPABILITIES


async def test_open_refuses_another_protocol_version(backend: ScriptedBackend) -> None:
    """The wire is closed again."""
    backend.identity = replace(IDENTITY, versions=(3,))
    with pytest.raises(LinkError, match="version must be 2, got 3 from Acme"):
        await Amplifier(backend).open()
    assert backend.closed == 1


@pytest.mark.parametrize(
    "name", ["channels", "voices", "frequency_step", "level_step", "phase_step"]
)
async def test_open_refuses_capabilities_of_zero(backend: ScriptedBackend, name: str) -> None:
    """The wire is closed again; the error names the capability."""
    backend.script += [IDENTITY, replace(CAPABILITIES, **{name: 0})]
    with pytest.raises(FrameError, match=f"above 0, got 0 as {name};"):
        await Amplifier(backend).open()
    assert backend.closed == 1


async def test_request_is_repeated_twice_when_replies_are_lost(
    amplifier: Amplifier, backend: ScriptedBackend, safe: MakeSafe
) -> None:
    """With the same token; any reply restarts the count, so a noisy line is not a lost one."""
    for token in (5, 6, 7):
        backend.requests.clear()
        backend.script += [LinkTimeout("silence"), LinkTimeout("silence")]
        wanted = safe(token)
        assert (await amplifier.apply(wanted)).token == token
        assert backend.requests == [Apply(wanted)] * 3
    assert not amplifier.is_lost


async def test_amplifier_is_lost_after_three_lost_replies(
    amplifier: Amplifier, backend: ScriptedBackend
) -> None:
    """Every call fails at once with cause and remedy; reopened it has all its retries again."""
    backend.script += [LinkTimeout("no answer")] * 3
    with pytest.raises(LinkTimeout, match="3 requests in a row"):
        await amplifier.heartbeat()
    assert amplifier.is_lost
    for call in (amplifier.arm, amplifier.disarm, amplifier.status, amplifier.heartbeat):
        with pytest.raises(LinkError, match=r"no answer.*energised.*disarmed"):
            await call()
    assert len(backend.requests) == 3
    await amplifier.close()
    backend.script += [LinkTimeout("still starting")] * 2
    await amplifier.open()
    assert await amplifier.status() == STATUS


async def test_link_error_is_not_retried(amplifier: Amplifier, backend: ScriptedBackend) -> None:
    """A LinkError other than a timeout is final."""
    backend.script.append(LinkError("unplugged"))
    for _ in range(2):
        with pytest.raises(LinkError, match="unplugged"):
            await amplifier.heartbeat()
    assert len(backend.requests) == 1


@pytest.mark.parametrize("code", NakCode)
async def test_refusal_names_request_and_channel(
    amplifier: Amplifier, backend: ScriptedBackend, code: NakCode
) -> None:
    """Every code has a reason in words; none tells of arming after a Stop."""
    backend.script += [Nak(code, 2)] * 3  # busy is retried
    with pytest.raises(CommandRefused, match=r"refused Arm \(channel 2\): \w+ \w+") as caught:
        await amplifier.arm()
    assert caught.value.channel == 2
    assert not amplifier.is_lost
    backend.script += [Nak(code, 2)] * 3
    with pytest.raises(CommandRefused, match=r"refused Stop \(channel 2\): (?!.*\barm)"):
        await amplifier.stop()


async def test_busy_amplifier_is_retried_twice(
    amplifier: Amplifier, backend: ScriptedBackend, safe: MakeSafe
) -> None:
    """With the same set; then CommandRefused, without a loss."""
    backend.script += [Nak(NakCode.BUSY), Nak(NakCode.BUSY)]
    assert (await amplifier.apply(safe(5))).token == 5
    assert backend.requests == [Apply(safe(5))] * 3
    backend.script += [Nak(NakCode.BUSY)] * 3
    with pytest.raises(CommandRefused, match="busy"):
        await amplifier.apply(safe(6))
    assert len(backend.requests) == 6
    assert not amplifier.is_lost


async def test_stuck_amplifier_is_not_retried_until_it_replies(
    amplifier: Amplifier, backend: ScriptedBackend
) -> None:
    """Retries of an amplifier that stays busy would delay other requests."""
    backend.script += [Nak(NakCode.BUSY)] * 3
    for count in (3, 4, 5):
        with pytest.raises(CommandRefused, match="busy"):
            await amplifier.status()
        assert len(backend.requests) == count
        backend.script += [Nak(NakCode.BUSY)] * (count < 5)
    backend.script.append(STATUS)
    assert await amplifier.status() == STATUS
    backend.script.append(Nak(NakCode.BUSY))
    assert await amplifier.status() == STATUS
    assert len(backend.requests) == 8


async def test_wrong_reply_is_a_frame_error(
    amplifier: Amplifier, backend: ScriptedBackend, safe: MakeSafe
) -> None:
    """Another type, token, slot or an invalid reply; the error names request, fault and remedy."""
    backend.script += [STATUS, Achieved(6, ()), FrameError("state 9"), Loaded(slot=5, knots=1)]
    for call, fault in (
        (amplifier.apply(safe(5)), "Apply .*Achieved, got Status"),
        (amplifier.apply(safe(5)), "token 5.*token 6"),
        (amplifier.status(), "GetStatus.*state 9"),
        (amplifier.load_envelope(SHAPE), "2 knots into slot 5, got 1"),
    ):
        with pytest.raises(FrameError, match=rf"{fault}.*update .*era amp conformance"):
            await call


async def test_broadcast_is_refused_without_a_bus(amplifier: Amplifier) -> None:
    """Nothing is sent."""
    with pytest.raises(CommandError, match=r"broadcast.*Commit"):
        await amplifier.commit_on_bus(1)


async def test_unchecked_set_is_refused(amplifier: Amplifier) -> None:
    """A set that has not passed a guard does not reach the backend."""
    plain = CommandSet(token=1, commands=(), ramp=0.0, valid_for=0.0)
    for call in (amplifier.apply, amplifier.stage):
        with pytest.raises(TypeError, match="SafeCommandSet"):
            await call(plain)


async def test_next_token_wraps_and_is_never_zero(amplifier: Amplifier) -> None:
    """All of 1 to 65535 in turn."""
    tokens = [amplifier.next_token() for _ in range(65536)]
    assert set(tokens) == set(range(1, 65536))
    assert tokens[tokens.index(65535) + 1] == 1
    assert tokens[0] == tokens[-1]


async def test_tokens_start_anew_at_each_opening(amplifier: Amplifier) -> None:
    """At random, so that a new set does not have the token of an old one."""
    starts = {amplifier.next_token()}
    for _ in range(20):
        await amplifier.close()
        await amplifier.open()
        starts.add(amplifier.next_token())
    assert len(starts) > 15


async def test_open_refuses_an_amplifier_that_stays_enabled(backend: ScriptedBackend) -> None:
    """Its outputs may play an earlier host's set."""
    backend.script += [IDENTITY, CAPABILITIES, STATUS]
    with pytest.raises(LinkError, match="OPERATION_ENABLED"):
        await Amplifier(backend).open()
    assert backend.closed == 1


@pytest.mark.parametrize("stopping", ["stop", "disarm", "silent set"])
@pytest.mark.parametrize("waiting", ["apply", "arm", "stage", "commit"])
async def test_stop_class_request_overtakes_and_supersedes(
    amplifier: Amplifier, backend: ScriptedBackend, safe: MakeSafe, stopping: str, waiting: str
) -> None:
    """It is sent before all that waits; what would arm or play is never sent."""
    zero = safe(2, level=0.0)
    stop, expected = {
        "stop": (amplifier.stop, Stop(0.005)),
        "disarm": (amplifier.disarm, Disarm(0.05)),
        "silent set": (lambda: amplifier.apply(zero), Apply(zero)),
    }[stopping]
    reply = pending_reply(backend)
    beat = await started(amplifier.heartbeat())
    status = await started(amplifier.status())
    superseded = await started(
        {
            "apply": lambda: amplifier.apply(safe(1)),
            "arm": amplifier.arm,
            "stage": lambda: amplifier.stage(safe(1)),
            "commit": lambda: amplifier.commit(1),
        }[waiting]()
    )
    silent = await started(stop())
    with pytest.raises(CommandRefused, match="superseded"):
        await superseded
    reply.set_result(STATUS)
    await asyncio.gather(beat, status, silent)
    assert backend.requests == [Ping(), expected, GetStatus()]


async def test_clear_is_superseded_by_a_stop_only(
    amplifier: Amplifier, backend: ScriptedBackend
) -> None:
    """A clear that waits does not acknowledge a later stop; a disarm, which latches nothing, only
    overtakes it."""
    for stopping in (amplifier.disarm, amplifier.stop):
        reply = pending_reply(backend)
        status = await started(amplifier.status())
        clear = await started(amplifier.clear())
        silent = await started(stopping())
        reply.set_result(STATUS)
        await asyncio.gather(status, silent)
        if stopping == amplifier.disarm:
            await clear
        else:
            with pytest.raises(CommandRefused, match="superseded"):
                await clear
    assert kinds(backend) == [
        *(GetStatus, Disarm, GetStatus, Clear),
        *(GetStatus, Stop, GetStatus),
    ]


@pytest.mark.parametrize("call", ["apply", "heartbeat", "commit", "apply before apply"])
async def test_request_is_not_repeated_when_another_precedes_it(
    amplifier: Amplifier, backend: ScriptedBackend, safe: MakeSafe, call: str
) -> None:
    """Its reply is lost while a stop, or for an apply a newer one, waits."""
    reply = pending_reply(backend)
    first = await started(
        {
            "heartbeat": amplifier.heartbeat,
            "commit": lambda: amplifier.commit(1),
        }.get(call, lambda: amplifier.apply(safe(1)))()
    )
    is_newer = call == "apply before apply"
    following = await started(amplifier.apply(safe(2)) if is_newer else amplifier.stop())
    reply.set_exception(LinkTimeout("late"))
    with pytest.raises(CommandRefused, match="superseded"):
        await first
    await following
    assert backend.requests[1:] == [Apply(safe(2)) if is_newer else Stop(0.005)]


@pytest.mark.parametrize("broken", ["sending", "replied"])
async def test_stop_and_disarm_depend_on_no_record(
    amplifier: Amplifier,
    backend: ScriptedBackend,
    broken: str,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """An exception in what records them is logged; other requests raise it."""

    def fail(*_: object) -> None:
        raise ZeroDivisionError(broken)

    monkeypatch.setattr(PlayRecorder, broken, fail)
    await amplifier.stop()
    await amplifier.disarm()
    assert kinds(backend) == [Stop, Disarm]
    with pytest.raises(ZeroDivisionError):
        await amplifier.commit(1)


async def test_stop_clips_its_ramp(amplifier: Amplifier, backend: ScriptedBackend) -> None:
    """A stop is never refused for its ramp."""
    for ramp in (float("nan"), -1, 99):
        await amplifier.stop(ramp)
    assert backend.requests == [Stop(0.0), Stop(0.0), Stop(1.0)]


async def test_arm_refuses_a_watchdog_out_of_range(
    amplifier: Amplifier, backend: ScriptedBackend
) -> None:
    """Nothing is sent then."""
    for watchdog in (0.05, 3.0, float("nan")):
        with pytest.raises(CommandError, match="watchdog"):
            await amplifier.arm(watchdog)
    await amplifier.arm()
    assert backend.requests == [Arm(0.25, backend.requests[0].session)]
    assert 1 <= backend.requests[0].session <= 65535


@pytest.mark.parametrize(
    ("watchdog", "round_trip", "fits"),
    [
        (0.25, 0.0083, True),
        (0.15, 0.0, True),
        (0.15, 0.001, False),
        (0.16, 0.02, False),
        (float("nan"), 0.0, False),
    ],
)
def test_check_watchdog_requires_three_heartbeats_and_a_round_trip(
    watchdog: float, round_trip: float, fits: bool
) -> None:
    """The error gives the shortest watchdog."""
    if fits:
        check_watchdog(watchdog, round_trip)
        return
    with pytest.raises(CommandError, match=r"at least \d+ ms"):
        check_watchdog(watchdog, round_trip)
