"""Amplifiers that lie: functions that alter their replies."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any, TypeAlias

from drivers.protocol.messages import Achieved, Reply, Status

Lie: TypeAlias = Callable[[Reply], Reply]
"""Alters a reply."""


def status(**changes: Any) -> Lie:
    """Alter every status; a callable changes the value."""

    def lie(reply: Reply) -> Reply:
        if not isinstance(reply, Status):
            return reply
        altered = {
            name: change(getattr(reply, name)) if callable(change) else change
            for name, change in changes.items()
        }
        return replace(reply, **altered)

    return lie


def achieved(**changes: Callable[[Any], Any]) -> Lie:
    """Alter the first command of every Achieved."""

    def lie(reply: Reply) -> Reply:
        if not isinstance(reply, Achieved):
            return reply
        first, *others = reply.commands
        altered = {name: change(getattr(first, name)) for name, change in changes.items()}
        return replace(reply, commands=(replace(first, **altered), *others))

    return lie
