"""Where moving fingers are going to be, so that answers are made, and promised, for their next way.

An answer to a place is best as it is asked, and the finger is elsewhere when it plays. One that
moves is answered for the next 8 mm of its way, at three places at once, its own content and as
quiet for all others: from where it is once the weights have half changed, to where they do again.
Weights that change have side bands, which a steady promise does not count: a margin does.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from controller.sources.contacts import Contact
from model.answer.answer import HELD_BACK, MIXED, ONSET_RAMP, OWN, Answer, Sensation, verdict_of
from model.answer.stimulus import MUST, Finger
from model.arrays import Point
from model.finger import FINGERTIP_RADIUS, MAX_CONTACTS
from model.structure.attachments import MIN_LOAD
from model.structure.plate import Plate

STRETCH = 0.008
"""Way [m] that a moving finger is answered for: until it has gone that far it is not asked anew."""

MARGIN_DB = 2.0
"""By how much less is promised while a finger moves, to it and beside it, than if it rested."""

_ANSWER_TIME = 0.020  # s; until what is asked now has begun to play


def with_ways(
    fingers: Sequence[Finger], contacts: Sequence[Contact], now: float, plate: Plate
) -> list[Finger]:
    """Return fingers of contacts with those that move where they are going to be.

    At a time [s]. Behind all of them come the two ends of the way of each, as fingers of the same
    stimulus that share its load. Fingers that may share with others, whose strength comes and goes,
    or that come too near another are only moved.
    """
    found, ends = [*fingers], list[Finger]()
    for number, (finger, contact) in enumerate(zip(fingers, contacts, strict=True)):
        vx, vy = contact.motion.velocity(now)
        if not (speed := math.hypot(vx, vy)):
            continue
        since = now - contact.motion.places[-1][0] + _ANSWER_TIME + ONSET_RAMP / 2
        way = [
            _on_plate((contact.x + vx * each, contact.y + vy * each), plate)
            for each in (since, since + STRETCH / 2 / speed, since + STRETCH / speed)
        ]
        others = [each for each in (*found, *ends) if each is not finger]
        if any(math.dist(at, each.at) < FINGERTIP_RADIUS for at in way for each in others):
            continue
        found[number] = replace(finger, at=way[1])
        is_one = len({*way}) == len(way) and len(found) + len(ends) + 2 <= MAX_CONTACTS
        if is_one and _is_steady_and_alone(finger, others):
            name = finger.name or f"finger {number}"
            stimulus = finger.stimulus and replace(finger.stimulus, name=name)
            one = replace(finger, stimulus=stimulus, load=MIN_LOAD, sharing=MUST)
            ends += [replace(one, at=at) for at in (way[0], way[2])]
            found[number] = replace(one, at=way[1], load=finger.load - 2 * MIN_LOAD)
    return [*found, *ends]


def felt_on_ways(found: Answer, count: int) -> list[Sensation]:
    """Return what the first fingers of an answer get on their ways, the rest being these.

    Of weights that change for a way those who rest feel side bands, too.
    """
    if len(found.fingers) == count:
        return [*found.fingers]
    return [_on_way([found.fingers[each] for each in way]) for way in _ways(found, count)]


def foreign_on_ways(found: Answer, count: int) -> list[list[float]]:
    """Return what they feel of others there at most, by set of thresholds [dB SL]."""
    levels = found.tones.foreign_db_sl
    heard = np.where(np.isnan(levels), -math.inf, levels)
    if len(heard) == count:
        return heard.tolist()  # type: ignore[no-any-return]
    return [(heard[way].max(axis=0) + MARGIN_DB).tolist() for way in _ways(found, count)]


def _ways(found: Answer, count: int) -> list[list[int]]:
    """The numbers of the fingers that stand for each of the first, itself before its ends."""
    ways, places = [[number] for number in range(count)], [each.at for each in found.asked]
    for end in range(count, len(places)):
        near = [math.dist(at, places[end]) for at in places[:count]]
        ways[near.index(min(near))].append(end)
    return ways


def _on_plate(at: Point, plate: Plate) -> Point:
    x, y = at
    return min(max(x, 0.0), plate.length), min(max(y, 0.0), plate.width)


def _is_steady_and_alone(finger: Finger, others: Sequence[Finger]) -> bool:
    """Whether a finger feels nothing, or what is steady and no other finger may feel."""
    if finger.stimulus is None:
        return True
    may_share = any(finger.may_feel_one_with(each) for each in others)
    return finger.stimulus.modulation_hz is None and not may_share


def _on_way(places: Sequence[Sensation]) -> Sensation:
    """What a finger gets at least on its way, of several places, while it moves."""
    first = places[0]
    if first.verdict == HELD_BACK:
        return first
    least = dict[str, Any]()
    for name, (sign, margin) in _WORST.items():
        values = [each for one in places if (each := getattr(one, name)) is not None]
        if values:
            least[name] = sign * min(sign * each for each in values) - sign * margin
    found: Sensation = replace(first, **least)
    if found.verdict not in (OWN, MIXED):
        return found
    judged = found.promised_contrast_db, found.foreign_level_db_sl
    return replace(found, verdict=verdict_of(*judged, pauses=found.pauses))


_WORST = {
    "level_db_sl": (1, 0.0),
    "promised_level_db_sl": (1, 0.0),
    "contrast_db": (1, 0.0),
    "median_contrast_db": (1, 0.0),
    "promised_contrast_db": (1, MARGIN_DB),
    "foreign_level_db_sl": (-1, MARGIN_DB),
}
"""Figures of a sensation: whether less of it is worse or more (-1), and the margin on it [dB]."""
