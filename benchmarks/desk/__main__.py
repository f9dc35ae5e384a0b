"""A desk without hardware: measured, calibrated, played and verified, on plates that deviate.

    python -m benchmarks.desk [--plates 10] [--promises 20] [--touches 6] [--report]
    python -m benchmarks.desk --identify-only [--plates 10] [--report]

Everything runs in processes of its own on a JACK server of the dummy driver:
`python -m benchmarks.desk_plate`, `era measure`, `era calibrate`, `era table build`,
`era table verify --device`, `era soft-amp`,
`era daemon`, `era rig identify --device`. Three minutes a plate on an idle machine. Exits with
status 1 unless 85 to 95 % of all promises are kept; of fewer than a hundred, unless four of five
are.
"""

import argparse
import json
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from benchmarks.desk.session import Identified, Outcome, chain, desk, errors_table, identify
from benchmarks.setting import write_parts

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "measured" / "desk.md"
RESULTS = ROOT / "out" / "desk.json"
_MANY = 100


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.desk", description=__doc__)
    parser.add_argument("--plates", type=int, default=10)
    parser.add_argument("--promises", type=int, default=20, help="on each plate")
    parser.add_argument("--touches", type=int, default=6, help="on each plate")
    parser.add_argument("--seed", type=int, default=1, help="of the first plate")
    parser.add_argument("--report", action="store_true", help=f"write {PAGE.relative_to(ROOT)}")
    parser.add_argument("--identify-only", action="store_true", help="nothing but identify")
    options = parser.parse_args()
    if options.identify_only:
        identify_only(range(options.seed, options.seed + options.plates), options.report)
        return
    found: list[Outcome] = []
    for seed in range(options.seed, options.seed + options.plates):
        found.append(chain(seed=seed, promises=options.promises, touched=options.touches))
        print(summary(found[-1]), flush=True)
        RESULTS.parent.mkdir(exist_ok=True)
        RESULTS.write_text(json.dumps([each.as_json() for each in found]), "utf-8")
        if options.report:
            write_parts(PAGE, tables(found))
    print("\n\n".join(tables(found).values()))
    kept = [row["kept"] for each in found for row in each.promises]
    share = float(np.mean(kept))
    low, high = (0.85, 0.95) if len(kept) >= _MANY else (0.8, 1.0)
    sys.exit(not low <= share <= high)


def identify_only(seeds: Sequence[int], is_reported: bool) -> None:
    """Identify plates, and write their part of the page if wanted."""
    found: list[Identified] = []
    for seed in seeds:
        with tempfile.TemporaryDirectory(prefix="desk") as name, desk(Path(name), seed=seed) as one:
            found.append(identify(one, seed=seed))
        print(f"plate {seed}: chi² {found[-1].chi2:.2f}", flush=True)
        if is_reported:
            write_parts(PAGE, {"identified": identified_tables(found)})
    print(identified_tables(found))


def identified_tables(found: Sequence[Identified]) -> str:
    """Errors of what was identified, and what else came of it."""
    chi2, held, measured, solved = (
        [getattr(each, key) for each in found]
        for key in ("chi2", "held_out_error", "measure_s", "solve_s")
    )
    rows = [
        "",
        f"| plates | {len(found)} |",
        "|---|---|",
        f"| chi² | {min(chi2):.2f} to {max(chi2):.2f} |",
        f"| tones left out predicted within / % | {100 * max(held):.1f} |",
        f"| measured in / s | {min(measured):.0f} to {max(measured):.0f} |",
        f"| computed in / s | {min(solved):.0f} to {max(solved):.0f} |",
    ]
    for quiet in (1, 2, 3):
        before, after, promised = (
            np.median(
                [row[key] for each in found for row in each.contrasts if row["quiet"] == quiet]
            )
            for key in ("before_db", "after_db", "promised_db")
        )
        rows.append(
            f"| contrast with {quiet} quiet / dB, medians | as written {before:.1f}, identified "
            f"{after:.1f}, promised {promised:.1f} |"
        )
    return "\n".join([errors_table([one for each in found for one in each.errors]), *rows])


def tables(found: Sequence[Outcome]) -> dict[str, str]:
    """The parts of the page."""
    return {
        "values": errors_table([one for each in found for one in each.errors]),
        "identified": identified_tables([each.identified for each in found]),
        "promises": promises_table(found),
        "touches": touches_table(found),
        "times": times_table(found),
    }


def summary(found: Outcome) -> str:
    kept = [row["kept"] for row in found.promises]
    felt = [each.measured_db >= each.promised_db for each in found.touches]
    return (
        f"plate {found.seed}: measured in {found.measure_s:.0f} s, {sum(kept)} of {len(kept)} "
        f"promises kept, {sum(felt)} of {len(felt)} touches at least as promised"
    )


def promises_table(found: Sequence[Outcome]) -> str:
    rows = [
        "| quiet sensors | patterns | kept | promised / dB, median | measured / dB, median "
        "| measured above promised / dB, 10 % and 90 % |",
        "|---|---|---|---|---|---|",
    ]
    everything = [row for each in found for row in each.promises]
    for name in ("1", "2", "3", "all"):
        some = [row for row in everything if name in ("all", str(len(row["quiet"])))]
        if some:
            promised = np.array([row["promised_contrast_db"] for row in some])
            measured = np.array([row["measured_contrast_db"] for row in some])
            low, high = np.percentile(measured - promised, [10, 90])
            rows.append(
                f"| {name} | {len(some)} | {100 * np.mean([row['kept'] for row in some]):.0f} % "
                f"| {np.median(promised):.1f} | {np.median(measured):.1f} | {low:.1f}, {high:.1f} |"
            )
    return "\n".join(rows)


def touches_table(found: Sequence[Outcome]) -> str:
    rows = [
        "| fingers | touches | at least as promised | promised / dB, median "
        "| measured / dB, median |",
        "|---|---|---|---|---|",
    ]
    everything = [one for each in found for one in each.touches]
    for fingers in sorted({one.fingers for one in everything}):
        some = [one for one in everything if one.fingers == fingers]
        kept = np.mean([one.measured_db >= one.promised_db for one in some])
        promised, measured = (
            np.median([getattr(one, key) for one in some]) for key in ("promised_db", "measured_db")
        )
        rows.append(
            f"| {fingers} | {len(some)} | {100 * kept:.0f} % | {promised:.1f} | {measured:.1f} |"
        )
    return "\n".join(rows)


def times_table(found: Sequence[Outcome]) -> str:
    def span(values: Sequence[float], digits: int) -> str:
        return f"{min(values):.{digits}f} to {max(values):.{digits}f}"

    return "\n".join(
        [
            f"| plates | {len(found)} |",
            "|---|---|",
            f"| `era measure` / s | {span([each.measure_s for each in found], 0)} |",
            f"| delay found / samples | {span([each.latency_samples for each in found], 2)} |",
            f"| runs repeated for lost blocks | {sum(each.repeated for each in found)} |",
            f"| lowest coherence | {min(each.coherence_min for each in found):.4f} |",
            "| held-out sensors predicted within / % "
            f"| {span([100 * each.held_out_error for each in found], 1)} |",
        ]
    )


if __name__ == "__main__":
    main()
