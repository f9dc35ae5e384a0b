"""Structures and arrays as the kernels in C take them, whose headers say what is in them."""

import ctypes
from ctypes import c_double, c_float, c_int, c_void_p
from typing import Any

import numpy as np
from numpy.typing import NDArray

FOUND, NO_MEMORY = 0, -1

_TYPES = {"i": np.int32, "f": np.float32, "c": np.complex64}
"""Of values that are integers, real and complex."""


def _fields(**names: str) -> list[tuple[str, Any]]:
    """Names of fields by the first letter of their kind: integers, floats, doubles, pointers."""
    kinds = {"i": c_int, "f": c_float, "d": c_double, "p": c_void_p}
    return [(name, kinds[kind[0]]) for kind, all_ in names.items() for name in all_.split()]


class Structure(ctypes.Structure):
    """A structure that keeps the arrays to which it points."""

    arrays: list[NDArray[Any]]

    def point(self, **given: NDArray[Any] | None) -> None:
        """Point to arrays as kernels read them; to none where there is none."""
        self.arrays = [*getattr(self, "arrays", [])]
        for name, array in given.items():
            if array is not None:
                kept: NDArray[Any] = np.ascontiguousarray(array, dtype=_TYPES[array.dtype.kind])
                self.arrays.append(kept)
                setattr(self, name, kept.ctypes.data)


def as_given(values: NDArray[Any]) -> NDArray[Any]:
    """Values as a kernel reads them: single precision, or integers of 32 bits, one by one."""
    return np.ascontiguousarray(values, dtype=_TYPES[values.dtype.kind])


class TouchedPlates(Structure):
    """`plates`: the plate on its ERAs, with fingers on it."""

    _fields_ = [
        *_fields(i="n b k r t off rows lanes kept", f="load_std"),
        *_fields(p="receptance by_force coupling moved minus_omega2 forces strokes by_damping"),
        *_fields(p="by_stiffness by_loss attached shapes centres stiffness of_blocks"),
    ]


class PointGroups(Structure):
    """`grouped`: groups of points whose expected powers are wanted."""

    _fields_ = [
        *_fields(i="groups p fine others", f="gain_variance ridge"),
        *_fields(p="points fine_points weights error shares is_fine", i="rim"),
    ]


class PlateDraws(Structure):
    """`draws`: plates within the uncertainty."""

    _fields_ = _fields(
        i="count bases nodes width first_base first_node amplifiers",
        p="node loss damping own gains errors harmonics delays amplifier",
    )


class Sensors(Structure):
    """`sensors`: points of all fingers."""

    _fields_ = _fields(i="points", p="rows weights error threshold")


class WeightSearch(Structure):
    """`method`: weights that are tried at each frequency."""

    _fields_ = _fields(i="steps limited", f="variance gain reserve growth most")


class Rules(Structure):
    """`rules`: how tones are chosen."""

    _fields_ = [
        *_fields(i="kept missing max_by_point pruning_step"),
        *_fields(i="rim_count is_deep others"),
        *_fields(f="gain_variance ridge margin highest reached"),
        *_fields(f="judged promised", i="starts iterations again"),
        ("one_finger", WeightSearch),
        ("several", WeightSearch),
        ("within", 3 * WeightSearch),
        *_fields(i="groups sets", p="rim group threshold error shares frequencies sensitivities"),
        *_fields(p="harmonic_sensitivities search_error harmonic_threshold at_harmonics"),
    ]


class GivenRaster(Structure):
    """`raster`: shapes of the plate, and how they are read under a fingertip."""

    _fields_ = _fields(
        i="nx ny side_x side_y r few fine",
        d="length width radius",
        p="points weights nodes shapes",
    )


class GivenQuestion(Structure):
    """`question`: fingers, and what each is to feel; what is found first is not named."""

    _fields_ = [
        *_fields(i="contents bands fingers quiet_count candidates combinations", f="apart"),
        *_fields(p="numbers level places stiffness at_harmonics background judging promise"),
    ]


class FoundTones(Structure):
    """`answered`: tones, and what is felt of them."""

    _fields_ = _fields(i="is_apart", p="rows figures")


class Shaping(Structure):
    """`shaping`: how knots are found."""

    _fields_ = _fields(
        i="samples steps knots ending_knots iterations", f="ridge penalty relaxation", p="rise"
    )


class ShapedTone(Structure):
    """`shaped_tone`: a tone whose onset or ending is shaped."""

    _fields_ = [
        *_fields(i="eras targets rows combinations", f="gain_variance weight"),
        *_fields(p="hats steady amplitudes", i="total"),
        *_fields(p="active residual"),
    ]
