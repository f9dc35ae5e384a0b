"""By which code a result was made."""

from model import version
from model.version import code_version


def test_the_code_version_changes_with_the_source(monkeypatch, tmp_path):
    """One more space in a module, and what was kept before is not used."""
    (tmp_path / "inner").mkdir()
    (tmp_path / "inner" / "module.py").write_text("a = 1", encoding="utf-8")
    monkeypatch.setattr(version.resources, "files", lambda package: tmp_path)
    first = code_version.__wrapped__()
    (tmp_path / "inner" / "module.py").write_text("a =  1", encoding="utf-8")
    assert code_version.__wrapped__() != first
