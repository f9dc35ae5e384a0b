"""Meshes of peers: elements of equal order, uniform except for strips along the edges."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Elements:
    """nx by ny elements of an order inside strips, their widths [m] from the edge inwards."""

    order: int
    nx: int
    ny: int
    strips: tuple[float, ...] = ()

    def __str__(self) -> str:
        strips = "/".join(f"{1e3 * width:.3g}" for width in self.strips)
        return f"{self.nx}x{self.ny} of order {self.order}, strips {strips} mm"
