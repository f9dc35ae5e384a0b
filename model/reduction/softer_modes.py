"""The free plate as soft under every force as its polynomials leave possible."""

from dataclasses import dataclass, replace

from model.arrays import FloatArray
from model.reduction.free_modes import PointSolutions
from model.reduction.layered_modes import LayeredModes
from model.reduction.spectral_modes import SpectralModes
from model.structure.dispersion import Dispersion


@dataclass(frozen=True, eq=False)
class SofterModes:
    """Modes of a free plate with more of the unresolved compliance; see `FreeModes`."""

    modes: SpectralModes | LayeredModes

    @property
    def eigenvalues(self) -> FloatArray:
        """As of the plate itself."""
        return self.modes.eigenvalues

    @property
    def losses(self) -> FloatArray:
        """As of the plate itself."""
        return self.modes.losses

    @property
    def dispersion(self) -> Dispersion | None:
        """As of the plate itself."""
        return self.modes.dispersion

    @property
    def largest_truncated(self) -> float:
        """As of the plate itself."""
        return self.modes.largest_truncated

    def solve_at(self, points: FloatArray) -> PointSolutions:
        """Solve for forces at points [m] (n, 2)."""
        solved = self.modes.solve_at(points)
        truncated_terms = solved.truncated_terms.copy()
        truncated_terms[0] += self.modes.uncertain(points, points)
        return replace(solved, truncated_terms=truncated_terms)

    def shapes_at(self, points: FloatArray) -> FloatArray:
        """Mode shapes at points [m] (p, 2) or footprints (p, 3), (p, r)."""
        return self.modes.shapes_at(points)

    def truncated_terms(self, points: FloatArray, others: FloatArray) -> FloatArray:
        """Sums between points (n, 2) and others (m, 2), as in `PointSolutions`."""
        truncated_terms = self.modes.truncated_terms(points, others)
        truncated_terms[0] += self.modes.uncertain(points, others)
        return truncated_terms

    def basis(self, attached: PointSolutions, points: FloatArray) -> FloatArray:
        """Deflection at points of modes and residual vectors, (p, r + RESIDUAL_ORDER n)."""
        basis = self.modes.basis(attached, points).copy()
        first = len(self.eigenvalues)
        basis[:, first : first + len(attached.points)] += self.modes.uncertain(
            points, attached.points
        )
        return basis

    def unknowns(self, attached: PointSolutions) -> tuple[FloatArray, ...]:
        """Those of the modes."""
        return self.modes.unknowns(attached)
