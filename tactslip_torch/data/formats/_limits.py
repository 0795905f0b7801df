"""What a file may cost, and how its faults are told: one line that names it and says what to do."""

from __future__ import annotations

import importlib.util
import os
from collections.abc import Iterator
from contextlib import contextmanager
from types import ModuleType

MOST_WHOLE = 4 * 2**30
"""Bytes of numbers in a file of a format that is read whole: MAT of version 5 and Parquet."""
MOST_CHANNELS = 2**16
MOST_MEMBERS = 10_000
"""Arrays, groups, columns or topics of one file that are looked at."""
MOST_RATIO, FREE_BYTES = 100, 64 * 2**20
"""A file may hold so many times its size, and so many bytes in any case."""
_MOST_SAID = 200


class Refused(ValueError):
    """A line for people that says all."""


@contextmanager
def guarded(path: str | os.PathLike[str]) -> Iterator[None]:
    """Turn whatever a library raises of a file into one line.

    Raises:
        FileNotFoundError: if there is no such file.
        Refused: of anything else that is raised inside; it begins with the path.
    """
    name = os.fspath(path)
    try:
        yield
    except Refused as error:
        said = str(error)
        raise (error if said.startswith(name) else Refused(f"{name} {said}")) from None
    except FileNotFoundError:
        raise FileNotFoundError(f"no file at {name}") from None
    except MemoryError as error:
        raise Refused(
            f"{name} needs more memory than there is, or than reading.isolate_gib; use .h5"
        ) from error
    except Exception as error:  # HDF5, Arrow, zlib, struct, SQLite and YAML raise many kinds
        said = " ".join(str(error).split())[:_MOST_SAID] or type(error).__name__
        raise Refused(f"{name} is damaged or no recording of ours ({said})") from error


def check_plausible(what: str, claimed: int, stored: int, most: int | None = None) -> None:
    """Refuse claims that a file of its size can hardly mean, before anything is allocated.

    Args:
        what: claims it, for the message.
        claimed: bytes of numbers.
        stored: bytes in the file.
        most: bytes that are read at all; ``None`` where a file is read by stretches.

    Raises:
        Refused: in one line with both sizes.
    """
    if claimed > max(FREE_BYTES, MOST_RATIO * stored):
        raise Refused(
            f"{what} claims {claimed} bytes and stores {stored}, of which {MOST_RATIO} times are "
            "believed; write it again without compression"
        )
    if most is not None and claimed > most:
        raise Refused(
            f"{what} has {claimed} bytes, of its format at most {most} are read; convert it to .h5"
        )


def needs(module: str, what: str) -> ModuleType:
    """A library that is there only if the extra ``formats`` was installed.

    Args:
        module: to import.
        what: it is for, such as ``"reading .h5"``.

    Raises:
        Refused: in one line, if it is absent.
    """
    name = module.partition(".")[0]
    if importlib.util.find_spec(name) is None:
        raise Refused(
            f'{what} needs {name}, which is not installed; pip install "tactslip-torch[formats]"'
        )
    return importlib.import_module(module)
