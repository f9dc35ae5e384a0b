"""`era measure --from`: responses from files of a stepped sine."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sim.desk.measuring.desk import Desk


def measured_from(source: Path, desk: "Desk", output: Path) -> tuple[list[str], dict[str, Any]]:
    """Read files of a stepped sine, write responses, and return the report; raises InputError."""
    from model.calibration.responses import responses_of
    from model.calibration.responses_file import write_responses
    from model.counting import counted
    from sim.desk.measuring.stepped_file import read_stepped

    found = responses_of(read_stepped(source, desk), desk.rig)
    write_responses(output, found, desk.rig)
    absent = [each.name for each in desk.sensors if each.name not in found.sensors]
    lines = found.frequencies
    count = found.values.size - found.count
    rows = [
        f"{source}: {counted(len(found.sensors), 'sensor')}, "
        f"{counted(len(lines), 'frequency', plural='frequencies')} from {lines[0]:g} to "
        f"{lines[-1]:g} Hz, {counted(found.count, 'value')}",
    ]
    if count:
        rows.append(f"{counted(count, 'value')} missing, or not settled and left out")
    if absent:
        rows.append(f"without {', '.join(absent)}")
    rows.append(f"wrote {output}")
    return rows, {
        "frequencies_hz": lines.tolist(),
        "sensors": [*found.sensors],
        "without": absent,
        "values": found.count,
        "values_missing": count,
        "files": [str(output)],
    }
