"""Interfaces for named materials: entry points `era_haptics.materials`."""

from model.structure.material import KnownMaterial, Material, Orthotropy

__all__ = ["KnownMaterial", "Material", "Orthotropy"]
