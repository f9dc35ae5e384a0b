"""Layers that play courses: the set of the next piece, and when the one after it is due."""

import math
from dataclasses import replace

from controller.play.content import Content
from controller.play.intent import Pulse
from controller.play.layer_content import LayerContent
from controller.play.pieces import HELD, piece_of
from controller.play.routing import Drive, PlateLayer, SetBuilder, full_drive
from model.answer import answer
from model.answer.stimulus import Course

MIN_LEFT = 0.001
"""Time [s] of a pulse that is about to end."""


class CourseLayers:
    """Makes the pieces of courses; knots: of an envelope, 0 for ramps."""

    def __init__(self, builder: SetBuilder, knots: int) -> None:
        self._builder, self._knots = builder, knots

    def piece(
        self,
        number: int,
        content: Content,
        course: Course,
        pulse: Pulse,
        now: float,
        *,
        among: int,
        playing: Drive,
        before: LayerContent | None = None,
    ) -> tuple[PlateLayer, answer.Layer]:
        """Return the set of the piece of a content's course that is played next, and its layer.

        From where the pulse is at a time [s] on, or once the piece before ends, if that has not
        ended yet. number: of the layer; among: pieces that are sent together; playing: what plays
        there; before: with the piece before, None for the first.
        """
        is_after, knots, starts = False, self._knots, now
        if before is None:
            knots = min(knots, self._builder.support.onset_knots)
        elif now < before.course_until:
            is_after, starts = True, before.course_until
        piece = piece_of(
            course,
            pulse,
            0.0 if pulse.started_at is None else starts - pulse.started_at,
            knots=max(knots // among, 1) if knots else 0,
            is_first=before is None,
        )
        has_ended = before is not None and now >= before.ends_at
        return self._builder.build_piece(
            number,
            content.layer,
            piece,
            playing={} if has_ended else playing,
            valid_for=piece.duration + HELD,
            is_after=is_after and piece.has_knots,
        )

    def confirmed(
        self, one: LayerContent, played: answer.Layer, since: float, now: float, *, is_first: bool
    ) -> LayerContent:
        """Return what plays of a course once a piece is confirmed that starts at a time [s].

        The next one follows the first at once, and is sent when half of any other has been played.
        """
        until = since + replace(one, layer=played).settled_after
        due = now + MIN_LEFT if is_first else (since + until) / 2
        due = due if played.onset else until
        pulse = one.content.targets[0][1].pulse
        is_over = pulse is not None and until > pulse.end - MIN_LEFT
        return replace(
            one,
            drive=full_drive(one.content.layer.excitation, self._builder.rig),
            course_until=until,
            ending_due=math.inf if is_over else due,
        )
