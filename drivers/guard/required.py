"""Refusal of requests that have not passed a guard, for encoders."""

from drivers.command import CommandSet
from drivers.guard.guard import SafeCommandSet, SafeEnvelope
from drivers.protocol.messages import Apply, LoadEnvelope, Request, Stage


def require_safe(request: Request) -> None:
    """Raise TypeError for a request whose set or envelope has not passed a guard."""
    match request:
        case Stage(command_set=content) | Apply(command_set=content):
            require_safe_set(content)
        case LoadEnvelope(envelope=content):
            if type(content) is not SafeEnvelope:
                raise _unsafe(content)
        case _:
            return


def require_safe_set(command_set: CommandSet) -> None:
    """Raise TypeError for a set that has not passed a guard."""
    if type(command_set) is not SafeCommandSet:
        raise _unsafe(command_set)


def _unsafe(content: object) -> TypeError:
    return TypeError(
        "request must carry a SafeCommandSet or a SafeEnvelope made by a Guard, got "
        f"{type(content).__name__}"
    )
