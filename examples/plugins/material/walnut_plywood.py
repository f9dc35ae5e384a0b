"""A material that rig files can name. The values are an example; measure your own board."""

from era_haptics.plugins.materials import KnownMaterial, Material

WALNUT_PLYWOOD = KnownMaterial(
    Material("example-walnut-plywood", E=9.5e9, rho=620.0, nu=0.3),
    source="bending test of three strips 300 mm long, weighed; nu assumed",
    variation="E 8.7 to 10.2 GPa over the strips, stiffer along the grain of the faces",
    loss_factor="0.01 to 0.02",
)
