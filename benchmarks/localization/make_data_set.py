"""Write the data set of the contrast benchmark.

    python -m benchmarks.localization.make_data_set

Contact sets: fingertips anywhere on the plate but 13 mm from its edges, at least 5 cm apart, the
first one the target. Another data set is another version: a new file, and a new checksum.
"""

import json
from pathlib import Path

import numpy as np

from benchmarks.contrast.data_set import FILE, checksum
from benchmarks.setting import random_contacts
from model.rig.file import load_rig

EXAMPLES = Path(__file__).parents[2] / "examples"
PLATES = ("paper_plate", "eight_eras", "car_display", "table")
SETS, QUIET = 10, (1, 2, 3)
MARGIN = 0.013  # m; so that a fingertip lies on the plate


def main() -> None:
    rng = np.random.default_rng(2026)
    plates = {}
    for name in PLATES:
        file = EXAMPLES / f"{name}.yaml"
        plate = load_rig(file).plate
        sets = {}
        for quiet in QUIET:
            for number in range(SETS):
                places = random_contacts(rng, 1 + quiet, (plate.length, plate.width), margin=MARGIN)
                sets[f"{name}/{quiet}-{number:02d}"] = np.round(places, 4).tolist()
        plates[name] = {"rig": file.read_text(encoding="utf-8"), "sets": sets}
    document = {
        "benchmark": "era-localization",
        "version": 1,
        "level_db_sl": 20.0,
        "held_out": {"draws": 200, "seed": 71, "seeds_in_time": [7101, 7102, 7103]},
        "plates": plates,
    }
    FILE.write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")
    print(f"wrote {FILE}, sha256 {checksum()}")


if __name__ == "__main__":
    main()
