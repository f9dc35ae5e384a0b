"""The table of docs/how-to/rig-check.md: every kind of finding, and when it is found."""

from model.estimate.findings import FINDING_KINDS


def finding_kinds() -> str:
    """Return each kind, what it is about, and its criterion."""
    rows = [f"| {name} | {each.about} | {each.criterion} |" for name, each in FINDING_KINDS.items()]
    return "\n".join(["| finding | of | criterion |", "|---|---|---|", *rows])
