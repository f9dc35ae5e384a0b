"""The API's server and its lines: refusals, the order of service, and which touches count."""

import asyncio
import json
import re
import socket
from collections import Counter
from collections.abc import AsyncIterator, Mapping
from contextlib import asynccontextmanager, suppress
from dataclasses import dataclass, field
from itertools import groupby
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest
from hypothesis import given
from hypothesis import strategies as st

from controller.api import server
from controller.api.jsonrpc import (
    ErrorCode,
    InvalidRequest,
    RpcError,
    error_line,
    read_params,
    read_request,
    request_line,
    result_line,
)
from controller.api.methods import METHODS, ArmParams, StatusResult, SubscribeParams
from controller.api.schema import ApiMessage, Empty
from controller.api.server import ApiServer, Connection
from courses import Taken, courses, fits, follow
from daemons import PATIENCE, ServedApi, Wire, request
from registry import threads
from virtual_lines import feed

PARAMS = {
    "arm": '{"owner":"me","lease_s":5}',
    "disarm level": '{"level":2}',
    "hello": '{"client":"a"}',
    "play": '{"effect":"x","x_m":0,"y_m":0}',
    "renew": '{"lease":"a"}',
    "renew stop": '{"lease":"stop"}',
    "stop x": '{"x":1}',
    "touch": '{"source":"a","touches":[]}',
    "touch down": '{"source":"a","touches":[{"id":1,"x_m":0.1,"y_m":0.1}]}',
}
"""Parameters of requests by their names, of which the first word is the method."""


def bytes_of(line: str | Mapping[Any, Any]) -> bytes:
    """A request by its name, so many of a line, or raw bytes."""
    if isinstance(line, Mapping):
        ((key, each),) = line.items()
        return each.encode("latin-1") if key == "raw" else key * bytes_of(each)
    name, _, id = line.partition(" #")
    return request(name.split()[0], PARAMS.get(name, "{}"), id=id or None)


@dataclass
class Clients(Taken):
    """Clients of a server in memory, by their names, and what they do; marked: of the calls."""

    served: ServedApi = field(init=False)
    made: dict[str, tuple[Connection, Wire]] = field(default_factory=dict)
    marked: int = 0
    patch: pytest.MonkeyPatch = field(default_factory=pytest.MonkeyPatch)

    def __post_init__(self) -> None:
        """Make the server, which counts time from now on."""
        began = threads.now()
        self.served = ServedApi(clock=lambda: threads.now() - began)

    def of(self, name: str) -> list[tuple[Connection, Wire]]:
        """The client of a name, or those that differ by a number."""
        return [each for key, each in self.made.items() if name in (key, key.rpartition(" ")[0])]

    def connects(self, name: str) -> None:
        """Connect a client."""
        self.connects_of(1, name)

    def connects_of(self, process: int, name: str) -> None:
        """Connect a client of a process."""
        self.made[name] = self.served.client(process=process)

    def connects_many(self, count: int, name: str) -> None:
        """Connect so many more, whose names end in numbers."""
        for _ in range(count):
            self.connects(f"{name} {len(self.made)}")

    def sends(self, name: str, *lines: str | Mapping[Any, Any]) -> None:
        """Let clients send lines at once."""
        for client, _ in self.of(name):
            feed(client, b"".join(map(bytes_of, lines)))

    async def takes(self, name: str, *lines: str | Mapping[Any, Any]) -> None:
        """Do the same for one after the other, and serve what is to be served at once."""
        for client, _ in self.of(name):
            await self.served.takes(client, b"".join(map(bytes_of, lines)))

    async def settles(self) -> None:
        """Serve what is to be served at once."""
        await self.served.settle()

    async def turns(self, count: int) -> None:
        """Let the event loop turn so often."""
        for _ in range(count):
            await asyncio.sleep(0)

    def hears(self, name: str, *lines: str) -> None:
        """Require the responses to each of some clients since the last that it read."""
        for _, wire in self.of(name):
            found = [
                f"{json.dumps(each['id'])} {each.get('error', {}).get('code', 'result')}"
                for each in wire.lines()
            ]
            assert found == [*lines]

    def reads(self) -> None:
        """Let all clients read, and forget, what was sent to them."""
        for _, wire in self.made.values():
            wire.waiting = b""

    @property
    def sent(self) -> str:
        """All that clients have not read yet."""
        return "".join(wire.waiting.decode() for _, wire in self.made.values())

    def results_fail(self) -> None:
        """Let the result of `status` be one that cannot be sent."""
        self.patch.setattr(StatusResult, "model_dump_json", Mock(side_effect=UnicodeError))

    def ends_its_input(self, name: str) -> None:
        """Let a client close its side."""
        self.made[name][0].eof_received()

    def leaves(self, name: str) -> None:
        """Let a client be gone."""
        client, wire = self.made[name]
        wire.abort()
        client.connection_lost(None)

    def is_busy(self, is_so: bool) -> None:
        """Let a touch be on its way to the wire, or none."""
        self.served.is_busy = is_so

    def arming_may_end(self) -> None:
        """Let all that is to be armed be."""
        self.served.may_arm.set()

    def holds_the_lease(self, name: str) -> None:
        """Let a client be its holder."""
        self.served.holder = self.made[name][0]

    def marks(self) -> None:
        """Look at the calls from now on."""
        self.marked = len(self.names)

    def calls_first(self, *names: str) -> None:
        """Require the first calls."""
        assert self.names[: len(names)] == [*names]

    def served_at(self, method: str, *times: str) -> None:
        """Require when a method was called."""
        assert fits(self.served.times(method), [*times]), self.served.times(method)

    @property
    def names(self) -> list[str]:
        """Names of the methods called."""
        return self.served.names

    @property
    def runs(self) -> list[tuple[str, int]]:
        """Names of calls since the mark, and how often in a row."""
        return [(name, len([*some])) for name, some in groupby(self.names[self.marked :])]

    @property
    def stop_at(self) -> int:
        """How many calls came before the first stop."""
        return self.names.index("stop")

    @property
    def leases(self) -> list[str]:
        """Leases that were renewed."""
        calls = self.served.calls
        return [params.model_dump()["lease"] for name, params, _ in calls if name == "renew"]

    @property
    def open_clients(self) -> Mapping[str, int]:
        """How many are connected of each name, numbers left out."""
        names = [name for name, (client, _) in self.made.items() if client.is_open]
        return Counter(re.sub(r" \d+$", "", name) for name in names)

    @property
    def in_reserve(self) -> list[str]:
        """Clients with a place in reserve."""
        return [name for name, (client, _) in self.made.items() if client.is_reserve]


