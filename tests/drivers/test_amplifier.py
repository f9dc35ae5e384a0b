import asyncio
from collections import deque
from collections.abc import Callable
from dataclasses import replace

import pytest

from drivers.amplifier import Amplifier
from drivers.backend import Backend
from drivers.command import CommandSet, Envelope, Knot
from drivers.errors import CommandError, CommandRefused, FrameError, LinkError, LinkTimeout
from drivers.guard import Guard, GuardLimits, SafeCommandSet
from drivers.link import turns
from drivers.operation.watchdog import check_watchdog
from drivers.protocol.messages import (
    Achieved,
    AmplifierState,
    Apply,
    Arm,
    Capabilities,
    Clear,
    Commit,
    Disarm,
    Fault,
    GetCaps,
    GetStatus,
    Hello,
    Identity,
    Loaded,
    Nak,
    NakCode,
    Ping,
    Reply,
    Request,
    Status,
    Stop,
)
from drivers.registry import open_backend
from scripted_amplifier import CAPABILITIES

IDENTITY = Identity("Acme", "Quad", "A-17", "1.2", 1)
STATUS = Status(AmplifierState.OPERATION_ENABLED, Fault.NONE, 0, True, 25.0, 0.25, (0.0,) * 4)
WITH_ENVELOPES = replace(CAPABILITIES, envelope_knots=8, envelope_slots=4, envelope_step_max=0.1)
MakeSafe = Callable[..., SafeCommandSet]


class ScriptedBackend(Backend):
    """Answers at once and well, except where `script` holds what to do next.

    In the script an exception is raised, a reply is given, and a future is waited for.
    """

    def __init__(self, capabilities: Capabilities) -> None:
        self.capabilities = capabilities
        self.identity = IDENTITY
        self.script: deque[Exception | Reply | asyncio.Future[Reply]] = deque()
        self.requests: list[Request] = []
        self.at_once = 0
        self.closed = 0

    async def open(self) -> None:
        """Nothing to open."""

    async def close(self) -> None:
        """Counts."""
        self.closed += 1

    async def exchange(self, request: Request, *, timeout: float) -> Reply:
        """The next of the script, or what a good amplifier says."""
        self.requests.append(request)
        self.at_once += 1
        assert self.at_once == 1, "two requests on the wire at once"
        try:
            await asyncio.sleep(0)
            if not self.script:
                return self._usual(request)
            step = self.script.popleft()
            if isinstance(step, Exception):
                raise step
            return await step if isinstance(step, asyncio.Future) else step
        finally:
            self.at_once -= 1

    def _usual(self, request: Request) -> Reply:
        match request:
            case Hello():
                return self.identity
            case GetCaps():
                return self.capabilities
            case Apply(command_set=wanted):
                return Achieved(wanted.token, wanted.commands)
            case Commit(token=token):
                return Achieved(token, ())
            case _:
                return STATUS

    @property
    def last_sent(self) -> float:
        """Not of interest here."""
        return 0.0


@pytest.fixture
def backend(capabilities: Capabilities) -> ScriptedBackend:
    """A backend that does as it is told."""
    return ScriptedBackend(capabilities)


@pytest.fixture
async def amplifier(backend: ScriptedBackend) -> Amplifier:
    """An open amplifier over it, the requests of opening forgotten."""
    amplifier = Amplifier(backend)
    await amplifier.open()
    backend.requests.clear()
    return amplifier


@pytest.fixture(autouse=True)
def patience(monkeypatch: pytest.MonkeyPatch) -> Callable[[float], None]:
    """No turn is cut short, however slow the machine, unless a test asks for it by a time [s]."""

    def change(seconds: float) -> None:
        monkeypatch.setattr(turns, "PATIENCE", seconds)

    change(60.0)
    return change


async def settle() -> None:
    """Let every task run until it waits for something that only the test brings about."""
    for _ in range(20):
        await asyncio.sleep(0)


async def test_opening_asks_and_arms_nothing(backend: ScriptedBackend) -> None:
    """Opening sends Hello and GetCaps only; identity and capabilities are then known."""
    amplifier = Amplifier(backend)
    with pytest.raises(LinkError, match="not open"):
        await amplifier.status()
    with pytest.raises(CommandError, match=r"who the amplifier is; call open\(\) first"):
        _ = amplifier.identity
    with pytest.raises(CommandError, match=r"what the amplifier can play; call open\(\) first"):
        _ = amplifier.capabilities
    await amplifier.open()
    assert backend.requests == [Hello(), GetCaps()]
    assert amplifier.identity == IDENTITY
    assert amplifier.capabilities == backend.capabilities


