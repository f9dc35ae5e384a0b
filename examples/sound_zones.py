"""Compare two methods of personal sound zones with the library's own, on drawn plates.

    python examples/sound_zones.py        pairs of fingers on the paper's plate
    python examples/sound_zones.py DIR    entries for the contrast benchmark exported into DIR

One finger should feel a vibration, the others nothing: a bright and a dark zone.
"""

import json
import sys
from pathlib import Path

import numpy as np

import era_haptics as era

LEVEL_DB_SL = 20
FEW, MANY = 20, 60  # plates that methods may use, seeds from 1000 on
JUDGES = range(40)  # seeds of others
# A fingertip, as the library has it: rings of points, their radius [m], a point's share in a mean.
RINGS = [(1, 0.0, 1 / 6), (8, 0.013 * 0.5**0.5, 1 / 12), (12, 0.013, 1 / 72)]
TURNS = np.concatenate([radius * np.exp(2j * np.pi * np.arange(n) / n) for n, radius, _ in RINGS])
SHARES = np.concatenate([np.full(n, share) for n, _, share in RINGS])


# The methods: fields (frequencies, ERAs, points) of both zones -> weights (frequencies, ERAs).
def contrast_control(bright, dark, loading=1e-3):
    """Acoustic contrast control: the largest power in the bright zone over that in the dark one.

    Its weights are a principal eigenvector (Choi and Kim, J. Acoust. Soc. Am. 111, 2002, 1695).
    """
    bright, dark = (zone.conj() @ zone.swapaxes(1, 2) for zone in (bright, dark))
    floor = loading * np.trace(dark, axis1=1, axis2=2)[:, None, None] * np.eye(dark.shape[1])
    values, vectors = np.linalg.eig(np.linalg.solve(dark + floor, bright))
    best = np.abs(values).argmax(axis=1)
    return np.take_along_axis(vectors, best[:, None, None], axis=2)[:, :, 0]


def pressure_matching(bright, dark, loading=1e-3):
    """Pressure matching: the field nearest to 1 in the bright zone and to 0 in the dark one.

    Its weights are regularised least squares (Poletti, 125th AES Convention, 2008).
    """
    zones = np.concatenate([bright, dark], axis=2)
    pressures = np.repeat([1.0, 0.0], [bright.shape[2], dark.shape[2]])
    power = zones.conj() @ zones.swapaxes(1, 2)
    floor = loading * np.trace(power, axis1=1, axis2=2)[:, None, None] * np.eye(power.shape[1])
    return np.linalg.solve(power + floor, zones.conj() @ pressures[:, None])[:, :, 0]


METHODS = {"contrast control": contrast_control, "pressure matching": pressure_matching}


# Inputs of the methods, and results of their weights.
def fields_of(plates, fingers):
    """Fields of each plate under the fingers, (plates, frequencies, ERAs, points)."""
    tip = np.column_stack([TURNS.real, TURNS.imag])
    points = np.concatenate([np.add(at, tip) for at in fingers])
    return np.array([plate.responses(points, fingers=fingers) for plate in plates])


def felt(weights, fields):
    """Amplitude [m/s²] at the first finger, and contrast [dB] to the loudest point of the others.

    Of weights (..., ERAs) and fields (..., ERAs, points).
    """
    size = np.abs(weights[..., None, :] @ fields)[..., 0, :]
    target = size[..., : len(SHARES)] @ SHARES
    return target, 20 * np.log10(target / size[..., len(SHARES) :].max(axis=-1))


def chosen(method, fields, thresholds, judged=None):
    """Return the frequency index and weights (ERAs,) with the most contrast among those with the
    level.

    Level and contrast are those of 90 % of plates, for the largest weight at full stroke. judged:
    fields for the evaluation, default the fields for the weights.
    """
    zones = np.concatenate(fields, axis=2).reshape(*fields.shape[1:3], len(fields), -1)
    bright, dark = np.split(zones, [len(SHARES)], axis=3)
    weights = method(*(zone.reshape(*zone.shape[:2], -1) for zone in (bright, dark)))
    weights /= np.abs(weights).max(axis=1, keepdims=True)
    target, contrast = np.percentile(
        felt(weights, fields if judged is None else judged), 10, axis=1
    )
    contrast[20 * np.log10(target / thresholds) < LEVEL_DB_SL] = -np.inf
    return contrast.argmax(), weights[contrast.argmax()]


