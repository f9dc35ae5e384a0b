"""The API's server: the order in which clients are served, their places and their bounds.

Clients and server are in memory and in virtual time, which stands still while lines are served.
"""

import asyncio
import json
from collections.abc import Sequence
from itertools import groupby
from typing import Final

import pytest

from controller.api import server
from controller.api.jsonrpc import ErrorCode
from controller.api.server import MAX_UNREAD_BYTES
from kit.api_parameters import API_PARAMETERS
from kit.clock import feed, in_virtual_time
from processes.daemons import ServedApi, request, serving

RESULT: Final = "result"
RATE_LIMIT = 2000
"""Requests of one client at once."""
MAX_LINE = 1 << 16
"""Bytes of a line with its line feed."""


def line(method: str, id: int | None = None) -> bytes:
    """A request with valid parameters."""
    return request(method, json.dumps(API_PARAMETERS.get(method, {})), id=id)


ASKING = line("renew")
TOUCHING = line("touch")
ESCAPED_STOP = r"\u0073top"
WRONG_STOP = request("stop", '{"x":1}')
WRONG_DISARM = request("disarm", '{"level":2}')


class MemoryClient:
    """A client of a server in memory, in a process with this id."""

    def __init__(self, api: ServedApi, *, process: int = 1) -> None:
        self.api = api
        self.connection, self.wire = api.client(process=process)

    @property
    def is_open(self) -> bool:
        """Whether the server has kept its connection."""
        return self.connection.is_open

    def send(self, *lines: bytes) -> None:
        """Send lines in one piece."""
        feed(self.connection, b"".join(lines))

    async def ask(self, *lines: bytes) -> None:
        """Send lines in one piece, and let the server serve what it serves at once."""
        self.send(*lines)
        await self.api.settle()

    def responses(self) -> list[tuple[object, ErrorCode | str]]:
        """The ids of responses since the last call, with the codes of their errors or RESULT."""
        pairs = list[tuple[object, ErrorCode | str]]()
        for response in self.wire.lines():
            error = response.get("error")
            outcome = RESULT if error is None else ErrorCode(error["code"])
            pairs.append((response["id"], outcome))
        return pairs

    def leave(self) -> None:
        """Lose the connection."""
        self.wire.abort()
        self.connection.connection_lost(None)


def timed_api() -> ServedApi:
    """A server that counts time from now on."""
    loop = asyncio.get_running_loop()
    start = loop.time()
    return ServedApi(clock=lambda: loop.time() - start)


def connect(api: ServedApi, count: int) -> list[MemoryClient]:
    """So many clients."""
    return [MemoryClient(api) for _ in range(count)]


async def ask_in_turn(clients: Sequence[MemoryClient], request_line: bytes) -> None:
    """Let clients ask one after the other."""
    for client in clients:
        await client.ask(request_line)


def runs(names: Sequence[str]) -> list[tuple[str, int]]:
    """Names of calls, with how often each was called in a row."""
    return [(name, len([*calls])) for name, calls in groupby(names)]


def places(clients: Sequence[MemoryClient]) -> int:
    """How many of them are connected."""
    return sum(client.is_open for client in clients)


async def iterate(count: int) -> None:
    """Run the event loop for some iterations."""
    for _ in range(count):
        await asyncio.sleep(0)


@pytest.fixture(autouse=True)
def one_line_a_turn(monkeypatch: pytest.MonkeyPatch) -> None:
    """End turns by the number of lines, as virtual time stands still meanwhile."""
    monkeypatch.setattr(server, "MAX_TURN", 0.0)


@pytest.fixture
def long_turns(one_line_a_turn: None, monkeypatch: pytest.MonkeyPatch) -> None:
    """Serve all lines of a client in one turn."""
    monkeypatch.setattr(server, "MAX_TURN", 1.0)