@asynccontextmanager
async def clients(*, turn: float = 0.0) -> AsyncIterator[Clients]:
    """A server without clients; turn [s]: how long one is, none for a line of each client."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(server, "MAX_TURN", turn)
        found = Clients(patch=patch)
        yield found
        found.arming_may_end()
        await found.settles()


COURSES = courses(Path(__file__).with_name("served.yaml"))


@pytest.mark.parametrize("name", COURSES)
def test_clients_are_served_by_their_course(name: str) -> None:
    """Every step is as it is in the file."""
    follow(COURSES[name], clients)


async def test_connection_that_is_accepted_amid_closing_is_closed(tmp_path: Path) -> None:
    """However far it has come when the server looks at those that are open."""
    for iterations in range(6):
        api = ApiServer({}, on_disconnect=Mock(), holds_lease=lambda client: False)
        bound = socket.socket(socket.AF_UNIX)
        bound.bind(str(tmp_path / f"{iterations}.sock"))
        await api.open(bound)
        with socket.socket(socket.AF_UNIX) as client:
            client.connect(str(tmp_path / f"{iterations}.sock"))
            for _ in range(iterations):
                await asyncio.sleep(0)
            await api.close()
            client.setblocking(False)
            with suppress(ConnectionResetError):  # it was never accepted
                async with asyncio.timeout(PATIENCE / 6):
                    assert await asyncio.get_running_loop().sock_recv(client, 1) == b""


@pytest.mark.parametrize("where", ["the line", "the method"])
async def test_server_stops_all_when_a_stop_fails_on_its_way(
    monkeypatch: pytest.MonkeyPatch, where: str
) -> None:
    """By a bug as its line is read, or in its method; its client is not told of success."""
    served = ServedApi()

    def fail(*_: object) -> None:
        raise ZeroDivisionError("a bug")

    if where == "the line":
        monkeypatch.setattr("controller.api.server.read_params", fail)
    else:
        served.called = fail
    client, wire = served.client()
    await served.takes(client, request("stop", id=1) + request("status", id=2))
    assert served.stops == 1
    assert {"error" in line for line in wire.lines()} == {True}


def refusal(line: bytes) -> RpcError:
    """The error that refuses a line, or its parameters."""
    with pytest.raises(RpcError) as caught:
        read_params(METHODS[(request := read_request(line)).method].params, request)
    return caught.value


TOUCH = '{"id":1,"x_m":0.1,"y_m":0.1}'


def call(method: str, params: str) -> bytes:
    """A request with these parameters."""
    return f'{{"jsonrpc":"2.0","id":1,"method":"{method}","params":{params}}}\n'.encode()


def test_request_of_the_specification_is_read() -> None:
    """The first example with named parameters of the JSON-RPC 2.0 specification."""
    request = read_request(
        b'{"jsonrpc": "2.0", "method": "subtract", '
        b'"params": {"subtrahend": 23, "minuend": 42}, "id": 3}'
    )
    assert (request.method, request.id, request.expects_response) == ("subtract", 3, True)
    assert request.params == {"subtrahend": 23, "minuend": 42}


@pytest.mark.parametrize(
    ("id", "expected"), [("", False), (',"id":null', True), (',"id":"a"', True)]
)
def test_request_expects_response_only_with_an_id(id: str, expected: bool) -> None:
    """A notification lacks the member id; null is an id."""
    line = f'{{"jsonrpc":"2.0","method":"stop"{id}}}'.encode()
    assert read_request(line).expects_response is expected


@pytest.mark.parametrize(
    ("line", "code"),
    [
        (b"", ErrorCode.PARSE),
        (b"hello", ErrorCode.PARSE),
        (b"\xff\xfe", ErrorCode.PARSE),
        (b'{"jsonrpc":"2.0","id":1,"method":"stop"', ErrorCode.PARSE),
        (b'{"jsonrpc":"2.0","id":1,"method":"\\ud800"}', ErrorCode.INVALID_REQUEST),
        (call("touch", '{"source":"a","touches":[{"id":1,"x_m":NaN,"y_m":0}]}'), ErrorCode.PARSE),
        (call("arm", '{"owner":"me","lease_s":Infinity}'), ErrorCode.PARSE),
        (b"[" * 60_000, ErrorCode.PARSE),
        (b"1", ErrorCode.INVALID_REQUEST),
        (b"[]", ErrorCode.INVALID_REQUEST),
        (b'[{"jsonrpc":"2.0","id":1,"method":"stop"}]', ErrorCode.INVALID_REQUEST),
        (b"{}", ErrorCode.INVALID_REQUEST),
        (b'{"jsonrpc":"1.0","id":1,"method":"stop"}', ErrorCode.INVALID_REQUEST),
        (b'{"jsonrpc":"2.0","id":1}', ErrorCode.INVALID_REQUEST),
        (b'{"jsonrpc":"2.0","id":1,"method":7}', ErrorCode.INVALID_REQUEST),
        (b'{"jsonrpc":"2.0","id":1.5,"method":"stop"}', ErrorCode.INVALID_REQUEST),
        (b'{"jsonrpc":"2.0","id":true,"method":"stop"}', ErrorCode.INVALID_REQUEST),
        (
            b'{"jsonrpc":"2.0","id":1' + b"0" * 4000 + b',"method":"stop"}',
            ErrorCode.INVALID_REQUEST,
        ),
        (
            b'{"jsonrpc":"2.0","id":"' + b"i" * 81 + b'","method":"stop"}',
            ErrorCode.INVALID_REQUEST,
        ),
        (b'{"jsonrpc":"2.0","id":1,"method":"stop","params":[1]}', ErrorCode.INVALID_REQUEST),
        (b'{"jsonrpc":"2.0","id":1,"method":"stop","more":1}', ErrorCode.INVALID_REQUEST),
    ],
)
def test_line_that_is_no_request_is_refused(line: bytes, code: ErrorCode) -> None:
    """-32700 for invalid JSON, -32600 for JSON that is not one request with named parameters."""
    error = refusal(line)
    assert error.code is code
    assert error.data.remedy


@pytest.mark.parametrize(
    ("line", "id"),
    [
        (b'{"jsonrpc":"1.0","id":7,"method":"stop"}', 7),
        (b'{"id":"a","method":1}', "a"),
        (b'{"jsonrpc":"2.0","id":7,"method":"stop","method":"arm"}', 7),
        (b'{"jsonrpc":"2.0","id":7,"method":"stop","params":{"a":1,"a":1}}', 7),
        (b'{"jsonrpc":"2.0","id":7,"method":"stop","params":{"a":NaN}}', 7),
        (b'{"jsonrpc":"1.0","id":1.5,"method":"stop"}', None),
        (b'{"jsonrpc":"2.0","id":7,"method":"stop"', None),
        (b'[{"id":7}]', None),
    ],
)
def test_invalid_request_is_refused_with_its_id_if_that_can_be_read(
    line: bytes, id: int | str | None
) -> None:
    """JSON that is no request, repeats a key or has NaN; null as JSON-RPC 2.0 has it otherwise."""
    with pytest.raises(InvalidRequest) as caught:
        read_request(line)
    assert caught.value.id == id


@pytest.mark.parametrize(
    ("method", "params", "key"),
    [
        ("arm", "{}", "owner"),
        ("arm", '{"owner":"me","lease_s":0.99}', "lease_s"),
        ("arm", '{"owner":"me","lease_s":61}', "lease_s"),
        ("arm", '{"owner":"me","lease_s":"5"}', "lease_s"),
        ("arm", '{"owner":"me","lease_s":1e999}', "lease_s"),
        ("arm", '{"owner":"me","lease_s":true}', "lease_s"),
        ("arm", '{"owner":"","lease_s":5}', "owner"),
        ("arm", '{"owner":"a\\nb","lease_s":5}', "owner"),
        ("arm", '{"owner":"a\\u001b[2J","lease_s":5}', "owner"),
        ("arm", '{"owner":"a\\u009b2J","lease_s":5}', "owner"),
        ("arm", '{"owner":"a\\u202eb","lease_s":5}', "owner"),
        ("arm", '{"owner":"me","lease_s":5,"level":2}', "level"),
        ("stop", '{"file":"/etc/passwd"}', "file"),
        ("hello", '{"client":"' + "c" * 81 + '"}', "client"),
        ("touch", '{"source":"a","touches":[{"id":1.5,"x_m":0,"y_m":0}]}', "touches.0.id"),
        ("touch", '{"source":"a","touches":[{"id":1,"x_m":null,"y_m":0}]}', "touches.0.x_m"),
        ("touch", '{"source":"a","touches":[{"id":9e99,"x_m":0,"y_m":0}]}', "touches.0.id"),
        ("touch", f'{{"source":"a","touches":[{",".join([TOUCH] * 65)}]}}', "touches"),
        ("subscribe", '{"topics":["weather"]}', "topics.0"),
        ("subscribe", '{"topics":["state"],"rate_hz":61}', "rate_hz"),
        ("subscribe", '{"topics":[]}', "topics"),
    ],
)
def test_parameter_that_is_wrong_is_refused_with_its_key(
    method: str, params: str, key: str
) -> None:
    """-32602 and the key of what is missing, unknown, of another type or out of range."""
    error = refusal(call(method, params))
    assert error.code is ErrorCode.INVALID_PARAMS
    assert error.data.where == key
    assert error.data.remedy


def test_response_has_the_members_of_the_specification() -> None:
    """Result and error objects of JSON-RPC 2.0, one line each."""
    assert json.loads(result_line("a", '{"lease":"x"}')) == {
        "jsonrpc": "2.0",
        "id": "a",
        "result": {"lease": "x"},
    }
    error = RpcError(ErrorCode.WRONG_STATE, "the\nplate", where="state", remedy="arm first")
    line = error_line(None, error)
    assert line.count(b"\n") == 1
    assert json.loads(line) == {
        "jsonrpc": "2.0",
        "id": None,
        "error": {
            "code": 1001,
            "message": "the\nplate; arm first",
            "data": {"what": "the\nplate", "where": "state", "remedy": "arm first"},
        },
    }


@pytest.mark.parametrize(
    "params",
    [
        ArmParams(owner="Zoë", lease_s=5.0),
        SubscribeParams(topics=["state"], rate_hz=None),
        SubscribeParams(topics=["amplifiers", "log"], rate_hz=60.0),
        Empty(),
    ],
)
def test_request_line_is_read_as_written(params: ApiMessage) -> None:
    """Requests of the client have the same id and parameters at the server."""
    line = request_line(7, "any", params.model_dump_json(exclude_none=True).encode())
    request = read_request(line)
    assert request.id == 7
    assert read_params(type(params), request) == params


@given(st.binary(max_size=200))
def test_line_of_any_bytes_is_a_request_or_refused(line: bytes) -> None:
    """Any input gives a request or an RpcError whose response is one line."""
    response = b"{}\n"
    try:
        read_request(line)
    except RpcError as error:
        response = error_line(None, error)
    assert json.loads(response) is not None
    assert response.index(b"\n") == len(response) - 1


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: (
        st.lists(inner, max_size=2) | st.dictionaries(st.text(max_size=3), inner, max_size=2)
    ),
    max_leaves=4,
)


@given(st.sampled_from(sorted(METHODS)), st.dictionaries(st.text(max_size=8), JSON, max_size=4))
def test_params_of_any_shape_are_valid_or_refused(method: str, params: dict[str, object]) -> None:
    """Any parameters give a message or an RpcError without control characters."""
    line = json.dumps({"jsonrpc": "2.0", "id": 1, "method": method, "params": params})
    text = ""
    try:
        read_params(METHODS[method].params, read_request(line.encode()))
    except RpcError as error:
        text = str(error)
    assert text == "" or text.isprintable()
