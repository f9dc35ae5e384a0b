"""Devices and networks that the unit allows a daemon, derived from its URLs."""

import ipaddress
import re
from collections.abc import Iterable
from dataclasses import dataclass
from typing import TypeAlias
from urllib.parse import urlsplit

_Address: TypeAlias = ipaddress.IPv4Address | ipaddress.IPv6Address

_SERIAL_SCHEMES = {"serial", "hwgrep", "modbus+rtu", "can+slcan"}
_NETWORK_SCHEMES = {"socket", "rfc2217", "modbus+tcp", "can+socketcand"}
_LOCAL_SCHEMES = {"can+socketcan", "can+virtual", "sim"}
_TOUCH_SCHEMES = {"tuio", "evdev", "evemu", "replay"}


@dataclass(frozen=True)
class Permissions:
    """Devices and networks that a service may use; everything by default.

    serial: serial ports; input: touch panels; can: CAN sockets; hosts: IP addresses beyond the
    loopback, None for any.
    """

    serial: bool = True
    input: bool = True
    can: bool = True
    hosts: tuple[str, ...] | None = None


def required_permissions(amplifiers: Iterable[str], touches: Iterable[str]) -> Permissions:
    """Derive the permissions from the URLs of amplifiers and touch sources.

    The scheme of a plug-in gets all permissions, since its needs are unknown. Any address is
    allowed if an amplifier has a host name or TUIO is received from other hosts.
    """
    amplifiers, touches = list(amplifiers), list(touches)
    schemes = {url.partition("://")[0] for url in amplifiers}
    touch_schemes = {url.partition(":")[0] for url in touches}
    if schemes - (_SERIAL_SCHEMES | _NETWORK_SCHEMES | _LOCAL_SCHEMES):
        return Permissions()
    if touch_schemes - _TOUCH_SCHEMES:
        return Permissions()
    hosts = [_address(urlsplit(url).hostname) for url in amplifiers if _is_networked(url)]
    listens_beyond_loopback = any(
        not _is_loopback(_tuio_address(url)) for url in touches if url.startswith("tuio:")
    )
    remote = sorted({str(host) for host in hosts if not _is_loopback(host)})
    return Permissions(
        serial=bool(schemes & _SERIAL_SCHEMES),
        input="evdev" in touch_schemes,
        can="can+socketcan" in schemes,
        hosts=None if None in hosts or listens_beyond_loopback else tuple(remote),
    )


def _is_networked(url: str) -> bool:
    return url.partition("://")[0] in _NETWORK_SCHEMES


def _tuio_address(url: str) -> _Address | None:
    """The address on which TUIO is received; the loopback unless the URL names one."""
    host = re.sub(r":?\d*$", "", url.partition(":")[2].removeprefix("//")).strip("[]")
    return _address(host or "localhost")


def _address(host: str | None) -> _Address | None:
    """The IP address of a host; None for a host name."""
    try:
        return ipaddress.ip_address("127.0.0.1" if host == "localhost" else host or "")
    except ValueError:
        return None


def _is_loopback(address: _Address | None) -> bool:
    return address is not None and address.is_loopback
