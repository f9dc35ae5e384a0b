"""What a layer of all amplifiers plays: a content, until when, and what is due of it."""

import math
from dataclasses import dataclass, field

from controller.play.content import Content
from controller.play.routing import Drive
from model.answer import answer


@dataclass(frozen=True)
class LayerContent:
    """A content in its layer.

    layer: with the ramp, onset and ending of its sets; drive: by ERA, as confirmed; settled_at
    [s]: when its onset has ended. is_shaped: whether it may have an ending, which is sent at
    ending_due [s], once the onset has ended: until then it fades. Of one with a course the next
    piece is sent then; course_until [s]: when what has been sent of it ends. confirmed_until [s]:
    when its first target would have been lifted, as known when it was sent; between renewal_due and
    renewable_until it is renewed if all targets have been confirmed since. ends_at: when it has
    ended by itself unless it was renewed. is_falling: whether another content takes its place along
    a cross-fade: it falls at ending_due, and is not renewed.
    """

    content: Content
    layer: answer.Layer
    drive: Drive = field(default_factory=dict)
    settled_at: float = math.inf
    is_shaped: bool = False
    ending_due: float = math.inf
    confirmed_until: float = math.inf
    renewal_due: float = math.inf
    renewable_until: float = math.inf
    ends_at: float = math.inf
    is_falling: bool = False
    course_until: float = -math.inf

    @property
    def settled_after(self) -> float:
        """How long [s] after the commit its ramp or onset has ended."""
        onset = self.layer.onset
        last = next(iter(onset.values())).duration if onset else 0.0
        return max(self.layer.ramp, last)
