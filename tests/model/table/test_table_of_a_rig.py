"""Which rigs a table is for: every key of a rig changed is refused, but for a short list."""

import copy
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic.fields import FieldInfo

import rig_page
from key_tables import quantities
from model.config.fields import Section
from model.errors import InputError
from model.finger import Grid
from model.rig import sections
from model.rig.actuator_keys import EraSection, ExciterSection
from model.rig.rig import Rig
from model.rig.rig_file import parse_rig
from model.table.table_file import TableProblem, load_table, save_table, solve_table

GLASS = {"name": "glass", "E": 70e9, "rho": 2500.0, "nu": 0.2}
FILM = {"name": "film", "E": 1e6, "rho": 1000.0, "nu": 0.45}
ROWS = [[1, 1, 0.1], [900, 2, 0.1]]
RIGS: dict[str, dict[str, Any]] = {
    "plain": {
        "plate": {
            "length": 0.3,
            "width": 0.2,
            "thickness": 0.002,
            "material": GLASS,
            "air_gap": {"depth": 0.01, "closed": False},
            "loss_factor": 0.01,
            "loss_exponent": 0.1,
            "modes": [[1.01, 1.1]],
        },
        "mesh": "12x9 Legendre",
        "eras": {
            "W": {"at": [0.0, 0.1], "amplifier": "main", "channel": 0, "damping_ratio": 0.05},
            "E": {"at": [0.3, 0.1], "amplifier": "main", "channel": 1, "damping": 2.0},
            "N": {"at": [0.15, 0.2], "amplifier": "main", "channel": 2},
            "leg": {"at": [0.15, 0.0], "damping": 2.0},
        },
        "masses": {"camera": {"at": [0.1, 0.1], "mass": 0.01, "foot": 0.005}},
        "amplifiers": {"main": {"url": "sim://"}, "other": {"url": "sim://"}},
        "threshold": "vibrotactile-probe",
        "fingertip": {"stiffness": 1000.0},
        "uncertainty": {"gain": 0.05, "damping": 1.5},
        "limits": {"power": 4.0},
    },
    "layers": {
        "plate": {
            "length": 0.3,
            "width": 0.2,
            "layers": [
                {"material": GLASS, "thickness": 0.001, "loss_factor": 0.02},
                {"material": FILM, "thickness": 0.001, "by_frequency": ROWS},
                {"material": GLASS, "thickness": 0.001},
            ],
        },
        "mesh": "12x9 Legendre",
        "eras": {
            name: {"at": at, "stiffness": 17e3, "amplifier": "main", "channel": channel}
            for channel, (name, at) in enumerate(
                {"W": [0.0, 0.1], "E": [0.3, 0.1], "N": [0.15, 0.2]}.items()
            )
        },
        "amplifiers": {"main": {"url": "sim://"}},
    },
}  # fmt: skip
RIGS["board"] = {
    "plate": {
        "length": 0.3,
        "width": 0.2,
        "thickness": 0.005,
        "grain": "length",
        "material": {
            **{"E1": 12e9, "E2": 5e9, "G12": 0.7e9, "G13": 0.3e9, "G23": 0.2e9},
            **{"nu12": 0.05, "rho": 680.0},
        },
    },
    "mesh": "12x9 Legendre",
    "eras": RIGS["layers"]["eras"],
    "masses": {"frame": {"along": "edges", "mass_per_length": 0.05, "points": 4}},
    "supports": {
        "foot": {"at": [0.01, 0.02], "kind": "foam"},
        "tape": {"along": "edges", "stiffness_per_length": 100.0},
    },
    "amplifiers": {"main": {"url": "sim://"}},
}
RIGS["exciters"] = copy.deepcopy(RIGS["plain"]) | {
    "mesh": "12x9 Legendre",
    "masses": {},
    "eras": {
        name: {"at": at, "stiffness": 17e3}
        for name, at in {"W": [0.0, 0.1], "E": [0.3, 0.1], "N": [0.15, 0.2]}.items()
    }
    | {
        "X1": {
            **{"at": [0.1, 0.05], "foot": 0.004, "coil_mass": 1e-3, "weight": 0.02},
            **{"resonance": 200, "resonance_is": "free", "q": 3, "force_factor": 1.5},
            **{"resistance": 3.6, "inductance": 1e-4, "source_resistance": 0.1, "power": 1},
            "excursion": 5e-4,
            "gains": [[40, 1, 0], [500, 1.1, 10]],
        },
        "X2": {
            **{"at": [0.2, 0.05], "type": "DAEX25CT-4", "stiffness": 4000, "damping": 0.8},
            "clip": 1,
        },
        "X3": {"at": [0.15, 0.12], "type": "DAEX25CT-4"},
    },
}
for channel, name in enumerate(("X1", "X2", "X3")):
    wired = {"kind": "exciter", "amplifier": "main", "channel": channel}
    RIGS["exciters"]["eras"][name] |= wired