def ours(table, fingers):
    """The same of the library's answer, for the first finger."""
    layer = era.query(table, fingers[0], quiet=fingers[1:], level_db_sl=LEVEL_DB_SL).layers[0]
    drives = table.drive_of(layer.excitation)
    phases = {name: 1j * np.radians(drive["phase_deg"]) for name, drive in drives.items()}
    weights = [drives[e.name]["level"] * np.exp(phases[e.name]) for e in table.eras]
    return np.abs(table.frequencies - layer.frequency).argmin(), np.array(weights)


def plates_of(rig, *counts):
    """What methods may know of the rig's plate: the nominal one, or some that are drawn."""
    drawn = [era.SolvedPlate(rig, seed=seed) for seed in range(1000, 1000 + max(counts))]
    known = {f"{count} drawn plates": drawn[:count] for count in counts}
    return {"nominal plate": [era.SolvedPlate(rig)], **known}


def by_method(fields, thresholds):
    """Return frequency index and weights by method name and known fields."""
    return {
        f"{name}, {of}": chosen(method, some, thresholds)
        for name, method in METHODS.items()
        for of, some in fields.items()
    }


def compare(pairs):
    """Return the contrast [dB] on 90 % of the evaluation plates for each pair of fingers, by
    method."""
    rig = era.load_rig(era.example_rig_path())
    table, plates, found = era.table(rig), plates_of(rig, FEW, MANY), {}
    judges = [era.SolvedPlate(rig, seed=seed) for seed in JUDGES]
    for fingers in pairs:
        judged = fields_of(judges, fingers)
        fields = {of: fields_of(some, fingers) for of, some in plates.items()}
        many = fields.pop(f"{MANY} drawn plates")
        rows = {"era-haptics": ours(table, fingers), **by_method(fields, table.thresholds)}
        nominal, few = fields.values()
        for name, weighed, tried in (
            (f"nominal weights, frequency of {FEW}", nominal, few),
            (f"weights of {FEW}, nominal frequency", few, nominal),
            (f"weights and frequency of {MANY}", many, many),
        ):
            rows[f"contrast control, {name}"] = chosen(
                contrast_control, weighed, table.thresholds, tried
            )
        for name, (frequency, weights) in rows.items():
            contrast = felt(weights, judged[:, frequency])[1]
            found.setdefault(name, []).append(np.percentile(contrast, 10))
    return found


def write_entries(folder):
    """Write an entry per method and known fields, for `python -m benchmarks.contrast`."""
    document, patterns = json.loads((folder / "localization-1.json").read_text("utf-8")), {}
    for plate, content in document["plates"].items():
        rig = era.load_rig(folder / f"{plate}.yaml")
        table, plates = era.table(rig), plates_of(rig, FEW)
        for place, fingers in content["sets"].items():
            fields = {of: fields_of(some, fingers) for of, some in plates.items()}
            for name, (row, weights) in by_method(fields, table.thresholds).items():
                patterns.setdefault(name, {})[place] = {
                    e.name: [table.frequencies[row], min(abs(w), 1), np.degrees(np.angle(w))]
                    for e, w in zip(rig.eras, weights, strict=True)
                }
    for name, each in patterns.items():
        entry = {"benchmark": "era-localization", "version": 1, "name": name, "patterns": each}
        file = folder / f"{name.replace(',', '').replace(' ', '-')}.json"
        file.write_text(json.dumps(entry), "utf-8")
        print(f"wrote {file}")


def pairs_of_fingers(count=20):
    """Pairs of fingers at least 5 cm apart, 13 mm from the edges of the paper's plate."""
    rng = np.random.default_rng(0)
    drawn = rng.uniform([0.013, 0.013], [0.2918, 0.2156], size=(2 * count, 2, 2))
    return drawn[np.linalg.norm(drawn[:, 0] - drawn[:, 1], axis=1) >= 0.05][:count].tolist()


if __name__ == "__main__":
    if sys.argv[1:]:
        write_entries(Path(sys.argv[1]))
    else:
        contrasts = compare(pairs_of_fingers())
        for name, each in contrasts.items():
            less = np.mean(np.subtract(each, contrasts["era-haptics"]))
            print(f"{name:55} {np.median(each):5.1f} dB {less:+5.1f} dB")
