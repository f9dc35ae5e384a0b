"""The sets that an amplifier plays, as its host commits them."""

from dataclasses import dataclass, field

from drivers.protocol.records import Values
from drivers.protocol.sets import LayerSet, unpack_layers


@dataclass
class CommittedSets:
    """Time [s], token and layers of every set, no layers for a silence, as they are carried out."""

    all: list[tuple[float, int, tuple[LayerSet, ...]]] = field(default_factory=list)
    _staged: dict[int, dict[int, list[int]]] = field(default_factory=dict)

    def note(self, name: str, values: Values, reply: Values, now: float) -> None:
        """Note what a request and its reply at a time [s] change."""
        if name == "Silence":
            self.all.append((now, 0, ()))
        if name == "Set":
            parts = self._staged.setdefault(values["token"], {})
            parts[values["index"]] = list(values["stream"])
        if name == "Commit" or (name == "Set" and reply["played"]):
            parts = self._staged.pop(values["token"], {})  # none if it was repeated
            words = [word for index in sorted(parts) for word in parts[index]]
            if words:
                self.all.append((now, values["token"], unpack_layers(words)))
