"""Reading a rig from its file, and refusing every rig that could not work."""

import math
import re
from pathlib import Path
from typing import Any

from model.actuator import Era, damping_from_ratio
from model.config import Validation
from model.document import key_name, read_document
from model.errors import InputError
from model.mesh import Mesh
from model.plate import Material, Plate
from model.rig import Channel, Limits, Rig
from model.rig_sections import EraSection, LimitsSection, PlateSection, RigSection

# Below six bilinear elements a wave, the wave itself is lost, not only its finer amplitude.
_FEWEST_ELEMENTS_PER_WAVELENGTH = 6
_MOST_ELEMENTS_PER_SIDE = 1000
# Two bolts cannot be closer; also how far off its edge rounding may put a bolt.
_SAME_POINT = 1e-6


def load_rig(path: Path | str, *, mesh: str | None = None) -> Rig:
    """Read a rig file; mesh, `auto` or NXxNY, stands in place of the file's own.

    Raises ConfigError with every problem of the file; InputError for a mesh that is none. A mesh
    asked for here may be as coarse as is wanted: how wrong it then is may be the question.
    """
    document = read_document(Path(path))
    validation = Validation(document, RigSection)
    _check_across(validation, mesh_given=mesh is not None)
    validation.finish()
    section = RigSection.model_validate(document.data)
    plate = _plate(section.plate)
    low, high = section.limits.frequency
    wanted = section.mesh if mesh is None else mesh
    return Rig(
        plate=plate,
        mesh=_mesh(wanted, plate, frequency_max=high),
        eras=tuple(
            _era(name, era, plate, era_count=len(section.eras))
            for name, era in section.eras.items()
        ),
        wiring={name: Channel(era.amplifier, era.channel) for name, era in section.eras.items()},
        amplifiers={name: amplifier.url for name, amplifier in section.amplifiers.items()},
        limits=Limits(frequency_min=low, frequency_max=high, level=section.limits.level),
    )


def parse_mesh(text: str, plate: Plate) -> Mesh:
    """The mesh `NXxNY` over a plate; raises InputError for what is none or beyond all reason."""
    match = re.fullmatch(r"\s*(\d{1,6})\s*[xX×]\s*(\d{1,6})\s*", text, re.ASCII)
    if match is None:
        raise InputError(
            f"mesh {text[:40]!r} is not understood; write the number of elements along x and y, "
            "for example 48x36"
        )
    nx, ny = (int(count) for count in match.groups())
    if not 1 <= min(nx, ny) <= max(nx, ny) <= _MOST_ELEMENTS_PER_SIDE:
        raise InputError(
            f"mesh {nx}x{ny} cannot be used; each side takes 1 to {_MOST_ELEMENTS_PER_SIDE}"
            " elements"
        )
    return Mesh(nx=nx, ny=ny, length=plate.length, width=plate.width)


def rig_schema() -> dict[str, Any]:
    """The JSON schema of a rig file, for editors."""
    schema = {"$schema": "https://json-schema.org/draft/2020-12/schema"}
    return schema | RigSection.model_json_schema() | {"title": "A rig of era-haptics"}


def example_rig_path() -> Path:
    """Where the commented rig of the paper's plate lies.

    A wheel carries it beside this module; a checkout has it in its examples only.
    """
    here = Path(__file__).parent
    installed = here / "data" / "paper_plate.yaml"
    return installed if installed.exists() else here.parent / "examples" / "paper_plate.yaml"


def _plate(section: PlateSection) -> Plate:
    numbers = section.material
    return Plate(
        length=section.length,
        width=section.width,
        thickness=section.thickness,
        material=Material(numbers.name, E=numbers.E, rho=numbers.rho, nu=numbers.nu),
        loss_factor=section.loss_factor,
    )


def _era(name: str, section: EraSection, plate: Plate, *, era_count: int) -> Era:
    damping = section.damping
    if damping is None:
        damping = damping_from_ratio(
            section.damping_ratio,
            stiffness=section.stiffness,
            plate_mass=plate.mass,
            era_count=era_count,
        )
    x, y = section.at
    return Era(
        name=name,
        x=min(max(x, 0.0), plate.length),
        y=min(max(y, 0.0), plate.width),
        stiffness=section.stiffness,
        damping=damping,
        bolt_mass=section.bolt_mass,
        stroke=section.stroke,
    )


