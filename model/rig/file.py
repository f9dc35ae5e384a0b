"""Reading a rig from its file, and refusing every rig that could not work."""

from pathlib import Path
from typing import Any

from model.arguments import expect_path, shown
from model.config.document import Document, parse_document, read_document
from model.config.sections import Validation
from model.errors import InputError
from model.rig.checks import check_across
from model.rig.parts import era_of, laminate_of, limits_of, mass_of, mesh_of, plate_of
from model.rig.rig import Channel, Rig
from model.rig.sections import RigSection


def load_rig(path: Path | str, *, mesh: str | None = None) -> Rig:
    """Read a rig file; mesh, `auto` or NXxNY, stands in place of the file's own.

    Raises ConfigError with every problem of the file; InputError for a mesh that is none. A mesh
    asked for here may be as coarse as is wanted: how wrong it then is may be the question.
    """
    if mesh is not None and not isinstance(mesh, str):
        raise InputError(f"mesh is {shown(mesh)}; give text, such as mesh='48x36', or 'auto'")
    return rig_of(read_document(expect_path(path, what="path")), mesh=mesh)


def parse_rig(source: str, text: str) -> Rig:
    """Read the text of a rig file that came from a source; raises ConfigError."""
    return rig_of(parse_document(source, text))


def rig_of(document: Document, *, mesh: str | None = None) -> Rig:
    """Make the rig of a document, with another mesh if one is given; raises as `load_rig`."""
    validation = Validation(document, RigSection)
    check_across(validation, mesh_given=mesh is not None)
    section = validation.finish()
    plate = plate_of(section.plate)
    wanted = section.mesh if mesh is None else mesh
    return Rig(
        plate=plate,
        mesh=mesh_of(wanted, plate, frequency_max=section.limits.frequency[1]),
        eras=tuple(
            era_of(name, era, plate, era_count=len(section.eras))
            for name, era in section.eras.items()
        ),
        wiring={name: Channel(era.amplifier, era.channel) for name, era in section.eras.items()},
        amplifiers={name: amplifier.url for name, amplifier in section.amplifiers.items()},
        limits=limits_of(section.limits),
        masses=tuple(mass_of(mass, plate) for mass in section.masses.values()),
        laminate=laminate_of(section.plate),
    )


def rig_schema() -> dict[str, Any]:
    """The JSON schema of a rig file, for editors."""
    schema = {"$schema": "https://json-schema.org/draft/2020-12/schema"}
    return schema | RigSection.model_json_schema() | {"title": "A rig of era-haptics"}


def example_rig_path() -> Path:
    """Where the commented rig of the paper's plate lies.

    A wheel carries it in the model's data; a checkout has it in its examples only.
    """
    here = Path(__file__).parents[1]
    installed = here / "data" / "paper_plate.yaml"
    return installed if installed.exists() else here.parent / "examples" / "paper_plate.yaml"
