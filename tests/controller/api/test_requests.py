"""Lines of JSON-RPC 2.0 as requests, and responses as lines: what is read, refused and written."""

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
)
from controller.api.methods import METHODS
from processes.daemons import request

TOUCH = '{"id":1,"x_m":0.1,"y_m":0.1}'
SIXTY_FIVE_TOUCHES = ",".join([TOUCH] * 65)
LONG_NAME = "c" * 81


def test_request_of_the_specification_is_read() -> None:
    """The first example with named parameters of the JSON-RPC 2.0 specification."""
    line = (
        b'{"jsonrpc": "2.0", "method": "subtract", '
        b'"params": {"subtrahend": 23, "minuend": 42}, "id": 3}'
    )

    example = read_request(line)

    assert (example.method, example.id, example.expects_response) == ("subtract", 3, True)
    assert example.params == {"subtrahend": 23, "minuend": 42}


@pytest.mark.parametrize(
    "line",
    [
        b"",
        b"hello",
        b"\xff\xfe",
        b'{"jsonrpc":"2.0","id":1,"method":"stop"',
        b'{"jsonrpc":"2.0","id":1,"method":"touch","params":{"touches":[{"x_m":NaN}]}}',
        b'{"jsonrpc":"2.0","id":1,"method":"arm","params":{"lease_s":Infinity}}',
        pytest.param(b"[" * 60_000, id="deep"),
    ],
)
def test_line_that_is_no_json_is_refused(line: bytes) -> None:
    """With the code -32700 of JSON-RPC 2.0 and a remedy."""
    with pytest.raises(RpcError) as caught:
        read_request(line)
    assert caught.value.code is ErrorCode.PARSE
    assert caught.value.data.remedy


LONG_ID = "i" * 81


@pytest.mark.parametrize(
    "line",
    [
        "1",
        "[]",
        '[{"jsonrpc":"2.0","id":1,"method":"stop"}]',
        "{}",
        '{"jsonrpc":"1.0","id":1,"method":"stop"}',
        '{"jsonrpc":"2.0","id":1}',
        '{"jsonrpc":"2.0","id":1,"method":7}',
        '{"jsonrpc":"2.0","id":1,"method":"\\ud800"}',
        '{"jsonrpc":"2.0","id":1.5,"method":"stop"}',
        '{"jsonrpc":"2.0","id":true,"method":"stop"}',
        f'{{"jsonrpc":"2.0","id":{10**4000},"method":"stop"}}',
        f'{{"jsonrpc":"2.0","id":"{LONG_ID}","method":"stop"}}',
        '{"jsonrpc":"2.0","id":1,"method":"stop","params":[1]}',
        '{"jsonrpc":"2.0","id":1,"method":"stop","more":1}',
    ],
    ids=lambda line: line[:60],
)
def test_json_that_is_no_request_is_refused(line: str) -> None:
    """With the code -32600 unless it is one request with named parameters; with a remedy."""
    with pytest.raises(RpcError) as caught:
        read_request(line.encode())
    assert caught.value.code is ErrorCode.INVALID_REQUEST
    assert caught.value.data.remedy


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
        (
            "touch",
            '{"source":"a","touches":[{"id":1,"x_m":0,"y_m":0,"radius_m":1.1}]}',
            "touches.0.radius_m",
        ),
        ("arm", '{"owner":"me","lease_s":1e999}', "lease_s"),
        ("arm", '{"owner":"me","lease_s":true}', "lease_s"),
        ("arm", '{"owner":"","lease_s":5}', "owner"),
        ("arm", '{"owner":"a\\nb","lease_s":5}', "owner"),
        ("arm", '{"owner":"a\\u001b[2J","lease_s":5}', "owner"),
        ("arm", '{"owner":"a\\u009b2J","lease_s":5}', "owner"),
        ("arm", '{"owner":"a\\u202eb","lease_s":5}', "owner"),
        ("arm", '{"owner":"me","lease_s":5,"level":2}', "level"),
        ("stop", '{"file":"/etc/passwd"}', "file"),
        ("hello", f'{{"client":"{LONG_NAME}"}}', "client"),
        ("touch", '{"source":"a","touches":[{"id":1.5,"x_m":0,"y_m":0}]}', "touches.0.id"),
        ("touch", '{"source":"a","touches":[{"id":1,"x_m":null,"y_m":0}]}', "touches.0.x_m"),
        ("touch", '{"source":"a","touches":[{"id":9e99,"x_m":0,"y_m":0}]}', "touches.0.id"),
        ("touch", f'{{"source":"a","touches":[{SIXTY_FIVE_TOUCHES}]}}', "touches"),
        ("subscribe", '{"topics":["weather"]}', "topics.0"),
        ("subscribe", '{"topics":["state"],"rate_hz":61}', "rate_hz"),
        ("subscribe", '{"topics":[]}', "topics"),
    ],
)
def test_parameter_that_is_wrong_is_refused_with_its_key(
    method: str, params: str, key: str
) -> None:
    """-32602 and the key of what is missing, unknown, of another type or out of range."""
    example = read_request(request(method, params, id=1))
    with pytest.raises(RpcError) as caught:
        read_params(METHODS[method].params, example)
    assert caught.value.code is ErrorCode.INVALID_PARAMS
    assert caught.value.data.where == key
    assert caught.value.data.remedy


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


def nested(values: st.SearchStrategy[object]) -> st.SearchStrategy[object]:
    """Lists and objects of JSON values."""
    lists = st.lists(values, max_size=2)
    objects = st.dictionaries(st.text(max_size=3), values, max_size=2)
    return lists | objects


SCALARS = st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5)
JSON = st.recursive(SCALARS, nested, max_leaves=4)
PARAMETERS = st.dictionaries(st.text(max_size=8), JSON, max_size=4)


@given(method=st.sampled_from(sorted(METHODS)), params=PARAMETERS)
def test_params_of_any_shape_are_valid_or_refused(method: str, params: dict[str, object]) -> None:
    """Any parameters give a message or an RpcError without control characters."""
    line = json.dumps({"jsonrpc": "2.0", "id": 1, "method": method, "params": params})
    text = "valid"
    try:
        example = read_request(line.encode())
        read_params(METHODS[method].params, example)
    except RpcError as error:
        text = str(error)
    assert text.isprintable()