def _mesh(text: str, plate: Plate, *, frequency_max: float) -> Mesh:
    if text != "auto":
        return parse_mesh(text, plate)
    mesh = Mesh.auto(plate, frequency_max=frequency_max)
    if max(mesh.nx, mesh.ny) > _MOST_ELEMENTS_PER_SIDE:
        raise InputError(
            f"auto: this plate would need {mesh} elements up to {frequency_max:g} Hz, more than "
            f"{_MOST_ELEMENTS_PER_SIDE} a side; check its sizes, or lower limits.frequency"
        )
    return mesh


def _check_across(validation: Validation, *, mesh_given: bool) -> None:
    """Note what is wrong between sections, as far as these are in order by themselves."""
    plate_section = validation.part(("plate",), PlateSection)
    plate = None if plate_section is None else _plate(plate_section)
    if plate is not None and plate.thickness > min(plate.length, plate.width):
        validation.add(
            ("plate", "thickness"),
            f"{plate.thickness:g} m is more than the plate is wide; is it in mm? write "
            f"{plate.thickness:g} mm",
        )
    if plate is not None and not mesh_given:
        limits = validation.field(("limits", "frequency"), LimitsSection)
        _check_mesh(validation, plate, frequency_max=(limits or LimitsSection().frequency)[1])
    names = tuple(validation.mapping(("eras",)))
    _check_places(validation, names, plate)
    _check_wiring(validation, names)
    for name in names:
        if {"damping", "damping_ratio"} <= validation.mapping(("eras", name)).keys():
            validation.add(
                ("eras", name, "damping"), "stands beside damping_ratio; keep one of the two"
            )


def _check_mesh(validation: Validation, plate: Plate, *, frequency_max: float) -> None:
    text = validation.mapping(()).get("mesh", "auto")
    if not isinstance(text, str):
        return
    try:
        mesh = _mesh(text, plate, frequency_max=frequency_max)
    except InputError as error:
        validation.add(("mesh",), str(error))
        return
    size = plate.bending_wavelength(frequency_max) / _FEWEST_ELEMENTS_PER_WAVELENGTH
    nx, ny = math.ceil(plate.length / size), math.ceil(plate.width / size)
    if mesh.nx < nx or mesh.ny < ny:
        validation.add(
            ("mesh",),
            f"{mesh} is too coarse for bending waves at {frequency_max:g} Hz (limits.frequency): "
            f"at least {nx}x{ny} is needed, {_FEWEST_ELEMENTS_PER_WAVELENGTH} elements a "
            "wavelength; auto takes a mesh that is accurate",
        )


def _check_places(validation: Validation, names: tuple[str, ...], plate: Plate | None) -> None:
    placed: dict[str, tuple[float, float]] = {}
    for name in names:
        place = validation.field(("eras", name, "at"), EraSection)
        if place is None:
            continue
        x, y = place
        if plate is not None and not (
            -_SAME_POINT <= x <= plate.length + _SAME_POINT
            and -_SAME_POINT <= y <= plate.width + _SAME_POINT
        ):
            validation.add(
                ("eras", name, "at"),
                f"({x:g}, {y:g}) m is off the plate, which reaches from (0, 0) to "
                f"({plate.length:g}, {plate.width:g}) m; move the ERA onto it",
            )
        for other, taken in placed.items():
            if math.dist(taken, place) < _SAME_POINT:
                validation.add(
                    ("eras", name, "at"), f"is where ERA {other} is already; move one of them"
                )
        placed[name] = place


def _check_wiring(validation: Validation, names: tuple[str, ...]) -> None:
    amplifiers = validation.mapping(("amplifiers",))
    wired: dict[tuple[str, int], str] = {}
    for name in names:
        amplifier = validation.field(("eras", name, "amplifier"), EraSection)
        channel = validation.field(("eras", name, "channel"), EraSection)
        if amplifier is not None and amplifier not in amplifiers:
            known = ", ".join(key_name((key,)) for key in amplifiers) or "none"
            validation.add(
                ("eras", name, "amplifier"),
                f"unknown amplifier {amplifier}; known under amplifiers: {known}",
            )
        if amplifier is None or channel is None:
            continue
        other = wired.setdefault((amplifier, channel), name)
        if other != name:
            validation.add(
                ("eras", name, "channel"),
                f"{channel} of amplifier {amplifier} drives ERA {other} already; "
                "give each ERA its own channel",
            )
