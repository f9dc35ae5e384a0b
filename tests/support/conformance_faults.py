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
    lines: list[str] = []
    for name, fault in FAULTS.items():
        for wire in fault.wires:
            result = result_of(fault, wire, rig)
            if result.result is Result.FAILED:
                found[wire] += 1
            else:
                lines.append(f"not found on {wire}: {name} ({fault.check} {result.result.value})")
    missed = len(lines)
    lines += [f"{wire}: {count} faults found" for wire, count in found.items()]
    lines += [f"not to be seen: {name}; {fault.unseen}" for name, fault in UNSEEN.items()]
    sys.stdout.write("\n".join([*lines, ""]))
    return 1 if missed else 0


if __name__ == "__main__":
    sys.exit(main())
