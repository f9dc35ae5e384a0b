"""Plate elements, a file each.

An installed package adds one by an entry point of the group `era_haptics.elements` that leads to
an `Element` of that name; it must pass `model.fem.element_checks`.
"""

from operator import attrgetter

from model.errors import InputError
from model.fem.elements.element import DOF_PER_NODE, Element
from model.fem.elements.lagrange import Q3, Q4, Q5
from model.fem.elements.mitc4 import MITC4
from registry.plugins import Instance, PluginRegistry

__all__ = ["DOF_PER_NODE", "ELEMENTS", "MITC4", "Q5", "Element", "element_names", "element_of"]

ELEMENTS = {element.name: element for element in (MITC4, Q3, Q4, Q5)}
"""Elements that come with this package, by name."""


def _matrix_problem(element: Element) -> str | None:
    """What is wrong with the nodes or the matrices of a plug-in's element."""
    from model.fem.element_checks import matrices, nodes  # they use meshes, and these elements

    return nodes(element) or matrices(element)


_ELEMENTS: PluginRegistry[Element] = PluginRegistry(
    "element",
    "era_haptics.elements",
    Instance(Element),
    error=InputError,
    own=ELEMENTS,
    called=attrgetter("name"),
    problem=_matrix_problem,
)


def element_names() -> tuple[str, ...]:
    """Names of all elements, those of plug-ins included; no plug-in is loaded."""
    return _ELEMENTS.names()


def element_of(name: str) -> Element:
    """Look up an element; raises InputError with a suggestion."""
    return _ELEMENTS.find(name)
