"""Ports and interfaces of this machine at which amplifiers may be; nothing is sent to them.

But for `with_slcan`, which looks for CAN adapters on serial ports.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from serial.tools.list_ports import comports

from drivers.codec.can_bus.canopen import BITRATE
from drivers.discovery.places import detect_slcan
from drivers.ports.opening import remedy_of
from drivers.urls import ADDRESS, BAUD, RTU_BAUD

_NETWORK = Path("/sys/class/net")
_CAN_TYPE = "280"  # ARPHRD_CAN of Linux
_UNDESCRIBED = "n/a"  # by pyserial
_SPEEDS = (BAUD, 115_200)


@dataclass(frozen=True)
class Candidate:
    """A port or interface: the URLs to try, and the remedy if it is known to be unusable."""

    name: str
    description: str
    urls: tuple[str, ...]
    remedy: str | None = None
    is_serial: bool = False
    is_slcan: bool = False


def candidates() -> list[Candidate]:
    """List the serial ports and CAN interfaces of this machine, usable or not."""
    return [*_serial_ports(), *_can_interfaces()]


def with_slcan(candidate: Candidate) -> Candidate:
    """Turn a serial port into a CAN adapter if it replies as one.

    Blocks; see `drivers.discovery.places` for what is sent. Its amplifiers are not identified.
    """
    if not candidate.is_serial:
        return candidate
    try:
        adapter = detect_slcan(candidate.name)
    except (OSError, ValueError) as problem:
        return replace(candidate, remedy=f"{candidate.name} cannot be used: {remedy_of(problem)}")
    if adapter is None:
        return candidate
    heard = adapter.nodes or ("none",)
    what = adapter.problem or f"heartbeats of nodes: {', '.join(map(str, heard))}"
    urls = tuple(
        f"can+slcan://{_absolute(candidate.name)}?bitrate={BITRATE}#{node}"
        for node in adapter.nodes
    )
    description = f"{candidate.description}: slcan adapter {adapter.version}, {what}"
    return Candidate(candidate.name, description, urls, is_slcan=True)


def _serial_ports() -> Iterator[Candidate]:
    for port in sorted(comports()):
        path = port.device
        urls = tuple(f"serial://{_absolute(path)}?baud={speed}" for speed in _SPEEDS)
        urls += (f"modbus+rtu://{_absolute(path)}?baud={RTU_BAUD}#{ADDRESS}",)
        description = "serial port" if port.description == _UNDESCRIBED else port.description
        yield Candidate(path, description, urls, is_serial=True)


def _absolute(path: str) -> str:
    return path if path.startswith("/") else f"/{path}"


def _can_interfaces() -> Iterator[Candidate]:
    if not _NETWORK.is_dir():
        return
    for interface in sorted(_NETWORK.iterdir()):
        kind = interface / "type"
        if not kind.is_file() or kind.read_text(encoding="ascii").strip() != _CAN_TYPE:
            continue
        name = interface.name
        is_up = (interface / "operstate").read_text(encoding="ascii").strip() != "down"
        urls = (f"can+socketcan://{name}#{ADDRESS}",)
        remedy = f"interface is down: sudo ip link set {name} up type can bitrate {BITRATE}"
        yield Candidate(name, "CAN interface", urls, remedy=None if is_up else remedy)
