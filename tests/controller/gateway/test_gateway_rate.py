"""The rate of HTTP requests."""

from pathlib import Path
from typing import Any

import pytest

from controller.api.jsonrpc import ErrorCode
from controller.gateway import app
from controller.gateway.openapi import HTTP_STATUS
from controller.gateway.settings import Settings

TOKEN = "t" * 22
BUSY, LINK = HTTP_STATUS[ErrorCode.BUSY], HTTP_STATUS[ErrorCode.LINK]


@pytest.mark.parametrize(
    ("method", "status"), [("status", BUSY), ("arm", BUSY), ("stop", LINK), ("disarm", LINK)]
)
async def test_stop_and_disarm_are_refused_for_no_rate(
    method: str, status: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With the rate used up they are passed on, here to a daemon that does not exist."""
    monkeypatch.setattr(app, "MAX_HTTP_RATE", 0)
    gateway = app.Gateway(Settings(socket=tmp_path / "none", token=TOKEN))
    scope = {
        "type": "http",
        "method": "POST",
        "path": f"/api/v1/{method}",
        "query_string": b"",
        "headers": [(b"host", b"localhost"), (b"authorization", f"Bearer {TOKEN}".encode())],
        "client": ("127.0.0.1", 1),
    }
    sent: list[dict[str, Any]] = []

    async def receive() -> dict[str, Any]:
        return {"type": "http.request", "body": b""}

    async def send(message: Any) -> None:
        sent.append(message)

    await gateway.app(scope, receive, send)
    assert sent[0]["status"] == status
