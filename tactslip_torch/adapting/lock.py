"""One change of a detector at a time, also from several programs."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def locked(model: str | os.PathLike[str]) -> Iterator[None]:
    """A lock file beside a detector, for as long as it is changed.

    A program that is killed leaves it; the message to the next says how to go on.

    Raises:
        ValueError: if another program changes the detector.

    Example:
        >>> model = getfixture("tmp_path") / "detector.pt"
        >>> with locked(model):
        ...     [path.name for path in model.parent.iterdir()]
        ['.detector.pt.lock']
        >>> list(model.parent.iterdir())
        []
    """
    path = Path(model).with_name(f".{Path(model).name}.lock")
    try:
        descriptor = os.open(path, os.O_CREAT | os.O_EXCL | os.O_WRONLY)
    except FileExistsError:
        raise ValueError(
            f"another adapt is changing {os.fspath(model)}; wait for it or, if none runs any more, "
            f"remove {path}"
        ) from None
    try:
        os.close(descriptor)
        yield
    finally:
        path.unlink(missing_ok=True)
