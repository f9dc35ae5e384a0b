"""What an encoder asks of every request before it makes anything of it."""

from drivers.guard.guard import SafeCommandSet, SafeEnvelope
from drivers.protocol.messages import Apply, LoadEnvelope, Request, Stage


def require_safe(request: Request) -> None:
    """Raise TypeError for a request with a set or an envelope that no guard has let through."""
    match request:
        case Stage(command_set=asked) | Apply(command_set=asked):
            is_safe = type(asked) is SafeCommandSet
        case LoadEnvelope(envelope=asked):
            is_safe = type(asked) is SafeEnvelope
        case _:
            return
    if not is_safe:
        raise TypeError(
            f"only a SafeCommandSet or a SafeEnvelope is played, not a {type(asked).__name__}: "
            "let a Guard make one"
        )
