"""What identification in place gains on plates that are not the model's.

    python -m benchmarks.identification [--plates 50] [--sets 2] [--kinds plain,form,hard,uneven]
        [--rounds 4] [--sensors 4] [--report]

Hidden plates are thin plates in Hermite elements with viscous modal losses; measured are responses
at the four ERAs to 27 tones with 1 % noise. Judged is the contrast of the model's answers on the
hidden plate with drives good to 1 % and 1°, for the rig as written, as identified, and for the
plate known exactly. --rounds: of interleaved tones, 1 is the quick check.
--sensors: how many, such as 3,4,6: at the first ERAs, then inside the plate; of several, or of
kinds outside the model's family (wedge, bumps, frame, loose, heavy, two), it is counted how many
plates are refused, and how the others keep what is promised.
With --report, the page docs/measured/identification.md is written as well.
"""

import argparse
from collections.abc import Sequence
from itertools import product
from pathlib import Path

import numpy as np

from benchmarks.identification.plates import (
    FAMILY,
    FREQUENCIES,
    QUIET,
    SETS,
    WAYS,
    Outcome,
    draw,
    outcome,
    share_in_region,
    share_within,
    table_of,
)
from benchmarks.setting import RIG, write_parts
from model.rig.rig_file import load_rig


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.identification")
    parser.add_argument("--plates", type=int, default=50)
    parser.add_argument(
        "--sets", type=int, default=2, help="of contacts on each plate, 0 for fits only"
    )
    parser.add_argument("--first", type=int, default=1, help="seed of the first plate")
    parser.add_argument("--kinds", default="plain,form,hard,uneven")
    parser.add_argument("--rounds", type=int, default=4)
    parser.add_argument("--sensors", default="4", help="numbers of sensors")
    parser.add_argument("--report", action="store_true")
    options = parser.parse_args()

    rig = load_rig(RIG)
    written = {loaded: table_of(rig, FREQUENCIES, loaded=loaded) for loaded in (False, True)}
    found = []
    seeds = range(options.first, options.first + options.plates)
    for seed, kind in product(seeds, options.kinds.split(",")):
        hidden = draw(kind, seed)
        for sensors in options.sensors.split(","):
            one = outcome(
                *(hidden, rig, written, kind, seed),
                sets=options.sets,
                rounds=options.rounds,
                sensors=int(sensors),
            )
            found.append(one)
            print(
                f"plate {seed} {kind}, {sensors} sensors: chi² {one.chi2:.2f}, modes shifted "
                f"by {one.mode_shift:.2f} {one.refusal}",
                flush=True,
            )
    is_outside = options.sensors != "4" or not {*options.kinds.split(",")} <= {*FAMILY}
    texts = {"outside": kept_or_refused(found)} if is_outside else {}
    if not is_outside:
        texts[f"fits-{options.rounds}"] = fits(found)
    if options.sets and not is_outside:
        texts[f"contrasts-{options.rounds}"] = contrasts(found)
        texts[f"promises-{options.rounds}"] = promises(found)
    print("\n\n".join(texts.values()))
    if options.report:
        run = f"python -m benchmarks.identification --plates {options.plates} --sets {options.sets}"
        rounds = f" --rounds {options.rounds}" if options.rounds != 4 else ""
        first = f" --first {options.first}" if options.first != 1 else ""
        which = f" --kinds {options.kinds} --sensors {options.sensors}" if is_outside else ""
        printed = f"Printed by `{run}{first}{which}{rounds} --report`."
        write_parts(PAGE, {part: f"{printed}\n\n{text}" for part, text in texts.items()})


PAGE = Path(__file__).parents[2] / "docs" / "measured" / "identification.md"

PLATE_KEEPS = 0.86
"""Share of answers from which a plate counts as one that keeps, of few that are nine of ten."""

NAMES = {
    "plain": "no form errors",
    "form": "places off by 1.5 mm, a hidden 3 g",
    "hard": "sides, ratio, modulus, bolts and loss law off too",
    "uneven": "places off, a hidden 3 g, thickness ± 1.5 % from end to end",
    "wedge": "the same, thickness ± 3 %",
    "bumps": "places off, a hidden 3 g, bumps of 3 % of the thickness",
    "frame": "a bonded frame, 12 mm wide: bending stiffness +80 %, mass +35 %",
    "loose": "places off, a hidden 3 g, one ERA at 0.35 of its spring",
    "heavy": "places off, 10 g",
    "two": "places off, twice 5 g",
}
GOALS = {
    ("plain", False): "within 0.5 dB of the plate known",
    ("plain", True): "30 (24.5) / 17.5 / 13.5",
    ("form", False): "32.5 (27) / 19 / 14",
    ("form", True): "30.5 (24.5) / 18.5 / 13",
    ("hard", False): "31 (26) / 18.5 / 13.5",
    ("hard", True): "29.5 (24.5) / 18 / 12.5",
}