@in_virtual_time
async def test_server_closes_a_connection_whose_line_exceeds_64_kib() -> None:
    """65 536 bytes with the line feed are served; a byte more, complete or not, is refused."""
    api = timed_api()
    head = b'{"jsonrpc":"2.0","id":1,"method":"layout","params":{"name":"a"}'
    padding = b" " * (MAX_LINE - len(head) - len(b"}\n"))
    lines = [head + padding + b"}\n", head + padding + b" }\n", b"x" * MAX_LINE]
    longest, longer, endless = connect(api, 3)

    for client, text in zip((longest, longer, endless), lines, strict=True):
        await client.ask(text)

    assert longest.responses() == [(1, RESULT)]
    assert longer.responses() == [(None, ErrorCode.PARSE)]
    assert endless.responses() == [(None, ErrorCode.PARSE)]
    assert [longest.is_open, longer.is_open, endless.is_open] == [True, False, False]
    assert api.names == ["layout"]


@in_virtual_time
async def test_request_without_id_gets_no_response() -> None:
    """Not even an error; and nothing is armed, as the lease would be unknown."""
    api = timed_api()
    client = MemoryClient(api)

    await client.ask(line("disarm"), line("no_such_method"), line("arm"))

    assert client.responses() == []
    assert api.names == ["disarm"]


@pytest.mark.parametrize("method", ["stop", "disarm"])
@pytest.mark.usefixtures("long_turns")
@in_virtual_time
async def test_arm_in_the_same_bytes_before_what_silences_is_not_carried_out(method: str) -> None:
    """The client wants the plate disarmed in the end; the other way round, it is armed."""
    api = timed_api()
    api.may_arm.set()
    client = MemoryClient(api)

    await client.ask(line("arm", 1), line(method, 2))
    assert api.names == [method]
    assert client.responses() == [(2, RESULT), (1, ErrorCode.LEASE)]

    await client.ask(line(method, 3), line("arm", 4))
    assert api.names == [method, method, "arm"]


@in_virtual_time
async def test_stop_and_disarm_are_served_while_requests_are_pending() -> None:
    """Eight requests may be pending, and further ones are refused; what silences is served."""
    api = timed_api()
    client = MemoryClient(api)

    await client.ask(*[line("arm", id) for id in range(10)])
    await client.ask(line("disarm", 98), line("stop", 99))

    busy = [(8, ErrorCode.BUSY), (9, ErrorCode.BUSY)]
    assert client.responses() == [*busy, (98, RESULT), (99, RESULT)]
    api.may_arm.set()
    await api.settle()
    assert client.responses() == [(id, RESULT) for id in range(8)]


@in_virtual_time
async def test_client_that_closed_its_side_gets_pending_responses() -> None:
    """The connection ends after the responses; an arm is only for a client that stays."""
    api = timed_api()
    client = MemoryClient(api)

    client.send(line("stop", 1), line("arm", 2))
    client.connection.eof_received()
    assert client.is_open
    await api.settle()

    assert client.responses() == [(1, RESULT), (2, ErrorCode.LEASE)]
    assert not client.is_open
    assert api.names == ["stop"]


@in_virtual_time
async def test_stop_is_served_among_silent_and_asking_clients() -> None:
    """With 160 silent clients after 32 that ask, one of another process gets a place in reserve.

    There it can stop, but not ask for effects until one of the 32 has left.
    """
    api = timed_api()
    asking = connect(api, 32)
    await ask_in_turn(asking, line("effects", 1))
    connect(api, 160)
    client = MemoryClient(api, process=2)
    in_reserve = ["hello", "status", "stop", "disarm"]

    await client.ask(line("effects", 0), *map(line, in_reserve, range(1, 5)))
    assert client.responses() == [
        (0, ErrorCode.BUSY),
        *[(id, RESULT) for id in range(1, 5)],
    ]

    asking[0].leave()
    await client.ask(line("effects", 6))
    assert client.responses() == [(6, RESULT)]


@in_virtual_time
async def test_client_that_touches_waits_for_no_other_client() -> None:
    """Its frames go before what 30 clients ask without end, until 150 ms after its last one.

    Every second turn is one of the others all the same.
    """
    api = timed_api()
    touching = MemoryClient(api)
    touching.send(TOUCHING * 8)
    asking = connect(api, 30)
    for client in asking:
        client.send(ASKING * 100)

    await iterate(40)
    assert api.names[:15] == ["touch", *["touch", "renew"] * 7]
    await api.settle()
    assert len(api.names) == 8 + 30 * 100

    await asyncio.sleep(0.16)
    api.calls.clear()
    for client in asking:
        client.send(ASKING)
    touching.send(TOUCHING)
    await api.settle()
    assert runs(api.names) == [("renew", 30), ("touch", 1)]


