"""The two Python clients of the daemon's API: `AsyncClient` for asyncio, and the blocking `Client`.

    with Client.connect() as era:
        print(era.status().state)
        with era.armed("my study"):
            era.touch([(0.10, 0.05)])

    async with await AsyncClient.connect() as era:
        await era.subscribe("pattern")
        async for event in era.events():
            print(event.data)

`Client` runs an `AsyncClient` in an event loop on its own thread. A `ClientSession` is one of its
connections, a `LeaseRenewal` keeps the plate armed. `make pages` generates the methods that send a
single request from `METHODS`.
"""

import asyncio
import functools
import inspect
from collections import deque
from collections.abc import (
    AsyncIterator,
    Awaitable,
    Callable,
    Coroutine,
    Iterator,
    Mapping,
    Sequence,
)
from contextlib import (
    AbstractAsyncContextManager,
    AbstractContextManager,
    ExitStack,
    asynccontextmanager,
    contextmanager,
    suppress,
)
from dataclasses import replace
from pathlib import Path
from typing import Any, Concatenate, ParamSpec, Self, TypeVar, cast

from controller.api.client_session import ClientSession
from controller.api.jsonrpc import RpcError
from controller.api.lease_renewal import LEASE_ENDED, LeaseRenewal
from controller.api.link import (
    RESPONSE_TIMEOUT,
    ConnectionLost,
    DaemonLink,
    Notification,
    Unreachable,
    as_position,
    find_socket,
    make_params,
    read_result,
    touches_at,
)

# begin: written by docs/generators/client_stub.py results
from controller.api.methods import (
    DEFAULT_LEASE,
    METHODS,
    SILENCING,
    ArmResult,
    EffectsResult,
    HelloResult,
    LayoutResult,
    PlayResult,
    ReloadResult,
    RenewResult,
    StatusResult,
    StopResult,
    StrengthResult,
)

# end
from controller.api.schema import ApiMessage, Empty, Topic
from controller.api.silencing import readable_params
from model.errors import InputError
from registry.retries import pauses
from registry.threads import LoopRunner, LoopThread

MAX_QUEUED_EVENTS = 1000  # waiting to be read; the oldest is dropped
_TOUCH_INTERVAL = 0.05  # s; a finger counts as lifted 150 ms after its last report
_REPEATED_FOR = 0.3  # s; of requests that lose their connection, as happens with many clients

_T = TypeVar("_T")
_ResultT = TypeVar("_ResultT", bound=ApiMessage)
_MethodT = TypeVar("_MethodT", bound=Callable[..., Coroutine[Any, Any, Any]])


def lenient(method: _MethodT) -> _MethodT:
    """Wrap a method so that it runs even when called with unknown arguments.

    The unknown arguments are left out; their TypeError is raised afterwards.
    """
    signature = inspect.signature(method)

    @functools.wraps(method)
    async def call(self: "AsyncClient", /, *args: Any, **options: Any) -> Any:
        try:
            signature.bind(self, *args, **options)
        except TypeError:
            parameters = signature.parameters
            valid_options = {name: options[name] for name in options if name in parameters}
            await method(self, **valid_options)
            raise
        return await method(self, *args, **options)

    return cast(_MethodT, call)


class _Tries:
    """Pauses between the tries of a request, within a total duration [s]."""

    def __init__(self, duration: float) -> None:
        self._end = asyncio.get_running_loop().time() + duration
        self._pauses = pauses(first=duration / 100, maximum=duration / 10)

    def next_pause(self) -> float | None:
        """Return the pause [s] before the next try; None if no time is left for it."""
        pause = next(self._pauses)
        is_over = asyncio.get_running_loop().time() + pause >= self._end
        return None if is_over else pause


