"""Interfaces for plate elements: entry points `era_haptics.elements`."""

from model.arrays import FloatArray
from model.fem.elements.element import Element, rigidities
from model.structure.material import Material
from model.structure.plate import Plate

__all__ = ["Element", "FloatArray", "Material", "Plate", "rigidities"]
