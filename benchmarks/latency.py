"""From a touch datagram to the last byte of the command on the wire, measured from outside.

    python -m benchmarks.latency [--touches 100000] [--seed 1] [--report | --check]

The daemon, the amplifier behind a pseudo-terminal, the panel and whoever disturbs them are
processes of their own (`benchmarks.latency_run`). Leave the machine alone meanwhile, some ten
minutes. With --report, docs/latency.md and its picture are written as well. With --check only taps
at 100 Hz are measured, and what was measured is printed as JSON: for tests.
"""

import argparse
import json
import os
import sys
import tempfile
from pathlib import Path


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--touches", type=int, default=100_000)
    parser.add_argument("--seed", type=int, default=1)
    purpose = parser.add_mutually_exclusive_group()
    purpose.add_argument("--report", action="store_true")
    purpose.add_argument("--check", action="store_true")
    options = parser.parse_args()
    for variable in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ[variable] = "1"  # before numpy loads: with two threads the daemon would compete

    from benchmarks.latency_report import as_json, cases, check_case, lines, write_report
    from benchmarks.latency_run import Disturbed, measure
    from model.rig_file import example_rig_path, load_rig
    from model.table_cache import cached_table
    from model.table_file import save_table

    table, _ = cached_table(load_rig(example_rig_path()))
    found = []
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "table.npz"
        save_table(table, file)
        try:
            if options.check:
                case = check_case(options.touches, options.seed)
                print(json.dumps(as_json(measure(case, file, table))))
                return
            for case in cases(options.touches, options.seed):
                found.append(measure(case, file, table))
                print(lines(found[-1:], first=len(found) == 1), flush=True)
        except Disturbed as error:
            sys.exit(f"{error}\nLeave the machine alone while this measures, and begin anew.")
    if options.report:
        write_report(found, touches=options.touches, seed=options.seed)


if __name__ == "__main__":
    main()
