"""The sender of a line: order, supersession, repetition and preemption, without a wire."""

import asyncio
from collections.abc import Callable

import pytest

from drivers import clock
from drivers.backend import Backend
from drivers.errors import LinkTimeout, Preempted
from drivers.line.priority import PREEMPTION_GRACE, Priority
from drivers.line.sender import Retry, Sender, sender_of
from drivers.protocol.messages import Reply, Request
from drivers.protocol.wire_times import WireTimes
from virtual_loop import in_virtual_time


class MultiMaster(WireTimes):
    """Times of a bus on which all may send."""

    is_multi_master = True


class Amplifier(Backend):
    """A backend that notes what it sends; `held`: names whose replies wait for `answer`.

    gap [s]: before anything is sent.
    """

    def __init__(
        self, line: "Line", bus: str | None = "line", times: WireTimes | None = None
    ) -> None:
        self.line = line
        self.gap = 0.0
        self._bus = bus
        self._times = times or WireTimes()
        self._last_sent_at = 0.0

    async def open(self) -> None:
        """Do nothing."""

    async def close(self) -> None:
        """Do nothing."""

    async def exchange(self, request: Request, *, timeout: float) -> Reply:
        """Not used."""
        raise NotImplementedError

    @property
    def last_sent_at(self) -> float:
        return self._last_sent_at

    @property
    def bus(self) -> str | None:
        return self._bus

    @property
    def wire_times(self) -> WireTimes:
        return self._times

    def ask(self, name: str, priority: Priority) -> "asyncio.Task[str]":
        """Queue a request of this name."""
        replies = self.line.replies.setdefault(name, [])

        async def attempt() -> str:
            self.line.exchanges += 1
            assert self.line.exchanges == 1
            try:
                if self.gap:
                    await asyncio.sleep(self.gap)
                self._last_sent_at = clock.now()
                self.line.sent.append(name)
                await asyncio.sleep(0.001)
                if name in self.line.held:
                    await self.line.answer.wait()
                if replies:
                    raise replies.pop(0)
                return name
            finally:
                self.line.exchanges -= 1

        return asyncio.create_task(self.line.sender.send(self, priority, attempt))


class Line:
    """A line, with what was sent in this order; replies: errors of the next attempts, by name."""

    def __init__(self) -> None:
        self.sender = Sender()
        self.sent: list[str] = []
        self.held: set[str] = {"first"}
        self.answer = asyncio.Event()
        self.replies: dict[str, list[Exception]] = {}
        self.exchanges = 0

    async def first_is_sent(self) -> "tuple[Amplifier, Amplifier, asyncio.Task[str]]":
        """Return two amplifiers, and the request of the first one, whose reply is awaited."""
        east, west = Amplifier(self), Amplifier(self)
        first = east.ask("first", Priority.OTHER)
        await asyncio.sleep(0.002)
        return east, west, first


@in_virtual_time
async def test_queue_is_sent_by_priority_and_then_in_order() -> None:
    """Stop, disarm, heartbeat, apply, everything else; the same for two amplifiers."""
    line = Line()
    east, west, first = await line.first_is_sent()
    names = ["OTHER", "CLEAR", "ARM", "APPLY", "HEARTBEAT"]
    tasks = [east.ask(name, Priority[name]) for name in names]
    tasks += [west.ask(name, Priority[name]) for name in ("OTHER", "SILENCE", "STOP")]
    await asyncio.sleep(0)
    line.answer.set()
    await asyncio.gather(first, *tasks)
    assert line.sent == [
        *("first", "STOP", "SILENCE", "HEARTBEAT", "APPLY"),
        *("OTHER", "CLEAR", "ARM", "OTHER"),
    ]


@in_virtual_time
async def test_busy_line_starves_no_request() -> None:
    """What has waited for 50 ms goes before newer heartbeats and sets."""
    line = Line()
    east, west = Amplifier(line), Amplifier(line)

    async def repeat(amplifier: Amplifier) -> None:
        while True:
            await amplifier.ask("beat", Priority.HEARTBEAT)

    busy = [asyncio.create_task(repeat(one)) for one in (east, west)]
    await asyncio.sleep(0.01)
    begin = clock.now()
    await asyncio.gather(east.ask("east", Priority.OTHER), west.ask("west", Priority.CLEAR))
    assert 0.05 < clock.now() - begin < 0.056
    for task in busy:
        task.cancel()


@pytest.mark.parametrize(
    ("newer", "superseded"),
    [
        (Priority.STOP, {"HEARTBEAT", "APPLY", "ARM", "CLEAR"}),
        (Priority.SILENCE, {"APPLY", "ARM"}),
        (Priority.APPLY, {"APPLY"}),
        (Priority.HEARTBEAT, set[str]()),
    ],
)
@in_virtual_time
async def test_successor_supersedes_queued_requests_of_its_amplifier(
    newer: Priority, superseded: set[str]
) -> None:
    """What is on the line and what waits for another amplifier stays."""
    line = Line()
    east, west, first = await line.first_is_sent()
    queued = {one.name: east.ask(one.name, one) for one in Priority}
    others = [west.ask(f"west {one.name}", one) for one in Priority]
    await asyncio.sleep(0)
    line.answer.set()
    newest = east.ask("newest", newer)
    await asyncio.gather(first, newest, *others)
    refused = {name for name, task in queued.items() if isinstance(await fate(task), Preempted)}
    assert refused == superseded
    assert not superseded & set(line.sent)


