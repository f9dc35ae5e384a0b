import json
import re
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

import controller
from api_page import WRITER, reference
from controller.api.jsonrpc import (
    ErrorCode,
    RpcError,
    error_line,
    event_line,
    read_params,
    read_request,
    request_line,
    result_line,
)
from controller.api.methods import METHODS, ArmParams, ArmResult, SubscribeParams, TouchParams
from controller.api.schema import Empty
from controller.api.topics import TOPICS, StateEvent
from page_part import insert

PAGE = Path(controller.__file__).parent.parent / "docs" / "reference" / "api.md"


def code_of(line: bytes) -> ErrorCode:
    """With which error a line is refused, up to its parameters."""

    def read() -> None:
        request = read_request(line)
        read_params(METHODS[request.method].params, request)

    return refusal_of(read).code


def refusal_of(read: Callable[[], object]) -> RpcError:
    """The error that this raises."""
    with pytest.raises(RpcError) as caught:
        read()
    return caught.value


def call(method: str, params: str) -> bytes:
    """A request with these parameters, as anyone could write it."""
    return f'{{"jsonrpc":"2.0","id":1,"method":"{method}","params":{params}}}\n'.encode()


def test_the_example_of_the_specification_is_understood() -> None:
    """The first example of the JSON-RPC 2.0 specification with named parameters, to the member."""
    line = (
        b'{"jsonrpc": "2.0", "method": "subtract", '
        b'"params": {"subtrahend": 23, "minuend": 42}, "id": 3}'
    )
    request = read_request(line)
    assert (request.method, request.id, request.wants_answer) == ("subtract", 3, True)
    assert request.params == {"subtrahend": 23, "minuend": 42}


@pytest.mark.parametrize(
    ("line", "wants_answer"),
    [
        (b'{"jsonrpc":"2.0","method":"stop"}', False),
        (b'{"jsonrpc":"2.0","method":"stop","id":null}', True),
        (b'{"jsonrpc":"2.0","method":"stop","id":"a"}', True),
    ],
)
def test_only_a_request_without_an_id_gets_no_answer(line: bytes, wants_answer: bool) -> None:
    """A notification is a request without the member id; null is an id."""
    assert read_request(line).wants_answer is wants_answer


@pytest.mark.parametrize(
    "line",
    [
        b"",
        b"hello",
        b"\xff\xfe",
        b'{"jsonrpc":"2.0","id":1,"method":"stop"',
        b'{"jsonrpc":"2.0","id":1,"method":"\\ud800"}',
        call("touch", '{"source":"a","touches":[{"id":1,"x_m":NaN,"y_m":0}]}'),
        call("touch", '{"source":"a","touches":[{"id":1,"x_m":Infinity,"y_m":0}]}'),
        b"[" * 60_000,
        b'{"a":' * 10_000,
    ],
)
def test_what_is_no_json_is_a_parse_error(line: bytes) -> None:
    """Code -32700 for anything but one JSON value; NaN and endless nesting are none."""
    assert code_of(line) is ErrorCode.PARSE


@pytest.mark.parametrize(
    "line",
    [
        b"1",
        b"null",
        b"[]",
        b'[{"jsonrpc":"2.0","id":1,"method":"stop"}]',
        b"{}",
        b'{"jsonrpc":"1.0","id":1,"method":"stop"}',
        b'{"jsonrpc":"2.0","id":1}',
        b'{"jsonrpc":"2.0","id":1,"method":7}',
        b'{"jsonrpc":"2.0","id":1.5,"method":"stop"}',
        b'{"jsonrpc":"2.0","id":true,"method":"stop"}',
        b'{"jsonrpc":"2.0","id":1' + b"0" * 4000 + b',"method":"stop"}',
        b'{"jsonrpc":"2.0","id":"' + b"i" * 81 + b'","method":"stop"}',
        b'{"jsonrpc":"2.0","id":1,"method":"stop","params":[1]}',
        b'{"jsonrpc":"2.0","id":1,"method":"stop","more":1}',
    ],
)
def test_what_is_no_request_is_refused(line: bytes) -> None:
    """Code -32600 for JSON that is no single JSON-RPC 2.0 request with named parameters."""
    assert code_of(line) is ErrorCode.INVALID_REQUEST


