import subprocess
import sys
from decimal import Decimal

import pytest
from hypothesis import given
from hypothesis import strategies as st

from model.config.units import (
    COMMON_FACTORS,
    DAMPING,
    DENSITY,
    FREQUENCY,
    LENGTH,
    MASS,
    MODULUS,
    RATIO,
    STIFFNESS,
    Dimension,
    quantity,
    unit_factor,
)
from model.errors import InputError

SI = {
    # An inch is 25.4 mm by definition; micro is written with the micro sign or the Greek letter.
    LENGTH: {
        "12 in": 0.3048, "9in": 0.2286, "1.5 mm": 0.0015, "2 mm": 0.002, "100 um": 1e-4,
        "100 µm": 1e-4, "100 μm": 1e-4, "1 ft": 0.3048, ".5 m": 0.5, "1e-3 m": 0.001,
        "-2 cm": -0.02, 3: 3.0, -1.5: -1.5, 0: 0.0,
    },
    MODULUS: {"70 GPa": 70e9, "70000 N/mm^2": 70e9, "70 kN/mm²": 70e9, "70e9": 70e9},
    DENSITY: {"2700 kg/m^3": 2700, "2700 kg/m**3": 2700, "2700 kg/m³": 2700, "2.7 g/cm^3": 2700},
    STIFFNESS: {"17 kN/m": 17000, "17 N/mm": 17000, "17000": 17000},
    DAMPING: {"2 N s/m": 2, "2 N*s/m": 2, "2 N·s/m": 2, "2 kg/s": 2},
    MASS: {"5 g": 0.005},
    FREQUENCY: {"0.25 kHz": 250},
    RATIO: {"1 %": 0.01, "5e-2": 0.05},
}  # fmt: skip


@pytest.mark.parametrize("dimension", SI, ids=lambda dimension: dimension.name)
def test_quantity_converts_to_si_exactly(dimension: Dimension) -> None:
    """Common units and spellings are exact to the last bit; a bare number is in SI."""
    expected = SI[dimension]
    assert {value: quantity(value, dimension) for value in expected} == expected


@pytest.mark.parametrize(
    ("value", "dimension"),
    [
        ("1.5 kg", LENGTH),
        ("70 GN", MODULUS),
        ("1.5 mm^2", LENGTH),
        ("2 %", LENGTH),
        ("1 m", RATIO),
        ("17 lb/in", STIFFNESS),  # pounds are a mass
        ("100 rpm", FREQUENCY),  # has the dimension of Hz, but 100 rpm are not 100 Hz
        ("100 rad/s", FREQUENCY),
        ("100 Bq", FREQUENCY),
        ("1 deg", RATIO),
    ],
)
def test_quantity_refuses_another_dimension(value: object, dimension: Dimension) -> None:
    """The error has the value, the dimension wanted and an example."""
    with pytest.raises(InputError) as caught:
        quantity(value, dimension)
    message = str(caught.value)
    assert all(part in message for part in (repr(value), dimension.name, dimension.example))


NO_VALUES = [
    "9**9**9 m", "9^9^9 m", "2 m^99999999", "2 m**9**9**9", "(3) m", "3 * 4 m",
    "__import__('os') m", "1,5 mm", "1.5 mmm", "1.5 m/", "m", "", " ", "one m", "1" * 41,
    "1 " + "m" * 41, "1e999 m", "1e99 Ym Ym Ym Ym Ym", "nan", "inf m", float("nan"), float("inf"),
    -float("inf"), 10**400, True, False, None, [1], {"m": 1}, b"1 m",
    "٣ m",  # digits of another script
]  # fmt: skip


@pytest.mark.parametrize("value", NO_VALUES)
def test_quantity_refuses_what_is_not_a_value(value: object) -> None:
    """Nothing is evaluated or guessed; the error is short and has a remedy."""
    with pytest.raises(InputError, match=r"1\.5 mm") as caught:
        quantity(value, LENGTH)
    assert len(str(caught.value)) < 200


@given(st.text(max_size=60) | st.text(alphabet="0123456789.eE+-*/^% mkgNsPainHz()", max_size=60))
def test_quantity_raises_input_error_only(text: str) -> None:
    """No text raises anything but InputError."""
    try:
        quantity(text, LENGTH)
    except InputError:
        return


def test_quantity_of_bare_numbers_does_not_load_pint() -> None:
    """A rig of bare numbers does not pay for loading the unit library."""
    script = (
        "import sys; from model.config.units import LENGTH, quantity; "
        "quantity('0.3', LENGTH); quantity(2, LENGTH); print('pint' in sys.modules)"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == "False"


@pytest.mark.parametrize(
    ("si", "unit"), [(si, unit) for si, factors in COMMON_FACTORS.items() for unit in factors]
)
def test_common_factors_are_those_of_pint(si: str, unit: str) -> None:
    """They agree to the last digit, so that it does not matter which of the two is used."""
    factor = unit_factor(f"1 {unit}", unit, Dimension("a value", si, ""))
    assert factor == Decimal(COMMON_FACTORS[si][unit])