@in_virtual_time
async def test_stop_is_carried_out_in_any_number_whatever_is_wrong_with_it() -> None:
    """6000 at once, beyond the rate of other requests."""
    api = timed_api()
    client = MemoryClient(api)

    await client.ask(WRONG_STOP * 3000, WRONG_DISARM * 3000)

    assert len(api.names) == 6000
    assert client.is_open


@in_virtual_time
async def test_stop_behind_a_line_that_is_too_long_is_carried_out() -> None:
    """The touches behind it, too, but no arm; then the connection is closed."""
    api = timed_api()
    client = MemoryClient(api)

    await client.ask(b"x" * MAX_LINE + b"\n", TOUCHING * 20, line("stop"), line("arm"))

    assert runs(api.names) == [("touch", 20), ("stop", 1)]
    assert not client.is_open


async def exceed_the_rate(client: MemoryClient, text: bytes) -> None:
    """Send a line as often as the rate of requests allows, each read by its client."""
    for _ in range(RATE_LIMIT):
        client.wire.waiting = b""
        await client.ask(text)
    client.wire.waiting = b""


@in_virtual_time
async def test_disarm_behind_too_many_errors_is_carried_out() -> None:
    """What else is behind the line that ends the connection is not."""
    api = timed_api()
    client = MemoryClient(api)
    await exceed_the_rate(client, b"{}\n")

    await client.ask(b"{}\n", line("disarm"), ASKING)

    assert api.names == ["disarm"]
    assert not client.is_open


@in_virtual_time
async def test_stop_of_a_client_that_is_lost_is_carried_out() -> None:
    """Its client is gone before its turn; what would play is not carried out."""
    api = timed_api()
    client = MemoryClient(api)

    client.send(TOUCHING * 100, line("stop", 1), line("arm", 2))
    client.leave()
    await api.settle()

    assert api.names == ["stop"]


@in_virtual_time
async def test_escaped_stop_of_a_client_that_is_lost_is_carried_out() -> None:
    """A stop with an escaped letter wins over the disarm before it, whatever else waits."""
    api = timed_api()
    client = MemoryClient(api)

    client.send(TOUCHING * 100, line("disarm"), request(ESCAPED_STOP, "{}"), line("arm"))
    client.leave()
    await api.settle()

    assert api.names == ["stop"]


@pytest.mark.parametrize(
    ("disarms", "lease"),
    [
        (['{"lease":"old"}'], "old"),
        (['{"lease":"old"}', '{"lease":"new"}'], "new"),
        (["{}", '{"lease":"old"}'], None),
        (['{"lease":"old"}'] * 64 + ["{}"], None),
    ],
)
@in_virtual_time
async def test_disarm_of_a_client_that_is_lost_keeps_its_lease(
    disarms: list[str], lease: str | None
) -> None:
    """The last disarm is carried out for its lease, unless one without a lease waits."""
    api = timed_api()
    client = MemoryClient(api)

    client.send(ASKING, *(request("disarm", params) for params in disarms))
    client.leave()
    await api.settle()

    [(name, params, _)] = api.calls
    assert (name, params.model_dump()["lease"]) == ("disarm", lease)


@in_virtual_time
async def test_requests_wait_while_a_touch_is_on_its_way_to_the_wire() -> None:
    """For 3 ms at most if touches follow each other without a gap; otherwise until it is sent."""
    api = timed_api()
    client = MemoryClient(api)
    api.is_busy = True
    client.send(ASKING * 4)

    await asyncio.sleep(0.0029)
    assert api.names == []
    await asyncio.sleep(0.0049)
    assert api.times("renew") == pytest.approx([0.003, 0.0065], abs=0.001)

    api.is_busy = False
    await asyncio.sleep(0.0006)
    assert api.names == ["renew"] * 4


