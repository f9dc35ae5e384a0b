"""Lines of the API: what is read, what is refused with which code and key, what is written."""

import inspect
import json

import pytest
from hypothesis import given
from hypothesis import strategies as st

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
from controller.api.methods import ArmParams, SubscribeParams
from controller.api.registered import METHODS
from controller.api.schema import Empty, Message
from controller.api.summaries import SUMMARIES
from controller.daemon.methods import ApiService


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
def test_request_line_is_read_as_written(params: Message) -> None:
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


def test_table_has_what_is_registered_where_it_is_handled() -> None:
    """Names, parameters, results, treatment and help of all handlers, in their order."""
    handlers = {name: each for name, each in vars(ApiService).items() if hasattr(each, "method")}
    assert {name: each.method for name, each in handlers.items()} == METHODS
    assert [*SUMMARIES] == [*handlers]
    for name, each in handlers.items():
        assert inspect.cleandoc(each.__doc__).split() == SUMMARIES[name].split()
