"""C kernels: their structures, and the library for this processor.

The libraries are compiled when era-haptics is installed or its wheel is built
(`build_libraries.py`). The kernels' headers describe the fields of the structures.
"""

import ctypes
import logging
from collections.abc import Callable
from collections.abc import Set as AbstractSet
from ctypes import c_double, c_float, c_int, c_void_p
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from model.compiled.versions import Version, versions

FOUND, NO_MEMORY = 0, -1

_ARRAY_TYPES = {"i": np.int32, "f": np.float32, "c": np.complex64}
"""Element types of the kernels' arrays by numpy's kind: integers, real and complex numbers."""

_FIELD_TYPES = {"i": c_int, "f": c_float, "d": c_double, "p": c_void_p}
"""Types of the fields of structures: integers, floats, doubles, pointers."""


def _fields(**names_by_type: str) -> list[tuple[str, Any]]:
    """Return the fields of a structure; each argument lists names of a type of `_FIELD_TYPES`."""
    fields = []
    for letter, names in names_by_type.items():
        fields += [(name, _FIELD_TYPES[letter]) for name in names.split()]
    return fields


class Structure(ctypes.Structure):
    """A structure that keeps the arrays to which it points."""

    arrays: list[NDArray[Any]]

    def point(self, **arrays: NDArray[Any] | None) -> None:
        """Set pointers to arrays, which are converted for kernels; None leaves a null pointer."""
        self.arrays = [*getattr(self, "arrays", [])]
        for field, values in arrays.items():
            if values is not None:
                array = as_given(values)
                self.arrays.append(array)
                setattr(self, field, array.ctypes.data)


def as_given(values: NDArray[Any]) -> NDArray[Any]:
    """Convert values for kernels: contiguous, in single precision or integers of 32 bits."""
    return np.ascontiguousarray(values, dtype=_ARRAY_TYPES[values.dtype.kind])


class TouchedPlates(Structure):
    """The plate on its ERAs with fingers on it: `plates` in C."""

    _fields_ = [
        *_fields(i="n b k r t off rows lanes kept"),
        *_fields(p="receptance by_force coupling moved minus_omega2 forces strokes by_damping"),
        *_fields(p="by_stiffness by_loss attached shapes centers stiffness load_std of_blocks"),
    ]


class PointGroups(Structure):
    """Groups of points whose expected powers are wanted: `grouped` in C."""

    _fields_ = [
        *_fields(i="groups p fine others", f="gain_variance ridge"),
        *_fields(p="points fine_points weights error shares is_fine touch_steps", i="rim"),
    ]


class PlateDraws(Structure):
    """Plates within the uncertainty: `draws` in C."""

    _fields_ = _fields(
        i="count bases nodes width first_base first_node amplifiers",
        p="node loss damping own gains errors harmonics touches delays amplifier",
    )


class Sensors(Structure):
    """Observed points of all fingers: `sensors` in C."""

    _fields_ = _fields(i="points", p="rows weights error threshold touch_steps disc")


class WeightSearch(Structure):
    """Parameters of the search for weights: `method` in C."""

    _fields_ = _fields(i="steps limited", f="variance gain reserve growth most")


class Rules(Structure):
    """Rules for choosing tones: `rules` in C."""

    _fields_ = [
        *_fields(i="kept missing max_by_point pruning_step"),
        *_fields(i="rim_count is_deep others"),
        *_fields(f="gain_variance touch_offset ridge margin highest reached"),
        *_fields(f="judged promised", i="starts iterations again"),
        ("one_finger", WeightSearch),
        ("several", WeightSearch),
        ("within", 3 * WeightSearch),
        *_fields(i="groups sets", p="rim group threshold error shares frequencies sensitivities"),
        *_fields(p="harmonic_sensitivities search_error harmonic_threshold at_harmonics"),
    ]


class GivenRaster(Structure):
    """Mode shapes on the sampling grid, and their interpolation at fingertips: `raster` in C."""

    _fields_ = _fields(
        i="nx ny side_x side_y r few fine",
        d="length width radius",
        p="points weights nodes shapes",
    )


class GivenQuestion(Structure):
    """Fingers and their requests: `question` in C, without its trailing results."""

    _fields_ = [
        *_fields(i="contents bands fingers quiet_count candidates combinations", f="apart"),
        *_fields(p="numbers level places stiffness at_harmonics load_std background"),
        *_fields(p="judging promise"),
    ]


class FoundTones(Structure):
    """Tones and their sensations: `answered` in C."""

    _fields_ = _fields(i="is_apart", p="rows figures")


class Shaping(Structure):
    """Parameters for computing knots: `shaping` in C."""

    _fields_ = _fields(
        i="samples steps knots ending_knots iterations", f="ridge penalty relaxation", p="rise"
    )


class ShapedTone(Structure):
    """A tone whose onset or ending is shaped: `shaped_tone` in C."""

    _fields_ = [
        *_fields(i="eras targets rows combinations", f="gain_variance weight"),
        *_fields(p="hats steady amplitudes", i="total"),
        *_fields(p="active residual"),
    ]


_logger = logging.getLogger(__name__)

KERNEL_FOLDER = Path(__file__).parent


def processor_features() -> AbstractSet[str]:
    """Return the names of this processor's features in numpy; empty if numpy lacks them."""
    try:
        availability = import_module("numpy._core._multiarray_umath").__cpu_features__
    except (ImportError, AttributeError):  # not a public interface
        return frozenset()
    return {feature for feature, is_available in availability.items() if is_available}


@dataclass(frozen=True, eq=False)
class Kernels:
    """The library, the name of its version, and the number of cases per kernel call."""

    library: ctypes.CDLL
    version: str
    lanes: int


@cache
def kernels() -> Kernels | None:
    """Load the fastest kernels for this processor; None if only numpy is available."""
    features = processor_features()
    for version in versions():
        path = KERNEL_FOLDER / version.file
        if version.features.keys() <= features and path.exists():
            return _load(path, version)
    return None


def _load(path: Path, version: Version) -> Kernels | None:
    """Load a library; None, with a warning, if that fails."""
    try:
        library = ctypes.CDLL(str(path))
    except OSError as error:
        _logger.warning("%s: %s", WITHOUT_KERNELS, error)
        return None
    return Kernels(library, version.name, version.lanes)


WITHOUT_KERNELS = "answers are computed by numpy, which takes 6 to 19 times as long as C kernels"
"""Measured on four and on twelve ERAs, for steady vibrations of one to twenty sharing fingers with
0 to 6 quiet fingers; clicks take 1.3 times as long."""


def why_slow() -> str | None:
    """Describe how much slower answers are without kernels; None with kernels."""
    return None if kernels() else arithmetic()


def arithmetic() -> str:
    """Describe whether C kernels or numpy compute answers."""
    loaded = kernels()
    if loaded is None:
        return f"{WITHOUT_KERNELS}; install a C compiler, then reinstall era-haptics"
    return f"answers are computed by C kernels ({loaded.version})"


def run_kernel(kernel: Callable[..., int], *arguments: Any) -> int:
    """Run a kernel on structures and other arguments and return its status; raises MemoryError."""
    converted = []
    for argument in arguments:
        is_structure = isinstance(argument, ctypes.Structure)
        converted.append(ctypes.byref(argument) if is_structure else argument)
    status = kernel(*converted)
    if status == NO_MEMORY:
        raise MemoryError("kernels could not get the memory that an answer takes")
    return status
