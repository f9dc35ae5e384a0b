"""Which wire each amplifier of a rig gets: as told on the command line, or as its own URL asks.

Nothing of a URL is opened: a serial port becomes a pseudo-terminal, an address a loopback port.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
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


@dataclass(frozen=True)
class Choice:
    """The wire of an amplifier; number: its address there, None where any will do."""

    wire: Wire
    number: int | None = None


def choose_wires(
    amplifiers: Mapping[str, str], *, common: Wire | None, own: Sequence[str], plain: Wire
) -> dict[str, Choice]:
    """The wire of each amplifier, by its name.

    amplifiers: URLs by name; common: of all that `own`, texts like `main=modbus-tcp:5020`, does not
    name, None to do as their URLs say; plain: speed, sharing and so on of those wires. Amplifiers
    with equal wires are on one. Raises InputError.
    """
    chosen: dict[str, Choice] = {}
    for text in own:
        name, equals, kind = text.partition("=")
        if not equals or name not in amplifiers or name in chosen:
            problem = (
                "is not NAME=WIRE"
                if not equals
                else "is chosen twice"
                if name in chosen
                else f"names no amplifier of the rig; it has {', '.join(amplifiers)}"
            )
            raise InputError(f"--wire {text}: {problem}; as in --wire main=serial")
        chosen[name] = Choice(_named(kind, text, plain))
    for name, url in amplifiers.items():
        if name not in chosen:
            chosen[name] = Choice(common) if common else _asked_for(name, url, plain)
    return {name: chosen[name] for name in amplifiers}


def _named(text: str, option: str, plain: Wire) -> Wire:
    kind, colon, port = text.partition(":")
    if kind in _KIND_OF_SCHEME.values() and bool(colon) <= (kind in _PORTED):
        if not colon:
            return replace(plain, kind=kind)
        if port.isascii() and port.isdigit() and int(port) <= 65535:
            return replace(plain, kind=kind, port=int(port))
    raise InputError(f"--wire {option}: {text!r} is no wire; choose one of {', '.join(_KINDS)}")


def _asked_for(name: str, url: str, plain: Wire) -> Choice:
    """The wire that a URL names."""
    parts = urlsplit(url)
    kind = _KIND_OF_SCHEME.get(parts.scheme)
    try:
        port = parts.port if kind in _PORTED else None
    except ValueError as error:
        raise InputError(f"amplifier {name}: {url} has no port that can be used: {error}") from None
    if kind is None or (kind in _PORTED and port is None):
        raise InputError(
            f"amplifier {name}: its url {url} names no wire that can be simulated. Which one? Add "
            "one of --serial (a pseudo-terminal each), --modbus-tcp PORT, --modbus-rtu, "
            f"--socketcand PORT and --slcan for all, or --wire {name}=serial for this one"
        )
    wire = replace(plain, kind=kind, port=port or 0)
    if port is None:  # amplifiers with one line in their URLs share it
        wire = replace(wire, line=parts.netloc + parts.path, shared=True)
    return Choice(wire, _number(parts))


def _number(parts: SplitResult) -> int | None:
    """The unit, node or address in a URL."""
    if parts.scheme == "modbus+tcp":
        text = parts.path.strip("/")
    elif parts.scheme == "serial":
        text = parse_qs(parts.query).get("address", [""])[0]
    else:
        text = parts.fragment
    return int(text) if text.isascii() and text.isdigit() and int(text) > 0 else None
