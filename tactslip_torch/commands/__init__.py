"""One module for each command; they alone know Hydra."""

from pathlib import Path

_PACKAGE = Path(__file__).resolve().parents[1]


def packaged_folder(name: str, hint: str) -> Path:
    """A folder inside the package (wheel) or beside it (checkout); ``hint`` is a file in it."""
    for folder in (_PACKAGE / name, _PACKAGE.parent / name):
        if (folder / hint).is_file():
            return folder
    raise FileNotFoundError(f"no {name} folder with {hint} in or beside {_PACKAGE}; reinstall")
