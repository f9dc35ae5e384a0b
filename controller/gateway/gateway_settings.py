"""Settings of the gateway: its address and its access rules; unsafe settings are rejected.

Imports no gateway library, because the daemon and the command line check for these here.
"""

import ipaddress
import os
import re
import secrets
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path

from model.errors import InputError
from registry.files import regular_file

_TOKEN = re.compile(r"[A-Za-z0-9_-]{22,128}")  # valid in a URL and in a WebSocket subprotocol
_HOST_NAME = re.compile(r"[a-z0-9._-]{1,253}")
_DEVIATING = re.compile("[\xdf\u03c2\u200c\u200d]")  # which Python's IDNA maps unlike browsers
_ORIGIN = re.compile(r"(https?)://([^/?#@:\s\[\]]+|\[[^]]*\])(?::([0-9]{1,5}))?", re.IGNORECASE)
_DEFAULT_PORTS = {"http": 80, "https": 443}
_LOOPBACK_NAMES = ("localhost", "127.0.0.1", "[::1]")
_RULE = (
    "token must have 22 to 128 letters, digits, - or _; make one with "
    "python -c 'import secrets; print(secrets.token_urlsafe(32))'"
)
_MAX_TOKEN_FILE = 4096  # bytes


@dataclass(frozen=True, kw_only=True)
class GatewaySettings:
    """Settings of the gateway; raises InputError if they are unsafe."""

    socket: Path
    """The daemon's socket."""
    host: str = "127.0.0.1"
    """IP address to listen on."""
    port: int = 0
    """Port to listen on; 0: any free one."""
    token: str = field(default_factory=lambda: secrets.token_urlsafe(32), repr=False)
    """Gives full access to the API; random by default."""
    extra_hosts: tuple[str, ...] = ()
    """Allowed Hosts without port, in addition to the loopback hosts."""
    origins: tuple[str, ...] = ()
    """Allowed Origins in addition to the gateway's own."""
    is_token_user_supplied: bool = False

    def __post_init__(self) -> None:
        try:
            is_loopback = self.is_loopback
        except ValueError as error:
            raise InputError(
                f"the address to listen on must be an IP address, such as 127.0.0.1 or ::1, got "
                f"{self.host!r}; give host names with --allow-host"
            ) from error
        if not 0 <= self.port < 65536:
            raise InputError(f"port must be 0 to 65535, got {self.port}")
        if not _TOKEN.fullmatch(self.token):
            raise InputError(_RULE)
        if not is_loopback and not self.is_token_user_supplied:
            raise InputError(
                f"listening on {self.host}, outside the loopback, needs your own token: give "
                "--token-file, or listen on 127.0.0.1 behind a reverse proxy with TLS"
            )
        if not is_loopback and not self.extra_hosts:
            raise InputError(
                f"listening on {self.host}, outside the loopback, needs --allow-host with the name "
                "or address that browsers use"
            )
        for name in self.extra_hosts:
            if not sent_host(name):
                raise InputError(
                    "--allow-host must be a host name without port and without *, such as "
                    f"panel.local, 192.0.2.7 or [2001:db8::7], got {name!r}"
                )
        for origin in self.origins:
            if not sent_origin(origin):
                raise InputError(
                    "--allow-origin must be scheme, host and perhaps port, such as "
                    "https://panel.example:8443, with neither path nor slash behind them, "
                    f"got {origin!r}"
                )

    @property
    def is_loopback(self) -> bool:
        """Whether only this machine can connect."""
        return ipaddress.ip_address(self.host).is_loopback

    @property
    def allowed_names(self) -> frozenset[str]:
        """Allowed Hosts as browsers send them, without port."""
        names = [*_LOOPBACK_NAMES, *self.extra_hosts]
        if not ipaddress.ip_address(self.host).is_unspecified:
            names.append(self.shown_host)
        return frozenset(map(sent_host, names))

    @property
    def allowed_origins(self) -> frozenset[str]:
        """Allowed Origins as browsers send them."""
        return frozenset(map(sent_origin, self.origins))

    @property
    def shown_host(self) -> str:
        """The host for a URL that can be opened."""
        if ipaddress.ip_address(self.host).is_unspecified:
            return self.extra_hosts[0]
        return f"[{self.host}]" if ":" in self.host else self.host


def sent_host(name: str) -> str:
    """Return a host as browsers send it, or "" if it is invalid.

    Lower case; international names in ASCII form; IPv6 addresses in brackets and in their shortest
    form. Names whose ASCII form depends on the edition of IDNA are invalid: give the ASCII form.
    """
    try:
        if name.startswith("[") and name.endswith("]") and "%" not in name:
            return f"[{ipaddress.IPv6Address(name[1:-1])}]"
        host = "" if _DEVIATING.search(name) else name.encode("idna").decode().lower()
        if host.rpartition(".")[2].isdecimal():
            return str(ipaddress.IPv4Address(host))
    except ValueError:
        return ""
    return host if _HOST_NAME.fullmatch(host) else ""


def sent_origin(text: str) -> str:
    """Return an origin as browsers send it, without a default port; "" if it is invalid."""
    match = _ORIGIN.fullmatch(text)
    if match is None:
        return ""
    host = sent_host(match[2])
    scheme = match[1].lower()
    default_port = _DEFAULT_PORTS[scheme]
    port = int(match[3] or default_port)
    if not host or not 0 < port < 65536:
        return ""
    origin = f"{scheme}://{host}"
    return origin if port == default_port else f"{origin}:{port}"


def read_token(path: Path) -> str:
    """Read the token from a file that only its owner may read; raises InputError."""
    try:
        with open(path, "rb", opener=regular_file) as file:
            status = os.fstat(file.fileno())
            content = file.read(_MAX_TOKEN_FILE)
    except OSError as error:
        raise InputError(
            f"{path}: cannot be read ({error.strerror}); --token-file must be a file with the "
            "token that only you may read"
        ) from error
    if status.st_mode & 0o077:
        raise InputError(f"{path}: readable by other users; restrict it with chmod 600 {path}")
    if status.st_uid not in (0, os.geteuid()):
        raise InputError(f"{path}: belongs to another user; give a file of your own")
    token = content.decode("ascii", "replace").strip()
    if not _TOKEN.fullmatch(token):
        raise InputError(f"{path}: --token-file must be a file with the token; {_RULE}")
    return token


def require_gateway() -> None:
    """Raise InputError if a library of the gateway is missing."""
    for name in ("aiohttp", "prometheus_client"):
        if find_spec(name) is None:
            raise InputError(
                f"the gateway needs {name}, which is not installed; "
                "install it in a checkout with  pip install -e '.[gateway]'"
            )
