"""Haptic files as a finger feels them, alone and next to another finger.

    python -m benchmarks.content [--files FOLDER] [--count 40] [--pairs 0] [--workers 2]

Prints the shares in docs/how-to/play-content.md and docs/measured/figures.md: the share of the time
in which the level at the skin is within 3 dB of the requested level. Like `era content check`, it
counts only times at which the requested level is within 20 dB of its maximum. The delay is the best
one for all files, at most 10 ms. A second row omits transients that are not clicks because they are
too close to stronger ones. The finger is alone on the paper's plate.

With --pairs, it also prints the promised and felt contrast of the strongest 40 ms with another
finger at least 5 cm away, over the wire, on plates, drives and fingers drawn within the rig's
uncertainty. Loop, line and amplifiers then run in virtual time (`benchmarks.promise.session`).

Without --files, the built-in contents are used, otherwise the first readable files of the folder,
in order of name, that request a vibration; equal files count once. Exits with status 1 unless half
of the files keep 95 %, 90 % of the files keep 80 %, and 86 to 94 % of the promises are kept.
"""

import argparse
import operator
import sys
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import cache, partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.promise.cases import Case
from benchmarks.promise.hearing import Heard, Log
from benchmarks.setting import random_contacts
from controller.content.formats import named_content, named_contents, read_content
from controller.content.pattern import Pattern
from controller.content.rendition import rendered
from controller.effects.effect import Region
from controller.effects.file_effect import File
from controller.effects.layout import SurfaceLayout
from controller.effects.player import EffectPlayer
from controller.play.intent import CLICK
from era_haptics.lab.checks.content_check import MAX_DELAY, check_content
from kit.chain import Chain
from kit.clock import run_virtual
from model.answer.answer_report import Timing
from model.config.shapes import Circle
from model.errors import InputError
from model.finger import FINGERTIP_RADIUS
from registry import threads
from sim.far_ends.wire_assignment import SimulatedWire
from sim.plant.imperfections import draw_imperfections
from sim.transport.simulated_line import PROMPT

AT = (0.11, 0.13)
LEVEL_DB_SL = 20.0
MEDIAN, WORST_TENTH, PROMISED_DB = 0.95, 0.80, 16.0


def main() -> None:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.content",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--files", type=Path, help="folder; default: the named contents")
    parser.add_argument("--count", type=int, default=40)
    parser.add_argument("--pairs", type=int, default=0, help="other fingers for each file")
    parser.add_argument("--workers", type=int, default=2)
    options = parser.parse_args()
    patterns = [*dict.fromkeys(_patterns(options.files))][: options.count]
    is_kept = _print_alone(patterns)
    if options.pairs:
        is_kept = _print_beside(patterns, options.pairs, options.workers) and is_kept
    sys.exit(not is_kept)


def _print_alone(patterns: Sequence[Pattern]) -> bool:
    """Print the shares; return whether they are sufficient."""
    table, delays = CASE.table, np.linspace(0, MAX_DELAY, 11)
    shares, lost = [], 0
    for pattern in patterns:
        clicks = {each.time for each in rendered(pattern, LEVEL_DB_SL, table.frequencies).clicks}
        taps = [each for each in pattern.transients if each.time in clicks]
        lost += len(pattern.transients) - len(taps)
        found = [
            check_content(each, table, LEVEL_DB_SL, at=AT)
            for each in (pattern, replace(pattern, transients=tuple(taps)))
        ]
        kept = []
        for checked in found:
            checked_delays = checked.step * np.arange(len(checked.kept_shares))
            kept.append(np.interp(delays, checked_delays, checked.kept_shares))
        shares.append(kept)
    by_delay = np.array(shares)  # files, both, delays
    late = int(np.median(by_delay, axis=0)[0].argmax())
    count = sum(len(each.transients) for each in patterns)
    print(
        f"{len(patterns)} files, {1000 * delays[late]:.0f} ms late; "
        f"{lost} of {count} taps too close"
    )
    print("| kept within 3 dB | median | worst tenth | goal |")
    print("|---|---|---|---|")
    kept = np.percentile(by_delay[:, :, late], [50, 10], axis=0).T
    for name, (median, tenth) in zip(
        ("of all that is asked", "without taps too close"), kept, strict=True
    ):
        print(
            f"| {name} | {100 * median:.0f} % | {100 * tenth:.0f} % | "
            f"{100 * MEDIAN:.0f} %, {100 * WORST_TENTH:.0f} % |"
        )
    return bool((kept[0] >= (MEDIAN, WORST_TENTH)).all())


def _print_beside(patterns: Sequence[Pattern], pairs: int, workers: int) -> bool:
    """Print contrasts to another finger; return whether enough promises are kept."""
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        running = [
            pool.submit(outcome, each, LEVEL_DB_SL, pair, len(patterns) * pair + number)
            for pair in range(pairs)
            for number, each in enumerate(patterns)
        ]
        found = []
        for job in running:
            found.append(job.result())
            print(".", end="", flush=True, file=sys.stderr)
    promised, felt = np.array(found).T
    kept = float((felt >= promised).mean())
    print("\n| beside another finger | promised [dB] | felt [dB] | promise kept | goal |")
    print("|---|---|---|---|---|")
    print(
        f"| {len(found)} of {pairs} pairs | {np.median(promised):.1f} | {np.median(felt):.1f} | "
        f"{100 * kept:.0f} % | {PROMISED_DB:g} dB, 86 to 94 % |"
    )
    return 0.86 <= kept <= 0.94


def _patterns(folder: Path | None) -> Iterator[Pattern]:
    """Yield the readable files of a folder in order of name, or the named contents."""
    paths = [named_content(each) for each in named_contents()]
    for path in paths if folder is None else sorted(folder.iterdir()):
        try:
            pattern = read_content(path)
        except InputError as error:
            print(f"skipped: {error}", file=sys.stderr)
            continue
        if pattern.transients or any(value > 0 for _, value in pattern.intensity):
            yield pattern


CASE = Case("files")
_BEFORE, _AFTER = 0.3, 0.3  # s; of the quiet finger alone, and after the file


@cache
def _timing() -> Timing:
    return Timing(CASE.table)


def outcome(pattern: Pattern, level_db_sl: float, pair: int, seed: int) -> tuple[float, float]:
    """Return the contrast [dB] of continuous events, or of taps: promised, and felt in the file.

    pair: number of the positions; seed: of plate, ERAs, drives and fingers. The felt contrast is
    the level of the strongest 40 ms at the finger, relative to the strongest 40 ms at the loudest
    point of the other finger, the lowest over the threshold sets.
    """
    found: tuple[float, float] = run_virtual(_run(pattern, level_db_sl, pair, seed))
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
    async with Chain.armed(
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
        log.note_owners(on.applied)
        for applied in on.applied:
            for one in applied.contents.values():
                contrast = one.content.sensations[0].promised_contrast_db
                promises.setdefault(one.content.key.voice, contrast)
        on.far.bench.advance(threads.now())
        voice = 0 if 0 in promises else CLICK
        played = log.replayed(partial(operator.eq, ~0 if voice == CLICK else 0), threads.now())
        span = since, threads.now()
        own = Heard(0, played, played).own_db_sl(span, strongest=True)
        leaked = Heard(1, played, played).foreign_db_sl(span, strongest=True)
        return promises[voice], float((own - leaked).min())


if __name__ == "__main__":
    main()
