"""What a rig check says of boards on exciters with a maker's mistake.

    python -m benchmarks.identification.mistakes [--boards 10] [--sound 40] [--first 1] [--report]

Boards are those of `benchmarks.weekend.chain`: drawn within the uncertainty of
examples/weekend/rig.yaml, and read by one sensor that is moved to twelve places, at 11 tones. It
counts the boards of which the check names the mistake and the exciter or the place, and of which it
says that anything is wrong; --sound: of those without a mistake. With --report, the page
docs/measured/identification.md is written as well.
"""

import argparse
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from multiprocessing import get_context
from typing import Any

import numpy as np

from benchmarks.identification.__main__ import PAGE
from benchmarks.setting import write_parts
from benchmarks.weekend.chain import FOLDER, BuiltBoard
from model.arrays import ComplexArray, FloatArray
from model.estimate.findings import Verdict
from model.estimate.measurement import Measurement
from model.estimate.rig_check import diagnose, judged_by_promises
from model.rig.rig import Rig
from model.rig.rig_file import load_rig

TONES = np.arange(91.0, 300.0, 20.0)
CONTACTS = (0.1, 0.2, 0.3, 0.4, 0.5)
GLUES = (300.0, 600.0, 1200.0, 1800.0, 2400.0)
STIFFER = (4000.0, 12000.0)
_GLUE_LOSS = 0.2


@dataclass(frozen=True)
class HalfGlued:
    """An exciter behind what is left of its glue: share (f,) of what it does that comes through."""

    own: Any
    share: Callable[[FloatArray], ComplexArray]

    def __getattr__(self, name: str) -> Any:
        """Its place, its foot and its full level."""
        return getattr(self.own, name)

    def dynamic_stiffness(self, omega: FloatArray) -> ComplexArray:
        """Of both, one behind the other [N/m]."""
        return np.asarray(self.own.dynamic_stiffness(omega) * self.share(omega))

    def force(self, omega: FloatArray) -> ComplexArray:
        """What comes through the glue [N]."""
        return np.asarray(self.own.force(omega) * self.share(omega))


def on_glue(own: Any, stiffness: float) -> HalfGlued:
    """An exciter on a spring of glue [N/m], which loses a fifth."""
    glue = stiffness * (1 + 1j * _GLUE_LOSS)
    return HalfGlued(own, lambda omega: glue / (glue + own.dynamic_stiffness(omega)))


def in_contact(own: Any, share: float) -> HalfGlued:
    """An exciter that acts with a share of its contact, alike at all frequencies."""
    return HalfGlued(own, lambda omega: np.full(len(omega), share + 0j))


@dataclass(frozen=True)
class Mistake:
    """A mistake: what it does, and whether a verdict says so; both by the number of an exciter.

    mount: of an exciter, by the board's seed; change: of the values (f, s, e).
    """

    is_named: Callable[[Verdict, int], bool]
    mount: Callable[[Any, int], Any] = lambda exciter, seed: exciter
    change: Callable[[ComplexArray, int], ComplexArray] = lambda values, exciter: values


def _states(state: str) -> Callable[[Verdict, int], bool]:
    return lambda verdict, exciter: state in verdict.channels[exciter].states


def _on_glue(stiffness: float) -> Callable[[Any, int], HalfGlued]:
    return lambda own, _: on_glue(own, stiffness)


def _acts_less(verdict: Verdict, exciter: int) -> bool:
    """Whether it is said to be loose or weak, of which the remedies name the mounting."""
    return bool({"loose", "weak"} & {*verdict.channels[exciter].states})


def _negated(values: ComplexArray, *, exciter: int | slice, place: int | slice) -> ComplexArray:
    changed = values.copy()
    changed[:, place, exciter] *= -1
    return changed


def _swapped(values: ComplexArray, exciter: int) -> ComplexArray:
    order = [*range(values.shape[2])]
    order[exciter], order[exciter - 1] = order[exciter - 1], order[exciter]
    return values[:, :, order]


