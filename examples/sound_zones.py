"""Compare two methods for personal sound zones with era-haptics on randomly drawn plates.

    python examples/sound_zones.py        pairs of fingers on the paper's plate
    python examples/sound_zones.py DIR    entries for the contrast benchmark exported into DIR

One finger should feel a vibration (bright zone), the others nothing (dark zone).
"""

import json
import sys
from collections import defaultdict
from pathlib import Path

import numpy as np

import era_haptics as era

LEVEL_DB_SL = 20
FEW = 20  # drawn plates that a method may use
MANY = 60
FIRST_SEED = 1000  # of the drawn plates
EVALUATION_SEEDS = range(40)  # of the plates on which all methods are compared
# The library's fingertip: rings of points, with their radius [m] and the weight of a point.
RINGS = [(1, 0.0, 1 / 6), (8, 0.013 * 0.5**0.5, 1 / 12), (12, 0.013, 1 / 72)]
OFFSETS = np.concatenate([radius * np.exp(2j * np.pi * np.arange(n) / n) for n, radius, _ in RINGS])
POINT_WEIGHTS = np.concatenate([np.full(n, weight) for n, _, weight in RINGS])


# The methods: fields (frequencies, ERAs, points) of both zones -> weights (frequencies, ERAs).
def contrast_control(bright, dark, loading=1e-3):
    """Acoustic contrast control: maximize the power ratio of bright and dark zone.

    The weights are the principal eigenvector (Choi and Kim, J. Acoust. Soc. Am. 111, 2002, 1695).
    """
    bright_power = bright.conj() @ bright.swapaxes(1, 2)
    dark_power = loaded(dark.conj() @ dark.swapaxes(1, 2), loading)
    values, vectors = np.linalg.eig(np.linalg.solve(dark_power, bright_power))
    best = np.abs(values).argmax(axis=1)
    return np.take_along_axis(vectors, best[:, None, None], axis=2)[:, :, 0]


def pressure_matching(bright, dark, loading=1e-3):
    """Pressure matching: approximate 1 in the bright zone and 0 in the dark zone.

    The weights are regularized least squares (Poletti, 125th AES Convention, 2008).
    """
    zones = np.concatenate([bright, dark], axis=2)
    desired = np.repeat([1.0, 0.0], [bright.shape[2], dark.shape[2]])
    power = loaded(zones.conj() @ zones.swapaxes(1, 2), loading)
    return np.linalg.solve(power, zones.conj() @ desired[:, None])[:, :, 0]


def loaded(power, loading):
    """Add a fraction of the trace to the diagonal of matrices (frequencies, ERAs, ERAs)."""
    trace = np.trace(power, axis1=1, axis2=2)
    return power + loading * trace[:, None, None] * np.eye(power.shape[1])


METHODS = {"contrast control": contrast_control, "pressure matching": pressure_matching}


# Inputs of the methods, and evaluation of their weights.
def fields_of(plates, fingers):
    """Return the field of each plate under the fingers (plates, frequencies, ERAs, points)."""
    fingertip = np.column_stack([OFFSETS.real, OFFSETS.imag])
    points = np.concatenate([np.add(finger, fingertip) for finger in fingers])
    return np.array([plate.responses(points, fingers=fingers) for plate in plates])


def evaluate(weights, fields):
    """Return amplitude [m/s²] at the first finger and contrast [dB] to the loudest other point.

    weights: (..., ERAs); fields: (..., ERAs, points).
    """
    amplitudes = np.abs(weights[..., None, :] @ fields)[..., 0, :]
    point_count = len(POINT_WEIGHTS)
    target = amplitudes[..., :point_count] @ POINT_WEIGHTS
    loudest = amplitudes[..., point_count:].max(axis=-1)
    return target, 20 * np.log10(target / loudest)


def best_frequency(method, fields, thresholds, evaluation_fields=None):
    """Return frequency index and weights (ERAs,) with the best contrast at a sufficient level.

    Level and contrast are reached by 90 % of plates, with the largest weight at full amplitude.
    evaluation_fields: fields for level and contrast; default: `fields`.
    """
    if evaluation_fields is None:
        evaluation_fields = fields
    frequency_count, era_count = fields.shape[1:3]
    zones = np.concatenate(fields, axis=2).reshape(frequency_count, era_count, len(fields), -1)
    bright, dark = np.split(zones, [len(POINT_WEIGHTS)], axis=3)
    weights = method(
        bright.reshape(frequency_count, era_count, -1),
        dark.reshape(frequency_count, era_count, -1),
    )
    weights /= np.abs(weights).max(axis=1, keepdims=True)
    target, contrast = np.percentile(evaluate(weights, evaluation_fields), 10, axis=1)
    contrast[20 * np.log10(target / thresholds) < LEVEL_DB_SL] = -np.inf
    best = contrast.argmax()
    return best, weights[best]


