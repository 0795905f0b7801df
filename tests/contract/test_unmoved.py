"""The unmoved numbers: no cell of a confusion moves by more than two bins."""

import json

import pytest

from .unmoved import FILE, REAL_DATA, measured, moved

NOTED = json.loads(FILE.read_text())


@pytest.mark.slow
@pytest.mark.parametrize("names", [("paper", "default"), ("real",)])
def test_the_numbers_are_unmoved(names, tmp_path):
    """Features of one set are made once for all its recipes."""
    if "real" in names and not REAL_DATA.exists():
        pytest.skip(f"no recordings at {REAL_DATA}; BIOTACSP names another folder")
    for name in names:
        assert moved(NOTED[name], measured(name, tmp_path / name, tmp_path / "cache")) == {}
