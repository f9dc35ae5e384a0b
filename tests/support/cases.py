"""Cases of tests: those of the long form, which files take longest, and data in YAML.

A test or a case with the mark `long` is left to `make test-long`, which `make nightly` runs;
`make test` has a short case of the same. Data have words and numbers as
the product's own files have them.
"""

from collections.abc import Collection, Iterable, Iterator, Sequence
from itertools import cycle
from pathlib import Path
from typing import Any, ClassVar

import pytest
import yaml

from model.config.document import plain_value


def shortly(values: Iterable[Any], short: Collection[Any]) -> list[Any]:
    """Values for `parametrize`, long ones marked; short: those that `make test` takes."""
    return [value if value in short else _long(value) for value in values]


def in_turn(rows: Iterable[Any], columns: Sequence[Any]) -> list[Any]:
    """All pairs of a row and a column; `make test` takes every row, and the columns in turn."""
    return [
        (row, column) if column == next_column else _long(row, column)
        for row, next_column in zip(rows, cycle(columns), strict=False)
        for column in columns
    ]


def _long(*values: Any) -> Any:
    return pytest.param(*values, marks=pytest.mark.long)


COLLECTED = pytest.StashKey[set[str]]()
"""Ids of all tests that were collected, also of those that no mark has selected."""

SLOWEST = (
    "test_rig_check.py",
    "test_daemon_faults_process.py",
    "test_calibrate.py",
    "test_application_page.py",
    "test_free_loop.py",
    "test_host_rules.py",
    "test_identify.py",
    "test_firmware.py",
    "test_how_to_pages.py",
    "test_conformance.py",
    "test_control_loop.py",
    "test_four_amplifiers.py",
    "test_soft_amp.py",
    "test_by_hand.py",
    "test_sound_card.py",
    "test_errors.py",
    "test_dashboard.py",
    "test_fingers.py",
    "test_clicks_and_crossfades.py",
    "test_clocks_of_a_group.py",
    "test_python_api.py",
    "test_courses_at_fingers.py",
    "test_layout_check.py",
    "test_group.py",
    "test_promises.py",
    "test_table_commands.py",
    "test_stimulus.py",
    "test_draws.py",
    "test_supervisor.py",
    "test_planted_faults.py",
    "test_people_at_a_plate.py",
    "test_house.py",
)
"""Run in this order before all others: one that started last would leave the other cores idle."""


class _Loader(yaml.CSafeLoader):
    """Leaves it to `plain_value` which unquoted texts are words and numbers; `<<` merges.

    A key that stands twice is an error: the first would never be tried.
    """

    yaml_implicit_resolvers: ClassVar[dict[str, Any]] = {
        "<": yaml.CSafeLoader.yaml_implicit_resolvers["<"]
    }

    def scalar(self, node: yaml.ScalarNode) -> Any:
        """The value of a text."""
        return node.value if node.style else plain_value(node.value)

    def mapping(self, node: yaml.MappingNode) -> Iterator[dict[Any, Any]]:
        """The values by their keys, once all are read."""
        keys = [key.value for key, _ in node.value]
        if twice := [key for key, _ in node.value if keys.count(key.value) > 1]:
            raise ValueError(f"{twice[-1].value} must stand once, got two{twice[-1].start_mark}")
        return self.construct_yaml_map(node)


_Loader.add_constructor("tag:yaml.org,2002:map", _Loader.mapping)
_Loader.add_constructor("tag:yaml.org,2002:str", _Loader.scalar)


def read_yaml(path: Path) -> Any:
    """The data of a file."""
    with path.open(encoding="utf-8") as file:
        return yaml.load(file, Loader=_Loader)
