"""Every planted fault on every wire that can have it, under the check that must find it.

    python tests/support/conformance_faults.py

Prints what was not found; exit status 1 if there is any.
"""

import sys
from collections import Counter

from conformance_bench import result_of
from drivers.conformance import Result
from paper_plate import make_paper_rig
from planted_faults import FAULTS, UNSEEN


def main() -> int:
    """Run all."""
    rig = make_paper_rig(12, 9)
    found: Counter[str] = Counter()
    missed = 0
    for name, fault in FAULTS.items():
        for wire in fault.wires:
            result = result_of(fault, wire, rig)
            if result.result is Result.FAILED:
                found[wire] += 1
            else:
                missed += 1
                print(f"not found on {wire}: {name} ({fault.check} {result.result.value})")
    for wire, count in found.items():
        print(f"{wire}: {count} faults found")
    for name, fault in UNSEEN.items():
        print(f"not to be seen: {name}; {fault.unseen}")
    return 1 if missed else 0


if __name__ == "__main__":
    sys.exit(main())
