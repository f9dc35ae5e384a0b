"""Reading a rig from its file."""

import math
from pathlib import Path

from model.config.document import Document, parse_document, read_document
from model.config.fields import Validation
from model.config.file_kinds import check_is_rig
from model.errors import InputError, expect_path, shown
from model.rig.checks import check_across
from model.rig.meshes import mesh_of
from model.rig.parts import (
    fingertip_of,
    laminate_of,
    limits_of,
    masses_of,
    plate_of,
    supports_of,
    uncertainty_of,
)
from model.rig.rig import Channel, Rig
from model.rig.sections import RigSection


def load_rig(path: Path | str, *, mesh: str | None = None) -> Rig:
    """Read a rig file; mesh: `auto` or NXxNY, replaces that of the file.

    Raises ConfigError with all problems of the file; InputError for an invalid mesh. The mesh given
    here may be coarser than a file's, to study its error.

    Example:
        >>> rig = era.load_rig("examples/paper_plate.yaml")
        >>> [each.name for each in rig.eras]
        ['SW', 'SE', 'NE', 'NW']
    """
    if mesh is not None and not isinstance(mesh, str):
        raise InputError(f"mesh must be text such as '48x36' or 'auto', got {shown(mesh)}")
    return rig_of(read_document(expect_path(path, what="path")), mesh=mesh)


def parse_rig(source: str, text: str) -> Rig:
    """Read the text of a rig file that came from a source; raises ConfigError."""
    return rig_of(parse_document(source, text))


def rig_of(document: Document, *, mesh: str | None = None) -> Rig:
    """Make the rig of a document, with another mesh if one is given; raises as `load_rig`."""
    if "plate" not in document.data:
        check_is_rig(document)
    validation = Validation(document, RigSection)
    check_across(validation, mesh_given=mesh is not None)
    section = validation.finish()
    if mesh is not None:
        document = Document(document.source, "", document.data | {"mesh": mesh}, {})
    plate = plate_of(section.plate, frequency_max=section.limits.frequency[1])
    wanted = section.mesh if mesh is None else mesh
    everything = {
        name: era.made(name, plate, len(section.eras)) for name, era in section.eras.items()
    }
    wiring = {
        name: Channel(era.amplifier, era.channel)
        for name, era in section.eras.items()
        if era.amplifier is not None and era.channel is not None
    }
    electrical = {era.amplifier for era in section.eras.values() if era.is_electrical}
    supports = {name: era for name, era in everything.items() if name not in wiring}
    return Rig(
        plate=plate,
        mesh=mesh_of(
            wanted,
            plate,
            frequency_max=section.limits.frequency[1],
            stiffness=max(era.in_time.stiffness for era in everything.values()),
            foot=min(era.foot for era in everything.values()),
        ),
        eras=tuple(era for name, era in everything.items() if name in wiring),
        wiring=wiring,
        amplifiers={name: amplifier.url for name, amplifier in section.amplifiers.items()},
        limits=limits_of(section.limits),
        masses=(
            *(each for mass in section.masses.values() for each in masses_of(mass, plate)),
            *(each for foot in section.supports.values() for each in supports_of(foot, plate)),
            *(era.support for era in supports.values()),
        ),
        supports=tuple(supports),
        laminate=laminate_of(section.plate),
        uncertainty=uncertainty_of(section.uncertainty, section.supports.values()),
        fingertip=fingertip_of(section.fingertip),
        threshold=section.threshold,
        promised_thresholds=tuple(section.promised_thresholds),
        outputs=frozenset(
            name
            for name, amplifier in section.amplifiers.items()
            if (amplifier.full_level or ("motion", "output")[name in electrical]) == "output"
        ),
        clock_errors={
            name: math.inf if amplifier.clock_error == "unknown" else amplifier.clock_error
            for name, amplifier in section.amplifiers.items()
        },
        document=document,
    )


def example_rig_path() -> Path:
    """The path of the commented rig of the paper's plate.

    Example:
        >>> era.example_rig_path().name
        'paper_plate.yaml'
    """
    here = Path(__file__).parents[1]  # a wheel has it in the model's data
    installed = here / "data" / "paper_plate.yaml"
    return installed if installed.exists() else here.parent / "examples" / "paper_plate.yaml"
