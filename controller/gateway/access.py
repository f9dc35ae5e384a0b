"""Access control of the gateway by Host, Origin and token, and the security headers of responses.

The Host list stops DNS rebinding, the Origin list cross-site requests and WebSockets, and the token
other users of the machine.
"""

import hmac
import re

from aiohttp import HttpVersion10, HttpVersion11, web

from controller.gateway.gateway_settings import GatewaySettings, sent_origin

SUBPROTOCOL = "era-haptics.v1"
_TOKEN_SUBPROTOCOL = "era-haptics.token."  # noqa: S105 (a prefix, not a token)
VERSIONS = (HttpVersion10, HttpVersion11)
_PORT = re.compile(r":[0-9]+\Z")
_CONTROL = re.compile(r"[\x00-\x1f\x7f]")

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

_CORS = {
    "Access-Control-Allow-Methods": "POST",
    "Access-Control-Allow-Headers": "Authorization, Content-Type",
    "Access-Control-Max-Age": "600",
    "Vary": "Origin",
}


class Access:
    """Rejects requests that are not allowed, and protects responses.

    Everything under /api except the OpenAPI description needs the token, and so do the metrics
    outside the loopback: `Authorization: Bearer TOKEN`, or for a WebSocket, where browsers cannot
    set headers, the subprotocol `era-haptics.token.TOKEN` in addition to `era-haptics.v1`.
    """

    def __init__(self, settings: GatewaySettings) -> None:
        self._settings = settings
        self._names = settings.allowed_names
        self._origins = settings.allowed_origins

    def check(self, request: web.Request) -> None:
        """Check the origin of a request before reading its body; raises web.HTTPException."""
        headers = request.headers
        # Routes would take an escaped line feed for another path, and ignore the host in a URL.
        if _CONTROL.search(request.path) or not request.raw_path.startswith("/"):
            text = "the target must be a path without control characters"
            raise web.HTTPBadRequest(text=text)
        host = ", ".join(headers.getall("Host", []))
        name = _PORT.sub("", host).lower()
        if name not in self._names:  # with any port
            raise web.HTTPMisdirectedRequest(text="this Host is not allowed; see --allow-host")
        origin = ", ".join(headers.getall("Origin", []))
        allowed_origins = {sent_origin(f"http://{host}"), *self._origins} - {""}
        if "Origin" in headers and origin.lower() not in allowed_origins:
            raise web.HTTPForbidden(text="this Origin is not allowed; see --allow-origin")
        is_link = headers.get("Sec-Fetch-Mode") == "navigate"  # which the user followed
        is_from_elsewhere = headers.get("Sec-Fetch-Site") == "cross-site"
        if is_from_elsewhere and not origin and not is_link:
            raise web.HTTPForbidden(text="cross-site requests are not allowed")
        if self._needs_token(request) and not self._has_token(request):
            text = "the token is missing or wrong; open the URL that the gateway printed"
            raise web.HTTPUnauthorized(text=text)

    def allows(self, request: web.Request) -> bool:
        """Whether `check` passes."""
        try:
            self.check(request)
        except web.HTTPException:
            return False
        return True

    def check_form(self, request: web.Request) -> None:
        """Check the form of a request before reading its body; raises web.HTTPException."""
        if request.version not in VERSIONS:
            raise web.HTTPVersionNotSupported(text="use HTTP/1.1")
        if "Transfer-Encoding" in request.headers:  # small chunks would take the time of others
            raise web.HTTPLengthRequired(text="send a Content-Length")

    async def preflight(self, _: web.Request) -> web.Response:
        """Respond to a CORS preflight of an allowed origin; `protect` adds the headers."""
        return web.Response(headers={"Allow": "OPTIONS, POST"})

    async def protect(self, request: web.Request, response: web.StreamResponse) -> None:
        """Add the security headers to a response, and remove the name of the web server."""
        response.headers.update(HEADERS)
        response.headers.pop("Server", None)
        if request.headers.get("Origin", "").lower() in self._origins:
            response.headers.update(_CORS)
            response.headers["Access-Control-Allow-Origin"] = request.headers["Origin"]

    def _needs_token(self, request: web.Request) -> bool:
        """Whether it needs the token, unlike the page, the OpenAPI description and a preflight."""
        path = request.path
        is_method = path.startswith("/api/") and path != "/api/v1/openapi.json"
        is_remote = path == "/metrics" and not self._settings.is_loopback
        return (is_method or is_remote) and request.method != "OPTIONS"

    def _has_token(self, request: web.Request) -> bool:
        tokens = []
        for value in request.headers.getall("Authorization", []):
            if value.startswith("Bearer "):
                tokens.append(value.removeprefix("Bearer "))
        subprotocols = ",".join(request.headers.getall("Sec-WebSocket-Protocol", []))
        for subprotocol in map(str.strip, subprotocols.split(",")):
            if subprotocol.startswith(_TOKEN_SUBPROTOCOL):
                tokens.append(subprotocol.removeprefix(_TOKEN_SUBPROTOCOL))
        return len(tokens) == 1 and hmac.compare_digest(  # in constant time
            tokens[0].encode(errors="surrogateescape"), self._settings.token.encode()
        )
