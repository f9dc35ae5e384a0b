"""Who may use the gateway: by the Host that was called, the page that calls, and the token.

The Host list stops rebinding (a foreign name that points here), the Origin list stops foreign pages
(cross-site requests and WebSockets), and the token stops everybody else on the machine.
"""

import hmac
from typing import TypeAlias

from starlette.datastructures import Headers
from starlette.responses import JSONResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from controller.gateway.settings import Settings

SUBPROTOCOL = "era-haptics.v1"
_TOKEN_SUBPROTOCOL = "era-haptics.token."  # noqa: S105 (what a browser puts before the token)
LARGEST_BODY = 1 << 16
_POLICY_VIOLATION = 1008

Refusal: TypeAlias = tuple[int, str]  # HTTP status, and why

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
"""On every answer: nothing from outside is loaded, and no page of others shows this one."""


class Access:
    """ASGI middleware that lets through what is allowed; the rest is answered here.

    Everything under /api needs the token, but for the description of the API: `Authorization:
    Bearer TOKEN`, or for a WebSocket, where browsers cannot set headers, the subprotocol
    `era-haptics.token.TOKEN` beside `era-haptics.v1`.
    """

    def __init__(self, app: ASGIApp, settings: Settings) -> None:
        self._app = app
        self._settings = settings
        self._scheme = "https" if settings.is_encrypted else "http"

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Check a request or WebSocket, then hand it on."""
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
        hosts = headers.getlist("host")
        if len(hosts) != 1 or not self._is_allowed_host(hosts[0]):
            return 421, "this is not a name by which the gateway may be called; see --allow-host"
        origins = headers.getlist("origin")
        if origins and not self._is_allowed_origin(origins, hosts[0]):
            return 403, "pages of this origin may not use the gateway; see --allow-origin"
        if headers.get("sec-fetch-site") == "cross-site" and not (origins or _is_visit(headers)):
            return 403, "pages of others may not use the gateway"
        if not _needs_token(scope["path"]) or scope.get("method") == "OPTIONS":  # does nothing
            return None
        if not self._has_token(headers):
            return 401, "the token is missing or another; open the URL that the gateway printed"
        if int_of(headers.get("content-length", "0")) > LARGEST_BODY:
            return 413, f"a request has at most {LARGEST_BODY} bytes"
        return None

    def _is_allowed_host(self, host: str) -> bool:
        """Whether a Host header names this gateway, with any port (a proxy may have another)."""
        name, colon, port = host.rpartition(":")
        if not colon or not port.isdecimal():
            name = host
        return name.lower() in self._settings.allowed_names

    def _is_allowed_origin(self, origins: list[str], host: str) -> bool:
        """Whether a page is the gateway's own or one of those that were allowed."""
        own = f"{self._scheme}://{host}".lower()
        allowed = {own, *(origin.lower() for origin in self._settings.origins)}
        return len(origins) == 1 and origins[0].lower() in allowed

    def _has_token(self, headers: Headers) -> bool:
        said = [
            value.removeprefix("Bearer ")
            for value in headers.getlist("authorization")
            if value.startswith("Bearer ")
        ]
        said += [
            name.strip().removeprefix(_TOKEN_SUBPROTOCOL)
            for value in headers.getlist("sec-websocket-protocol")
            for name in value.split(",")
            if name.strip().startswith(_TOKEN_SUBPROTOCOL)
        ]
        # In constant time, so that nobody finds it letter by letter.
        return len(said) == 1 and hmac.compare_digest(
            said[0].encode(), self._settings.token.encode()
        )


def _is_visit(headers: Headers) -> bool:
    """Whether somebody has followed a link to the page."""
    return headers.get("sec-fetch-mode") == "navigate"


def _needs_token(path: str) -> bool:
    """Whether a path is not for everybody, as the page and the description are."""
    return path.startswith("/api/") and path != "/api/v1/openapi.json"


def int_of(text: str) -> int:
    """A header's number; what is none counts as too large."""
    return int(text) if text.isascii() and text.isdecimal() and len(text) < 10 else 1 << 62


def _with_headers(send: Send) -> Send:
    """Send with the security headers on every answer."""

    async def sending(message: Message) -> None:
        if message["type"] == "http.response.start":
            raw = [(name.lower().encode(), value.encode()) for name, value in HEADERS.items()]
            message["headers"] = [*message.get("headers", []), *raw]
        await send(message)

    return sending
