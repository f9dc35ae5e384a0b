"""Versions of the C kernels for processors with different vector instructions.

The build of the package imports this module too, so it needs only the standard library.
"""

import os
import platform
from collections.abc import Mapping
from dataclasses import dataclass


@dataclass(frozen=True)
class Version:
    """A version of the kernels for processors with certain features."""

    name: str
    lanes: int
    """Cases processed together: as many as fill a register of the processor; more are many times
    slower."""
    features: Mapping[str, str]
    """Compiler flag per feature, by numpy's feature name."""

    @property
    def file(self) -> str:
        """Name of the library."""
        return f"kernels-{self.name}.so"


_AVX2 = {"AVX2": "-mavx2", "FMA3": "-mfma"}
_AVX512 = {"AVX512F": "-mavx512f", "AVX512DQ": "-mavx512dq", "AVX512VL": "-mavx512vl", **_AVX2}
_PLAIN = Version("plain", lanes=4, features={})
_VERSIONS_FOR_X86 = (
    Version("avx512", lanes=16, features=_AVX512),
    Version("avx2", lanes=8, features=_AVX2),
    _PLAIN,
)


def versions() -> tuple[Version, ...]:
    """Return the versions for this architecture, the fastest first.

    Without AVX on Windows, where gcc does not align its registers on the stack (GCC bug 54412).
    """
    is_x86 = platform.machine().lower() in ("x86_64", "amd64")
    if is_x86 and os.name == "posix":
        return _VERSIONS_FOR_X86
    return (_PLAIN,)
