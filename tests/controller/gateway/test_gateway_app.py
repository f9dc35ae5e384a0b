"""The gateway for allowed clients: HTTP, OpenAPI, the WebSocket, metrics and the drawn field."""

import asyncio
import contextlib
import json
import math
import re
import signal
import struct
import subprocess
import sys
import threading
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple
from unittest.mock import AsyncMock, MagicMock

import httpx
import numpy as np
import pytest
from aiohttp import web
from aiohttp.test_utils import make_mocked_request
from prometheus_client.parser import text_string_to_metric_families

from controller.api.jsonrpc import event_line
from controller.api.link import DaemonLink, Unreachable
from controller.api.methods import (
    METHODS,
    ClearParams,
    LogEvent,
    PatternEvent,
    RequestedBy,
    StatusResult,
)
from controller.api.schema import PlayedTone
from controller.gateway import app
from controller.gateway.access import Access
from controller.gateway.app import serve
from controller.gateway.field import DrawnField
from controller.gateway.gateway_settings import GatewaySettings
from controller.gateway.metrics import exposition
from kit.api_parameters import API_PARAMETERS
from kit.plates import write_rig
from model.arrays import ComplexArray
from processes.daemons import ready_daemon, stated_readings
from processes.gateways import (
    TOKEN,
    UNCONFIRMED,
    GatewayProcess,
    RawWebSocket,
    ScriptedDaemon,
    gateway_process,
    http,
    wait_for,
    wait_for_daemon,
)


def scraped(status: StatusResult | None) -> dict[tuple[str, str], float]:
    """Samples by name and first label."""
    return {
        (sample.name, next(iter(sample.labels.values()), "")): sample.value
        for family in text_string_to_metric_families(exposition(status).decode())
        for sample in family.samples
    }


async def test_metrics_follow_status(tmp_path: Path) -> None:
    """State, link counters, readings and latency of a daemon, in base units."""
    async with ready_daemon(tmp_path) as (bench, era):
        status = await era.status()
        readings = {
            (f"era_amplifier_{reading.metric}", "main"): value
            for reading, value in stated_readings(bench)
        }
    link = status.amplifiers[0].statistics
    expected = readings | {
        ("era_up", ""): 1,
        ("era_state", "READY_TO_SWITCH_ON"): 1,
        ("era_state", "FAULT"): 0,
        ("era_link_frames_out_total", "main"): link.frames_out,
        ("era_amplifier_temperature_celsius", "main"): 25,
        ("era_amplifier_high_voltage", "main"): 0,
        ("era_amplifier_high_voltage_volts", "main"): 0,
        ("era_amplifier_round_trip_seconds", "main"): (link.round_trip_ms or math.nan) / 1000,
        ("era_touch_to_wire_seconds_bucket", "+Inf"): 0,
    }
    read = scraped(status)
    assert {reading: read[reading] for reading in expected} == pytest.approx(expected)
    latency = status.latency_ms.model_copy(
        update={"count": 9, "histogram": [(1.0, 2), (5.0, 3), (100.0, 4)]}
    )
    lifts = latency.model_copy(update={"histogram": [(1.0, 4), (2.0, 0)]})
    counts = {"rejected_touches": {"off_plate": 3}, "lost_events": {"log": 5}}
    latencies = {"latency_ms": latency, "lift_latency_ms": lifts}
    assert scraped(status.model_copy(update={**latencies, **counts})).items() >= {
        (("era_touch_to_wire_seconds_bucket", "0.001"), 2),
        (("era_touch_to_wire_seconds_bucket", "0.005"), 5),
        (("era_touch_to_wire_seconds_bucket", "+Inf"), 9),
        (("era_lift_to_wire_seconds_bucket", "+Inf"), 4),
        (("era_rejected_touches_total", "off_plate"), 3),
        (("era_lost_events_total", "log"), 5),
    }


