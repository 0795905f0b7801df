"""Parts of the package import each other along one direction."""

import ast
from pathlib import Path

ROOT = Path(__file__).parents[1] / "tactslip_torch"
_LOWER = ("hand", "native", "signals", "data", "features", "model")
ARROWS = {
    "runtime": (),
    "package_files": ("hand",),
    "hand": (),
    "native": (),
    "signals": ("hand",),
    "data": ("hand", "signals"),
    "simulation": ("hand", "data", "native"),
    "features": ("hand", "signals", "native"),
    "model": ("features", "signals", "native", "hand"),
    "onset": ("model", "features", "signals", "native", "hand"),
    "deploy": ("features", "model", "onset", "signals", "hand"),
    "live": ("hand", "data", "signals", "model", "onset", "deploy"),
    "training": (*_LOWER, "onset", "deploy", "report"),
    "pareto": ("model", "features", "report"),
    "report": (),
}
"""Importer: what it may import beside itself, ``runtime`` and ``package_files``; others may all."""


def part_of(module: str) -> str:
    return module.split(".")[0]


def test_parts_import_along_the_arrows() -> None:
    wrong = set()
    for path in ROOT.rglob("*.py"):
        module = ".".join(path.relative_to(ROOT).with_suffix("").parts)
        part = part_of(module)
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if not isinstance(node, ast.ImportFrom) or not node.module:
                continue
            if not node.module.startswith("tactslip_torch."):
                continue
            name = node.module.removeprefix("tactslip_torch.")
            other = part_of(name)
            if part in ARROWS and other not in (part, "runtime", "package_files", *ARROWS[part]):
                wrong.add(f"{module} -> {node.module}")
    assert not wrong, "\n".join(sorted(wrong))
