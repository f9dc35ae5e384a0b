"""TUIO messages and bundles as a sender makes them, by python-osc."""

from typing import Any

from pythonosc.osc_bundle_builder import IMMEDIATELY, OscBundleBuilder
from pythonosc.osc_message_builder import OscMessageBuilder


def message(*arguments: Any, address: str = "/tuio/2Dcur") -> Any:
    """An OSC message with python-osc's own choice of types."""
    builder = OscMessageBuilder(address)
    for argument in arguments:
        builder.add_arg(argument)
    return builder.build()


def bundle(*messages: Any) -> bytes:
    """A bundle as a TUIO sender makes it."""
    builder = OscBundleBuilder(IMMEDIATELY)
    for part in messages:
        builder.add_content(part)
    return builder.build().dgram


def cursor(id: int, x: float, y: float) -> Any:
    """A set message of a cursor at rest."""
    return message("set", id, x, y, 0.0, 0.0, 0.0)


def frame(*touches: tuple[int, float, float], fseq: int = -1, source: str = "table@a") -> bytes:
    """A complete bundle."""
    return bundle(
        message("source", source),
        message("alive", *(id for id, _, _ in touches)),
        *(cursor(*touch) for touch in touches),
        message("fseq", fseq),
    )
