"""What people do beside the wires: they touch the plate, and wish for this and that."""

import math
from collections.abc import Collection, Hashable
from dataclasses import dataclass


@dataclass
class KnownInputs:
    """What the witness was told of them last; times [s], of what never was -inf.

    contacts: who touches, None where nobody tells; touched: when the last of them came; hung: since
    when the control loop hangs; arm_wished: whether it is to be armed, None where wishes are not
    told; wished: when anything was.
    """

    contacts: frozenset[Hashable] | None = None
    last_lift: float = -math.inf
    touched: float = -math.inf
    stalled_since: float | None = None
    is_arm_requested: bool | None = None
    last_command: float = -math.inf
    last_disarm: float = -math.inf
    last_silencing: float = -math.inf

    def touch(self, time: float, contacts: Collection[Hashable]) -> frozenset[Hashable]:
        """These fingers are on the plate from now on; those of them who have just come."""
        before, self.contacts = self.contacts or frozenset(), frozenset(contacts)
        if before and not self.contacts:
            self.last_lift = time
        if come := self.contacts - before:
            self.last_touch = time
        return come

    def operator_command(self, time: float, what: str) -> None:
        """Somebody wants it to arm, disarm, stop or clear."""
        self.last_command = time
        if what == "disarm":
            self.last_disarm = time
        self.is_arm_requested = what == "arm" or (self.is_arm_requested is True and what == "clear")
        if what in ("stop", "disarm"):
            self.last_silencing = time