def library_weights(table, fingers):
    """Return frequency index and weights that era-haptics chooses for the first finger."""
    answer = era.query(table, fingers[0], quiet=fingers[1:], level_db_sl=LEVEL_DB_SL)
    layer = answer.layers[0]
    drives = table.drive_of(layer.excitation)
    weights = []
    for actuator in table.eras:
        drive = drives[actuator.name]
        weights.append(drive["level"] * np.exp(1j * np.radians(drive["phase_deg"])))
    return np.abs(table.frequencies - layer.frequency).argmin(), np.array(weights)


def plates_of(rig, *counts):
    """Return the plates that methods may use: the nominal plate, and sets of drawn plates."""
    seeds = range(FIRST_SEED, FIRST_SEED + max(counts))
    drawn = [era.SolvedPlate(rig, seed=seed) for seed in seeds]
    plates = {"nominal plate": [era.SolvedPlate(rig)]}
    for count in counts:
        plates[f"{count} drawn plates"] = drawn[:count]
    return plates


def by_method(fields, thresholds):
    """Return frequency index and weights by the name of the method and its plates."""
    results = {}
    for method_name, method in METHODS.items():
        for plates_name, plate_fields in fields.items():
            result = best_frequency(method, plate_fields, thresholds)
            results[f"{method_name}, {plates_name}"] = result
    return results


def compare(pairs):
    """Return, by method, the contrast [dB] on 90 % of the evaluation plates for each pair."""
    rig = era.load_rig(era.example_rig_path())
    table = era.table(rig)
    plates = plates_of(rig, FEW, MANY)
    evaluation_plates = [era.SolvedPlate(rig, seed=seed) for seed in EVALUATION_SEEDS]
    contrasts = defaultdict(list)
    for fingers in pairs:
        fields = {name: fields_of(drawn, fingers) for name, drawn in plates.items()}
        evaluation_fields = fields_of(evaluation_plates, fingers)
        for name, (frequency, weights) in all_weights(table, fingers, fields).items():
            contrast = evaluate(weights, evaluation_fields[:, frequency])[1]
            contrasts[name].append(np.percentile(contrast, 10))
    return contrasts


def all_weights(table, fingers, fields):
    """Return frequency index and weights of the library, the methods and their variants."""
    nominal = fields["nominal plate"]
    few = fields[f"{FEW} drawn plates"]
    many = fields[f"{MANY} drawn plates"]
    results = {"era-haptics": library_weights(table, fingers)}
    without_many = {name: field for name, field in fields.items() if field is not many}
    results.update(by_method(without_many, table.thresholds))
    variants = {
        f"nominal weights, frequency of {FEW}": (nominal, few),
        f"weights of {FEW}, nominal frequency": (few, nominal),
        f"weights and frequency of {MANY}": (many, many),
    }
    for name, (weight_fields, frequency_fields) in variants.items():
        results[f"contrast control, {name}"] = best_frequency(
            contrast_control, weight_fields, table.thresholds, frequency_fields
        )
    return results


def write_entries(folder):
    """Write a benchmark entry per method and set of plates, for `python -m benchmarks.contrast`."""
    document = json.loads((folder / "localization-1.json").read_text("utf-8"))
    patterns = defaultdict(dict)
    for plate_name, content in document["plates"].items():
        rig = era.load_rig(folder / f"{plate_name}.yaml")
        table = era.table(rig)
        plates = plates_of(rig, FEW)
        for set_name, fingers in content["sets"].items():
            fields = {name: fields_of(drawn, fingers) for name, drawn in plates.items()}
            for name, (row, weights) in by_method(fields, table.thresholds).items():
                pattern = pattern_of(rig, table.frequencies[row], weights)
                patterns[name][set_name] = pattern
    for name, method_patterns in patterns.items():
        entry = {
            "benchmark": "era-localization",
            "version": 1,
            "name": name,
            "patterns": method_patterns,
        }
        file = folder / f"{name.replace(',', '').replace(' ', '-')}.json"
        file.write_text(json.dumps(entry), "utf-8")
        print(f"wrote {file}")


def pattern_of(rig, frequency, weights):
    """Return frequency [Hz], level and phase [degrees] of each ERA."""
    pattern = {}
    for actuator, weight in zip(rig.eras, weights, strict=True):
        level = min(abs(weight), 1)
        pattern[actuator.name] = [frequency, level, np.degrees(np.angle(weight))]
    return pattern


def random_pairs(count=20):
    """Return pairs of fingers at least 5 cm apart, 13 mm from the edges of the paper's plate."""
    rng = np.random.default_rng(0)
    pairs = rng.uniform([0.013, 0.013], [0.2918, 0.2156], size=(2 * count, 2, 2))
    distances = np.linalg.norm(pairs[:, 0] - pairs[:, 1], axis=1)
    return pairs[distances >= 0.05][:count].tolist()


if __name__ == "__main__":
    if sys.argv[1:]:
        write_entries(Path(sys.argv[1]))
    else:
        contrasts = compare(random_pairs())
        for name, values in contrasts.items():
            difference = np.mean(np.subtract(values, contrasts["era-haptics"]))
            print(f"{name:55} {np.median(values):5.1f} dB {difference:+5.1f} dB")