async def test_another_version_is_refused_and_closed(backend: ScriptedBackend) -> None:
    """An amplifier of another protocol version is not used, and the wire is given back."""
    backend.identity = replace(IDENTITY, protocol_version=2)
    with pytest.raises(LinkError, match="version 2"):
        await Amplifier(backend).open()
    assert backend.closed == 1


async def test_two_lost_replies_are_asked_for_again(
    amplifier: Amplifier, backend: ScriptedBackend, safe: MakeSafe
) -> None:
    """The same request, token and all, is repeated twice at most."""
    backend.script += [LinkTimeout("silence"), LinkTimeout("silence")]
    wanted = safe(5)
    achieved = await amplifier.apply(wanted)
    assert achieved.token == 5
    assert backend.requests == [Apply(wanted)] * 3


async def test_three_lost_replies_lose_the_amplifier(
    amplifier: Amplifier, backend: ScriptedBackend
) -> None:
    """After the third timeout every call fails at once, with what happened and what to do."""
    backend.script += [LinkTimeout("no answer")] * 3
    with pytest.raises(LinkTimeout, match="3 requests in a row"):
        await amplifier.heartbeat()
    assert amplifier.is_lost
    for call in (amplifier.arm, amplifier.stop, amplifier.status, amplifier.heartbeat):
        with pytest.raises(LinkError, match=r"no answer.*opened again it is disarmed"):
            await call()
    assert len(backend.requests) == 3


async def test_a_lost_amplifier_that_is_opened_again_has_all_its_retries(
    amplifier: Amplifier, backend: ScriptedBackend
) -> None:
    """What was left unanswered before the loss does not count against the new link."""
    backend.script += [LinkTimeout("no answer")] * 3
    with pytest.raises(LinkTimeout):
        await amplifier.heartbeat()
    await amplifier.close()
    backend.script += [LinkTimeout("still starting")] * 2
    await amplifier.open()
    assert await amplifier.status() == STATUS


async def test_a_lost_link_is_not_retried(amplifier: Amplifier, backend: ScriptedBackend) -> None:
    """A LinkError that is no timeout is final at the first."""
    backend.script.append(LinkError("unplugged"))
    with pytest.raises(LinkError, match="unplugged"):
        await amplifier.heartbeat()
    with pytest.raises(LinkError, match="unplugged"):
        await amplifier.heartbeat()
    assert len(backend.requests) == 1


async def test_timeouts_are_counted_in_a_row(
    amplifier: Amplifier, backend: ScriptedBackend
) -> None:
    """Any answer starts the count anew: a noisy line is not a dead one."""
    for _ in range(3):
        backend.script += [LinkTimeout("noise"), LinkTimeout("noise"), STATUS]
        await amplifier.heartbeat()
    assert not amplifier.is_lost


@pytest.mark.parametrize("code", NakCode)
async def test_a_refusal_is_readable(
    amplifier: Amplifier, backend: ScriptedBackend, code: NakCode
) -> None:
    """Every refusal becomes a sentence that names the request and the channel."""
    backend.script += [Nak(code, 2)] * 3  # one that is busy is asked again
    with pytest.raises(CommandRefused, match=r"refused Arm \(channel 2\): \w+ \w+") as caught:
        await amplifier.arm()
    assert caught.value.channel == 2
    assert not amplifier.is_lost


async def test_a_busy_amplifier_is_asked_again(
    amplifier: Amplifier, backend: ScriptedBackend, safe: MakeSafe
) -> None:
    """Twice at most, with the same set; it costs nothing else and loses nothing."""
    backend.script += [Nak(NakCode.BUSY), Nak(NakCode.BUSY)]
    assert (await amplifier.apply(safe(5))).token == 5
    assert backend.requests == [Apply(safe(5))] * 3
    backend.script += [Nak(NakCode.BUSY)] * 3
    with pytest.raises(CommandRefused, match="busy"):
        await amplifier.apply(safe(6))
    assert len(backend.requests) == 6
    assert not amplifier.is_lost