class AsyncClient(AbstractAsyncContextManager["AsyncClient"]):
    """A client of the daemon, made by `connect`; any number of calls can be pending.

    A client constructed directly connects on its first call. After a lost connection or a response
    timeout, the next call reconnects and restores all subscriptions. Every method returns within
    the timeout. It raises RpcError for an error of the daemon and Unreachable (a LinkError) without
    a response. Once the lease of `armed` is lost, methods other than `stop` and `disarm` raise
    LeaseLost.

    `stop` and `disarm` are sent even with invalid arguments; InputError or TypeError is raised
    afterwards.
    """

    def __init__(self, path: Path, *, name: str, timeout: float) -> None:
        make_params("hello", client=name)  # a wrong name would keep a stop from being sent
        self.path = path
        self._name = name
        self._timeout = timeout
        self._is_closed = False
        self._session: ClientSession | None = None  # the current or last connection
        self._session_count = 0
        self._opening = asyncio.Lock()  # held while a session is opened
        self._restoring = asyncio.Lock()  # held while its subscriptions are restored
        self._rates: dict[Topic, float | None] = {}  # of the subscriptions
        self._events: deque[tuple[int, Notification]] = deque()  # with their session numbers
        self._lost = 0  # events dropped here before the next one
        self._changed = asyncio.Event()  # an event arrived, or session or lease was lost
        self._renewal: LeaseRenewal | None = None  # of the lease of `armed`
        self._seen: tuple[int, int] | None = None  # session number and epoch received last

    @classmethod
    async def connect(
        cls,
        path: Path | str | None = None,
        *,
        name: str = "python",
        timeout: float = RESPONSE_TIMEOUT,
    ) -> Self:
        """Connect to the daemon's socket (default: see `find_socket`) and introduce this client.

        Raises Unreachable if no daemon responds, its major version differs, or the process is not
        trusted (`check_peer`).
        """
        client = cls(find_socket(path), name=name, timeout=timeout)
        async with client._time_limit():
            await client._repeated(client._restored, _Tries(_REPEATED_FOR))
        return client

    async def __aexit__(self, *_: object) -> None:
        await self.close()

    async def close(self) -> None:
        """Close the connection; the daemon lifts this client's fingers."""
        self._is_closed = True
        self._changed.set()
        self._end_renewal()
        if self._session is not None:
            self._session.abort()
        await asyncio.sleep(0)

    # begin: written by docs/generators/client_stub.py methods

    async def hello(self, client: str) -> HelloResult:
        """Introduce the client; returns the daemon's rig, table and layout."""
        return await self._call(HelloResult, "hello", client=client)

    async def status(self) -> StatusResult:
        """Show the state of the daemon, the amplifiers and the contacts."""
        return await self._call(StatusResult, "status")

    async def arm(self, owner: str, *, lease_s: float = 10.0) -> ArmResult:
        """Switch the high voltage on.

        Touches are felt until the lease expires.
        """
        return await self._call(ArmResult, "arm", owner=owner, lease_s=lease_s)

    async def renew(self, lease: str) -> RenewResult:
        """Extend the lease."""
        return await self._call(RenewResult, "renew", lease=lease)

    @lenient
    async def disarm(self, *, client: str | None = None, lease: str | None = None) -> None:
        """Ramp to silence, then switch the high voltage off.

        Any client can disarm. While a link is lost, this stops all amplifiers.
        """
        await self._call(Empty, "disarm", client=client, lease=lease)

    @lenient
    async def stop(self, *, client: str | None = None) -> StopResult:
        """Quick-stop all amplifiers.

        The stop is latched until `clear`. Not an emergency stop. Every client can stop the plate at
        any time. Fails with error 1006 if an amplifier is not confirmed silent.
        """
        return await self._call(StopResult, "stop", client=client)

    async def clear(self, *, client: str | None = None, epoch: int | None = None) -> None:
        """Clear a stop, or a fault that no longer exists.

        The plate stays disarmed.
        """
        await self._call(Empty, "clear", client=client, epoch=epoch)

    async def layout(self, name: str) -> LayoutResult:
        """Switch to another of the daemon's layouts.

        Continuous effects under resting fingers change immediately. Effects of limited duration,
        and effects that a program plays, continue to their end.
        """
        return await self._call(LayoutResult, "layout", name=name)

    async def reload(self) -> ReloadResult:
        """Read the daemon's files again and apply their layouts.

        All other changes are rejected; they need a restart.
        """
        return await self._call(ReloadResult, "reload")

    async def effects(self) -> EffectsResult:
        """List the available effects."""
        return await self._call(EffectsResult, "effects")

    async def strength(self, name: str, gain_db: float | None = None) -> StrengthResult:
        """Set or show the strength of a source, client or region.

        The status shows all strengths. Active effects fade to the new strength within 100 ms.
        """
        return await self._call(StrengthResult, "strength", name=name, gain_db=gain_db)

    # end

    async def touch(
        self, positions: Sequence[tuple[float, float]], *, source: str = "python"
    ) -> None:
        """Report all fingers of a source, at x, y [m]; valid for 150 ms, so repeat it."""
        await self._call(Empty, "touch", source=source, touches=touches_at(positions))

    async def play(
        self,
        effect: str | Sequence[tuple[float, float, float]],
        position: tuple[float, float],
        *,
        level_db_sl: float | None = None,
        taps: Sequence[tuple[float, float, float]] = (),
        loop: bool = False,
    ) -> PlayResult:
        """Play an effect at the finger nearest to x, y [m]; return the outcome.

        Returns once the amplifiers have confirmed the start, usually within some milliseconds, or
        the effect is late or held back. effect: its name, or points of a continuous event: time
        [s], intensity and sharpness, 0 to 1. taps: transients, in the same format.
        """
        x, y = as_position(position)
        params: dict[str, Any] = {"x_m": x, "y_m": y, "level_db_sl": level_db_sl, "loop": loop}
        params["taps"] = [*map(list, taps)]
        if isinstance(effect, str):
            params["effect"] = effect
        else:
            params["points"] = [*map(list, effect)]
        return await self._call(PlayResult, "play", **params)

    @asynccontextmanager
    async def resting(
        self, positions: Sequence[tuple[float, float]], *, source: str = "python"
    ) -> AsyncIterator[None]:
        """Keep all fingers of a source down for the duration of a `with` block, at x, y [m].

        They also rest while the plate is disarmed or stopped, and after a lost connection.
        """
        params = make_params("touch", source=source, touches=touches_at(positions))
        await self.request("touch", params)
        repeating = asyncio.create_task(self._repeat_touch(params), name="resting fingers")
        try:
            yield
        finally:
            repeating.cancel()
            lifted = make_params("touch", source=source, touches=[])
            with suppress(RpcError, Unreachable):
                await self.request("touch", lifted)

    async def _repeat_touch(self, params: ApiMessage) -> None:
        """Report the same fingers until cancelled or closed."""
        while not self._is_closed:
            await asyncio.sleep(_TOUCH_INTERVAL)
            with suppress(RpcError, Unreachable):
                await self.request("touch", params)

    async def subscribe(self, *topics: Topic, rate_hz: float | None = None) -> None:
        """Subscribe to topics; see `events`."""
        await self._call(Empty, "subscribe", topics=list(topics), rate_hz=rate_hz)
        self._rates.update(dict.fromkeys(topics, rate_hz))

    async def unsubscribe(self, *topics: Topic) -> None:
        """Receive no more notifications of topics."""
        await self._call(Empty, "unsubscribe", topics=list(topics))
        for topic in topics:
            self._rates.pop(topic, None)

    @asynccontextmanager
    async def armed(
        self, owner: str, *, lease_s: float = DEFAULT_LEASE
    ) -> AsyncIterator[ArmResult]:
        """Arm for the duration of a `with` block, and renew the lease meanwhile.

        Once the lease is lost, the next call and the end of the block raise LeaseLost.
        """
        arming = asyncio.ensure_future(self.arm(owner, lease_s=lease_s))
        try:
            lease = await asyncio.shield(arming)
        except asyncio.CancelledError:
            with suppress(RpcError, Unreachable):  # if rejected: another client's lease
                await self.disarm(lease=(await arming).lease)
            raise
        renewal = LeaseRenewal(
            lease,
            request=self.request,
            status=self.status,
            stopped=self._changed.set,
            path=self.path,
        )
        self._renewal = renewal
        try:
            yield lease
        except BaseException:
            with suppress(RpcError, Unreachable):
                await self._disarm_after(renewal)
            raise
        await self._disarm_after(renewal)

    async def events(self) -> AsyncIterator[Notification]:
        """Yield notifications as they arrive, until `close`; raises Unreachable."""
        event = await self.next_event()
        while event is not None:
            yield event
            event = await self.next_event()

    async def next_event(self, *, timeout: float | None = None) -> Notification | None:
        """Wait for a notification; None after a timeout [s] or `close`; raises Unreachable.

        Reconnects after a lost connection, within the client's timeout. If too many notifications
        wait, the oldest are dropped and counted in `lost` of the next one. Once the lease of
        `armed` is lost, raises LeaseLost after the notifications that have arrived.
        """
        with suppress(TimeoutError):
            async with asyncio.timeout(timeout):
                while not self._events and not self._is_closed:
                    self._check_lease()
                    self._changed.clear()
                    async with self._time_limit():
                        tries = _Tries(0.9 * self._timeout)
                        await self._repeated(self._restored, tries, (RpcError, Unreachable))
                    await self._changed.wait()
        if not self._events:
            return None
        session_number, event = self._events.popleft()
        self._see(session_number, event.data.get("epoch"))
        lost = event.lost + self._lost
        self._lost = 0
        return replace(event, lost=lost)

    async def _call(self, result: type[_ResultT], method: str, **values: Any) -> _ResultT:
        """Call a method with these parameters and return its result.

        `clear` acknowledges the epoch that this client last received in a `status`, `stop` or state
        event.
        """
        if method in SILENCING:
            return await self._silence(result, method, values)
        self._check_lease()
        if method == "clear" and values["epoch"] is None and self._seen is not None:
            values["epoch"] = self._seen[1]
        params = make_params(method, **values)
        read = read_result(await self.request(method, params), result)
        if method == "hello":
            self._name = values["client"]
        self._see(self._session_count, getattr(read, "epoch", None))
        return read

    async def _silence(
        self, result: type[_ResultT], method: str, values: Mapping[str, object]
    ) -> _ResultT:
        """Call a method that silences, then raise the errors in its arguments.

        After a stop no lease is renewed, even if no daemon responds.
        """
        if method == "stop":
            self._end_renewal()
        params = readable_params(method, values)
        read = read_result(await self.request(method, params), result)
        self._end_renewal()
        self._see(self._session_count, getattr(read, "epoch", None))
        try:
            make_params(method, **values)
        except InputError as error:
            raise InputError(f"{error} ({method} was carried out nevertheless)") from None
        return read

    async def request(self, method: str, params: ApiMessage) -> Any:
        """Send a request; after a lost connection, send it again if that is harmless.

        Returns its result as parsed JSON, including unknown keys of a newer daemon. Requests that
        silence are sent before subscriptions are restored.
        """
        connect = self._opened if method in SILENCING else self._restored
        tries = _Tries(_REPEATED_FOR)

        async def attempt() -> Any:
            session = await self._repeated(connect, tries)
            return await session.call(method, params)

        repeated_after: tuple[type[Unreachable], ...] = ()
        if METHODS[method].is_repeated:
            repeated_after = (Unreachable if method == "stop" else ConnectionLost,)
        async with self._time_limit():
            return await self._repeated(attempt, tries, repeated_after)

    @asynccontextmanager
    async def _time_limit(self) -> AsyncIterator[None]:
        """Raise Unreachable, and close the session, after the client's timeout."""
        try:
            async with asyncio.timeout(self._timeout):
                yield
        except TimeoutError as error:
            if self._session is not None:  # otherwise its queue would grow without bounds
                self._session.abort()
            raise Unreachable.at(self.path, error) from error

    async def _repeated(
        self,
        attempt: Callable[[], Awaitable[_T]],
        tries: _Tries,
        after: tuple[type[Exception], ...] = (ConnectionLost,),
    ) -> _T:
        """Return the result of an attempt; repeat it after some errors, while there are tries."""
        while True:
            try:
                return await attempt()
            except after:
                pause = tries.next_pause()
                if self._is_closed or pause is None:
                    raise
                await asyncio.sleep(pause)

    async def _restored(self) -> ClientSession:
        """Return the session with all subscriptions; raises RpcError and Unreachable."""
        async with self._restoring:
            session = await self._opened()
            if not session.is_restored:
                await self._restore(session)
            return session

    async def _opened(self) -> ClientSession:
        """Return the session, a new one if it was lost; raises RpcError and Unreachable."""
        async with self._opening:
            if self._is_closed:
                raise Unreachable(f"this client of the daemon at {self.path} is closed")
            if self._session is None or not self._session.is_open:
                link = await DaemonLink.open(self.path, self._name)
                self._session_count += 1
                number = self._session_count
                self._session = ClientSession(
                    link,
                    received=lambda event: self._queue(number, event),
                    lost=self._changed.set,
                )
            return self._session

    async def _restore(self, session: ClientSession) -> None:
        """Restore subscriptions in a new session; close it if that fails."""
        try:
            for topic, rate in list(self._rates.items()):
                params = make_params("subscribe", topics=[topic], rate_hz=rate)
                await session.call("subscribe", params)
            session.is_restored = True
        except BaseException:
            session.abort()
            raise

    def _queue(self, session_number: int, event: Notification) -> None:
        """Append an event; drop the oldest if too many wait."""
        if len(self._events) == MAX_QUEUED_EVENTS:
            _, dropped = self._events.popleft()
            self._lost += 1 + dropped.lost
        self._events.append((session_number, event))
        self._changed.set()

    def _see(self, session_number: int, epoch: int | None) -> None:
        """Store the latest epoch received; in a new session, it can be lower than before."""
        if epoch is not None:
            self._seen = max(self._seen or (0, 0), (session_number, epoch))

    def _check_lease(self) -> None:
        """Raise LeaseLost once the lease of `armed` is lost."""
        if self._renewal is not None:
            self._renewal.check()

    def _end_renewal(self) -> None:
        """Stop renewing the lease, unless it is lost."""
        if self._renewal is not None:
            self._renewal.end()

    async def _disarm_after(self, renewal: LeaseRenewal) -> None:
        """End `armed`: disarm unless already done; raises LeaseLost if the lease was lost."""
        self._renewal = None
        renewal.check()
        if renewal.is_ended:
            return
        renewal.end()
        try:
            await self.disarm(lease=renewal.token)
        except RpcError as error:
            if error.code not in LEASE_ENDED:
                raise
            raise await renewal.loss(error) from error


