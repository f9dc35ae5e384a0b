"""A region of the plate and its effects."""

from dataclasses import dataclass
from typing import Any

from controller.play.intent import Band
from model.config.fields import Shape

ON_PRESS, ON_MOVE, ON_RELEASE = USES = ("on_press", "on_move", "on_release")
"""Keys of a region's effects."""


@dataclass(frozen=True)
class Region:
    """A region of the plate and the names of its effects, None for none.

    on_press: when a finger comes down or slides in; on_move: while it moves within; on_release:
    when it slides out. A finger that lifts feels nothing. level_db_sl: replaces the level of the
    effects if has_level; band: their frequencies, if not None. priority: lower ones give way first.
    is_own: a finger in it feels its own content or none; may_share: it may feel that of any finger
    that may share, too; is_protected: no content that it would notice is played elsewhere.
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
    is_own: bool = False
    may_share: bool = False
    is_protected: bool = False

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
            "own": self.is_own,
            "may_share": self.may_share,
            "protected": self.is_protected,
        }
