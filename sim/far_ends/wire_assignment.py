"""Assign a wire to each amplifier: by options of the command line, else by its URL.

A serial port in a URL becomes a pseudo-terminal, a network address a loopback port.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from urllib.parse import SplitResult, parse_qs, urlsplit

from model.errors import InputError
from sim.far_ends.wires import Wire

_PORTED = ("modbus-tcp", "socketcand")
_KINDS = ("serial", "modbus-tcp:PORT", "modbus-rtu", "socketcand:PORT", "slcan")
_KIND_OF_SCHEME = {
    "serial": "serial",
    "modbus+tcp": "modbus-tcp",
    "modbus+rtu": "modbus-rtu",
    "can+socketcand": "socketcand",
    "can+slcan": "slcan",
}
_EXAMPLE = "; as in --wire main=serial"


def assign_wires(
    amplifiers: Mapping[str, str], *, common: Wire | None, options: Sequence[str], defaults: Wire
) -> dict[str, Wire]:
    """The wire of each amplifier, by name.

    amplifiers: URLs by name; options: texts like `main=modbus-tcp:5020`; common: the wire of all
    others, None to follow their URLs; defaults: speed and sharing of those wires. Equal wires are
    shared. Raises InputError.
    """
    assigned: dict[str, Wire] = {}
    for text in options:
        name, equals, kind = text.partition("=")
        if not equals:
            raise InputError(f"--wire {text}: must be NAME=WIRE{_EXAMPLE}")
        if name not in amplifiers:
            known = ", ".join(amplifiers)
            raise InputError(f"--wire {text}: amplifier must be one of {known}{_EXAMPLE}")
        if name in assigned:
            raise InputError(f"--wire {text}: must be given once per amplifier{_EXAMPLE}")
        assigned[name] = _wire_of_option(kind, text, defaults)
    for name, url in amplifiers.items():
        if name not in assigned:
            assigned[name] = common or _wire_of_url(name, url, defaults)
    return {name: assigned[name] for name in amplifiers}


def _wire_of_option(text: str, option: str, defaults: Wire) -> Wire:
    kind, colon, port = text.partition(":")
    if kind in _KIND_OF_SCHEME.values() and bool(colon) <= (kind in _PORTED):
        if not colon:
            return replace(defaults, kind=kind)
        if port.isascii() and port.isdigit() and int(port) <= 65535:
            return replace(defaults, kind=kind, port=int(port))
    raise InputError(f"--wire {option}: wire must be one of {', '.join(_KINDS)}, got {text!r}")


def _wire_of_url(name: str, url: str, defaults: Wire) -> Wire:
    """The wire that a URL names."""
    parts = urlsplit(url)
    kind = _KIND_OF_SCHEME.get(parts.scheme)
    try:
        port = parts.port if kind in _PORTED else None
    except ValueError as error:
        raise InputError(f"amplifier {name}: {url}: invalid port: {error}") from None
    if kind is None or (kind in _PORTED and port is None):
        schemes = ", ".join(_KIND_OF_SCHEME)
        raise InputError(
            f"amplifier {name}: scheme must be one of {schemes}, with a port over TCP, got {url}; "
            "add --serial (a pseudo-terminal each), --modbus-tcp PORT, --modbus-rtu, --socketcand "
            f"PORT or --slcan for all, or --wire {name}=serial"
        )
    wire = replace(defaults, kind=kind, port=port or 0, address=_address(parts))
    if port is None:  # amplifiers whose URLs name one line share it
        wire = replace(wire, line=parts.netloc + parts.path, shared=True)
    return wire


def _address(parts: SplitResult) -> int | None:
    """The unit, node or address in a URL."""
    if parts.scheme == "modbus+tcp":
        text = parts.path.strip("/")
    elif parts.scheme == "serial":
        text = parse_qs(parts.query).get("address", [""])[0]
    else:
        text = parts.fragment
    return int(text) if text.isascii() and text.isdigit() and int(text) > 0 else None
