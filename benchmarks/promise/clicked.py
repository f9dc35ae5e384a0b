"""Clicks in a session: what each promises, and what the others are said to feel meanwhile.

A click has a content of its own at its finger, whether that feels what lasts besides or not. All
levels are of 40 ms: the click's of its duration, others' the strongest while it plays and rings.
"""

import asyncio
import operator
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np

from benchmarks.promise.heard import Heard, Log, Span
from controller.effects.player import CLICK_ABOVE_DB
from controller.play.intent import CLICK, Prediction, Pulse, Target
from controller.play.loop import PlayReport
from controller.sources.touch import ContactKey
from registry import threads

DURATION, LEVEL_DB_SL, RINGING, PAUSE = 0.040, 20.0, 0.060, 0.6  # s, dB SL


@dataclass
class Clicked:
    """Of the clicks of a session, each promised and felt [dB].

    contrasts: of the click, above its own at other fingers and above others' at its own; foreign:
    levels at the others meanwhile, negative, so that more is better; restated: contrasts of their
    own contents meanwhile; over_own: level of the click above what lasts at its finger, felt alone.
    """

    contrasts: list[tuple[float, float]] = field(default_factory=list)
    foreign: list[tuple[float, float]] = field(default_factory=list)
    restated: list[tuple[float, float]] = field(default_factory=list)
    over_own: list[float] = field(default_factory=list)


def owner_of(one: Any) -> int:
    """The finger that a layer plays for, its complement for a click."""
    id = int(one.content.targets[0][0].key.id)
    return ~id if one.content.key[1] == CLICK else id


def click_at(key: ContactKey, now: float) -> Target:
    """The target of a click from a time [s] on."""
    pulse = Pulse(DURATION, now)
    return Target(key, LEVEL_DB_SL, pulse, content="click", above_db=CLICK_ABOVE_DB)


async def clicks(on: Any, wanted: Any, fingers: Sequence[int]) -> list[tuple[int, PlayReport]]:
    """Let fingers click, one after the other; returns the report of each click that was played."""
    found = list[tuple[int, PlayReport]]()
    for id in fingers:
        count = len(on.applied)
        wanted.click = click_at(ContactKey("panel", id), threads.now())
        on.controller.cycle.request_update()
        await asyncio.sleep(0)
        await on.hold(PAUSE)
        reports = [each for each in on.applied[count:] if _layers_of(each, ~id)]
        found += [(id, each) for each in reports[:1]]
    return found


def measured(
    log: Log, reports: Sequence[tuple[int, PlayReport]], fingers: int, until: float
) -> Clicked:
    """What was felt of clicks up to a time [s] by so many fingers, beside what was promised."""
    found = Clicked()
    every = {id: Heard.by(id, log, until) for id in range(fingers)} if reports else {}
    alone = {id: log.replayed(partial(operator.eq, ~id), until) for id, _ in reports}
    for id, report in reports:
        promised = {each.contact.key.id: each for each in report.targets}
        during, after = _spans(report.time)
        others, click = [other for other in range(fingers) if other != id], alone[id]
        own = Heard(id, click, click).own_db_sl(during)
        leaks = [
            Heard(other, click, click).foreign_db_sl(after, strongest=True) for other in others
        ]
        foreign = every[id].foreign_db_sl(during)
        contrast = promised[id].promised_contrast_db
        if contrast is not None:
            loudest = np.max([*leaks, foreign], axis=0)
            found.contrasts.append((contrast, float((own - loudest).min())))
        if _layers_of(report, id):
            found.over_own.append(float((own - every[id].own_db_sl(during))[0]))
        for other in others:
            _note(found, other, report, promised.get(other), every[other])
    return found


def _note(
    found: Clicked,
    id: int,
    report: PlayReport,
    promised: Prediction | None,
    heard: Heard,
) -> None:
    """Note what another finger felt of a click."""
    during, after = _spans(report.time)
    foreign = heard.foreign_db_sl(after, strongest=True)
    if promised is None:
        (levels,) = [each for key, each in report.quiet_levels.items() if key.id == id]
        found.foreign.append((-max(levels), -float(foreign.max())))
        return
    if promised.foreign_level_db_sl is not None:
        found.foreign.append((-promised.foreign_level_db_sl, -float(foreign.max())))
    if promised.promised_contrast_db is not None:
        contrast = float((heard.own_db_sl(during) - foreign).min())
        found.restated.append((promised.promised_contrast_db, contrast))


def _spans(since: float) -> tuple[Span, Span]:
    return (since, since + DURATION), (since, since + DURATION + RINGING)


def _layers_of(report: PlayReport, owner: int) -> list[int]:
    return [n for n, one in report.contents.items() if owner_of(one) == owner]
