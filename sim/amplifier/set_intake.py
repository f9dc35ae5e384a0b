"""Sets of a simulated amplifier: collected from their parts, checked as a whole, staged, committed.

All numbers are integers of the wire; see drivers.protocol.sets.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import TypeAlias

from drivers.protocol.definition import STAGED_LIFE
from drivers.protocol.records import Refusal, Values
from drivers.protocol.sets import (
    Assembly,
    Command,
    LayerSet,
    is_newer_token,
    unpack_layers,
)

Layers: TypeAlias = tuple[LayerSet, ...]


class SetIntake:
    """Takes the parts of sets, and keeps the one that is whole until it is committed.

    capabilities: values of its record. committed: token of the set committed last, 0 for none.
    One set is under way at most: collected, or staged.
    """

    def __init__(self, capabilities: Values) -> None:
        self.capabilities = capabilities
        self.committed = 0
        self._parts = Assembly()  # of the set under way
        self._staged: Layers | None = None  # of the same, once it is whole

    def keep(self, part: Values, now: float) -> bool:
        """Take a part but the last at a time [s]; returns whether it is kept."""
        token, under_way = part["token"], self._under_way(now)
        is_newer = token != under_way and is_newer_token(token, under_way)
        is_under_way = token == under_way and self._staged is None
        if not (is_newer_token(token, self.committed) and (is_newer or is_under_way)):
            return False
        if is_newer:
            self._staged = None
        return self._parts.keep(part, now)

    def take(self, part: Values, now: float) -> Layers | int:
        """Take the last part of a set that was not committed, at a time [s].

        Returns the layers that are staged now, or the number of the first part that is missing.
        Raises Refusal, which drops the parts of this set alone, and only where that is whole.
        """
        token, under_way = part["token"], self._under_way(now)
        is_under_way = token == under_way
        if is_under_way and self._staged is not None:  # it came again
            return self._staged
        for other in (self.committed, 0 if is_under_way else under_way):
            if not is_newer_token(token, other):
                raise Refusal(f"token must be newer than {other}, got {token}", "BAD_TOKEN")
        if part["index"] >= part["parts"]:
            raise Refusal(f"index must be below {part['parts']}, got {part['index']}")
        if is_under_way and part["parts"] != self._parts.count:
            raise Refusal(f"parts must be {self._parts.count} as before, got {part['parts']}")
        stream = self._parts.whole(part)
        if isinstance(stream, int):
            return stream
        try:
            layers = self._checked(stream)
        except Refusal:
            if is_under_way:
                self.drop()
            raise
        if not is_under_way:
            self._parts = Assembly(token, part["parts"], now)
        self._staged = layers
        return layers

    def commit(self, token: int, now: float) -> Layers | None:
        """Return the layers of the staged set; None where it was committed before.

        Raises Refusal if none is staged under this token.
        """
        if token == self.committed:
            return None
        if token != self._under_way(now):
            raise Refusal(f"no set is staged under token {token}", "BAD_TOKEN")
        if self._staged is None:
            raise Refusal(f"all parts of set {token} must come first", "INCOMPLETE")
        layers, self.committed = self._staged, token
        self.drop()
        return layers

    def drop(self) -> None:
        """Discard what is not committed."""
        self._parts, self._staged = Assembly(), None

    def forget(self) -> None:
        """Discard all, with the token committed last."""
        self.drop()
        self.committed = 0

    def _under_way(self, now: float) -> int:
        """Return the token of the set that is collected or staged, 0 for none."""
        if now - self._parts.began > STAGED_LIFE:
            self.drop()
        return self._parts.token

    def _checked(self, stream: Sequence[int]) -> Layers:
        if len(stream) > self.capabilities["set_words"]:
            room = self.capabilities["set_words"]
            raise Refusal(f"a set must have at most {room} words", "BAD_LENGTH")
        return unpack_layers(stream, self.capabilities)


def derated(layers: Sequence[LayerSet], factor: float) -> tuple[LayerSet, ...]:
    """Return the layers with all levels, also of knots, times a factor."""

    def command_of(command: Command) -> Command:
        return replace(
            command,
            level=round(command.level * factor),
            onset=command.onset and command.onset.scaled(factor),
            ending=command.ending and command.ending.scaled(factor),
        )

    return tuple(
        replace(layer, commands=tuple(map(command_of, layer.commands))) for layer in layers
    )
