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
from itertools import product

from benchmarks.page import write_parts
from benchmarks.setting import RIG, use_one_thread


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
    use_one_thread()

    from benchmarks.identification.answers import table_of
    from benchmarks.identification.hidden import FAMILY, draw
    from benchmarks.identification.plates import FREQUENCIES, outcome
    from benchmarks.identification.tables import PAGE, contrasts, fits, kept_or_refused, promises
    from model.rig.rig_file import load_rig

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


if __name__ == "__main__":
    main()
