"""What people do beside the wires: they touch the plate, and wish for this and that."""

import math
from collections.abc import Collection, Hashable
from dataclasses import dataclass


@dataclass
class People:
    """What the witness was told of them last; times [s], of what never was -inf.

    contacts: who touches, None where nobody tells; touched: when the last of them came; hung: since
    when the control loop hangs; arm_wished: whether it is to be armed, None where wishes are not
    told; wished: when anything was.
    """

    contacts: frozenset[Hashable] | None = None
    lifted: float = -math.inf
    touched: float = -math.inf
    hung: float | None = None
    arm_wished: bool | None = None
    wished: float = -math.inf
    disarm_wished: float = -math.inf
    silence_wished: float = -math.inf

    def touch(self, time: float, contacts: Collection[Hashable]) -> frozenset[Hashable]:
        """These fingers are on the plate from now on; those of them who have just come."""
        before, self.contacts = self.contacts or frozenset(), frozenset(contacts)
        if before and not self.contacts:
            self.lifted = time
        if come := self.contacts - before:
            self.touched = time
        return come

    def wish(self, time: float, what: str) -> None:
        """Somebody wants it to arm, disarm, stop or clear."""
        self.wished = time
        if what == "disarm":
            self.disarm_wished = time
        self.arm_wished = what == "arm" or (self.arm_wished is True and what == "clear")
        if what in ("stop", "disarm"):
            self.silence_wished = time
