"""A file at one finger beside a quiet one, over the wire, on a plate that deviates.

Control loop, line and amplifiers run in virtual time, as in `benchmarks.promise.session`.
"""

import operator
from functools import cache, partial
from typing import Any

import numpy as np

from benchmarks.promise.cases import Case
from benchmarks.promise.clicked import owner_of
from benchmarks.promise.heard import Heard, Log
from benchmarks.promise.session import EARLY
from benchmarks.setting import random_contacts, support
from controller.content.pattern import Pattern
from controller.effects.effect import Region
from controller.effects.kinds import File
from controller.effects.layout import SurfaceLayout
from controller.effects.player import EffectPlayer
from controller.play.intent import CLICK
from model.answer.answer_report import Timing
from model.config.fields import Circle
from model.finger import FINGERTIP_RADIUS
from registry import threads
from sim.far_ends.wire_assignment import SimulatedWire
from sim.plant.imperfections import draw_imperfections
from sim.transport.simulated_line import PROMPT

_chain: Any = support("chain").Chain
_run_virtual: Any = support("virtual_lines").run_virtual

CASE = Case("files", None)
_BEFORE, _AFTER = 0.3, 0.3  # s; of the quiet finger alone, and after the file


@cache
def _timing() -> Timing:
    return Timing(CASE.table)


def outcome(pattern: Pattern, level_db_sl: float, pair: int, seed: int) -> tuple[float, float]:
    """Contrast [dB] of what lasts, else of the taps: promised, and felt over the whole file.

    pair: number of the places; seed: of plate, ERAs, drives and fingers. The strongest 40 ms at the
    finger above the strongest at the loudest point of the other one, the least over the sets of
    thresholds.
    """
    found: tuple[float, float] = _run_virtual(_run(pattern, level_db_sl, pair, seed))
    return found


async def _run(pattern: Pattern, level_db_sl: float, pair: int, seed: int) -> tuple[float, float]:
    rig, table = CASE.rig, CASE.table
    size, margin = (rig.plate.length, rig.plate.width), FINGERTIP_RADIUS + 0.001
    places = random_contacts(np.random.default_rng([pair, 61]), 2, size, margin=margin)
    at, quiet = [(float(x), float(y)) for x, y in places]
    effect = File.of(pattern, name="file", level_db_sl=level_db_sl)
    region = Region("here", Circle(*at, 0.02), on_press="file")
    layout = SurfaceLayout((region,), {"file": effect}, elsewhere=None)
    drawn = draw_imperfections(rig, seed=1000 + seed)
    on: Any
    async with _chain.armed(
        SimulatedWire("serial", speed=921_600, shared=True, line_kind=PROMPT, seed=drawn.seed),
        rig,
        table,
        intent_source=EffectPlayer(layout.for_table(table.frequencies)),
        timing=_timing(),
        imperfections=drawn,
    ) as on:
        on.must_be_felt = False
        log = Log(rig, drawn, threads.now())
        log.watch(on.far.bench)
        on.at[1] = quiet
        await on.hold(_BEFORE)
        on.at[0], since = at, threads.now()
        await on.hold(pattern.duration + _AFTER)
        promises = dict[int, float]()
        for applied in on.applied:
            owners = {number: owner_of(one) for number, one in applied.contents.items()}
            log.own(owners, applied.time - EARLY)
            for one in applied.contents.values():
                contrast = one.content.predictions[0].promised_contrast_db
                promises.setdefault(one.content.key[1], contrast)
        on.far.bench.advance(threads.now())
        voice = 0 if 0 in promises else CLICK
        played = log.replayed(partial(operator.eq, ~0 if voice == CLICK else 0), threads.now())
        span = since, threads.now()
        own = Heard(0, played, played).own_db_sl(span, strongest=True)
        leaked = Heard(1, played, played).foreign_db_sl(span, strongest=True)
        return promises[voice], float((own - leaked).min())
