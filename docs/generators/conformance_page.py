"""The table of checks on docs/reference/conformance.md, from `era_haptics.lab.conformance`."""

from era_haptics.lab.conformance.check import ConformanceCheck
from era_haptics.lab.conformance.contract import CHECKS

_WIRES = {"serial": "serial", "rtu": "Modbus RTU", "tcp": "Modbus TCP", "can": "CAN"}


def _row(check: ConformanceCheck) -> str:
    anchor = check.place.partition("#")[2]
    rule = f"[{anchor.replace('-', ' ')}]({check.place})"
    wires = ", ".join(_WIRES[kind] for kind in check.kinds) or "all"
    return f"| `{check.name}` | {check.title} | {rule} | {wires} |"


def checks() -> str:
    """Return a row for each check, in the order of execution."""
    head = ("| check | stimulus: required reaction | rule | wires |", "|---|---|---|---|")
    return "\n".join((*head, *map(_row, CHECKS)))