async def test_a_stuck_amplifier_is_asked_once(
    amplifier: Amplifier, backend: ScriptedBackend
) -> None:
    """Busy to the last it is not repeated to until it has taken something: others would wait."""
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


async def test_an_apply_is_not_repeated_before_a_newer_one(
    amplifier: Amplifier, backend: ScriptedBackend, safe: MakeSafe
) -> None:
    """Its answer is late while another set waits: that one is sent, and the first is given up."""
    late: asyncio.Future[Reply] = asyncio.get_running_loop().create_future()
    backend.script.append(late)
    first = asyncio.create_task(amplifier.apply(safe(1)))
    await settle()
    newer = asyncio.create_task(amplifier.apply(safe(2)))
    await settle()
    late.set_exception(LinkTimeout("nothing"))
    with pytest.raises(CommandRefused, match="superseded"):
        await first
    assert (await newer).token == 2
    assert backend.requests == [Apply(safe(1)), Apply(safe(2))]


async def test_a_reply_of_the_wrong_type_is_no_reply(
    amplifier: Amplifier, backend: ScriptedBackend, safe: MakeSafe
) -> None:
    """A Status in answer to an apply, or another set's token, is the far end's fault."""
    backend.script += [STATUS, Achieved(6, ())]
    with pytest.raises(FrameError, match="Status"):
        await amplifier.apply(safe(5))
    with pytest.raises(FrameError, match="token 6 instead of 5"):
        await amplifier.apply(safe(5))


async def test_an_answer_that_makes_no_sense_is_told_with_what_to_do(
    amplifier: Amplifier, backend: ScriptedBackend
) -> None:
    """What was asked, what is wrong with the answer, and that the firmware is to blame."""
    what_to_do = "firmware does not keep to the protocol: update it; era amp conformance tells"
    backend.script += [FrameError("9 is no state"), Loaded(slot=2, knots=1)]
    with pytest.raises(FrameError, match=f"answered to GetStatus.*9 is no state.*{what_to_do}"):
        await amplifier.status()
    shape = Guard(GuardLimits(40.0, 500.0, 0.8), WITH_ENVELOPES).check_envelope(
        Envelope(2, 0.005, (Knot(0.1, 0.0), Knot(0.2, 0.0)))
    )
    with pytest.raises(FrameError, match=f"1 knots into slot 2 instead of 2.*{what_to_do}"):
        await amplifier.load_envelope(shape)


async def test_a_wire_without_a_broadcast_says_so(amplifier: Amplifier) -> None:
    """A bus is asked for where none is: nothing is sent, and each is to be told by itself."""
    with pytest.raises(CommandError, match="knows no broadcast, so none of a Commit; tell each"):
        await amplifier.commit_on_bus(1)


async def test_only_safe_commands_are_taken(amplifier: Amplifier) -> None:
    """A set that no guard has seen does not reach the backend."""
    plain = CommandSet(token=1, commands=(), ramp=0.0, valid_for=0.0)
    for call in (amplifier.apply, amplifier.stage):
        with pytest.raises(TypeError, match="SafeCommandSet"):
            await call(plain)


async def test_tokens_count_round_and_are_never_zero(amplifier: Amplifier) -> None:
    """From 1 on, and after 65535, the last that two bytes hold, comes 1: 0 names no set."""
    tokens = [amplifier.next_token() for _ in range(65536)]
    assert tokens[0] == 1
    assert tokens[-2:] == [65535, 1]


async def test_the_latest_apply_wins(
    amplifier: Amplifier, backend: ScriptedBackend, safe: MakeSafe
) -> None:
    """Of the applies that wait, only the newest is sent; the others are told so."""
    answer: asyncio.Future[Reply] = asyncio.get_running_loop().create_future()
    backend.script.append(answer)
    first, second, third = (asyncio.create_task(amplifier.apply(safe(i))) for i in (1, 2, 3))
    await settle()
    assert second.done()
    answer.set_result(Achieved(1, ()))
    assert (await first).token == 1
    assert (await third).token == 3
    with pytest.raises(CommandRefused, match="superseded"):
        await second
    assert backend.requests == [Apply(safe(1)), Apply(safe(3))]