async def fate(task: "asyncio.Task[str]") -> "str | BaseException":
    """The result of a request, or its error."""
    return (await asyncio.gather(task, return_exceptions=True))[0]


@pytest.mark.parametrize("is_own", [True, False])
@in_virtual_time
async def test_stop_waits_for_the_grace_and_not_for_an_unsent_request(is_own: bool) -> None:
    """An exchange of its own amplifier ends, that of another is repeated afterwards."""
    for gap, latest in ((0.0, PREEMPTION_GRACE), (0.1, 0.0)):
        line = Line()
        east, west = Amplifier(line), Amplifier(line)
        east.gap = gap
        first = east.ask("first", Priority.APPLY)
        await asyncio.sleep(0.002)
        begin, east.gap = clock.now(), 0.0
        await (east if is_own else west).ask("stop", Priority.STOP)
        sent_at = max(east.last_sent_at, west.last_sent_at) if is_own else west.last_sent_at
        assert sent_at - begin == pytest.approx(latest)
        line.answer.set()
        outcome = await fate(first)
        assert isinstance(outcome, Preempted) if is_own else outcome == "first"
        before = [] if gap else ["first"]
        assert line.sent == [*before, "stop", *(["first"] if not is_own else [])]


@in_virtual_time
async def test_withdrawn_stop_ends_the_grace() -> None:
    """And nothing is abandoned; a withdrawn exchange frees the line at once."""
    line = Line()
    east, west, first = await line.first_is_sent()
    stop = west.ask("stop", Priority.STOP)
    await asyncio.sleep(0.001)
    stop.cancel()
    await asyncio.sleep(2 * PREEMPTION_GRACE)
    assert not first.done()
    first.cancel()
    assert await east.ask("next", Priority.OTHER) == "next"
    assert first.cancelled()
    assert line.sent == ["first", "next"]


@in_virtual_time
async def test_disarm_does_not_preempt_a_stop() -> None:
    """It waits for the reply to the stop, and to its repetition."""
    line = Line()
    line.held, line.replies = {"stop"}, {"stop": [Retry()]}
    east = Amplifier(line)
    stop = east.ask("stop", Priority.STOP)
    await asyncio.sleep(0.002)
    disarm = east.ask("disarm", Priority.SILENCE)
    await asyncio.sleep(2 * PREEMPTION_GRACE)
    line.answer.set()
    await asyncio.gather(stop, disarm)
    assert line.sent == ["stop", "stop", "disarm"]


@pytest.mark.parametrize("is_answered", [False, True])
@in_virtual_time
async def test_cancellation_frees_the_line(is_answered: bool) -> None:
    """Before, or in the iteration in which, a request has its turn; also while it is preempted."""
    line = Line()
    east, _, first = await line.first_is_sent()
    second, third = east.ask("second", Priority.OTHER), east.ask("third", Priority.OTHER)
    await asyncio.sleep(0)
    if is_answered:
        line.answer.set()
        await first
    else:
        stop = east.ask("stop", Priority.STOP)
        await asyncio.sleep(PREEMPTION_GRACE)
        first.cancel()
        await stop
        assert first.cancelled()
    second.cancel()
    assert await third == "third"
    assert second.cancelled()


@in_virtual_time
async def test_repetition_keeps_the_order_of_its_amplifier_and_lets_others_go() -> None:
    """A retry precedes later requests of its amplifier and follows those that others queued."""
    line = Line()
    line.replies = {"retried": [Retry()], "busy": [Retry(0.005)]}
    east, west = Amplifier(line), Amplifier(line)
    tasks = [
        east.ask("retried", Priority.OTHER),
        east.ask("later", Priority.OTHER),
        west.ask("other", Priority.OTHER),
    ]
    await asyncio.gather(*tasks)
    assert line.sent == ["retried", "other", "retried", "later"]
    line.sent.clear()
    begin = clock.now()
    tasks = [east.ask("busy", Priority.OTHER), west.ask("meanwhile", Priority.OTHER)]
    await asyncio.gather(*tasks)
    assert line.sent == ["busy", "meanwhile", "busy"]
    assert clock.now() - begin == pytest.approx(0.007)


