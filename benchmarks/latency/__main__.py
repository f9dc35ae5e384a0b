"""Latency from a touch datagram to the last byte of the command on the wire.

    python -m benchmarks.latency [--seconds S] [--seed 1] [--report | --check WIRE]

The daemon, the amplifier, the panel and programs that load the machine are separate processes
(`benchmarks.latency.run`). It takes six minutes on an otherwise idle machine; a trial run with
--seconds 2 takes half of one. A disturbed case is repeated once; if that fails, too, the others
follow.

--report: write docs/measured/latency.md. --check: measure taps at 100 Hz only, over `tcp` or a
`pty`, and print the result as JSON.
"""

import argparse
import json
import sys
import tempfile
import time
from functools import partial
from pathlib import Path

from benchmarks.setting import use_one_thread


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.latency", description=__doc__)
    parser.add_argument(
        "--seconds", type=float, default=100.0, help="duration of the longest cases"
    )
    parser.add_argument("--seed", type=int, default=1)
    purpose = parser.add_mutually_exclusive_group()
    purpose.add_argument("--report", action="store_true")
    purpose.add_argument("--check", choices=("tcp", "pty"))
    options = parser.parse_args()
    use_one_thread()  # with two the daemon would compete

    from benchmarks.latency.report import (
        as_json,
        cases,
        check_case,
        lines,
        write_report,
    )
    from benchmarks.latency.run import Failed, Found, attempt, measure
    from model.rig.file import example_rig_path, load_rig
    from model.table.file import save_table
    from model.table.table_cache import cached_table

    seconds = options.seconds
    table, _ = cached_table(load_rig(example_rig_path()))
    found: list[Found | Failed] = []
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "table.npz"
        save_table(table, file)
        if options.check:
            checked = check_case(options.check, seconds, options.seed)
            one = attempt(checked, partial(measure, checked, file, table), attempts=1)
            if isinstance(one, Failed):
                sys.exit(f"no figures: {'; then: '.join(one.why)}")
            print(json.dumps(as_json(one)))
            return
        begun = time.monotonic()
        for case in cases(seconds, options.seed):
            found.append(attempt(case, partial(measure, case, file, table)))
            print(lines(found[-1:], first=len(found) == 1), flush=True)
        minutes = (time.monotonic() - begun) / 60
        print(f"{minutes:.1f} minutes")
    if options.report:
        write_report(found, seconds=seconds, seed=options.seed, minutes=minutes)
    failed = [each for each in found if isinstance(each, Failed)]
    if failed:
        sys.exit(f"no figures of {len(failed)} of {len(found)} cases: leave the machine alone")


if __name__ == "__main__":
    main()
