"""The API's server and its lines: refusals, the order of service, and which touches count."""

import asyncio
import json
import socket
from contextlib import suppress
from pathlib import Path
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
from controller.api.server import ApiServer
from daemons import PATIENCE, ServedApi, request, serving
from virtual_lines import feed

ARM = '{"owner":"me","lease_s":5}'


async def test_server_continues_after_invalid_lines() -> None:
    """Invalid JSON, requests, methods and parameters get an error each; the next line is served."""
    served, client, wire = serving()
    feed(client, b"garbage\n\n\xff\n[]\n" + request("no_such_method", id=1))
    await served.takes(client, request("disarm", '{"level": 2}', id=1) + request("disarm", id=9))
    *errors, last = wire.lines()
    codes = [each["error"]["code"] for each in errors]
    assert codes == [-32700, -32700, -32700, -32600, -32601, -32602]
    assert last == {"jsonrpc": "2.0", "id": 9, "result": {}}
    assert served.names == ["disarm"]


async def test_server_closes_when_a_line_exceeds_64_kib() -> None:
    """65 536 bytes with the line feed are served; a byte more, complete or not, is refused."""
    served = ServedApi()
    head, tail = b'{"jsonrpc":"2.0","id":1,"method":"disarm"', b"}\n"
    longest = head + b" " * ((1 << 16) - len(head) - len(tail)) + tail
    for line, is_served in (
        (longest, True),
        (longest[:-2] + b" }\n", False),
        (b"x" * 65536, False),
    ):
        client, wire = served.client()
        await served.takes(client, line)
        (reply,) = wire.lines()
        assert ("result" in reply, client.is_open) == (is_served, is_served)
        assert is_served or reply["error"]["code"] == -32700
    assert served.names == ["disarm"]


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


async def test_request_without_id_gets_no_response() -> None:
    """Not even an error; and without an id nothing is armed, as its lease would be unknown."""
    served, client, wire = serving()
    await served.takes(client, request("disarm") + request("nothing") + request("arm", ARM))
    assert (wire.lines(), served.names) == ([], ["disarm"])


async def test_bug_in_a_method_is_reported_without_details(
    caplog: pytest.LogCaptureFixture,
) -> None:
    """Code -32603; the details are in the log alone."""
    served, client, wire = serving()
    await served.takes(client, request("play", '{"effect":"x","x_m":0,"y_m":0}', id=1))
    response = json.dumps(wire.lines())
    assert "-32603" in response
    assert "/a/path" not in response
    assert "/a/path" in caplog.text


async def test_result_that_cannot_be_sent_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    """As of a text that is not Unicode; the next line is served in the same turn."""
    served, client, wire = serving()
    monkeypatch.setattr(StatusResult, "model_dump_json", Mock(side_effect=UnicodeError))
    async with asyncio.timeout(PATIENCE / 6):
        await served.takes(client, request("status", id=1) + request("disarm", id=2))
    failed, done = wire.lines()
    assert (failed["id"], failed["error"]["code"]) == (1, ErrorCode.INTERNAL)
    assert done == {"jsonrpc": "2.0", "id": 2, "result": {}}


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


@pytest.mark.parametrize("silencing", ["stop", "disarm"])
async def test_arm_is_not_carried_out_after_what_silences(
    monkeypatch: pytest.MonkeyPatch, silencing: str
) -> None:
    """Both in the same bytes: it ends disarmed; the other way round it is armed."""
    monkeypatch.setattr(server, "MAX_TURN", 1.0)  # else the arming may have begun by then
    served = ServedApi()
    served.may_arm.set()
    client, wire = served.client()
    await served.takes(client, request("arm", ARM, id=1) + request(silencing, id=2))
    assert served.names == [silencing]
    assert [line["error"]["code"] for line in wire.lines() if line["id"] == 1] == [ErrorCode.LEASE]
    await served.takes(client, request(silencing, id=3) + request("arm", ARM, id=4))
    assert served.names == [silencing] * 2 + ["arm"]


async def test_stop_is_served_while_requests_are_pending() -> None:
    """Eight may be pending, further ones are refused, a stop is served at once."""
    served, client, wire = serving()
    await served.takes(client, b"".join(request("arm", ARM, id=id) for id in range(10)))
    await served.takes(client, request("stop", id=99))
    lines = wire.lines()
    assert {line["id"] for line in lines} == {8, 9, 99}
    assert [line["error"]["code"] for line in lines if "error" in line] == [1005, 1005]
    served.may_arm.set()
    await asyncio.gather(*client.pending)
    assert {line["id"] for line in wire.lines()} == set(range(8))


async def test_client_that_closed_its_side_gets_pending_responses() -> None:
    """End of input, then the responses, then the end; only arming is for those who stay."""
    served, client, wire = serving()
    feed(client, request("stop", id=1) + request("arm", ARM, id=2))
    client.eof_received()
    assert client.is_open
    await served.settle()
    assert {each["id"]: "result" in each for each in wire.lines()} == {1: True, 2: False}
    assert (client.is_open, served.names) == (False, ["stop"])


async def test_stop_is_served_among_silent_and_asking_clients() -> None:
    """With 160 silent connections after 32 that ask: a place in reserve stops, but does not arm.

    They are those of another process.
    """
    served = ServedApi()
    asking = [served.client() for _ in range(32)]
    for client, wire in asking:
        await served.takes(client, request("effects", id=1))
        assert "result" in wire.lines()[0]
    for _ in range(160):
        served.client()
    client, wire = served.client(process=2)
    feed(client, request("effects", id=1) + request("hello", '{"client":"me"}', id=2))
    await served.takes(
        client, b"".join(request(each, id=3) for each in ("status", "stop", "disarm"))
    )
    replies = wire.lines()
    assert ["result" in each for each in replies] == [False, True, True, True, True]
    assert replies[0]["error"]["code"] == 1005
    asking[0][1].abort()
    asking[0][0].connection_lost(None)
    await served.takes(client, request("effects", id=1))
    assert "result" in wire.lines()[0]  # there is a place for all methods now


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
