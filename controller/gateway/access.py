"""Access control of the gateway by Host, Origin and token.

The Host list stops DNS rebinding, the Origin list stops cross-site requests and WebSockets, and the
token stops other users of the machine.
"""

import hmac
import re
from typing import TypeAlias

from starlette.datastructures import Headers
from starlette.responses import JSONResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from controller.gateway.settings import Settings

SUBPROTOCOL = "era-haptics.v1"
_TOKEN_SUBPROTOCOL = "era-haptics.token."  # noqa: S105 (a prefix, not a token)
_POLICY_VIOLATION = 1008
_CONTROL = re.compile(r"[\x00-\x1f\x7f]")

Refusal: TypeAlias = tuple[int, str]  # HTTP status and reason

HEADERS = {
    "Content-Security-Policy": (
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; "
        "connect-src 'self'; manifest-src 'self'; base-uri 'none'; form-action 'none'; "
        "frame-ancestors 'none'"
    ),
    "Cache-Control": "no-cache",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Permissions-Policy": "camera=(), geolocation=(), microphone=()",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
}
"""Headers of every response: the page loads nothing from elsewhere and cannot be framed."""


class Access:
    """ASGI middleware that passes on allowed requests and refuses the others.

    Everything under /api except the OpenAPI description needs the token, and so do the metrics
    outside the loopback: `Authorization: Bearer TOKEN`, or for a WebSocket, where browsers cannot
    set headers, the subprotocol `era-haptics.token.TOKEN` beside `era-haptics.v1`.
    """

    def __init__(self, app: ASGIApp, settings: Settings) -> None:
        self._app = app
        self._settings = settings
        self._scheme = "https" if settings.is_encrypted else "http"

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Check a request or WebSocket, then pass it on."""
        refusal = self._refusal(scope)
        if refusal is None:
            await self._app(scope, receive, _with_headers(send))
        elif scope["type"] == "websocket":
            await receive()
            await send({"type": "websocket.close", "code": _POLICY_VIOLATION, "reason": refusal[1]})
        else:
            status, why = refusal
            await JSONResponse({"error": why}, status)(scope, receive, _with_headers(send))

    def _refusal(self, scope: Scope) -> Refusal | None:
        headers = Headers(scope=scope)
        if _CONTROL.search(scope["path"]):  # routes take a line feed at the end for nothing
            return 400, "the path must have no control characters"
        hosts = headers.getlist("host")
        if len(hosts) != 1 or not self._is_allowed_host(hosts[0]):
            return 421, "this Host is not allowed; see --allow-host"
        origins = headers.getlist("origin")
        if origins and not self._is_allowed_origin(origins, hosts[0]):
            return 403, "this Origin is not allowed; see --allow-origin"
        is_link = headers.get("sec-fetch-mode") == "navigate"  # which the user followed
        if headers.get("sec-fetch-site") == "cross-site" and not (origins or is_link):
            return 403, "cross-site requests are not allowed"
        if scope.get("method") == "OPTIONS":  # without effect
            return None
        if not self._needs_token(scope["path"]):
            return None
        if not self._has_token(headers):
            return 401, "the token is missing or wrong; open the URL that the gateway printed"
        return None

    def _is_allowed_host(self, host: str) -> bool:
        """Whether a Host header names this gateway, with any port (a proxy may have another)."""
        name, colon, port = host.rpartition(":")
        if not colon or not port.isdecimal():
            name = host
        return name.lower() in self._settings.allowed_names

    def _is_allowed_origin(self, origins: list[str], host: str) -> bool:
        """Whether an Origin is the gateway's own or an allowed one."""
        own = f"{self._scheme}://{host}".lower()
        allowed = {own, *(origin.lower() for origin in self._settings.origins)}
        return len(origins) == 1 and origins[0].lower() in allowed

    def _needs_token(self, path: str) -> bool:
        """Whether a path needs the token, unlike the page and the OpenAPI description."""
        if path == "/metrics":
            return not self._settings.is_loopback
        return path.startswith("/api/") and path != "/api/v1/openapi.json"

    def _has_token(self, headers: Headers) -> bool:
        tokens = [
            value.removeprefix("Bearer ")
            for value in headers.getlist("authorization")
            if value.startswith("Bearer ")
        ]
        tokens += [
            name.strip().removeprefix(_TOKEN_SUBPROTOCOL)
            for value in headers.getlist("sec-websocket-protocol")
            for name in value.split(",")
            if name.strip().startswith(_TOKEN_SUBPROTOCOL)
        ]
        return len(tokens) == 1 and hmac.compare_digest(  # in constant time
            tokens[0].encode(), self._settings.token.encode()
        )


def _with_headers(send: Send) -> Send:
    """Add the security headers to every response."""

    async def sending(message: Message) -> None:
        if message["type"] == "http.response.start":
            raw = [(name.lower().encode(), value.encode()) for name, value in HEADERS.items()]
            message["headers"] = [*message.get("headers", []), *raw]
        await send(message)

    return sending
