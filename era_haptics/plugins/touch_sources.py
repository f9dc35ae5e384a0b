"""Interfaces for touch panels with their own protocol: entry points `era_haptics.touch_sources`.

Use `open_source` and `ContactTracker` to try a source and see its contacts on a plate.
"""

from controller.sources.contact_tracker import ContactTracker
from controller.sources.touch import (
    Change,
    Contact,
    ContactKey,
    RejectCounter,
    Touch,
    TouchFrame,
    TouchSource,
    open_source,
)
from controller.sources.udp_source import Datagram, Datagrams, UdpSource, listen
from model.errors import InputError
from registry.threads import now

__all__ = [
    "Change",
    "Contact",
    "ContactKey",
    "ContactTracker",
    "Datagram",
    "Datagrams",
    "InputError",
    "RejectCounter",
    "Touch",
    "TouchFrame",
    "TouchSource",
    "UdpSource",
    "listen",
    "now",
    "open_source",
]
