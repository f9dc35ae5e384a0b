"""Interfaces for materials by name: entry points `era_haptics.materials`."""

from model.structure.material import Material
from model.structure.materials import KnownMaterial

__all__ = ["KnownMaterial", "Material"]