@pytest.mark.parametrize("silencing", ["stop", "disarm", "apply"])
async def test_falling_silent_overtakes(
    amplifier: Amplifier, backend: ScriptedBackend, safe: MakeSafe, silencing: str
) -> None:
    """Stop, disarm and a silent set go before all that waits; the apply that waited never goes."""
    answer: asyncio.Future[Reply] = asyncio.get_running_loop().create_future()
    backend.script.append(answer)
    beat = asyncio.create_task(amplifier.heartbeat())
    await settle()
    status = asyncio.create_task(amplifier.status())
    apply = asyncio.create_task(amplifier.apply(safe(1)))
    await settle()
    zero = safe(2, level=0.0)
    silent = asyncio.ensure_future(
        amplifier.apply(zero) if silencing == "apply" else getattr(amplifier, silencing)()
    )
    expected = {"stop": Stop(0.005), "disarm": Disarm(0.05), "apply": Apply(zero)}[silencing]
    await settle()
    with pytest.raises(CommandRefused, match="superseded"):
        await apply
    answer.set_result(STATUS)
    await asyncio.gather(beat, status, silent)
    assert backend.requests[:2] == [Ping(), expected]
    assert len(backend.requests) == 3


async def test_nothing_arms_after_it_was_silenced(
    amplifier: Amplifier, backend: ScriptedBackend
) -> None:
    """An arm that still waits when a disarm comes is never sent."""
    answer: asyncio.Future[Reply] = asyncio.get_running_loop().create_future()
    backend.script.append(answer)
    status = asyncio.create_task(amplifier.status())
    await settle()
    arm = asyncio.create_task(amplifier.arm())
    await settle()
    disarm = asyncio.create_task(amplifier.disarm())
    await settle()
    answer.set_result(STATUS)
    await asyncio.gather(status, disarm)
    with pytest.raises(CommandRefused, match="superseded"):
        await arm
    assert [type(request) for request in backend.requests[1:]] == [Disarm]


async def test_nothing_is_staged_after_it_was_silenced(
    amplifier: Amplifier, backend: ScriptedBackend, safe: MakeSafe
) -> None:
    """A set that still waits to be staged when a disarm comes is never sent."""
    answer: asyncio.Future[Reply] = asyncio.get_running_loop().create_future()
    backend.script.append(answer)
    status = asyncio.create_task(amplifier.status())
    await settle()
    stage = asyncio.create_task(amplifier.stage(safe(1)))
    await settle()
    disarm = asyncio.create_task(amplifier.disarm())
    await settle()
    answer.set_result(STATUS)
    await asyncio.gather(status, disarm)
    with pytest.raises(CommandRefused, match="superseded"):
        await stage
    assert [type(request) for request in backend.requests[1:]] == [Disarm]


async def test_a_stop_is_not_acknowledged_by_who_asked_before_it(
    amplifier: Amplifier, backend: ScriptedBackend
) -> None:
    """A clear that still waits when a stop comes is never sent; a disarm, which latches nothing,
    only goes before it."""
    for silence in (amplifier.disarm, amplifier.stop):
        answer: asyncio.Future[Reply] = asyncio.get_running_loop().create_future()
        backend.script.append(answer)
        status = asyncio.create_task(amplifier.status())
        await settle()
        clear = asyncio.create_task(amplifier.clear())
        await settle()
        silent = asyncio.create_task(silence())
        await settle()
        answer.set_result(STATUS)
        await asyncio.gather(status, silent)
        if silence == amplifier.disarm:
            await clear
        else:
            with pytest.raises(CommandRefused, match="superseded"):
                await clear
    kinds = [type(request) for request in backend.requests]
    assert kinds == [GetStatus, Disarm, Clear, GetStatus, Stop]


@pytest.mark.parametrize("handed_over", [False, True])
async def test_a_clear_that_was_just_handed_the_turn_gives_way_to_a_stop_for_good(
    amplifier: Amplifier, backend: ScriptedBackend, handed_over: bool
) -> None:
    """Whether it has the turn, but nothing has run since, or is next to have it."""
    answer: asyncio.Future[Reply] = asyncio.get_running_loop().create_future()
    backend.script.append(answer)
    stopping: list[asyncio.Task[Status]] = []

    async def ask_then_stop() -> None:
        await amplifier.status()
        stopping.append(asyncio.create_task(amplifier.stop()))

    first = asyncio.create_task(ask_then_stop())
    await settle()
    clears = [asyncio.create_task(amplifier.clear()) for _ in range(1 + handed_over)]
    await settle()
    answer.set_result(STATUS)
    await first
    await settle()
    await asyncio.gather(*stopping, *clears, return_exceptions=True)
    kinds = [type(request) for request in backend.requests]
    assert kinds[kinds.index(Stop) :] == [Stop]


