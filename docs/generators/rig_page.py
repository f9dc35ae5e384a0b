"""The tables of keys in reference/rig.md, from the sections of a rig file."""

from collections.abc import Callable, Mapping
from functools import partial

from key_tables import key_table
from model.config.fields import Section
from model.rig import plate_sections, sections
from model.rig.actuator_keys import EraSection, ExciterSection
from model.structure.attachments import FEET, FOOT_LOSS
from model.structure.exciter import EXCITER_TYPES
from model.structure.material import KNOWN_MATERIALS

SECTIONS: Mapping[str, type[Section]] = {
    "rig": sections.RigSection,
    "plate": plate_sections.PlateSection,
    "surface": plate_sections.SurfaceSection,
    "layers": plate_sections.LayerSection,
    "air_gap": plate_sections.AirGapSection,
    "material": plate_sections.MaterialSection,
    "eras": EraSection,
    "exciters": ExciterSection,
    "masses": sections.MassSection,
    "supports": sections.SupportSection,
    "amplifiers": sections.AmplifierSection,
    "limits": sections.LimitsSection,
    "uncertainty": sections.UncertaintySection,
    "fingertip": sections.FingertipSection,
}


def _own_losses() -> str:
    """Return the default loss factors of materials that differ from the general default."""
    own = {name: each.own_loss for name, each in KNOWN_MATERIALS.items() if each.own_loss}
    by_loss = [
        f"{100 * loss:g} % ({', '.join(f'`{name}`' for name in own if own[name] == loss)})"
        for loss in dict.fromkeys(own.values())
    ]
    return f"Wood has higher losses; the defaults are {' or '.join(by_loss)} (assumed)."


def _types() -> str:
    """Return the types of exciters with their notes."""
    return "\n".join(f"- `{each.name}`: {each.note}" for each in EXCITER_TYPES.values())


def _feet() -> str:
    """Return the stiffness and loss factor of each kind of foot."""
    feet = ", ".join(f"`{kind}` {stiffness / 1e3:g} kN/m" for kind, stiffness in FEET.items())
    return (
        f"Assumed values for feet of about 2 cm: stiffness of {feet}; loss factor {FOOT_LOSS:g}, "
        "also along edges."
    )


def _weather() -> str:
    """Return the changes of moduli with temperature and moisture, by material."""
    rows = [
        f"| `{name}` | {100 * each.by_kelvin:g} % | "
        f"{f'{each.by_moisture:g} %' if each.by_moisture else '-'} | {each.weather} |"
        for name, each in KNOWN_MATERIALS.items()
    ]
    head = ["| material | modulus per kelvin | per 1 % of moisture | source |", "|---|---|---|---|"]
    return "\n".join([*head, *rows])


PARTS: Mapping[str, Callable[[], str]] = {
    **{name: partial(key_table, each) for name, each in SECTIONS.items()},
    "own_losses": _own_losses,
    "types": _types,
    "feet": _feet,
    "weather": _weather,
}
