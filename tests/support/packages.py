"""The packages of the product, as `pyproject.toml` lists them for the wheel."""

import tomllib
from pathlib import Path

_PROJECT = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text("utf-8"))

PACKAGES: tuple[str, ...] = tuple(
    _PROJECT["tool"]["hatch"]["build"]["targets"]["wheel"]["packages"]
)