@pytest.mark.parametrize("method", ["stop", ESCAPED_STOP])
@in_virtual_time
async def test_stop_is_served_at_once_though_touches_come_first(method: str) -> None:
    """Also behind other requests of its client, and in two parts."""
    api = timed_api()
    client = MemoryClient(api)
    api.is_busy = True
    client.send(TOUCHING * 100)
    await asyncio.sleep(0.001)
    assert api.names == []

    client.send(f'{{"jsonrpc":"2.0","method":"{method}","para'.encode())
    client.send(b'ms":{}}\n')
    await asyncio.sleep(0.0001)

    assert api.times("stop") == pytest.approx([0.001], abs=1e-6)
    assert runs(api.names) == [("touch", 100), ("stop", 1)]


@in_virtual_time
async def test_lines_that_only_look_like_a_stop_keep_no_other_client_waiting() -> None:
    """A stop of another client among them comes after one of them."""
    api = timed_api()
    misleading = request("renew", '{"lease":"stop"}')
    for client in connect(api, 3):
        client.send(misleading * 100)
    asking, stopping = connect(api, 2)
    asking.send(ASKING)
    stopping.send(line("stop"))

    await iterate(12)

    assert api.names.index("stop") <= 4
    leases = [params.model_dump().get("lease") for _, params, _ in api.calls]
    assert "a-lease" in leases


@in_virtual_time
async def test_server_limits_the_request_rate_except_for_stop_disarm_and_touch() -> None:
    """After 2000 requests at once further ones are refused."""
    api = timed_api()
    client = MemoryClient(api)

    await client.ask(ASKING * (RATE_LIMIT + 1))
    assert runs(api.names) == [("renew", RATE_LIMIT)]

    api.calls.clear()
    await client.ask(line("stop"), line("disarm"), TOUCHING, line("clear"))
    assert api.names == ["stop", "disarm", "touch"]


@pytest.mark.parametrize(
    "text",
    [b"\n", b"{}\n", line("no_such_method"), request("effects", '{"x":1}')],
    ids=["empty", "no request", "unknown method", "unknown parameter"],
)
@in_virtual_time
async def test_refused_lines_count_in_the_rate(text: bytes) -> None:
    """After 2000 at once the connection is closed with an error."""
    api = timed_api()
    client = MemoryClient(api)

    await exceed_the_rate(client, text)
    assert client.is_open
    await client.ask(text)

    assert client.responses() == [(None, ErrorCode.BUSY)]
    assert not client.is_open


@in_virtual_time
async def test_place_is_taken_from_no_client_that_has_asked_within_a_second() -> None:
    """Nor from the holder of the lease, or from a client that waits for a response."""
    api = timed_api()
    holder = MemoryClient(api)
    api.holder = holder.connection
    waiting = MemoryClient(api)
    await waiting.ask(line("arm", 1))
    await asyncio.sleep(98.1)
    asking = MemoryClient(api)
    await asking.ask(ASKING)
    await asyncio.sleep(0.9)
    clients = connect(api, 29)
    await ask_in_turn(clients, ASKING)

    new = MemoryClient(api)

    assert new.connection.is_reserve
    assert places([holder, waiting, asking, *clients, new]) == 33


@in_virtual_time
async def test_place_is_taken_from_the_client_that_is_idle_for_longest() -> None:
    """Of one that has asked 3 s ago and one 2 s ago, not from the holder of the lease."""
    api = timed_api()
    holder = MemoryClient(api)
    api.holder = holder.connection
    await asyncio.sleep(96)
    idle = MemoryClient(api)
    await idle.ask(ASKING)
    await asyncio.sleep(1)
    asking = MemoryClient(api)
    await asking.ask(ASKING)
    await asyncio.sleep(2)
    clients = connect(api, 29)
    await ask_in_turn(clients, ASKING)

    new = MemoryClient(api)

    assert not new.connection.is_reserve
    assert not idle.is_open
    assert places([holder, asking, *clients, new]) == 32


@in_virtual_time
async def test_bug_in_a_method_is_reported_without_details(
    caplog: pytest.LogCaptureFixture,
) -> None:
    """The details are in the log alone."""
    client = MemoryClient(timed_api())

    await client.ask(line("play", 1))

    assert b"/a/path" not in client.wire.waiting
    assert client.responses() == [(1, ErrorCode.INTERNAL)]
    assert "/a/path" in caplog.text