async def test_a_commit_that_waits_plays_nothing_after_silence(
    amplifier: Amplifier, backend: ScriptedBackend, safe: MakeSafe
) -> None:
    """A staged set whose commit still waits when a silent set comes is never played."""
    answer: asyncio.Future[Reply] = asyncio.get_running_loop().create_future()
    backend.script.append(answer)
    status = asyncio.create_task(amplifier.status())
    await settle()
    commit = asyncio.create_task(amplifier.commit(1))
    await settle()
    silent = asyncio.create_task(amplifier.apply(safe(2, level=0.0)))
    await settle()
    answer.set_result(STATUS)
    await asyncio.gather(status, silent)
    with pytest.raises(CommandRefused, match="superseded"):
        await commit
    assert [type(request) for request in backend.requests] == [GetStatus, Apply]


async def test_an_apply_is_not_repeated_before_a_stop(
    amplifier: Amplifier, backend: ScriptedBackend, safe: MakeSafe
) -> None:
    """While a stop waits, an apply whose answer is lost is given up instead of repeated."""
    answer: asyncio.Future[Reply] = asyncio.get_running_loop().create_future()
    backend.script.append(answer)
    apply = asyncio.create_task(amplifier.apply(safe(1)))
    await settle()
    stop = asyncio.create_task(amplifier.stop())
    await settle()
    answer.set_exception(LinkTimeout("late"))
    with pytest.raises(CommandRefused, match="superseded"):
        await apply
    await stop
    assert backend.requests == [Apply(safe(1)), Stop(0.005)]


@pytest.mark.parametrize("call", ["heartbeat", "commit"])
async def test_nothing_is_repeated_before_a_stop(
    amplifier: Amplifier, backend: ScriptedBackend, call: str
) -> None:
    """While a stop waits, whatever lost its answer gives way, be it no apply."""
    answer: asyncio.Future[Reply] = asyncio.get_running_loop().create_future()
    backend.script.append(answer)
    first = asyncio.create_task(amplifier.commit(1) if call == "commit" else amplifier.heartbeat())
    await settle()
    stop = asyncio.create_task(amplifier.stop())
    await settle()
    answer.set_exception(LinkTimeout("late"))
    with pytest.raises(CommandRefused, match="superseded"):
        await first
    await stop
    assert [type(request) for request in backend.requests[1:]] == [Stop]


async def test_a_stop_waits_for_no_answer_that_does_not_come(
    amplifier: Amplifier,
    backend: ScriptedBackend,
    safe: MakeSafe,
    patience: Callable[[float], None],
) -> None:
    """A stop gives what is on the wire a moment, and goes out although that has no answer yet."""
    patience(0.001)
    backend.script.append(asyncio.get_running_loop().create_future())  # never done
    apply = asyncio.create_task(amplifier.apply(safe(1)))
    await settle()
    async with asyncio.timeout(5):
        await amplifier.stop()
    with pytest.raises(CommandRefused, match="superseded"):
        await apply
    assert backend.requests == [Apply(safe(1)), Stop(0.005)]
    assert not amplifier.is_lost
    assert (await amplifier.status()) == STATUS


async def test_a_stop_is_not_cut_short_by_another(
    amplifier: Amplifier, backend: ScriptedBackend, patience: Callable[[float], None]
) -> None:
    """A disarm that waits for a stop leaves it all its time: a stop latches, a disarm does not."""
    patience(0.001)
    answer: asyncio.Future[Reply] = asyncio.get_running_loop().create_future()
    backend.script.append(answer)
    stop = asyncio.create_task(amplifier.stop())
    await settle()
    disarm = asyncio.create_task(amplifier.disarm())
    await asyncio.sleep(0.01)
    answer.set_exception(LinkTimeout("late"))
    await asyncio.gather(stop, disarm)
    assert backend.requests == [Stop(0.005), Stop(0.005), Disarm(0.05)]


