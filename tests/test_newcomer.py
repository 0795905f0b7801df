"""From CSV files to ONNX in few lines of public names; the same with other libraries beside it."""

from __future__ import annotations

import ast
import io
import os
import subprocess
import sys
import tokenize
from pathlib import Path

import numpy as np
import pytest

import tactslip_torch

EXAMPLES = Path(__file__).parents[1] / "examples"
MOST_LINES = 25


def code_lines(path: Path) -> int:
    """Lines that hold code: no comment, blank line or docstring."""
    text = path.read_text(encoding="utf-8")
    passed = (tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT)
    lines: set[int] = set()
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type not in passed and token.string:
            lines.update(range(token.start[0], token.end[0] + 1))
    docstring = ast.parse(text).body[0]
    return len(lines - set(range(docstring.lineno, (docstring.end_lineno or 0) + 1)))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two seconds of noise of three channels a file; slip is louder, each material by its own."""
    rng, made = np.random.default_rng(0), tmp_path_factory.mktemp("recordings")
    for number, material in enumerate(("foam", "glass", "steel")):
        for label, size in (("stick", 1.0), ("slip", 2.0 + 0.3 * number)):
            samples = size * rng.standard_normal((4000, 3))
            path = made / f"{material}_{label}_1.csv"
            np.savetxt(path, samples, "%.6f", delimiter=",", header="C1,C2,C3", comments="")
    return made


@pytest.mark.slow
@pytest.mark.parametrize("name", ["newcomer", "newcomer_tsfel", "newcomer_aeon"])
def test_a_newcomer_gets_from_files_to_a_model(folder: Path, name: str) -> None:
    if (library := name.removeprefix("newcomer_")) != name:
        pytest.importorskip(library)
    environment = os.environ | {"PYTHONPATH": str(EXAMPLES.parent)}
    command = [sys.executable, str(EXAMPLES / f"{name}.py"), str(folder)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    score, found = done.stdout.splitlines()[-2:]
    assert float(score.split()[-1]) > 0.9
    assert "of 240 windows are slip" in found
    assert 100 < int(found.split()[1]) < 140


def test_it_takes_few_lines_of_public_names() -> None:
    path = EXAMPLES / "newcomer.py"
    assert code_lines(path) <= MOST_LINES
    imported = [
        (node.module, name.name)
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.ImportFrom) and "tactslip" in str(node.module)
        for name in node.names
    ]
    assert imported
    assert all(m == "tactslip_torch" and n in tactslip_torch.__all__ for m, n in imported)
