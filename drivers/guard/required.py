"""Refusal of requests that have not passed a guard, for encoders."""

from drivers.guard.guard import SafeCommandSet, SafeEnvelope
from drivers.protocol.messages import Apply, LoadEnvelope, Request, Stage


def require_safe(request: Request) -> None:
    """Raise TypeError for a request whose set or envelope has not passed a guard."""
    match request:
        case Stage(command_set=content) | Apply(command_set=content):
            is_safe = type(content) is SafeCommandSet
        case LoadEnvelope(envelope=content):
            is_safe = type(content) is SafeEnvelope
        case _:
            return
    if not is_safe:
        raise TypeError(
            "request must carry a SafeCommandSet or a SafeEnvelope made by a Guard, got "
            f"{type(content).__name__}"
        )
