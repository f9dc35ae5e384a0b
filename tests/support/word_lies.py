"""Amplifiers that lie: functions that alter their replies, by the name of the request."""

from collections.abc import Callable
from typing import Any, TypeAlias

from drivers.protocol.records import Values

Lie: TypeAlias = Callable[[str, Values], Values]
"""Alters the reply to a request of a name."""


def status(**changes: Callable[[Any], Any]) -> Lie:
    """Alter every status."""

    def lie(name: str, reply: Values) -> Values:
        if "watchdog_left" not in reply:
            return reply
        return {**reply, **{each: change(reply[each]) for each, change in changes.items()}}

    return lie


def achieved(**changes: Callable[[Any], Any]) -> Lie:
    """Say of every set that it is not exact, and alter the first command of what is achieved."""

    def lie(name: str, reply: Values) -> Values:
        if name == "Set":
            return {**reply, "exact": 0}
        if name != "GetAchieved" or not reply["commands"]:
            return reply
        first, *others = reply["commands"]
        altered = {each: change(first[each]) for each, change in changes.items()}
        return {**reply, "commands": [{**first, **altered}, *others]}

    return lie