def contrasts(outcomes: Sequence[Outcome]) -> str:
    """What answers give."""
    lines = [
        "Median (tenth percentile) of the contrast [dB] for one / two / three quiet fingers:",
        "",
        "| | rig as written | identified | goal | plate known |",
        "|---|---|---|---|---|",
    ]
    for kind in _kinds(outcomes):
        own = [each for each in outcomes if each.kind == kind and not each.refusal]
        for loaded in (False, True):
            cells = [" / ".join(_cell(own, way, loaded, quiet) for quiet in QUIET) for way in WAYS]
            fingers = "loaded" if loaded else "weightless"
            goal = GOALS.get((kind, loaded), "–")
            lines.append(
                f"| {NAMES[kind]}, {fingers} | {cells[0]} | {cells[1]} | {goal} | {cells[2]} |"
            )
    return "\n".join(lines)


def promises(outcomes: Sequence[Outcome]) -> str:
    """How often plates give what is promised of them."""
    lines = [
        "Share of answers of the rig as identified whose promise the plate keeps (nine of ten are "
        "meant), where the plate is not refused:",
        "",
        "| | contrast, weightless | loaded | level, weightless | loaded |",
        "|---|---|---|---|---|",
    ]
    for kind in _kinds(outcomes):
        own = [each for each in outcomes if each.kind == kind and each.is_explained]
        cells = []
        for what in ("contrast", "level"):
            for loaded in (False, True):
                kept = [reached for each in own for reached in each.kept[what, loaded]]
                cells.append(f"{100 * np.mean(kept):.0f} % of {len(kept)}")
        lines.append(f"| {NAMES[kind]} | {' | '.join(cells)} |")
    return "\n".join(lines)


def kept_or_refused(outcomes: Sequence[Outcome]) -> str:
    """By kind of plate and number of sensors how many are refused, and how the others keep."""
    lines = [
        "Plates refused; of the others the share of answers, weightless and loaded, whose promise "
        "is kept (tenth percentile and least of plates), and plates that keep nine of ten levels:",
        "",
        "| | sensors | plates, refused | contrast | level | plates that keep level |",
        "|---|---|---|---|---|---|",
    ]
    for kind in _kinds(outcomes):
        every = [each for each in outcomes if each.kind == kind]
        for sensors in sorted({each.sensors for each in every}):
            of = [each for each in every if each.sensors == sensors]
            own = [each for each in of if each.is_explained]
            shares = [[_kept(each, what) for each in own] for what in ("contrast", "level")]
            rows = [[np.mean(of), np.percentile(of, 10), min(of)] for of in shares if of]
            cells = ["{:.0f} % ({:.0f}, {:.0f})".format(*100 * np.array(row)) for row in rows]
            if own:
                cells.append(f"{sum(share >= PLATE_KEEPS for share in shares[1])} of {len(own)}")
            row = [NAMES[kind], str(sensors), f"{len(of)}, {len(of) - len(own)}"]
            lines.append(f"| {' | '.join([*row, *(cells or ['–'] * 3)])} |")
    return "\n".join(lines)


def _kept(found: Outcome, what: str) -> float:
    """Share of all answers of a plate that keep what is promised."""
    return float(np.mean([one for loaded in (False, True) for one in found.kept[what, loaded]]))


def fits(outcomes: Sequence[Outcome]) -> str:
    """How well plates are explained, and how often intervals hold the truth."""
    lines = [
        "Fits; shares of 95 % intervals and regions that hold the truth, where the plate is not "
        "refused:",
        "",
        "| | plates, refused | chi², median (most) | not explained | held-out error, unexplained | "
        "springs | dampers | gains, phases | frequencies | places | mass | fields | "
        "processor time |",
        "|---|---|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for kind in _kinds(outcomes):
        every = [each for each in outcomes if each.kind == kind]
        own = [each for each in every if not each.refusal]
        chi2 = np.array([each.chi2 for each in own])
        held = np.median([[each.held_out, each.unexplained] for each in own], axis=0)
        refused = len(every) - len(own)
        beyond = sum(not each.is_explained for each in own)
        seconds = np.median([each.seconds for each in own])
        own = [each for each in own if each.is_explained]
        shares = [
            _share(own, "stiffness"),
            _share(own, "damping"),
            _share(own, "gain", "phase"),
            _share(own, "frequency"),
            _share(own, "place"),
            _share(own, "mass"),
            f"{100 * share_in_region(np.concatenate([each.fields for each in own])):.0f} %",
        ]
        lines.append(
            f"| {NAMES[kind]} | {len(every)}, {refused} | {np.median(chi2):.2f} "
            f"({chi2.max():.2f}) | {beyond} | {100 * held[0]:.1f}, {100 * held[1]:.1f} % | "
            f"{' | '.join(shares)} | {seconds:.1f} s |"
        )
    return "\n".join(lines)


def _kinds(outcomes: Sequence[Outcome]) -> list[str]:
    return [kind for kind in SETS if any(each.kind == kind for each in outcomes)]


def _cell(outcomes: Sequence[Outcome], way: str, loaded: bool, quiet: int) -> str:
    values = [c for each in outcomes for c in each.contrasts[way, loaded, quiet]]
    return f"{np.median(values):.1f} ({np.percentile(values, 10):.1f})"


def _share(outcomes: Sequence[Outcome], *kinds: str) -> str:
    errors = [each.errors[kind] for each in outcomes for kind in kinds if kind in each.errors]
    return f"{100 * share_within(np.concatenate(errors)):.0f} %" if errors else "–"


if __name__ == "__main__":
    main()
