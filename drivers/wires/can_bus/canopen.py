"""Frames on a CAN bus, and the numbers of CANopen (CiA 301) that amplifiers and hosts agree on."""

from collections.abc import Mapping
from typing import Any, Final, NamedTuple

BLOCK: Final = 8
"""Bytes of a classic frame."""
_FRAME_BITS = 47 + 8 * BLOCK
_STUFFED_MAX = (33 + 8 * BLOCK) // 4  # one stuff bit per four at worst

ERROR_ID: Final = 0x800
"""Above all identifiers of frames: what an adapter reports in place of one, its code as data."""
BITRATE: Final = 500_000
"""Of a bus whose URL names none [bit/s]."""

CANOPEN: Mapping[str, Any] = {
    "heartbeat_ms": 50,  # of the amplifier
    "device_type": 0,  # no device profile
    "vendor_id": 0,  # not assigned by CiA
    "product_code": 1,
    "revision": 1,
    "cob_ids": {  # plus the node, except NMT
        **{"nmt": 0x000, "emergency": 0x080, "sdo_answer": 0x580, "sdo_request": 0x600},
        **{"heartbeat": 0x700},
    },
    "nmt": {
        **{"start": 1, "stop": 2, "pre_operational": 128, "reset_node": 129},
        **{"reset_communication": 130},
    },
    "nmt_states": {"BOOT_UP": 0, "STOPPED": 4, "OPERATIONAL": 5, "PRE_OPERATIONAL": 127},
    "emergencies": {  # of each fault
        "NONE": {"code": 0x0000, "error_register": 0x00},
        "WATCHDOG": {"code": 0x8130, "error_register": 0x11},
        "OVER_TEMPERATURE": {"code": 0x4310, "error_register": 0x09},
        "OVER_VOLTAGE": {"code": 0x3310, "error_register": 0x05},
        "ARC": {"code": 0x2340, "error_register": 0x03},
        "CHANNEL": {"code": 0xFF01, "error_register": 0x81},
        "INTERNAL": {"code": 0x6100, "error_register": 0x81},
        "INTERLOCK": {"code": 0x9000, "error_register": 0x01},  # external error
        "OVER_CURRENT": {"code": 0x2310, "error_register": 0x03},  # continuous over-current
    },
    "objects": {
        **{"device_type": 0x1000, "error_register": 0x1001, "emergency_cob_id": 0x1014},
        **{"heartbeat_producer": 0x1017, "identity": 0x1018},
        **{"texts": 0x2000, "capabilities": 0x2001, "status": 0x2002},
    },
}


class CanFrame(NamedTuple):
    """A data frame with an 11-bit identifier."""

    id: int
    data: bytes


def cob_id(kind: str, node: int = 0) -> int:
    """Return the COB-ID of a kind of frame (a key of `cob_ids`) of a node."""
    return int(CANOPEN["cob_ids"][kind]) + node


def frame_time(bitrate: int) -> float:
    """Return how long a frame of eight bytes takes [s], with its pause, stuffed at worst."""
    return (_FRAME_BITS + _STUFFED_MAX) / bitrate
