"""Rig files written again with other values."""

from dataclasses import replace
from pathlib import Path

from model.config.document import parse_document
from model.rig.file import rig_of
from model.rig.rewritten import rewritten_text

RIG = Path(__file__).parents[3] / "examples" / "desk" / "rig.yaml"


def test_gains_are_rewritten_wherever_yaml_wraps_the_line() -> None:
    """An ERA of several short lines becomes a long one; some lengths break it at its gains."""
    lines = RIG.read_text("utf-8").splitlines()
    text = "\n".join(line for line in lines if not line.startswith("#"))
    text = text.replace("main", 32 * "m")
    for zeros in range(8, 29, 4):
        longer = text.replace(
            "0.05, bolt_mass: 0, stroke: 100 um", f"0.05,\n     stroke: 0.0001{zeros * '0'}"
        )
        document = parse_document("rig.yaml", longer)
        rig = rig_of(document)
        gains = ((50.0, 1.25, 0.5), (60.0, 1.5, 0.25))
        eras = tuple(
            replace(era, x=0.99 * era.x + 0.0005678, stiffness=1.0123 * era.stiffness, gains=gains)
            for era in rig.eras
        )
        after = rewritten_text(document, rig, replace(rig, eras=eras), comment="measured")
        read = rig_of(parse_document("new.yaml", after))
        assert [[row[0] for row in era.gains] for era in read.eras] == [[50.0, 60.0]] * 4