@pytest.mark.parametrize(
    ("method", "params", "where"),
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
        ("subscribe", '{"topics":["weather"]}', "topics.0"),
        ("subscribe", '{"topics":["state"],"rate_hz":61}', "rate_hz"),
        ("subscribe", '{"topics":[]}', "topics"),
    ],
)
def test_wrong_parameters_are_refused_with_their_key(method: str, params: str, where: str) -> None:
    """Code -32602 and the place, for what is missing, too much, of another type or out of range."""
    request = read_request(call(method, params))
    with pytest.raises(RpcError) as caught:
        read_params(METHODS[method].params, request)
    assert caught.value.code in (ErrorCode.INVALID_PARAMS, ErrorCode.PARSE)
    assert caught.value.data.where == where


def test_a_frame_has_at_most_64_touches() -> None:
    """The bound of a touch frame, from both sides."""
    touch = '{"id":1,"x_m":0.1,"y_m":0.1}'

    def frame(count: int) -> bytes:
        return call("touch", f'{{"source":"a","touches":[{",".join([touch] * count)}]}}')

    request = read_request(frame(64))
    params = read_params(TouchParams, request)
    assert isinstance(params, TouchParams)
    assert len(params.touches) == 64
    assert code_of(frame(65)) is ErrorCode.INVALID_PARAMS


def test_an_answer_and_an_error_have_the_members_of_the_specification() -> None:
    """Result and error objects of JSON-RPC 2.0, one line each; errors have a remedy."""
    assert json.loads(result_line("a", ArmResult(lease="x", lease_s=5.0))) == {
        "jsonrpc": "2.0",
        "id": "a",
        "result": {"lease": "x", "lease_s": 5.0},
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


def test_a_notification_has_a_method_and_no_id() -> None:
    """An event as the contract has it: topic, time_s, data, and how many were lost before."""
    data = StateEvent(old="FAULT", new="SWITCH_ON_DISABLED", cause="cleared", remedy=None)
    line = event_line("state", time=12.5, lost=3, data=data.model_dump_json().encode())
    assert line.count(b"\n") == 1
    assert json.loads(line) == {
        "jsonrpc": "2.0",
        "method": "event",
        "params": {
            "topic": "state",
            "time_s": 12.5,
            "lost": 3,
            "data": {
                "old": "FAULT",
                "new": "SWITCH_ON_DISABLED",
                "cause": "cleared",
                "remedy": None,
            },
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
def test_what_a_client_writes_is_what_the_server_reads(
    params: ArmParams | SubscribeParams | Empty,
) -> None:
    """Requests of our own client keep their meaning on the way."""
    request = read_request(request_line(7, "any", params))
    assert request.id == 7
    assert read_params(type(params), request) == params
    assert not read_request(request_line(None, "any", params)).wants_answer


@given(st.binary(max_size=200))
def test_any_bytes_are_a_request_or_an_error(line: bytes) -> None:
    """Whatever arrives, reading it gives a request or an RpcError whose answer is one line."""
    answer = b"{}\n"
    try:
        read_request(line)
    except RpcError as error:
        answer = error_line(None, error)
    assert json.loads(answer) is not None
    assert answer.index(b"\n") == len(answer) - 1


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: (
        st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3)
    ),
    max_leaves=8,
)


@given(st.sampled_from(sorted(METHODS)), st.dictionaries(st.text(max_size=8), JSON, max_size=4))
def test_any_parameters_are_the_methods_or_an_error(method: str, params: dict[str, object]) -> None:
    """Parameters of any shape are refused by an RpcError that quotes no control characters."""
    line = json.dumps({"jsonrpc": "2.0", "id": 1, "method": method, "params": params})
    said = ""
    try:
        read_params(METHODS[method].params, read_request(line.encode()))
    except RpcError as error:
        said = str(error)
    assert said == "" or said.isprintable()


def test_the_page_names_every_method_topic_key_and_code() -> None:
    """The API's page holds the reference that the models give; after a change write it anew."""
    page = PAGE.read_text("utf-8")
    assert insert(page, reference(), writer=WRITER) == page, (
        "python docs/generators/api_page.py docs/reference/api.md"
    )
    for name in [*METHODS, *(f"topic {topic}" for topic in TOPICS)]:
        assert re.search(rf"^#### {name}$", page, re.MULTILINE)


def test_every_link_of_the_reference_leads_somewhere() -> None:
    """Types that tables refer to stand on the page, too."""
    tables = reference()
    for name in re.findall(r"\]\(#(\w+)\)", tables):
        assert re.search(rf"^#### {name}$", tables, re.MULTILINE | re.IGNORECASE)
