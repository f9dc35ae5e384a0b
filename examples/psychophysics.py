"""Measure what a person feels: detection threshold, and which of two fingers felt a vibration.

    pip install 'era-haptics[studies]'
    python examples/psychophysics.py OUT [--person] [--trials 40]

Every trial is a forced choice of two: the interval, or the finger, with the vibration. QUEST+
(Watson 2017) chooses its level. Without --person, a simulated observer answers from what its
fingertips feel on a simulated plate, in virtual time. With --person, you answer; a daemon must run,
and two fingers rest at POSITIONS. Writes the trials into the folder OUT, and a threshold set:

    ERA_HAPTICS_THRESHOLDS=OUT/thresholds era config check RIG      # RIG with `threshold: observer`
"""

import argparse
import csv
from contextlib import ExitStack
from pathlib import Path

import numpy as np
from questplus import QuestPlusWeibull

import era_haptics as era

POSITIONS = {"left": (0.08, 0.06), "right": (0.22, 0.16)}  # m
LEVELS = np.arange(-11.5, 20.0, 1.0)  # dB SL
PLAYED, PAUSE = 0.6, 0.3  # s
LAPSE = 0.02
OBSERVER = {"threshold": 3.0, "slope": 3.0}  # the simulated one
rng = np.random.default_rng(1)


def quest():
    """Return the search for threshold and slope."""
    return QuestPlusWeibull(
        intensities=LEVELS, thresholds=LEVELS, slopes=range(1, 7), lower_asymptotes=[0.5],
        lapse_rates=[LAPSE], responses=["right", "wrong"], stim_scale="dB",
    )  # fmt: skip


def stimulate(client, panel, finger, level):
    """Play at a finger, again if it was late; return the level that each finger feels [dB SL]."""
    points = [(0.0, 1.0, 0.5), (PLAYED, 1.0, 0.5)]
    while (played := client.play(points, POSITIONS[finger], level_db_sl=level)).start_s is None:
        print(f"again, because it was {played.outcome}: {played.reason}")
        client.sleep(1)
    client.sleep(PLAYED + PAUSE)
    if panel is None:
        return {}  # only the person knows
    felt = panel.felt(played.start_s + 0.25, played.start_s + 0.55)
    return {name: finger.level_db_sl for name, finger in zip(POSITIONS, felt, strict=True)}


def observe(choices):
    """Return the choice of the simulated observer, by the levels felt with each choice [dB SL]."""
    felt = []
    for name, level in choices.items():
        steepness = 10 ** (OBSERVER["slope"] * (level - OBSERVER["threshold"]) / 20)
        if rng.random() > np.exp(-steepness):
            felt.append(name)
    guesses = len(felt) != 1 or rng.random() < 2 * LAPSE  # half of the guesses are right
    return rng.choice([*choices]) if guesses else felt[0]


def trial(client, panel, task, level):
    """Run a trial; return whether the answer was right."""
    names = list(POSITIONS) if task == "localization" else ["1", "2"]
    answer = rng.choice(names)
    choices = dict.fromkeys(names, -np.inf)
    if task == "localization":
        choices |= stimulate(client, panel, answer, level)
    else:
        for name in names:
            if panel is None:
                print(f"  interval {name}", flush=True)
            if name == answer:
                choices[name] = stimulate(client, panel, "left", level).get("left", -np.inf)
            else:
                client.sleep(PLAYED + PAUSE)
    if panel is not None:
        return observe(choices) == answer
    return input(f"{task}, {' or '.join(names)}: ") == answer


def main():
    """Run both tasks; write the trials and the threshold set."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("out", type=Path)
    parser.add_argument("--person", action="store_true")
    parser.add_argument("--trials", type=int, default=40)
    arguments = parser.parse_args()
    (arguments.out / "thresholds").mkdir(parents=True, exist_ok=True)
    with ExitStack() as stack:
        rig = era.load_rig(era.example_rig_path())
        panel = None if arguments.person else stack.enter_context(era.simulated_panel(rig))
        client = panel.client if panel else stack.enter_context(era.Client.connect(name="study"))
        if panel is not None:
            stack.enter_context(client.resting([*POSITIONS.values()]))
        stack.enter_context(client.armed("study"))
        write = csv.writer(stack.enter_context((arguments.out / "trials.csv").open("w"))).writerow
        write(["task", "level_db_sl", "is_correct"])
        for task in ("localization", "detection"):
            search = quest()
            for _ in range(arguments.trials):
                level = float(search.next_intensity)
                is_correct = trial(client, panel, task, level)
                search.update(intensity=level, response="right" if is_correct else "wrong")
                write([task, level, int(is_correct)])
            weights = search.marginal_posterior["threshold"]
            threshold = search.param_estimate["threshold"]
            error = np.sqrt(weights @ (LEVELS - threshold) ** 2)
            print(f"{task}: threshold {threshold:.2f} +- {error:.2f} dB SL")
    hertz = np.geomspace(10, 1000, 41)
    shifted = era.detection_threshold(hertz, rig.threshold) * 10 ** (threshold / 20)
    rows = [f"{f:.6g},{a:.4g},shifted" for f, a in zip(hertz, shifted, strict=True)]
    text = "\n".join(["frequency_hz,threshold_m_s2_peak,basis", *rows])
    (arguments.out / "thresholds" / "observer.csv").write_text(text, "utf-8")


if __name__ == "__main__":
    main()
