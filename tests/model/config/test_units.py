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


@pytest.mark.parametrize(
    ("text", "dimension", "expected"),
    [
        ("12 in", LENGTH, 0.3048),  # an inch is 25.4 mm by definition
        ("9 in", LENGTH, 0.2286),
        ("9in", LENGTH, 0.2286),
        ("1.5 mm", LENGTH, 0.0015),
        ("2 mm", LENGTH, 0.002),
        ("100 um", LENGTH, 1e-4),
        ("100 µm", LENGTH, 1e-4),  # the micro sign
        ("100 μm", LENGTH, 1e-4),  # the Greek letter
        ("1 ft", LENGTH, 0.3048),
        (".5 m", LENGTH, 0.5),
        ("1e-3 m", LENGTH, 0.001),
        ("-2 cm", LENGTH, -0.02),
        ("70 GPa", MODULUS, 70e9),
        ("70000 N/mm^2", MODULUS, 70e9),
        ("70 kN/mm²", MODULUS, 70e9),
        ("70e9", MODULUS, 70e9),
        ("2700 kg/m^3", DENSITY, 2700.0),
        ("2700 kg/m**3", DENSITY, 2700.0),
        ("2700 kg/m³", DENSITY, 2700.0),
        ("2.7 g/cm^3", DENSITY, 2700.0),
        ("17 kN/m", STIFFNESS, 17000.0),
        ("17 N/mm", STIFFNESS, 17000.0),
        ("17000", STIFFNESS, 17000.0),
        ("2 N s/m", DAMPING, 2.0),
        ("2 N*s/m", DAMPING, 2.0),
        ("2 N·s/m", DAMPING, 2.0),
        ("2 kg/s", DAMPING, 2.0),
        ("5 g", MASS, 0.005),
        ("0.25 kHz", FREQUENCY, 250.0),
        ("1 %", RATIO, 0.01),
        ("5e-2", RATIO, 0.05),
    ],
)
def test_quantity_converts_to_si_exactly(text: str, dimension: Dimension, expected: float) -> None:
    """What people write comes out as the exact SI value, to the last bit."""
    assert quantity(text, dimension) == expected


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
    """A value of the wrong kind is refused, with the kind that is wanted and an example."""
    with pytest.raises(InputError) as caught:
        quantity(value, dimension)
    message = str(caught.value)
    assert repr(value) in message
    assert f"is not {dimension.name}" in message
    assert dimension.example in message


@pytest.mark.parametrize(
    "value",
    [
        "9**9**9 m",
        "9^9^9 m",
        "2 m^99999999",
        "2 m**9**9**9",
        "(3) m",
        "3 * 4 m",
        "__import__('os') m",
        "1,5 mm",
        "1.5 mmm",
        "1.5 m/",
        "m",
        "",
        " ",
        "one m",
        "1" * 41,
        "1 " + "m" * 41,
        "1e999 m",
        "1e99 Ym Ym Ym Ym Ym",
        "nan",
        "inf m",
        float("nan"),
        float("inf"),
        -float("inf"),
        10**400,
        True,
        False,
        None,
        [1],
        {"m": 1},
        b"1 m",
        "٣ m",  # digits of another script
    ],
)
def test_quantity_refuses_what_is_not_a_value(value: object) -> None:
    """Nothing is evaluated, guessed or converted: what is no plain number is refused, shortly."""
    with pytest.raises(InputError, match=r"write a bare number in m, or for example 1\.5 mm") as e:
        quantity(value, LENGTH)
    assert len(str(e.value)) < 200


@given(st.text(max_size=60) | st.text(alphabet="0123456789.eE+-*/^% mkgNsPainHz()", max_size=60))
def test_quantity_raises_input_error_only(text: str) -> None:
    """No text whatever raises anything but InputError."""
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
    """To the last digit, so that it does not matter which of the two is used."""
    factor = unit_factor(f"1 {unit}", unit, Dimension("a value", si, ""))
    assert factor == Decimal(COMMON_FACTORS[si][unit])
