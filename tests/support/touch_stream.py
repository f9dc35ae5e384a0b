"""A touch stream: fingers come, move and go, and what each change asks for."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

Place = tuple[float, float]


@dataclass(frozen=True)
class Situation:
    """What is so from one change of the fingers to the next [s] of the stream.

    fingers: places by id, in order of arrival; target: the id of the one to feel it, None where
    no finger is there; from_rest: whether the plate was silent before.
    """

    begin: float
    end: float
    fingers: Mapping[int, str]
    target: int | None
    from_rest: bool

    @property
    def quiet(self) -> tuple[str, ...]:
        """Where nothing may be felt."""
        return tuple(place for id, place in self.fingers.items() if id != self.target)

    @property
    def felt_at(self) -> str:
        """Where it is to be felt."""
        assert self.target is not None
        return self.fingers[self.target]


@dataclass(frozen=True)
class Stream:
    """Places [m] by name, and who is where from when [s] on; the last change ends it."""

    places: Mapping[str, Place]
    changes: Sequence[tuple[float, Mapping[int, str]]]

    @property
    def situations(self) -> list[Situation]:
        """Each change with what it asks for: the finger that came last feels it."""
        found = []
        before: Mapping[int, str] = {}
        for (begin, fingers), (end, _) in pairwise(self.changes):
            target = max(fingers, default=None)  # ids are given in order of arrival
            found.append(Situation(begin, end, fingers, target, not before))
            before = fingers
        return found