def _mistakes() -> Iterator[tuple[str, Mistake]]:
    """By name."""
    yield "none", Mistake(lambda verdict, _: verdict.is_well)
    yield (
        "an exciter backwards",
        Mistake(_states("inverted"), change=lambda v, e: _negated(v, exciter=e, place=slice(None))),
    )
    yield (
        "all exciters backwards",
        Mistake(
            lambda verdict, _: all("inverted" in each.states for each in verdict.channels),
            change=lambda values, _: -values,
        ),
    )
    yield "two exciters swapped", Mistake(_states("other ERA"), change=_swapped)
    yield (
        "the sensor upside down at a place",
        Mistake(
            lambda verdict, e: [each.of for each in verdict.about("sensor")] == [f"P{2 * e + 1}"],
            change=lambda v, e: _negated(v, exciter=slice(None), place=2 * e),
        ),
    )
    yield (
        "loose, 0.1 to 0.5 of its contact",
        Mistake(_acts_less, mount=lambda own, seed: in_contact(own, CONTACTS[seed % 5])),
    )
    yield (
        "on glue of 300 to 2400 N/m",
        Mistake(_states("loose"), mount=lambda own, seed: on_glue(own, GLUES[seed % 5])),
    )
    for glue in STIFFER:
        yield (
            f"on glue of {glue:g} N/m",
            Mistake(_states("loose"), mount=_on_glue(glue)),
        )


MISTAKES = dict(_mistakes())


def measured(rig: Rig, mistake: Mistake, seed: int) -> Measurement:
    """What the sensor reads of a board with a mistake."""
    built, who = BuiltBoard.drawn(rig, seed), seed % len(rig.eras)
    eras = [*built.rig.eras]
    eras[who] = mistake.mount(eras[who], seed)
    # What is glued badly is no exciter of a rig's, only something that pushes.
    found = replace(built, rig=replace(built.rig, eras=tuple(eras))).measured(TONES, seed)
    return replace(found, values=mistake.change(found.values, who))


def verdict_on(name: str, seed: int) -> tuple[bool, bool]:
    """Whether the check names a mistake on a board, and whether it fails."""
    rig, mistake = load_rig(FOLDER / "rig.yaml"), MISTAKES[name]
    verdict = diagnose(rig, measured(rig, mistake, seed), has_form=True)
    if verdict.is_well:  # what fails already need not miss its promises
        verdict = judged_by_promises(verdict, rig)
    return mistake.is_named(verdict, seed % len(rig.eras)), not verdict.is_well


def row(name: str, found: Sequence[tuple[bool, bool]]) -> str:
    """A line of the table."""
    named, failed = np.sum(found, axis=0)
    return f"| {name} | {named} of {len(found)} | {failed} of {len(found)} |"


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.identification.mistakes")
    parser.add_argument("--boards", type=int, default=10, help="with each mistake")
    parser.add_argument("--sound", type=int, default=40)
    parser.add_argument("--first", type=int, default=1, help="seed of the first board")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--report", action="store_true")
    options = parser.parse_args()
    lines = ["| mistake | named | exit status 1 |", "|---|---|---|"]
    with ProcessPoolExecutor(options.workers, mp_context=get_context("spawn")) as pool:
        jobs = {}
        for name in MISTAKES:
            count = options.sound if name == "none" else options.boards
            seeds = range(options.first, options.first + count)
            jobs[name] = [pool.submit(verdict_on, name, seed) for seed in seeds]
        for name, own in jobs.items():
            lines.append(row(name, [each.result() for each in own]))
            print(lines[-1], flush=True)
    if options.report:
        printed = (
            f"Printed by `python -m benchmarks.identification.mistakes --boards {options.boards} "
            f"--sound {options.sound} --first {options.first} --report`."
        )
        write_parts(PAGE, {"mistakes": "\n".join([printed, "", *lines])})


if __name__ == "__main__":
    main()
