"""A table of one rig is refused for every other rig: for each key that changes, but for a few."""

import copy
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic.fields import FieldInfo

import rig_page
from cases import read_yaml
from key_tables import quantities
from model.errors import InputError
from model.finger import Grid
from model.rig.rig import Rig
from model.rig.rig_file import parse_rig
from model.table.table_file import TableProblem, load_table, save_table, solve_table

CASES = read_yaml(Path(__file__).with_name("rigs.yaml"))
RIGS = CASES["rigs"]
LOCATIONS = CASES["locations"]
OTHER_VALUES = CASES["others"]
MAY_DIFFER = CASES["may_differ"]

WEATHER = ("temperature", "measured_temperature", "humidity", "measured_humidity")
"""Keys that change the uncertainty of a table."""
NOT_TESTED = ("kind", "along", "surface", "mode_amplitude")
"""A kind has other keys, `along` has one value; tests/model/structure has surfaces."""


def keys() -> list[str]:
    """Return all keys of a rig file, each with its section."""
    names = []
    for section, model in rig_page.SECTIONS.items():
        if section != "surface":
            fields = [key for key in model.model_fields if key not in NOT_TESTED]
            names += [f"{section}.{key}" for key in fields]
    return names


def parsed(data: Mapping[str, Any]) -> Rig:
    """Return the rig of a file with these data."""
    return parse_rig("rig.json", json.dumps(data))  # YAML, too


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A table of each rig, which its rig can load."""
    folder = tmp_path_factory.mktemp("tables")
    paths = {}
    for name, data in RIGS.items():
        problem = TableProblem(parsed(data), np.array([60.0, 110.0]), Grid(2, 2))
        paths[name] = folder / f"{name}.npz"
        save_table(solve_table(problem, drive_mode="phased"), paths[name])
        load_table(paths[name], rig=problem.rig)
    return paths


def near_value(field: FieldInfo, value: Any) -> float:
    """Return a value 1 % from a quantity's, from its default, or from its lowest."""
    quantity, *_ = quantities(field)
    if value is None:
        value = field.get_default(call_default_factory=True)
    if not isinstance(value, float | int):
        value = max(quantity.above, quantity.at_least)
    size = abs(value) or min(1.0, quantity.at_most)
    higher = value + 0.01 * size
    if higher <= quantity.at_most:
        return float(higher)
    return float(value - 0.01 * size)


@pytest.mark.parametrize("name", keys())
def test_rig_that_differs_in_a_key_is_refused(name: str, files: dict[str, Path]) -> None:
    """The error names the key, or the section at the top of the file."""
    section, key = name.split(".")
    location = LOCATIONS.get(name, LOCATIONS[section])
    data = copy.deepcopy(RIGS[location["rig"]])
    parent = data
    for part in location["path"]:
        parent = parent[part]
    if key in OTHER_VALUES and section != "uncertainty":
        parent[key] = OTHER_VALUES[key]
    else:
        field = rig_page.SECTIONS[section].model_fields[key]
        parent[key] = near_value(field, parent.get(key))
    rig = parsed(data)
    file = files[location["rig"]]

    if key in MAY_DIFFER or section == "limits":
        load_table(file, rig=rig)
        return
    with pytest.raises(InputError) as error:
        load_table(file, rig=rig)

    top, *_ = [*location["path"], key]
    if key in WEATHER:
        top = "uncertainty"
    elif top == "supports":
        top = "masses"
    assert f" {top}" in str(error.value)