@in_virtual_time
async def test_repetition_is_refused_behind_a_stop_and_when_aborted() -> None:
    """A stop-class request is repeated in any case."""
    for stop in (Priority.STOP, None):
        line = Line()
        line.replies = {"first": [Retry()]}
        east, _, first = await line.first_is_sent()
        queued = east.ask("queued", Priority.HEARTBEAT)
        await asyncio.sleep(0)
        stopping = None if stop is None else east.ask("stop", stop)
        if stop is None:
            line.sender.abort_unsent(east)
        await asyncio.sleep(0)
        line.answer.set()
        for task in (first, queued):
            assert isinstance(await fate(task), Preempted)
        if stopping is not None:
            await stopping
    line.replies = {"silence": [Retry()], "stop": [Retry()]}
    tasks = [east.ask("silence", Priority.SILENCE), east.ask("stop", Priority.STOP)]
    line.sender.abort_unsent(east)
    assert await asyncio.gather(*tasks) == ["silence", "stop"]


@in_virtual_time
async def test_pausing_stop_reserves_the_line() -> None:
    """Nothing is sent while an amplifier that is busy is given time for its stop."""
    line = Line()
    line.replies = {"stop": [Retry(0.005)]}
    east, west = Amplifier(line), Amplifier(line)
    await asyncio.gather(east.ask("stop", Priority.STOP), west.ask("beat", Priority.HEARTBEAT))
    assert line.sent == ["stop", "stop", "beat"]


@in_virtual_time
async def test_error_of_an_attempt_reaches_its_caller_only() -> None:
    """The line goes on."""
    line = Line()
    line.replies = {"first": [LinkTimeout("no reply")]}
    _, west, first = await line.first_is_sent()
    other = west.ask("other", Priority.OTHER)
    line.answer.set()
    assert isinstance(await fate(first), LinkTimeout)
    assert await other == "other"


@in_virtual_time
async def test_amplifiers_share_the_sender_of_their_bus() -> None:
    """Not on a multi-master bus, nor without a bus; another bus is another line."""
    line = Line()
    make: Callable[..., Amplifier] = lambda *how: Amplifier(line, *how)  # noqa: E731
    east, west, other = make("bus"), make("bus"), make("other bus")
    kept = sender_of(east)
    assert sender_of(west) is kept
    assert sender_of(other) is not kept
    assert sender_of(make("bus", MultiMaster())) is not kept
    alone = sender_of(make(None))
    assert alone is not sender_of(make(None))


@in_virtual_time
async def test_request_on_a_free_line_is_sent_without_an_iteration_of_the_event_loop() -> None:
    """Before its caller first yields; one that is queued behind it waits."""
    line = Line()
    one = Amplifier(line)
    first, second = one.ask("first", Priority.OTHER), one.ask("second", Priority.OTHER)
    await asyncio.sleep(0)
    assert line.sent == ["first"]
    line.answer.set()
    assert await asyncio.gather(first, second) == ["first", "second"]
    assert line.sent == ["first", "second"]


@in_virtual_time
async def test_preemption_that_comes_too_late_leaves_its_caller_uncancelled() -> None:
    """An attempt that has its reply all the same returns it; a stop is sent after it."""
    sender, events = Sender(), []
    amplifier = Amplifier(Line())

    async def late() -> str:
        try:
            await asyncio.sleep(1.0)
        except asyncio.CancelledError:
            events.append("cancelled")
        return "reply"

    async def stop() -> None:
        events.append("stop")

    async def caller() -> tuple[str, int]:
        reply = await sender.send(amplifier, Priority.OTHER, late)
        task = asyncio.current_task()
        assert task is not None
        return reply, task.cancelling()

    called = asyncio.create_task(caller())
    await asyncio.sleep(0)
    await sender.send(amplifier, Priority.STOP, stop)
    assert await called == ("reply", 0)
    assert events == ["cancelled", "stop"]


@in_virtual_time
async def test_reading_goes_last_however_long_it_waits() -> None:
    """Heartbeats, sets and all else of both amplifiers are sent before a reading of sensors."""
    line = Line()
    east, west = Amplifier(line), Amplifier(line)
    beats = 100

    async def repeat() -> None:
        for _ in range(beats):
            await east.ask("beat", Priority.HEARTBEAT)

    busy = [asyncio.create_task(repeat()), asyncio.create_task(repeat())]
    await asyncio.sleep(0.01)
    reading = west.ask("reading", Priority.READING)
    await asyncio.gather(west.ask("other", Priority.OTHER), *busy)
    await reading
    assert line.sent.count("beat") == 2 * beats
    assert line.sent[-1] == "reading"


@pytest.mark.parametrize("newer", [Priority.STOP, Priority.SILENCE, Priority.APPLY])
@in_virtual_time
async def test_set_and_silence_abandon_a_reading_on_the_line(newer: Priority) -> None:
    """After the grace, as other requests for a stop; the reading fails and is not repeated."""
    line = Line()
    east = Amplifier(line)
    reading = east.ask("first", Priority.READING)
    await asyncio.sleep(0.002)
    begin = clock.now()
    await east.ask("newer", newer)
    assert east.last_sent_at - begin == pytest.approx(PREEMPTION_GRACE)
    assert isinstance(await fate(reading), Preempted)
    assert line.sent == ["first", "newer"]
