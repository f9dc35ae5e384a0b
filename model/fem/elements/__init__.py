"""Plate elements, a file each; `model.fem.element_registry` finds them and those of plug-ins."""

from model.fem.elements.element import DOF_PER_NODE, Element
from model.fem.elements.lagrange import Q3, Q4, Q5
from model.fem.elements.mitc4 import MITC4

__all__ = ["DOF_PER_NODE", "ELEMENTS", "MITC4", "Q5", "Element"]

ELEMENTS = {element.name: element for element in (MITC4, Q3, Q4, Q5)}
"""Elements that come with this package, by name."""
