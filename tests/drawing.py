"""What printed tables and written figures hold."""

import re
from pathlib import Path


def rows_of(table: str) -> list[list[str]]:
    return [re.split(r"\s{2,}", line.strip()) for line in table.splitlines()]


def assert_png(path: Path) -> None:
    """A whole PNG, and nothing left beside it."""
    assert path.read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"
    assert not [other for other in path.parent.iterdir() if ".tmp" in other.name]
