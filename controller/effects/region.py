"""A region of the plate and its effects."""

from dataclasses import dataclass
from typing import Any

from controller.effects.band import Band
from controller.effects.shapes import Shape


@dataclass(frozen=True)
class Region:
    """A region of the plate and the names of its effects, None for none.

    on_press: when a finger comes down or slides in; on_move: while it moves within; on_release:
    when it slides out. A finger that lifts feels nothing. level_db_sl: replaces the level of the
    effects if has_level; band: their frequencies, if not None. priority: the highest is felt.
    """

    name: str
    shape: Shape
    on_press: str | None = None
    on_move: str | None = None
    on_release: str | None = None
    level_db_sl: float | None = None
    has_level: bool = False
    priority: int = 0
    band: Band | None = None

    def as_json(self) -> dict[str, Any]:
        """Return it as the API describes it."""
        return {
            "name": self.name,
            **self.shape.as_json(),
            "on_press": self.on_press,
            "on_move": self.on_move,
            "on_release": self.on_release,
            "priority": self.priority,
            "band_hz": None if self.band is None else [*self.band],
        }