_P = ParamSpec("_P")


def _blocking(
    method: Callable[Concatenate[AsyncClient, _P], Coroutine[Any, Any, _T]],
) -> Callable[Concatenate["Client", _P], _T]:
    """Wrap a method for the blocking client."""

    @functools.wraps(method)
    def call(self: "Client", /, *args: _P.args, **options: _P.kwargs) -> _T:
        return self._run(method(self._client, *args, **options))

    return call


class Client(AbstractContextManager["Client"]):
    """A client of the daemon, returned by `connect`; its methods are thread-safe.

    loop: runs the asynchronous client.
    """

    def __init__(self, client: AsyncClient, loop: LoopRunner) -> None:
        self.path = client.path
        self._client = client
        self._loop = loop

    @classmethod
    def connect(
        cls,
        path: Path | str | None = None,
        *,
        name: str = "python",
        timeout: float = RESPONSE_TIMEOUT,
    ) -> Self:
        """Connect to the daemon's socket (default: see `find_socket`) and introduce this client.

        Raises Unreachable if no daemon responds, its major version differs, or the process is not
        trusted (`check_peer`).
        """
        loop = LoopThread("API")
        try:
            client = loop.run(AsyncClient.connect(path, name=name, timeout=timeout))
        except BaseException:
            loop.close()
            raise
        return cls(client, loop)

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the connection; the daemon lifts this client's fingers."""
        if self._loop.is_open:
            self._loop.run(self._client.close())
            self._loop.close()

    # begin: written by docs/generators/client_stub.py blocking

    hello = _blocking(AsyncClient.hello)
    status = _blocking(AsyncClient.status)
    arm = _blocking(AsyncClient.arm)
    renew = _blocking(AsyncClient.renew)
    disarm = _blocking(AsyncClient.disarm)
    stop = _blocking(AsyncClient.stop)
    clear = _blocking(AsyncClient.clear)
    touch = _blocking(AsyncClient.touch)
    layout = _blocking(AsyncClient.layout)
    reload = _blocking(AsyncClient.reload)
    effects = _blocking(AsyncClient.effects)
    play = _blocking(AsyncClient.play)
    strength = _blocking(AsyncClient.strength)
    subscribe = _blocking(AsyncClient.subscribe)
    unsubscribe = _blocking(AsyncClient.unsubscribe)

    # end

    @contextmanager
    def armed(self, owner: str, *, lease_s: float = DEFAULT_LEASE) -> Iterator[ArmResult]:
        """Arm for the duration of a `with` block, and renew the lease meanwhile.

        Once the lease is lost, the next call and the end of the block raise LeaseLost.
        """
        with self._entered(self._client.armed(owner, lease_s=lease_s)) as lease:
            yield lease

    @contextmanager
    def resting(
        self, positions: Sequence[tuple[float, float]], *, source: str = "python"
    ) -> Iterator[None]:
        """Keep all fingers of a source down for the duration of a `with` block, at x, y [m].

        They also rest while the plate is disarmed or stopped, and after a lost connection.
        """
        with self._entered(self._client.resting(positions, source=source)):
            yield

    @contextmanager
    def _entered(self, context: AbstractAsyncContextManager[_T]) -> Iterator[_T]:
        """Enter a context of the asynchronous client for the duration of a `with` block."""
        with ExitStack() as end:
            value = self._run(context.__aenter__())
            end.push(lambda *error: self._run(context.__aexit__(*error)))
            yield value

    def sleep(self, seconds: float) -> None:
        """Wait for a time [s], which is virtual in a simulated panel."""
        self._run(asyncio.sleep(seconds))

    def events(self, *, timeout: float | None = None) -> Iterator[Notification]:
        """Yield notifications as they arrive; end when none arrives within a timeout [s]."""
        event = self._run(self._client.next_event(timeout=timeout))
        while event is not None:
            yield event
            event = self._run(self._client.next_event(timeout=timeout))

    def _run(self, work: Coroutine[Any, Any, _T]) -> _T:
        if not self._loop.is_open:
            work.close()
            raise Unreachable(f"this client of the daemon at {self.path} is closed")
        return self._loop.run(work)