RIGS["sheets"] = copy.deepcopy(RIGS["layers"])
RIGS["sheets"]["plate"]["layers"] = 2 * [{"material": GLASS, "thickness": 0.001}]
for era in RIGS["plain"]["eras"].values():
    era |= {"stiffness": 17e3, "bolt_mass": 0.003, "stroke": 1e-4, "foot": 0.004}
    era["gains"] = [[40, 1, 0], [500, 1.1, 10]]

SECTIONS: dict[type[Section], tuple[str, tuple[Any, ...]]] = {
    sections.RigSection: ("plain", ()),
    sections.PlateSection: ("plain", ("plate",)),
    sections.MaterialSection: ("plain", ("plate", "material")),
    sections.AirGapSection: ("plain", ("plate", "air_gap")),
    sections.LayerSection: ("layers", ("plate", "layers", 1)),
    EraSection: ("plain", ("eras", "W")),
    ExciterSection: ("exciters", ("eras", "X1")),
    sections.MassSection: ("plain", ("masses", "camera")),
    sections.SupportSection: ("board", ("supports", "foot")),
    sections.AmplifierSection: ("plain", ("amplifiers", "main")),
    sections.UncertaintySection: ("plain", ("uncertainty",)),
    sections.FingertipSection: ("plain", ("fingertip",)),
    sections.LimitsSection: ("plain", ("limits",)),
}
"""An instance of every section of a rig file: the rig, and where it is there."""

ELSEWHERE: dict[tuple[type[Section], str], tuple[str, tuple[Any, ...]]] = {
    (sections.PlateSection, "bond"): ("sheets", ("plate",)),
    (sections.PlateSection, "layers"): ("layers", ("plate",)),
    (sections.PlateSection, "grain"): ("board", ("plate",)),
    **{
        (sections.MaterialSection, key): ("board", ("plate", "material"))
        for key in sections.ORTHOTROPIC
    },
    (sections.MassSection, "mass_per_length"): ("board", ("masses", "frame")),
    (sections.MassSection, "points"): ("board", ("masses", "frame")),
    (sections.SupportSection, "stiffness_per_length"): ("board", ("supports", "tape")),
    (sections.SupportSection, "points"): ("board", ("supports", "tape")),
    (EraSection, "damping"): ("plain", ("eras", "E")),
    (ExciterSection, "damping"): ("exciters", ("eras", "X2")),
    (ExciterSection, "stiffness"): ("exciters", ("eras", "X2")),
    (ExciterSection, "clip"): ("exciters", ("eras", "X2")),
    (ExciterSection, "type"): ("exciters", ("eras", "X3")),
}

MAY_DIFFER = {
    *("mesh", "amplifiers", "url", "full_level", "clock_error", "amplifier", "channel", "name"),
    *("limits", *sections.LimitsSection.model_fields),
}
"""Keys that may have other values than the rig of a table, by the reference of the table's file."""

