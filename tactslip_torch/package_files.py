"""The package's own files: detectors, classifiers and sums, each plain values and finite tensors.

A file is an archive as ``torch.save`` writes it, with a format, JSON text and tensors by name. Size
and check sums are looked at here; whether parts fit together, where they are put together.
"""

from __future__ import annotations

import json
import os
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from tactslip_torch.runtime import whole_file

DETECTOR = "tactslip_torch detector 5"
SUMS = "tactslip_torch sums 3"
SIDECAR = "tactslip_torch onnx 2"
_MOST_JSON_BYTES = 2**24
DAMAGE_ERRORS = (
    ArithmeticError,
    AttributeError,
    EOFError,
    LookupError,
    RuntimeError,
    TypeError,
    ValueError,
)
"""What comes of a part that is made of wrong values."""


def save_table(
    path: str | os.PathLike[str],
    form: str,
    metadata: Mapping[str, Any],
    tensors: Mapping[str, Tensor],
) -> None:
    """Write tensors and JSON-able metadata to one file, whole or not at all.

    The same metadata and tensors give the same bytes.

    Args:
        path: of the file.
        form: names the format and, last, its number; ``load_table`` wants the same.
        metadata: kept as JSON text.
        tensors: by name; of a view no more is written than it shows.
    """
    content = {
        "format": form,
        "metadata": json.dumps(metadata, sort_keys=True),
        "tensors": {k: v.detach().cpu().contiguous().clone() for k, v in sorted(tensors.items())},
    }
    with whole_file(path) as temporary, temporary.open("wb") as file:
        torch.save(content, file)  # handed a path, it would write its name into the file


def load_table(
    path: str | os.PathLike[str], form: str, most_bytes: int = 2**33
) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """Metadata and tensors of a file that ``save_table`` wrote; nothing in it is executed.

    Args:
        path: of the file.
        form: that it must be of.
        most_bytes: that it may hold.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is no file, has another format, holds more than that, is damaged, or a
            number in it is not finite.
    """
    content = _load(path, most_bytes)
    kind, number = form.rsplit(" ", 1)
    if content["format"] in {f"{kind} {earlier}" for earlier in range(1, int(number))}:
        raise ValueError(
            f"{os.fspath(path)} was made by version 0.2.0 or earlier; make it again, or use that "
            "version"
        )
    if content["format"] != form:
        raise ValueError(
            f"{os.fspath(path)} must be of format {form!r}, got {content['format']!r:.80}"
        )
    with reading(path):
        metadata, tensors = json.loads(content["metadata"]), content["tensors"]
        for name, tensor in tensors.items():
            if not (tensor.is_contiguous() and bool(tensor.isfinite().all())):
                raise ValueError(f"{name} must be finite and contiguous")
    return metadata, tensors


def read_json(path: str | os.PathLike[str], form: str) -> dict[str, Any]:
    """The content of a JSON file of the package, at most 16 MiB.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is no JSON, longer than that, or of another format.
    """
    text = _regular_file(path, _MOST_JSON_BYTES).read_bytes()
    with reading(path):
        content: dict[str, Any] = json.loads(text)
        if content["format"] != form:
            raise ValueError(f"its format must be {form!r}, got {content['format']!r:.80}")
    return content


@contextmanager
def reading(path: str | os.PathLike[str]) -> Iterator[None]:
    """Within it, what wrong values of a file lead to becomes one line that names the file.

    Raises:
        ValueError: in place of ``DAMAGE_ERRORS`` and of what is nested too deeply.

    Example:
        >>> with reading("a.pt"):
        ...     int("twelve")
        Traceback (most recent call last):
        ValueError: a.pt is damaged: invalid literal for int() with base 10: 'twelve'; make it again
    """
    try:
        yield
    except DAMAGE_ERRORS as error:
        lines = str(error).splitlines() or [type(error).__name__]
        line = lines[0] if not isinstance(error, KeyError) else f"{lines[0]} is missing"
        raise ValueError(f"{os.fspath(path)} is damaged: {line:.200}; make it again") from error


def _load(path: str | os.PathLike[str], most_bytes: int) -> dict[str, Any]:
    """A dictionary with a format, of an archive whose check sums fit."""
    file = _regular_file(path, most_bytes)
    try:
        with zipfile.ZipFile(file) as archive:
            if sum(member.file_size for member in archive.infolist()) > most_bytes:
                raise ValueError("it unpacks to too much")
            if (damaged := archive.testzip()) is not None:  # torch does not look at check sums
                raise ValueError(f"{damaged} is damaged")
        content = torch.load(file, map_location="cpu", weights_only=True)
        if not isinstance(content, dict) or not isinstance(content.get("format"), str):
            raise ValueError("it has no format")
    except Exception as error:  # archives and pickles raise many kinds for what is not their own
        raise ValueError(
            f"{os.fspath(path)} is damaged or no file of this package; make it again"
        ) from error
    return content


def _regular_file(path: str | os.PathLike[str], most_bytes: int) -> Path:
    """The path of a file that can be read from start to end: no folder, device or pipe.

    Opening a pipe would wait for whoever writes to it.

    Args:
        path: of the file.
        most_bytes: that it may be long.

    Raises:
        FileNotFoundError: if there is nothing.
        ValueError: if it is no file, or longer than that.
    """
    path = Path(path)
    if not path.exists():
        raise FileNotFoundError(f"no file at {path}")
    if not path.is_file():
        kind = "a folder" if path.is_dir() else "a device or pipe"
        raise ValueError(f"{path} is {kind}, expected a file; copy it to a file first")
    if (size := path.stat().st_size) > most_bytes:
        raise ValueError(f"{path} has {size} bytes, at most {most_bytes:.0f} can be read")
    return path
