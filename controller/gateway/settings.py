"""Where the gateway listens and whom it lets in; what would be unsafe is refused here."""

import ipaddress
import os
import re
import secrets
import stat
from dataclasses import dataclass, field
from pathlib import Path

from model.errors import InputError

DEFAULT_HOST = "127.0.0.1"
DEFAULT_PORT = 8137

_TOKEN = re.compile(r"[A-Za-z0-9_-]{22,128}")  # also fits a URL and a WebSocket subprotocol
_HOST_NAME = re.compile(r"[A-Za-z0-9._-]{1,253}|\[[0-9A-Fa-f:.]{2,45}\]")
_LOOPBACK_NAMES = ("localhost", "127.0.0.1", "[::1]")
_LARGEST_TOKEN_FILE = 4096  # bytes


@dataclass(frozen=True, kw_only=True)
class Settings:
    """Everything that the gateway goes by; raises InputError where that would be unsafe.

    socket: the daemon's; host: an address to bind, not a name; port: 0 for any free one. token:
    whoever has it may do everything that the API can, made at random unless given. names: host
    names, without port, by which browsers may call it besides those of the loopback; origins:
    pages of others that may use it, none by default.
    """

    socket: Path
    host: str = DEFAULT_HOST
    port: int = DEFAULT_PORT
    token: str = field(default_factory=lambda: secrets.token_urlsafe(32), repr=False)
    certificate: Path | None = None
    key: Path | None = None
    names: tuple[str, ...] = ()
    origins: tuple[str, ...] = ()
    chose_token: bool = False

    def __post_init__(self) -> None:
        if not 0 <= self.port < 65536:
            raise InputError(f"the gateway cannot listen on port {self.port}; 0 to 65535 are ports")
        try:
            address = ipaddress.ip_address(self.host)
        except ValueError as error:
            raise InputError(
                f"the gateway cannot listen on {self.host!r}: give an address, such as 127.0.0.1 "
                "or ::1; names by which it is called are given with --allow-host"
            ) from error
        if not _TOKEN.fullmatch(self.token):
            raise InputError(
                "the gateway's token must be 22 to 128 letters, digits, - or _; make one with "
                "python -c 'import secrets; print(secrets.token_urlsafe(32))'"
            )
        if (self.certificate is None) != (self.key is None):
            raise InputError("TLS needs a certificate and its key: give both or none of them")
        for path in (self.certificate, self.key):
            if path is not None and not path.is_file():
                raise InputError(
                    f"{path}: there is no such file; --certificate and --key want PEM files"
                )
        if not address.is_loopback and not (self.certificate and self.chose_token):
            raise InputError(
                f"the gateway listens on {self.host}, beyond this machine, only with TLS and a "
                "token that you chose: give --certificate, --key and --token-file, or listen on "
                "127.0.0.1 and let a proxy do it"
            )
        if not address.is_loopback and not self.names:
            raise InputError(
                f"the gateway listens on {self.host}, beyond this machine: say with --allow-host "
                "by which name or address browsers call it, for all others are refused"
            )
        for name in self.names:
            if not _HOST_NAME.fullmatch(name):
                raise InputError(
                    f"{name!r} is no host name: give one without port and without *, such as "
                    "panel.local, 192.0.2.7 or [2001:db8::7]"
                )
        for origin in self.origins:
            if not re.fullmatch(r"https?://[^/\s]+", origin):
                raise InputError(
                    f"{origin!r} is no origin; one looks like https://panel.example:8443"
                )

    @property
    def is_encrypted(self) -> bool:
        """Whether it speaks TLS."""
        return self.certificate is not None

    @property
    def allowed_names(self) -> frozenset[str]:
        """Host names, without port and in lower case, by which it may be called."""
        own = () if ipaddress.ip_address(self.host).is_unspecified else (self.shown_host,)
        return frozenset(name.lower() for name in (*_LOOPBACK_NAMES, *own, *self.names))

    @property
    def shown_host(self) -> str:
        """The host as it stands in a URL that can be opened."""
        if ipaddress.ip_address(self.host).is_unspecified:
            return self.names[0]
        return f"[{self.host}]" if ":" in self.host else self.host


def read_token(path: Path) -> str:
    """The token in a file that nobody else may read; raises InputError."""
    try:
        # Not to hang where it is a pipe.
        with open(path, "rb", opener=lambda name, flags: os.open(name, flags | os.O_NONBLOCK)) as f:
            about = os.fstat(f.fileno())
            said = f.read(_LARGEST_TOKEN_FILE) if stat.S_ISREG(about.st_mode) else b""
    except OSError as error:
        raise InputError(
            f"{path}: cannot be read ({error.strerror}); --token-file wants a file that holds the "
            "token and that you alone may read"
        ) from error
    if not stat.S_ISREG(about.st_mode) or not said.isascii():
        raise InputError(f"{path}: is no text file, and so holds no token; give one that does")
    if about.st_mode & 0o077:
        raise InputError(f"{path}: others may read this token; forbid it with chmod 600 {path}")
    if about.st_uid not in (0, os.geteuid()):
        raise InputError(
            f"{path}: belongs to somebody else, who can read this token; give a file of your own"
        )
    return said.decode().strip()
