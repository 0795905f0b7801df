"""What a bad file makes a library raise, of whatever kind, becomes one line that names the file."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType

from tactslip_torch.data.formats.header import FORM, damaged
from tactslip_torch.data.formats.reading import needs

_FORMS = FORM.rpartition(" ")[0]


class Refused(ValueError):
    """A line for people that says all."""


@contextmanager
def refusing(path: str | os.PathLike[str]) -> Iterator[None]:
    """Turn what is raised inside into a ``ValueError`` of one line.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is a folder, or of anything else that is raised inside.
    """
    if not Path(path).exists():
        raise FileNotFoundError(f"no file at {os.fspath(path)}")
    if not Path(path).is_file():
        raise ValueError(f"{os.fspath(path)} must be a file")
    try:
        yield
    except Refused:
        raise
    except Exception as error:  # HDF5, Arrow, zlib, struct and JSON raise many kinds
        raise damaged(path) from error


def library(module: str, what: str, extra: str = "formats") -> ModuleType:
    """A library (``needs``), also while a file is open.

    Raises:
        Refused: in one line, if it is absent.
    """
    try:
        return needs(module, what, extra)
    except ValueError as error:
        raise Refused(str(error)) from None


def is_ours(header: str | None) -> bool:
    """Whether a text found where our headers stand is one of ours, of this or a later version."""
    return header is not None and _FORMS in header