OTHERS: dict[str, Any] = {
    "plate": {"length": 0.3, "width": 0.2, "thickness": 0.003, "material": "steel"},
    "material": "steel",
    "air_gap": None,
    "layers": [{"material": GLASS, "thickness": 0.003}],
    "bond": "none",
    "modes": [[1.02, 1.1]],
    "by_frequency": [[1, 1, 0.1], [900, 2.1, 0.1]],
    "closed": True,
    "promised_thresholds": ["vibrotactile-probe"],
    "mesh": "13x9 Legendre",
    "eras": {each: RIGS["plain"]["eras"][each] for each in "WEN"},
    "at": [0.05, 0.15],
    "gains": [[40, 1, 0], [500, 1.2, 10]],
    "type": "DAEX25FHE-4",
    "resonance_is": "mounted",
    "magnet": "held",
    "amplifier": "other",
    "channel": 9,
    "masses": {},
    "supports": {"leg": {"at": [0.01, 0.02], "kind": "rubber"}},
    "grain": "width",
    "kind": "rubber",
    "points": 5,
    "amplifiers": {"main": {"url": "sim://"}, "other": {"url": "serial:///dev/b"}},
    "url": "serial:///dev/b",
    "full_level": "output",
    "clock_error": "unknown",
    "name": "another",
    "limits": {"level": 0.5},
    "frequency": [50, 400],
    "uncertainty": {"gain": 0},
    "fingertip": "none",
    "threshold": "pressing-fingertip",
}
"""Another value of each key that is no plain quantity."""


def rig_of(data: Mapping[str, Any]) -> Rig:
    """The rig of a file with these data."""
    return parse_rig("rig.json", json.dumps(data))  # YAML, too


def other_value(field: FieldInfo, value: Any) -> float:
    """A little beside a quantity's value, or the least that it may have."""
    quantity = quantities(field)[0]
    value = field.get_default(call_default_factory=True) if value is None else value
    least = max(quantity.above, quantity.at_least)
    start = value if isinstance(value, float | int) else least
    step = 0.01 * (abs(start) or min(1.0, quantity.at_most))
    return float(start + (step if start + step <= quantity.at_most else -step))


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A table of each rig."""
    found = {}
    for name, data in RIGS.items():
        problem = TableProblem(rig_of(data), np.array([60.0, 110.0]), Grid(2, 2))
        found[name] = tmp_path_factory.mktemp("tables") / f"{name}.npz"
        save_table(solve_table(problem, drive_mode="phased"), found[name])
        load_table(found[name], rig=problem.rig)
    return found


@pytest.mark.parametrize(
    ("section", "key"),
    [
        pytest.param(each, key, id=f"{each.__name__}.{key}")
        for each in rig_page.SECTIONS.values()
        for key in each.model_fields
        if key not in ("kind", "along")  # has other keys; of which there is one value
    ],
)
def test_a_rig_that_differs_in_a_key_is_refused(
    section: type[Section], key: str, files: dict[str, Path]
) -> None:
    """By its key, unless it is one of few that may differ."""
    name, place = ELSEWHERE.get((section, key), SECTIONS[section])
    data = copy.deepcopy(RIGS[name])
    parent = data
    for part in place:
        parent = parent[part]
    is_plain = key not in OTHERS or section is sections.UncertaintySection
    parent[key] = (
        other_value(section.model_fields[key], parent.get(key)) if is_plain else OTHERS[key]
    )
    rig = rig_of(data)
    if key in MAY_DIFFER and (section, key) != (ExciterSection, "power"):  # which is a limit's, too
        load_table(files[name], rig=rig)
        return
    with pytest.raises(InputError) as refused:
        load_table(files[name], rig=rig)
    named = place[0] if place else key
    assert f" {'masses' if named == 'supports' else named}" in str(refused.value)
