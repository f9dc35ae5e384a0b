"""How long a run of conformance takes on each wire, in virtual time.

    python -m benchmarks.conformance [--reply MS]

Of a simulated amplifier; --reply: time from a request to its reply on the line. Printed are the
duration of all checks [s] and how many have no verdict.
"""

import argparse
from typing import Any

from benchmarks.setting import support
from era_haptics.lab.conformance.judge_client import TooLate

virtual_lines: Any = support("kit.clock")


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.conformance")
    parser.add_argument("--reply", type=float, default=0.4)
    virtual_lines.DELAY = parser.parse_args().reply / 2000
    for kind, name in virtual_lines.PROTOCOLS.items():
        results = virtual_lines.judged(kind)
        late = sum(isinstance(each.finding, TooLate) for each in results)
        print(f"{name:11} {sum(each.seconds for each in results):5.1f} s, {late} without a verdict")


if __name__ == "__main__":
    main()