def fail(*_: object) -> None:
    """Fail by a bug."""
    raise ZeroDivisionError("a bug")


@pytest.mark.parametrize("function", ["silencing.parse_json", "server.read_params"])
async def test_stop_is_carried_out_although_reading_it_fails(
    monkeypatch: pytest.MonkeyPatch, function: str
) -> None:
    """By a bug, which its client is told."""
    api, connection, wire = serving()
    monkeypatch.setattr(f"controller.api.{function}", fail)
    monkeypatch.setattr("controller.api.server.read_request", fail)

    await api.takes(connection, line("stop", 1))

    assert (api.names, api.stops) == (["stop"], 0)
    assert [response["error"]["code"] for response in wire.lines()] == [ErrorCode.INTERNAL]


async def test_server_stops_all_if_the_method_of_a_stop_fails() -> None:
    """Its client is not told of success."""
    api, connection, wire = serving()
    api.called = fail

    await api.takes(connection, line("stop", 1))

    assert (api.names, api.stops) == (["stop"], 1)
    assert [response["error"]["code"] for response in wire.lines()] == [ErrorCode.INTERNAL]


@in_virtual_time
async def test_turn_ends_with_the_line_after_a_tenth_of_a_millisecond(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Of ten lines of 30 us each, four are served in the first turn."""
    monkeypatch.undo()
    api = timed_api()
    monkeypatch.setattr(server.time, "perf_counter", lambda: 30e-6 * len(api.calls))

    MemoryClient(api).send(ASKING * 10)
    await iterate(3)

    assert len(api.calls) == 4


def test_connection_closes_when_unread_responses_exceed_256_kib() -> None:
    """It holds 256 KiB, and is closed by another byte."""
    client = MemoryClient(ServedApi())

    client.connection.respond(b"x" * (MAX_UNREAD_BYTES - 1))
    client.connection.respond(b"\n")
    assert (len(client.wire.waiting), client.wire.is_aborted) == (1 << 18, False)
    client.connection.respond(b"\n")
    assert (len(client.wire.waiting), client.wire.is_aborted) == (1 << 18, True)


def test_single_response_may_be_longer_than_256_kib() -> None:
    """A response of 1 MiB does not close the connection."""
    client = MemoryClient(ServedApi())

    client.connection.respond(b"x" * (4 * MAX_UNREAD_BYTES))

    assert (len(client.wire.waiting), client.wire.is_aborted) == (1 << 20, False)


async def test_input_of_a_client_is_bounded() -> None:
    """Nothing is read while 64 KiB wait to be served; no line is, beside 64 stops on their way."""
    api, connection, wire = serving()
    pending_stops = [asyncio.ensure_future(asyncio.sleep(3600)) for _ in range(64)]
    connection.pending = set(pending_stops)

    await api.takes(connection, line("stop") * 2000)
    assert (api.names, wire.is_read) == ([], False)

    connection.pending.remove(pending_stops[0])
    await api.takes(connection, b"\n")
    assert (api.names, wire.is_read) == (["stop"] * 2000, True)
    for stop in pending_stops:
        stop.cancel()


def test_client_that_does_not_read_loses_notifications_and_then_the_connection() -> None:
    """Half of 256 KiB are kept; the next event counts 372 lost of 500; 5 s later it is closed."""
    now = [0.0]
    client = MemoryClient(ServedApi(clock=lambda: now[0]))
    lost_counts = list[int]()

    def notify(count: int) -> None:
        for _ in range(count):
            client.connection.notify(make_event)

    def make_event(lost: int) -> bytes:
        lost_counts.append(lost)
        return b"x" * 1023 + b"\n"

    notify(500)
    assert lost_counts == [0] * 128
    assert len(client.wire.waiting) == MAX_UNREAD_BYTES // 2

    client.wire.waiting = b""
    notify(1)
    assert lost_counts[-1] == 372

    notify(500)
    now[0] = 4.9  # s after the first loss
    notify(500)
    assert not client.wire.is_aborted
    now[0] = 5.1
    notify(500)
    assert client.wire.is_aborted
