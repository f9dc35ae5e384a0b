"""Sets of a simulated amplifier: collected from their parts, checked as a whole, staged.

All numbers are integers of the wire; see drivers.protocol.sets.
"""

import math
from collections.abc import Sequence
from dataclasses import replace

from drivers.protocol.records import Refusal, Values
from drivers.protocol.sets import (
    Assembly,
    Command,
    Envelope,
    LayerSet,
    is_newer_token,
    unpack_layers,
)
from drivers.protocol.table import STAGED_LIFE


class SetIntake:
    """Takes the parts of sets, and keeps the one that is whole until it is committed.

    capabilities: values of its record. What is refused changes nothing.
    """

    def __init__(self, capabilities: Values) -> None:
        self.capabilities = capabilities
        self.committed = 0  # token of the set committed last; 0: none
        self._parts = Assembly()
        self._staged: tuple[int, tuple[LayerSet, ...]] | None = None
        self._began = -math.inf

    @property
    def missing(self) -> int:
        """Number of the first part of the set under way that has not come."""
        return self._parts.missing or 0

    def add(self, part: Values, now: float) -> tuple[LayerSet, ...] | None:
        """Take a part at a time [s]; returns the layers once all parts are there.

        Raises Refusal for a part of no newer set, or for a set that is not allowed.
        """
        token = part["token"]
        if not is_newer_token(token, self.committed):  # a late copy
            raise Refusal(f"token must be newer than {self.committed}, got {token}", "BAD_TOKEN")
        if self._staged is not None and self._staged[0] == token:
            if now - self._began <= STAGED_LIFE:
                return self._staged[1]  # a part came again
            self._staged = None
        if self._is_older_than_kept(token, now):
            raise Refusal("token must be newer than that of the set under way", "BAD_TOKEN")
        stream = self._parts.add(part, now, self.capabilities["set_words"])
        if self._parts.began == now:
            self._staged = None
        if stream is None:
            return None
        began = self._parts.began
        self._parts.drop()
        layers = unpack_layers(stream)
        for layer in layers:
            self._check(layer)
        self._staged, self._began = (token, layers), began
        return layers

    def commit(self, token: int, now: float) -> tuple[LayerSet, ...] | None:
        """Return the layers of the staged set; None where it was committed before.

        Raises Refusal if none is staged under this token.
        """
        if token == self.committed:
            return None
        if self._parts.count and self._parts.token == token:
            raise Refusal(f"part {self.missing} of set {token} must come first", "INCOMPLETE")
        if self._staged is None or self._staged[0] != token or now - self._began > STAGED_LIFE:
            raise Refusal(f"no set is staged under token {token}", "BAD_TOKEN")
        layers = self._staged[1]
        self._staged, self.committed = None, token
        return layers

    def drop(self) -> None:
        """Discard what is not committed."""
        self._parts.drop()
        self._staged = None

    def forget(self) -> None:
        """Discard all, with the token committed last."""
        self.drop()
        self.committed = 0

    def _is_older_than_kept(self, token: int, now: float) -> bool:
        """Whether a token is older than that of the set under way, or of the staged one."""
        kept = []
        if self._parts.count and now - self._parts.began <= STAGED_LIFE:
            kept.append(self._parts.token)
        if self._staged is not None and now - self._began <= STAGED_LIFE:
            kept.append(self._staged[0])
        return any(token != other and not is_newer_token(token, other) for other in kept)

    def _check(self, layer: LayerSet) -> None:
        can = self.capabilities
        if layer.layer >= can["layers"]:
            raise Refusal(f"layer must be 0 to {can['layers'] - 1}, got {layer.layer}")
        if layer.ramp > can["ramp_max"]:
            raise Refusal(f"ramp must be at most {can['ramp_max']}, got {layer.ramp}")
        for command in layer.commands:
            self._check_command(command)

    def _check_command(self, command: Command) -> None:
        can, channel = self.capabilities, command.channel
        if channel >= can["channels"]:
            text = f"channel must be 0 to {can['channels'] - 1}, got {channel}"
            raise Refusal(text, "BAD_CHANNEL", channel)
        limits = can["limits"][channel]
        low, high = limits["frequency_min"], limits["frequency_max"]
        if command.is_driven and not low <= command.frequency <= high:
            text = f"frequency must be {low} to {high}, got {command.frequency}"
            raise Refusal(text, channel=channel)
        envelopes = [one for one in (command.onset, command.ending) if one is not None]
        levels = [level for one in envelopes for level, _ in one.knots]
        if max((command.level, *levels)) > limits["level_max"]:
            text = (
                f"level must be at most {limits['level_max']}, got {max((command.level, *levels))}"
            )
            raise Refusal(text, channel=channel)
        for one in envelopes:
            self._check_envelope(one, channel)

    def _check_envelope(self, envelope: Envelope, channel: int) -> None:
        can = self.capabilities
        low, high = can["envelope_step_min"], can["envelope_step_max"]
        if not low <= envelope.step <= high:
            raise Refusal(f"step must be {low} to {high}, got {envelope.step}", channel=channel)
        if len(envelope.knots) > can["knots"]:
            text = f"knots must be at most {can['knots']}, got {len(envelope.knots)}"
            raise Refusal(text, channel=channel)


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