async def test_cancelling_leaves_the_link_usable(
    amplifier: Amplifier, backend: ScriptedBackend, safe: MakeSafe
) -> None:
    """Whoever is cancelled, on the wire or waiting, hands the turn on, and is told so."""
    answer: asyncio.Future[Reply] = asyncio.get_running_loop().create_future()
    backend.script.append(answer)
    on_wire = asyncio.create_task(amplifier.heartbeat())
    await settle()
    waiting = asyncio.create_task(amplifier.apply(safe(1)))
    last = asyncio.create_task(amplifier.status())
    await settle()
    waiting.cancel()
    on_wire.cancel()
    for task in (waiting, on_wire):
        with pytest.raises(asyncio.CancelledError):
            await task
    assert await last == STATUS
    assert (await amplifier.apply(safe(2))).token == 2
    assert Apply(safe(1)) not in backend.requests


@pytest.mark.parametrize("handed_over", [False, True])
async def test_cancelled_in_the_moment_of_its_turn(
    amplifier: Amplifier, backend: ScriptedBackend, handed_over: bool
) -> None:
    """A request cancelled just before or just after it is given the turn passes it on."""
    answer: asyncio.Future[Reply] = asyncio.get_running_loop().create_future()
    backend.script.append(answer)

    async def beat_then_cancel() -> None:
        await amplifier.heartbeat()
        if handed_over:
            second.cancel()

    first = asyncio.create_task(beat_then_cancel())
    await settle()
    second = asyncio.create_task(amplifier.heartbeat())
    third = asyncio.create_task(amplifier.status())
    await settle()
    answer.set_result(STATUS)
    if not handed_over:
        second.cancel()
    async with asyncio.timeout(5):
        await first
        assert await third == STATUS
        with pytest.raises(asyncio.CancelledError):
            await second
    assert (await amplifier.status()) == STATUS


async def test_a_cancelled_stop_overtakes_nothing(
    amplifier: Amplifier,
    backend: ScriptedBackend,
    safe: MakeSafe,
    patience: Callable[[float], None],
) -> None:
    """An apply whose answer is lost is repeated again once the stop that waited is withdrawn."""
    patience(0.02)
    answer: asyncio.Future[Reply] = asyncio.get_running_loop().create_future()
    backend.script.append(answer)
    apply = asyncio.create_task(amplifier.apply(safe(1)))
    await settle()
    stop = asyncio.create_task(amplifier.stop())
    await settle()
    stop.cancel()
    await asyncio.sleep(0.05)
    answer.set_exception(LinkTimeout("late"))
    assert (await apply).token == 1
    assert backend.requests == [Apply(safe(1))] * 2


async def test_ramps_of_silence_are_never_refused(
    amplifier: Amplifier, backend: ScriptedBackend
) -> None:
    """A stop with an impossible ramp is sent with the nearest that can be."""
    await amplifier.stop(float("nan"))
    await amplifier.stop(-1)
    await amplifier.stop(99)
    assert backend.requests == [Stop(0.0), Stop(0.0), Stop(1.0)]


async def test_a_watchdog_out_of_range_is_not_sent(
    amplifier: Amplifier, backend: ScriptedBackend
) -> None:
    """The amplifier's own range holds, NaN included."""
    for watchdog in (0.05, 3.0, float("nan")):
        with pytest.raises(CommandError, match="watchdog"):
            await amplifier.arm(watchdog)
    await amplifier.arm()
    assert backend.requests == [Arm(0.25)]


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
def test_watchdog_bears_three_heartbeats(watchdog: float, round_trip: float, fits: bool) -> None:
    """Three heartbeats of 50 ms and a round trip must fit, else the message says what would."""
    if fits:
        check_watchdog(watchdog, round_trip)
        return
    with pytest.raises(CommandError, match=r"at least \d+ ms"):
        check_watchdog(watchdog, round_trip)


@pytest.mark.parametrize(
    ("url", "milliseconds"),
    [
        ("serial:///dev/ttyUSB0?baud=115200", 8.33),  # 50 + 46 bytes of ten bits
        ("serial:///dev/ttyUSB0?baud=9600", 100.0),
        ("serial://box:4001", 0.0),
        ("sim://rig.yaml", 0.0),
    ],
)
def test_the_round_trip_follows_from_the_url(url: str, milliseconds: float) -> None:
    """Four channels at the speed in the URL; what is not known there counts as nothing."""
    assert open_backend(url).wire_times.round_trip(4) * 1e3 == pytest.approx(milliseconds, abs=0.01)
