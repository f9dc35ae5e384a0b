"""What the daemon of a configuration must be allowed: devices, networks, groups."""

import ipaddress
import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import urlsplit

_SERIAL = ("serial", "hwgrep", "modbus+rtu", "can+slcan")
_NETWORK = ("socket", "rfc2217", "modbus+tcp", "can+socketcand")


@dataclass(frozen=True)
class Needs:
    """What a service must be allowed.

    serial: serial ports; input: touch panels; can: network interfaces of the CAN family; hosts:
    addresses beyond the loopback, None for any (one is given by a name, or touches may come from
    anywhere).
    """

    serial: bool = True
    input: bool = True
    can: bool = True
    hosts: tuple[str, ...] | None = None


def needs_of(amplifiers: Iterable[str], touches: Iterable[str]) -> Needs:
    """What amplifiers and touch sources at these URLs need."""
    amplifiers, touches = list(amplifiers), list(touches)
    hosts: list[str] | None = []
    for url in amplifiers:
        scheme, _, rest = url.partition("://")
        if scheme in _NETWORK and hosts is not None:
            host = _address(urlsplit(f"//{rest}").hostname)
            hosts = None if host is None else [*hosts, host]
    for url in touches:
        scheme, _, rest = url.partition(":")
        if scheme == "tuio" and not _is_loopback(rest):
            hosts = None
    known = set(_NETWORK) | set(_SERIAL) | {"can+socketcan", "sim", "can+virtual"}
    schemes = {url.partition("://")[0] for url in amplifiers}
    kinds = {url.partition(":")[0] for url in touches}
    is_foreign = bool(schemes - known or kinds - {"tuio", "evdev", "evemu", "replay"})
    return Needs(
        serial=is_foreign or bool(schemes & set(_SERIAL)),
        input=is_foreign or "evdev" in kinds,
        can=is_foreign or "can+socketcan" in schemes,
        hosts=None
        if is_foreign or hosts is None
        else tuple(sorted({host for host in hosts if not _is_own(host)})),
    )


def _address(host: str | None) -> str | None:
    """A host's address, None where only a name is known."""
    if host == "localhost":
        return "127.0.0.1"
    try:
        return str(ipaddress.ip_address(host or ""))
    except ValueError:
        return None


def _is_own(address: str) -> bool:
    return ipaddress.ip_address(address).is_loopback


def _is_loopback(place: str) -> bool:
    """Whether TUIO is listened for on the loopback only; it is where nothing else is said."""
    host = re.sub(r":?\d*$", "", place.removeprefix("//")).strip("[]")
    address = _address(host)
    return host == "" or (address is not None and _is_own(address))


def check_path(path: Path) -> bool:
    """Whether a path can stand in a unit file as it is."""
    return path.is_absolute() and re.fullmatch(r"[\w/.+@-]+", str(path), re.ASCII) is not None
