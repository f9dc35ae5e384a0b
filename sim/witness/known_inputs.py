"""What the witness knows beside the bytes: contacts, operator commands and loop stalls."""

import math
from collections.abc import Collection, Hashable
from dataclasses import dataclass


@dataclass
class KnownInputs:
    """The latest inputs; times [s], -inf for what has not happened.

    contacts, is_arm_requested: None where the witness is not given them; last_silencing: of the
    last stop or disarm command; stalled_since: None while the control loop runs.
    """

    contacts: frozenset[Hashable] | None = None
    last_lift: float = -math.inf
    last_touch: float = -math.inf
    stalled_since: float | None = None
    is_arm_requested: bool | None = None
    last_command: float = -math.inf
    last_disarm: float = -math.inf
    last_silencing: float = -math.inf

    def set_contacts(self, time: float, contacts: Collection[Hashable]) -> frozenset[Hashable]:
        """Replace the contacts on the plate; returns those that are new."""
        before, self.contacts = self.contacts or frozenset(), frozenset(contacts)
        if before and not self.contacts:
            self.last_lift = time
        if new := self.contacts - before:
            self.last_touch = time
        return new

    def operator_command(self, time: float, command: str) -> None:
        """Note an operator's arm, disarm, stop or clear."""
        self.last_command = time
        if command == "disarm":
            self.last_disarm = time
        self.is_arm_requested = command == "arm" or (
            self.is_arm_requested is True and command == "clear"
        )
        if command in ("stop", "disarm"):
            self.last_silencing = time
