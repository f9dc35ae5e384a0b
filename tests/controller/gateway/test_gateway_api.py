"""What the gateway offers to those that it lets in: HTTP, its description, and the WebSocket."""

import json
import re
import struct
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from controller.api.methods import METHODS, TouchParams
from controller.api.schema import PlayedTone
from controller.api.topics import LogEvent, PatternEvent
from gateway_bench import (
    TOKEN,
    GatewayProcess,
    RawWebSocket,
    ScriptedDaemon,
    gateway_process,
    http,
    wait_for,
    wait_for_daemon,
)

ALLOWED = "https://panel.example"


@pytest.fixture(scope="module")
def gateway(
    daemon: ScriptedDaemon, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[GatewayProcess]:
    """One for all tests here, that lets in the pages of another origin, too."""
    folder = tmp_path_factory.mktemp("gateway")
    options = ("--allow-origin", ALLOWED, "--allow-host", "panel.example")
    with gateway_process(folder, daemon.socket, *options) as made:
        wait_for_daemon(made)
        yield made


@pytest.fixture(autouse=True)
def nothing_asked_yet(daemon: ScriptedDaemon) -> None:
    """Each test sees what itself has asked."""
    daemon.calls.clear()


PARAMETERS: dict[str, dict[str, object]] = {
    "hello": {"client": "me"},
    "status": {},
    "arm": {"owner": "me", "lease_s": 5},
    "renew": {"lease": "a-lease"},
    "disarm": {},
    "stop": {},
    "clear": {},
    "touch": {"source": "me", "touches": [{"id": 1, "x_m": 0.1, "y_m": 0.2}]},
    "effects": {},
    "play": {"effect": "tap", "x_m": 0.1, "y_m": 0.2},
}


def ask(gateway: GatewayProcess, method: str) -> tuple[int, dict[str, object]]:
    """A method over HTTP: status and what it says."""
    answer = http(gateway, f"/api/v1/{method}", body=json.dumps(PARAMETERS[method]).encode())
    return answer.status, json.loads(answer.body)


@pytest.mark.parametrize("method", [name for name in PARAMETERS if name not in ("hello", "play")])
def test_a_method_over_http_is_the_daemons(
    gateway: GatewayProcess, daemon: ScriptedDaemon, method: str
) -> None:
    """It is asked once, with these parameters, and its result comes back as the API says."""
    status, said = ask(gateway, method)
    assert status == 200
    METHODS[method].result.model_validate_json(json.dumps(said))
    assert daemon.methods == [method]


def test_all_methods_but_those_of_notifications_are_there_over_http() -> None:
    """Subscriptions need a connection that stays."""
    assert METHODS.keys() - PARAMETERS.keys() == {"subscribe", "unsubscribe"}


def test_an_error_of_the_daemon_keeps_its_code_and_remedy(gateway: GatewayProcess) -> None:
    """What the daemon refuses is 409, with the words, code and remedy of the API."""
    status, said = ask(gateway, "play")
    assert status == 409
    assert said == {
        "error": "there is no such effect; see effects",
        "code": 1003,
        "data": {"what": "there is no such effect", "where": None, "remedy": "see effects"},
    }


def test_nobody_can_give_the_gateway_another_name(
    gateway: GatewayProcess, daemon: ScriptedDaemon
) -> None:
    """The gateway answers hello itself: the daemon goes on to log it by its own name."""
    status, said = ask(gateway, "hello")
    assert status == 200
    assert said["api_version"] == "1.0"
    assert daemon.calls == []


def test_touches_over_http_say_so(gateway: GatewayProcess, daemon: ScriptedDaemon) -> None:
    """Their source cannot be taken for one of a browser."""
    ask(gateway, "touch")
    (params,) = [params for _, params in daemon.calls]
    assert isinstance(params, TouchParams)
    assert params.source == "http:me"


def test_an_empty_body_is_no_parameters(gateway: GatewayProcess, daemon: ScriptedDaemon) -> None:
    """A stop needs nothing but the token, not even the type of nothing."""
    assert http(gateway, "/api/v1/stop", body=b"").status == 200
    assert http(gateway, "/api/v1/stop", body=b"", media=None).status == 200
    assert daemon.methods == ["stop", "stop"]


@pytest.mark.parametrize(
    "file", ["", *sorted(p.name for p in Path("controller/gateway/page").glob("*"))]
)
def test_a_file_of_the_page_is_for_everybody(gateway: GatewayProcess, file: str) -> None:
    """Without a token, never from an old copy, and with a policy to load nothing from outside."""
    answer = http(gateway, f"/{file}", method="GET", body=b"", token=())
    assert answer.status == 200
    headers = answer.headers.lower()
    assert "content-security-policy: default-src 'none'; script-src 'self';" in headers
    assert "x-content-type-options: nosniff" in headers
    assert "x-frame-options: deny" in headers
    assert "cache-control: no-cache" in headers
    assert "\r\nserver:" not in headers
    named = set(re.findall(rb"(?:https?:)?//[\w.-]+\.\w+", answer.body))
    assert named <= {b"http://www.w3.org"}  # the name of SVG, which nothing fetches


def test_a_link_to_the_page_can_be_followed(gateway: GatewayProcess) -> None:
    """From a page of others, as a visit; not as a part of it."""
    visit = ["Sec-Fetch-Site: cross-site", "Sec-Fetch-Mode: navigate"]
    part = ["Sec-Fetch-Site: cross-site", "Sec-Fetch-Mode: no-cors"]
    assert http(gateway, "/", method="GET", body=b"", more=visit).status == 200
    assert http(gateway, "/app.js", method="GET", body=b"", more=part).status == 403


def test_an_allowed_origin_may_ask_and_read(gateway: GatewayProcess) -> None:
    """Its preflight is granted for this one origin, and so is reading the answer."""
    said = http(
        gateway,
        method="OPTIONS",
        body=b"",
        token=(),
        more=[
            f"Origin: {ALLOWED}",
            "Access-Control-Request-Method: POST",
            "Access-Control-Request-Headers: authorization, content-type",
        ],
    )
    assert said.status == 200
    assert f"access-control-allow-origin: {ALLOWED}" in said.headers.lower()
    said = http(gateway, more=[f"Origin: {ALLOWED}"])
    assert said.status == 200
    assert f"access-control-allow-origin: {ALLOWED}" in said.headers.lower()
    assert "access-control" not in http(gateway).headers.lower()


def test_an_allowed_host_is_served(gateway: GatewayProcess) -> None:
    """Under the name that was allowed, in any case and with any port."""
    assert http(gateway, host=["PANEL.example:443"]).status == 200


def test_the_description_is_of_what_is_there(gateway: GatewayProcess) -> None:
    """Every method, with its parameters, results and errors, for whoever has no token yet."""
    answer = http(gateway, "/api/v1/openapi.json", method="GET", body=b"", token=())
    described = json.loads(answer.body)
    assert described["openapi"].startswith("3.1")
    assert set(described["paths"]) == {f"/api/v1/{name}" for name in PARAMETERS}
    arm = described["paths"]["/api/v1/arm"]["post"]
    assert set(arm["responses"]) >= {"200", "401", "403", "409", "413", "415", "421", "422", "429"}
    lease = described["components"]["schemas"]["ArmParams"]["properties"]["lease_s"]
    assert (lease["minimum"], lease["maximum"]) == (1.0, 60.0)


def test_requests_made_from_the_description_find_no_fault(
    gateway: GatewayProcess, daemon: ScriptedDaemon, tmp_path: Path
) -> None:
    """Schemathesis makes good and bad requests of every method; all is answered as described."""
    # By JSON Schema 1.0 is an integer; by the API a finger's id is one without a point.
    (tmp_path / "schemathesis.toml").write_text(
        '[[operations]]\ninclude-name = "POST /api/v1/touch"\n'
        "checks.positive_data_acceptance.enabled = false\n",
        encoding="utf-8",
    )
    done = subprocess.run(
        [
            *(Path(sys.executable).with_name("schemathesis"), "run"),
            *("-H", f"Authorization: Bearer {TOKEN}", "--rate-limit", "200/s"),
            *("--seed", "1", "--generation-deterministic"),
            *("--max-examples", "4", "--phases", "coverage,fuzzing", "--no-color"),
            "--continue-on-failure",
            f"{gateway.url}api/v1/openapi.json",
        ],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert done.returncode == 0, done.stdout[-6000:]
    assert set(daemon.methods) == set(PARAMETERS) - {"hello"}


def subscribe(ws: RawWebSocket, *topics: str) -> None:
    """Be told of topics."""
    ws.call("subscribe", {"topics": topics}, id=100)
    assert ws.response(100)["result"] == {}


def told(ws: RawWebSocket, topic: str) -> dict[str, object] | None:
    """The data of a topic's next notification."""
    while True:
        opcode, payload = ws.next()
        assert opcode in (1, 2), payload
        params = json.loads(payload).get("params", {}) if opcode == 1 else {}
        if params.get("topic") == topic:
            return params["data"]  # type: ignore[no-any-return]


def test_a_browser_is_told_what_is_so_and_what_happens(
    gateway: GatewayProcess, daemon: ScriptedDaemon
) -> None:
    """At once who the daemon is and its state, then every event, its text as it was."""
    text = '<img src=x onerror=alert(1)> "quoted" \u2028'
    with RawWebSocket(gateway) as ws:
        subscribe(ws, "hello", "state", "log")
        state = told(ws, "state")
        assert state is not None
        assert state["new"] == "READY_TO_SWITCH_ON"
        hello = told(ws, "hello")
        assert hello is not None
        rig = hello["rig"]
        assert isinstance(rig, dict)
        assert rig["length_m"] == pytest.approx(0.3048)  # 12 inches, as in the rig's file
        daemon.publish("log", LogEvent(level="error", message=text, cause=text, remedy=text))
        assert told(ws, "log") == {"level": "error", "message": text, "cause": text, "remedy": text}


def test_the_field_is_that_of_the_drive(gateway: GatewayProcess, daemon: ScriptedDaemon) -> None:
    """By the layout of docs/reference/gateway.md.

    Below all natural frequencies the plate is a board on four springs: pushed at its south-west
    corner it moves most there, least at the far one.
    """
    with RawWebSocket(gateway) as ws:
        subscribe(ws, "field")
        daemon.publish(
            "pattern",
            PatternEvent(
                contacts=[],
                drive={"SW": PlayedTone(frequency_hz=5.0, level=0.5, phase_deg=0.0)},
                predicted_contrast_db=None,
                robust_contrast_db=None,
                predicted_level_db_sl=None,
                latency_ms=1.0,
            ),
        )
        while True:
            opcode, payload = ws.next()
            if opcode == 2 and struct.unpack_from("<H", payload, 4) == (1,):
                break
    columns, rows, count, zero = struct.unpack_from("<4H", payload)
    scale, frequency = struct.unpack_from("<2f", payload, 8)
    assert (count, zero, frequency) == (1, 0, 5.0)
    assert columns > rows > 2
    parts = struct.unpack_from(f"<{2 * rows * columns}h", payload, 16)
    assert len(payload) == 16 + 4 * rows * columns
    assert max(map(abs, parts)) == 32767
    strength = [abs(complex(*parts[at : at + 2])) for at in range(0, len(parts), 2)]
    assert scale > 0
    south_west, south_east = strength[0], strength[columns - 1]
    north_west = strength[-columns]
    assert south_west == max(strength)
    assert south_west > 2 * max(south_east, north_west)


def test_browsers_fingers_are_kept_apart_and_lifted_when_they_leave(
    gateway: GatewayProcess, daemon: ScriptedDaemon
) -> None:
    """Two pages that call their fingers the same are two sources; each lifts its own at the end."""
    touch = PARAMETERS["touch"]
    with RawWebSocket(gateway) as one, RawWebSocket(gateway) as other:
        for ws in (one, other):
            ws.call("touch", touch)
            assert ws.response()["result"] == {}
        wait_for(lambda: len(daemon.calls) == 2)
    wait_for(lambda: len(daemon.calls) == 4)
    frames = [params for _, params in daemon.calls]
    assert all(isinstance(params, TouchParams) for params in frames)
    said = [(params.source, len(params.touches)) for params in frames]  # type: ignore[attr-defined]
    sources = {source for source, _ in said}
    assert len(sources) == 2
    assert sorted(said) == sorted((source, count) for source in sources for count in (0, 1))


def test_a_stop_overtakes_what_waits(gateway: GatewayProcess, daemon: ScriptedDaemon) -> None:
    """Sixteen requests to arm are under way, more are refused; a stop is answered all the same."""
    with RawWebSocket(gateway) as ws:
        with daemon.holding():
            for id in range(17):
                ws.call("arm", PARAMETERS["arm"], id=id)
            error = ws.response(16)["error"]
            assert isinstance(error, dict)
            assert error["code"] == 1005
            ws.call("stop", {}, id=99)
            assert ws.response(99)["result"] == {}
        wait_for(lambda: is_taken(ws))  # after the answers to what waited, so that all are told


def is_taken(ws: RawWebSocket) -> bool:
    """Whether the daemon takes another request; it refuses one where many are under way."""
    ws.call("effects", {}, id=300)
    return "result" in ws.response(300)


def test_a_request_without_id_gets_no_answer(
    gateway: GatewayProcess, daemon: ScriptedDaemon
) -> None:
    """Not even where it is wrong; the next one is answered."""
    with RawWebSocket(gateway) as ws:
        ws.send(b'{"jsonrpc": "2.0", "method": "stop"}')
        ws.send(b'{"jsonrpc": "2.0", "method": "arm", "params": {}}')
        ws.call("effects", {}, id=5)
        opcode, payload = ws.next()
        assert (opcode, json.loads(payload)["id"]) == (1, 5)
    assert daemon.methods == ["stop", "effects"]


def test_a_message_in_two_fragments_is_one(gateway: GatewayProcess) -> None:
    """As RFC 6455 has it; a character may be cut through."""
    said = json.dumps(
        {"jsonrpc": "2.0", "id": "ü", "method": "disarm"}, ensure_ascii=False
    ).encode()
    at = said.index("ü".encode()) + 1
    with RawWebSocket(gateway) as ws:
        ws.send(said[:at], first=0x01)
        ws.send(said[at:], first=0x80)
        assert json.loads(ws.next()[1]) == {"jsonrpc": "2.0", "id": "ü", "result": {}}
