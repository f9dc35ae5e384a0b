"""The API's server: what it replies, in which order it serves, and which touches count."""

import asyncio
import json
import socket
from pathlib import Path
from unittest.mock import Mock

import pytest

from controller.api import connection
from controller.api.jsonrpc import ErrorCode
from controller.api.methods import StatusResult, TouchParams
from controller.api.server import ApiServer
from daemons import PATIENCE, ServedApi, feed, request, serving

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
    """It is not open yet when the server looks at those that are."""
    server = ApiServer({}, on_disconnect=Mock(), holds_lease=lambda client: False)
    bound = socket.socket(socket.AF_UNIX)
    bound.bind(str(tmp_path / "api.sock"))
    await server.open(bound)
    with socket.socket(socket.AF_UNIX) as client:
        client.connect(str(tmp_path / "api.sock"))
        server._acceptor._accept()  # the loop's turn in which closing begins
        await server.close()
        await asyncio.sleep(0)  # the turn in which sockets are closed
        client.setblocking(False)
        assert client.recv(1) == b""


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
    monkeypatch.setattr(connection, "MAX_TURN", 1.0)  # else the arming may have begun by then
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


def touch(source: str, *ids: int, x: float = 0.1, id: int | None = None) -> bytes:
    """A touch frame with these fingers."""
    touches = ",".join(f'{{"id":{each},"x_m":{x},"y_m":0.1}}' for each in ids)
    return request("touch", f'{{"source":"{source}","touches":[{touches}]}}', id=id)


async def test_touch_frame_is_superseded_by_the_next_of_its_source() -> None:
    """Only by a valid frame of the same source without an id, directly after it."""
    served, client, wire = serving()
    lines = [touch("a", 1, x=0.01 * number) for number in range(4)]  # the last one is served
    lines += [touch("b", 1, x=0.04), touch("a", 1, x=0.05), request("disarm")]
    lines += [
        touch("a", 1, x=0.06, id=7),
        touch("a", 1, x=0.07),
        request("touch", '{"source":"a"}'),
    ]
    invalid = [
        touch("a", 1, x=0.5).replace(b"0.1}", b'"here"}'),
        touch("a", 1, x=0.5).replace(b'"2.0"', b'"1.0"'),
        touch("a", 1, x=0.5).replace(b'"method"', b'"more":1,"method"'),
    ]
    for number, line in enumerate(invalid):
        lines += [touch("a", 1, x=0.08 + 0.01 * number), line]
    await served.takes(client, b"".join(lines) + request("stop", id=8))
    # Two of the invalid ones are not requests, hence errors without an id.
    assert [each["id"] for each in wire.lines()] == [7, None, None, 8]
    frames = [each for _, each, _ in served.calls if isinstance(each, TouchParams)]
    before = [("a", 0.03), ("b", 0.04), ("a", 0.05), ("a", 0.06), ("a", 0.07)]
    assert [(each.source, each.touches[0].x_m) for each in frames] == [
        *before,
        *(("a", 0.08), ("a", 0.09), ("a", 0.1)),
    ]


async def test_touch_read_ahead_of_a_client_that_left_is_not_served() -> None:
    """Its fingers are lifted by then, and nobody would lift them again."""
    served = ServedApi(costs=0.001)
    client, _ = served.client()
    leave = asyncio.get_running_loop().call_soon
    served.called = lambda name: leave(client.connection_lost, None)
    await served.takes(client, touch("a", 1, x=0.1) + touch("a", 2, x=0.2))
    assert served.names == ["touch"]


async def test_touch_frame_with_a_finger_that_the_next_has_not_is_served() -> None:
    """A tap whose frames come together is not lost; one more finger supersedes."""
    served, client, _ = serving()
    await served.takes(client, b"".join(touch("a", *ids) for ids in [(1,), (2,), (2, 3), (3,), ()]))
    frames = [each for _, each, _ in served.calls if isinstance(each, TouchParams)]
    fingers = [tuple(each.id for each in frame.touches) for frame in frames]
    assert fingers == [(1,), (2, 3), (3,), ()]


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
    asking[0][0].connection_lost(None)
    await served.takes(client, request("effects", id=1))
    assert "result" in wire.lines()[0]  # there is a place for all methods now
