"""Versions of code and numbers that results carry."""

import json

import numpy as np

from model import caching
from model.caching import NUMERICS_VERSION, code_version
from reference_figures import RECORD, reference_figures

REMEDY = "increase NUMERICS_VERSION and run python tests/support/reference_figures.py"


def test_numerics_version_changes_when_figures_change():
    """Recorded figures are those of this code to rounding, and of this NUMERICS_VERSION."""
    record = json.loads(RECORD.read_text(encoding="utf-8"))
    assert record["numerics_version"] == NUMERICS_VERSION, REMEDY
    found = reference_figures()
    assert found.keys() == record["figures"].keys()
    for name, values in record["figures"].items():
        tolerance = {"atol": 2e-3} if name.endswith("_db") else {"rtol": 2e-6}
        np.testing.assert_allclose(found[name], values, err_msg=f"{name}: {REMEDY}", **tolerance)


def test_code_version_changes_with_the_source(monkeypatch, tmp_path):
    """One more space in a module is another version."""
    (tmp_path / "inner").mkdir()
    (tmp_path / "inner" / "module.py").write_text("a = 1", encoding="utf-8")
    monkeypatch.setattr(caching.resources, "files", lambda package: tmp_path)
    first = code_version.__wrapped__()
    (tmp_path / "inner" / "module.py").write_text("a =  1", encoding="utf-8")
    assert code_version.__wrapped__() != first