async def test_network_needs_the_token_and_no_foreign_page(tmp_path: Path) -> None:
    """Metrics are given with the token alone, and to pages of the gateway's own origin."""
    settings = GatewaySettings(
        socket=tmp_path / "era.sock",
        host="192.0.2.7",
        is_token_user_supplied=True,
        extra_hosts=("panel.local",),
    )
    access = Access(settings)
    for path, token, origin, expected in (
        ("/metrics", "wrong", "http://panel.local", 401),
        ("/metrics%0A", "wrong", "http://panel.local", 400),
        ("/metrics", settings.token, "http://evil.example", 403),
        ("/metrics", settings.token, "http://panel.local", 200),
    ):
        headers = {"Host": "panel.local", "Authorization": f"Bearer {token}", "Origin": origin}
        status = 200
        try:
            access.check(make_mocked_request("GET", path, headers=headers))
        except web.HTTPException as refused:
            status = refused.status
        assert status == expected


async def test_metrics_are_read_once_for_all_and_a_failure_is_answered_and_logged(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """However many read them within half a second; the gateway ends at SIGTERM.

    A failure, unlike what is no HTTP, is logged, and answered with the security headers.
    """
    status = AsyncMock(side_effect=Unreachable)
    monkeypatch.setattr(app.AsyncClient, "status", status)
    monkeypatch.setattr("os.nice", lambda _: 0)
    monkeypatch.setattr(app, "METRICS_INTERVAL", 1e9)
    port: asyncio.Future[int] = asyncio.get_running_loop().create_future()
    settings = GatewaySettings(socket=tmp_path / "era.sock")
    serving = asyncio.create_task(serve(settings, announce=port.set_result))
    async with httpx.AsyncClient(base_url=f"http://localhost:{await port}") as client:
        for _ in range(3):
            assert "era_up 0.0" in (await client.get("/metrics")).text
        assert status.await_count == 1
        monkeypatch.setattr(app, "METRICS_INTERVAL", 0.0)
        await client.get("/metrics")
        assert status.await_count == 2
        assert [record for record in caplog.records if record.exc_info] == []
        status.side_effect = ZeroDivisionError
        response = await client.get("/metrics")
        _, writer = await asyncio.open_connection(client.base_url.host, client.base_url.port)
        writer.write(b"evil\r\n\r\n")
        await client.get("/metrics")
        writer.close()
    signal.raise_signal(signal.SIGTERM)
    await serving
    assert response.status_code == 500
    assert response.headers["x-frame-options"] == "DENY"
    assert "server" not in response.headers
    errors = [record.exc_info[0] for record in caplog.records if record.exc_info]
    assert errors == [ZeroDivisionError] * 2


def pattern(**layers: dict[str, PlayedTone]) -> PatternEvent:
    """An event of what plays, by layer and ERA."""
    return PatternEvent(
        contacts=[],
        drive=layers.get("0", {}),
        layers=layers,
        predicted_contrast_db=None,
        predicted_level_db_sl=None,
        latency_ms=1.0,
    )


class Decoded(NamedTuple):
    """A frame: fields (count, rows, columns) [m/s²], of each its frequency, threshold and layer."""

    fields: ComplexArray
    frequencies: tuple[float, ...]
    thresholds: tuple[float, ...]
    layers: tuple[int, ...]


def decoded(frame: bytes) -> Decoded:
    """Decode a frame as the page of the reference describes it."""
    columns, rows, count, zero = struct.unpack_from("<4H", frame)
    assert (zero, len(frame)) == (0, 12 + count * (10 + 4 * rows * columns))
    scale, *numbers = struct.unpack_from(f"<{1 + 2 * count}f", frame, 8)
    layers = struct.unpack_from(f"<{count}H", frame, 12 + 8 * count)
    parts = np.frombuffer(frame, "<i2", offset=12 + 10 * count).reshape(count, rows, columns, 2)
    assert np.abs(parts).max() == 32767
    fields = (parts[..., 0] + 1j * parts[..., 1]) * scale / 32767
    return Decoded(fields, tuple(numbers[:count]), tuple(numbers[count:]), layers)


ALLOWED = "https://panel.example"


@pytest.fixture(scope="module")
def gateway(
    daemon: ScriptedDaemon, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[GatewayProcess]:
    """One gateway for all tests, with a further allowed origin and host."""
    folder = tmp_path_factory.mktemp("gateway")
    options = ("--allow-origin", ALLOWED, "--allow-host", "panel.example")
    with gateway_process(folder, daemon.socket, *options) as process:
        wait_for_daemon(process)
        yield process


@pytest.fixture(autouse=True)
def no_calls_yet(daemon: ScriptedDaemon) -> None:
    """Each test sees its own calls."""
    daemon.calls.clear()
    daemon.callers.clear()


PARAMETERS = {
    name: params
    for name, params in API_PARAMETERS.items()
    if name not in ("subscribe", "unsubscribe")
}
"""Parameters of all methods that need no persistent connection."""


def call(gateway: GatewayProcess, method: str) -> tuple[int, dict[str, Any]]:
    """Call a method over HTTP; status and body."""
    response = http(gateway, f"/api/v1/{method}", body=json.dumps(PARAMETERS[method]).encode())
    return response.status, json.loads(response.body)


def test_http_error_has_the_code_and_data_of_the_api(
    gateway: GatewayProcess, daemon: ScriptedDaemon, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A refusal of the daemon is 409; a stop is 503 unless all amplifiers are confirmed silent.

    Of a body that is no JSON line and column are named, not those of the daemon's line.
    """
    refusal = {
        "error": "there is no such effect; see effects",
        "code": 1003,
        "data": {"what": "there is no such effect", "where": None, "remedy": "see effects"},
    }
    assert call(gateway, "play") == (409, refusal)
    monkeypatch.setattr(daemon, "silence", UNCONFIRMED)
    status, body = call(gateway, "stop")
    assert (status, body["code"]) == (503, 1006)
    silences = {name: silence.model_dump() for name, silence in UNCONFIRMED.items()}
    assert body["data"]["amplifiers"] == silences
    response = http(gateway, body=b'{"owner": "me",\n  lease_s: 5}')
    assert response.status == 400
    assert "line 2 column 3" in json.loads(response.body)["error"]


def test_http_touches_belong_to_their_connection(
    gateway: GatewayProcess, daemon: ScriptedDaemon
) -> None:
    """A connection has one to the daemon, which ends with it: no other client lifts its fingers."""
    headers = {"Authorization": f"Bearer {TOKEN}"}
    with httpx.Client(base_url=gateway.url, headers=headers) as keeping_client:
        for _ in range(2):
            assert keeping_client.post("api/v1/touch", json=PARAMETERS["touch"]).status_code == 200
        call(gateway, "touch")
        first, again, second = daemon.callers
        assert first is again is not second
        assert re.fullmatch(r"http 127\.0\.0\.1:\d+", first.name)
        wait_for(lambda: not second.is_open)
        assert first.is_open
    wait_for(lambda: not first.is_open)


def test_http_body_may_have_line_feeds_wait_or_be_missing(
    gateway: GatewayProcess, daemon: ScriptedDaemon
) -> None:
    """Line feeds are spaces of JSON; between requests to the daemon they are the end of one.

    A stop needs only the token: no body, nor a content type. One that waits for 100 (RFC 9110
    10.1.1) gets the interim response first, then that to the request.
    """
    for method in ("stop", "clear"):
        assert http(gateway, f"/api/v1/{method}", body=b'{"client":"a"\n}').status == 200
    assert daemon.calls == [("stop", RequestedBy(client="a")), ("clear", ClearParams(client="a"))]
    assert http(gateway, "/api/v1/stop", body=b"").status == 200
    assert http(gateway, "/api/v1/stop", body=b"", media=None).status == 200
    assert daemon.methods[2:] == ["stop", "stop"]
    response = http(gateway, "/api/v1/stop", body=b"{}", more=["Expect: 100-continue"])
    assert response.status == 100
    assert response.body.startswith(b"HTTP/1.1 200 ")


@pytest.mark.parametrize(
    "file", ["", *sorted(p.name for p in Path("controller/gateway/page").glob("*"))]
)
def test_page_file_is_served_without_a_token(gateway: GatewayProcess, file: str) -> None:
    """With the security headers, and without references to other hosts."""
    response = http(gateway, f"/{file}", method="GET", body=b"", token=())
    assert response.status == 200
    headers = response.headers.lower()
    for header in (
        "content-security-policy: default-src 'none'; script-src 'self';",
        "x-content-type-options: nosniff",
        "x-frame-options: deny",
        "cache-control: no-cache",
    ):
        assert header in headers
    assert "\r\nserver:" not in headers
    named = set(re.findall(rb"(?:https?:)?//[\w.-]+\.\w+", response.body))
    assert named <= {b"http://www.w3.org"}  # the namespace of SVG, not fetched


def test_foreign_links_and_allowed_hosts_and_origins_are_served(gateway: GatewayProcess) -> None:
    """A foreign page may open the page, not embed it; hosts are in any case and with any port.

    Preflight and response allow an origin that is allowed, and only to its requests.
    """
    visit = ["Sec-Fetch-Site: cross-site", "Sec-Fetch-Mode: navigate"]
    part = ["Sec-Fetch-Site: cross-site", "Sec-Fetch-Mode: no-cors"]
    assert http(gateway, "/", method="GET", body=b"", more=visit).status == 200
    assert http(gateway, "/app.js", method="GET", body=b"", more=part).status == 403
    assert http(gateway, host=["PANEL.example:443"]).status == 200
    response = http(
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
    for reply in (response, http(gateway, more=[f"Origin: {ALLOWED}"])):
        assert reply.status == 200
        assert f"access-control-allow-origin: {ALLOWED}" in reply.headers.lower()
    assert "access-control" not in http(gateway).headers.lower()


def test_openapi_describes_every_http_method(gateway: GatewayProcess) -> None:
    """With parameters, results and errors; no token needed. Subscriptions need a WebSocket."""
    response = http(gateway, "/api/v1/openapi.json", method="GET", body=b"", token=())
    document = json.loads(response.body)
    assert document["openapi"].startswith("3.1")
    assert set(document["paths"]) == {f"/api/v1/{name}" for name in PARAMETERS}
    assert METHODS.keys() == API_PARAMETERS.keys()
    arm = document["paths"]["/api/v1/arm"]["post"]
    assert set(arm["responses"]) >= {"200", "401", "403", "409", "413", "415", "421", "422", "429"}
    lease = document["components"]["schemas"]["ArmParams"]["properties"]["lease_s"]
    assert (lease["minimum"], lease["maximum"]) == (1.0, 60.0)


@pytest.mark.long
def test_openapi_matches_the_responses(
    gateway: GatewayProcess, daemon: ScriptedDaemon, tmp_path: Path
) -> None:
    """Schemathesis makes valid and invalid requests of every method."""
    # JSON Schema accepts 1.0 as an integer, the API does not.
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


def next_event(ws: RawWebSocket, topic: str) -> dict[str, Any]:
    """The data of the next event of a topic."""
    while True:
        opcode, payload = ws.next()
        assert opcode in (1, 2), payload
        params = json.loads(payload).get("params", {}) if opcode == 1 else {}
        if params.get("topic") == topic:
            return dict(params["data"])


def test_websocket_receives_current_state_and_events(
    gateway: GatewayProcess, daemon: ScriptedDaemon
) -> None:
    """The daemon's hello first, to the browser's name; then events, their text unchanged.

    A request in two fragments is one, also when the boundary is within a character.
    """
    text = '<img src=x onerror=alert(1)> "quoted" \u2028'
    request = '{"jsonrpc": "2.0", "id": "ü", "method": "disarm"}'.encode()
    at = request.index("ü".encode()) + 1
    with RawWebSocket(gateway) as ws:
        hello = json.loads(ws.hello)
        assert re.fullmatch(r"web:\d+ 127\.0\.0\.1:\d+", hello["id"])
        assert hello["result"]["rig"]["length_m"] == pytest.approx(0.3048)  # 12 inches
        ws.send(request[:at], first=0x01)
        ws.send(request[at:], first=0x80)
        assert json.loads(ws.next()[1]) == {"jsonrpc": "2.0", "id": "ü", "result": {}}
        ws.call("subscribe", {"topics": ["state", "log"]}, id=100)
        assert next_event(ws, "state")["new"] == "READY_TO_SWITCH_ON"
        event = LogEvent(level="error", message=text, cause=text, remedy=text)
        daemon.publish("log", event)
        assert next_event(ws, "log") == event.model_dump()


def test_websocket_receives_the_field_of_the_drive(
    gateway: GatewayProcess, daemon: ScriptedDaemon
) -> None:
    """Encoded as docs/reference/gateway.md says.

    Far below the first natural frequency the plate is rigid on four springs: driven at its
    south-west corner it moves most there.
    """
    tone = PlayedTone(frequency_hz=10.0, level=0.5, phase_deg=0.0)
    with RawWebSocket(gateway, target="/api/v1/ws?field") as ws:
        daemon.publish("pattern", pattern(**{"2": {"SW": tone}}))
        while True:
            opcode, payload = ws.next()
            assert opcode != 8, payload
            if opcode == 2 and struct.unpack_from("<H", payload, 4) == (1,):
                break
    field = decoded(payload)
    assert (field.frequencies, field.layers) == ((10.0,), (2,))
    assert field.thresholds == pytest.approx((0.0788,))  # by the set's file
    (strength,) = np.abs(field.fields)
    assert strength.shape[1] > strength.shape[0] > 2  # columns along the length
    south_west, south_east, north_west = strength[0, 0], strength[0, -1], strength[-1, 0]
    assert south_west == strength.max()
    assert south_west > 2 * max(south_east, north_west)


@contextlib.asynccontextmanager
async def drawing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> AsyncIterator[Callable[[str], Awaitable[bytes]]]:
    """Yield a function that draws the playback of the ERA of a name, and returns its frame."""
    rig_text = write_rig(tmp_path / "rig.yaml").read_text(encoding="utf-8")
    lines: asyncio.Queue[bytes] = asyncio.Queue()
    link = MagicMock(
        hello=json.dumps({"result": {"rig_text": rig_text}}), send=AsyncMock(), next_line=lines.get
    )
    monkeypatch.setattr(DaemonLink, "open", AsyncMock(return_value=link))
    field = DrawnField(tmp_path / "era.sock")
    frames = field.frames()
    await anext(frames)
    tone = PlayedTone(frequency_hz=10.0, level=0.5, phase_deg=0.0)

    async def draw(name: str) -> bytes:
        event = pattern(**{"2": {name: tone}}).model_dump_json().encode()
        lines.put_nowait(event_line("pattern", time=1.0, lost=0, data=event))
        return await anext(frames)

    running = asyncio.create_task(field.run())
    try:
        yield draw
    finally:
        running.cancel()
        await asyncio.wait([running])


async def test_drawing_error_is_logged_again_when_it_recurs_after_a_good_frame(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """An error is logged once while it lasts, and again once a good frame has ended it."""
    logged = []
    async with drawing(tmp_path, monkeypatch) as draw:
        for name in ("UNKNOWN", "UNKNOWN", "SW", "UNKNOWN"):
            await draw(name)
            logged.append(caplog.text.count("field of the plate: not drawn"))
    assert logged == [1, 1, 1, 2]


async def test_drawing_does_not_delay_the_exit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Python waits for threads that are not daemons: drawing starts none."""
    started: list[threading.Thread] = []
    start = threading.Thread.start

    def record(thread: threading.Thread) -> None:
        started.append(thread)
        start(thread)

    monkeypatch.setattr(threading.Thread, "start", record)
    async with drawing(tmp_path, monkeypatch) as draw:
        await draw("SW")
    assert {thread.daemon for thread in started} == {True}
