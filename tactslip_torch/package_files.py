"""The project's own files: tables of tensors and JSON, and the one schema of what they hold.

A table is an archive as ``torch.save`` writes it. Members must be stored as they are and tensors
fill their storage, so a file takes no more memory than it is long; nothing in it is executed.
"""

from __future__ import annotations

import json
import math
import os
import pickletools
import re
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, get_args

import torch
from torch import Tensor

from tactslip_torch.hand import Adapting
from tactslip_torch.runtime import content_digest, regular_file, whole_file

DAMAGE_ERRORS = (
    ArithmeticError,
    AttributeError,
    EOFError,
    LookupError,
    RuntimeError,
    TypeError,
    ValueError,
)
"""What comes of a file that another program wrote, where a part is made of what it says."""

# Tables ------------------------------------------------------------------------------------------


def save_table(
    path: str | os.PathLike[str],
    form: str,
    metadata: Mapping[str, Any],
    tensors: Mapping[str, Tensor],
) -> None:
    """Write tensors and JSON-able metadata to one file, whole or not at all.

    The same metadata and tensors give the same bytes. Of a view, no more is written than it shows.

    Args:
        path: of the file.
        form: names the format and, last, its number; ``load_table`` wants the same.
        metadata: kept as JSON text.
        tensors: by name.
    """
    text = json.dumps(metadata, sort_keys=True)
    content = {
        "format": form,
        "metadata": text,
        "tensors": {name: _alone(tensors[name]) for name in sorted(tensors)},
        "digest": _digest(text, tensors),
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
        most_bytes: that it may be long.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is no file, has another format, is longer than that, is damaged, or holds
            what ``SCHEMAS`` does not allow.
    """
    name = os.fspath(path)
    content = _read(regular_file(path, most_bytes))
    kind, number = form.rsplit(" ", 1)
    if content["format"] in {f"{kind} {earlier}" for earlier in range(1, int(number))}:
        raise ValueError(
            f"{name} was made by version 0.2.0 or earlier; make it again, or use that version"
        )
    if content["format"] != form:
        raise ValueError(f"{name} must be of format {form!r}, got {content['format']!r:.80}")
    try:
        metadata, tensors = content["metadata"], content["tensors"]
        is_whole = all(map(Tensor.is_contiguous, tensors.values()))  # else larger than the file
        is_whole = is_whole and content["digest"] == _digest(metadata, tensors)
        metadata = json.loads(metadata)
    except (AttributeError, KeyError, TypeError, ValueError, RecursionError):
        is_whole = False
    if not is_whole:
        raise ValueError(f"{name} is damaged or no file of ours; make it again")
    checked(name, metadata, form)
    for place, tensor in tensors.items():
        is_finite = form not in SCHEMAS or bool(tensor.isfinite().all())
        if not is_finite:
            raise ValueError(f"{name} is damaged: {place} must be finite; make it again")
    return metadata, tensors


def _alone(tensor: Tensor) -> Tensor:
    """The values without a larger storage around them, which ``torch.save`` would write too."""
    tensor = tensor.detach().cpu().contiguous()
    is_all = tensor.untyped_storage().nbytes() == tensor.numel() * tensor.element_size()
    return tensor if is_all else tensor.clone()


def _digest(text: str, tensors: Mapping[str, Tensor]) -> str:
    names = sorted(tensors)
    head = torch.frombuffer(bytearray((text + "\n".join(names)).encode()), dtype=torch.uint8)
    return content_digest(head, *(tensors[name] for name in names))


_MAY_NAME = re.compile(
    r"torch\._utils _rebuild_tensor_v2|collections OrderedDict|"
    r"torch (Double|Float|Half|BFloat16|Long|Int|Short|Char|Byte|Bool)Storage"
)
"""What the pickle in an archive may name, of all that ``torch.load`` would let pass."""


def _read(path: Path) -> dict[str, Any]:
    """What ``save_table`` wrote, unchecked but for its format being text."""
    try:
        with zipfile.ZipFile(path) as archive:
            members = archive.infolist()
            is_stored = all(
                member.compress_type == zipfile.ZIP_STORED and not member.flag_bits & 1
                for member in members
            )
            if not is_stored or sum(m.file_size for m in members) > path.stat().st_size:
                raise ValueError("members must be stored as they are")
            text = archive.read(f"{members[0].filename.split('/')[0]}/data.pkl")
        for opcode, name, _ in pickletools.genops(text):
            if "GLOBAL" in opcode.name and not _MAY_NAME.fullmatch(str(name)):
                raise ValueError(f"{name} has no place in a table")
        content = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # archives and pickles raise many kinds for what is not their own
        raise ValueError(f"{path} is damaged or no file of ours; make it again") from error
    if not isinstance(content, dict) or not isinstance(content.get("format"), str):
        raise ValueError(f"{path} is damaged or no file of ours; make it again")
    return content


def read_checkpoint(path: str | os.PathLike[str]) -> dict[str, Any]:
    """What is in a checkpoint of a training of ours, held against its schema.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is none, or damaged.
    """
    try:
        content = _read(regular_file(path, 2**33))
    except ValueError as error:
        raise ValueError(f"{error}; give last.ckpt of a run, or its folder") from None
    found: dict[str, Any] = checked(os.fspath(path), content, CHECKPOINT)
    return found


def read_json(path: str | os.PathLike[str], form: str, most_bytes: int = 2**24) -> dict[str, Any]:
    """The content of a JSON file of ours, held against the schema of its format.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is no JSON, longer than that, or not what the schema wants.
    """
    file = regular_file(path, most_bytes)
    try:
        content = json.loads(file.read_bytes())
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{os.fspath(path)} is damaged ({error}); make it again") from None
    found: dict[str, Any] = checked(os.fspath(path), content, form)
    return found


# Schema ------------------------------------------------------------------------------------------
#
# What a field may be: a type; a function of its value that returns what was wanted, or None if it
# is right; a dictionary of the fields of a mapping ("name?" may be absent or null, "*" is of all
# others); a list of one such thing for a list, and of how many entries it may have at most.

Wanted = type[Any] | Callable[[Any], str | None] | Mapping[str, Any] | list[Any]
_TYPES: Mapping[Any, str] = {str: "text", bool: "true or false"}


def checked(name: str, content: Any, form: str) -> Any:
    """``content``, if it is what ``SCHEMAS`` say of this format.

    Raises:
        ValueError: that names the file, the field, what was wanted and what it is.
    """
    if problem := _problem(content, SCHEMAS.get(form, object), ""):
        raise ValueError(f"{name} is damaged: {problem}; make it again")
    return content


def _problem(value: Any, wanted: Wanted, field: str) -> str | None:
    if callable(wanted):
        if not isinstance(wanted, type):
            said = wanted(value)
        else:
            said = None if isinstance(value, wanted) else _TYPES[wanted]
        return said and f"{field} must be {said}, got {value!r:.60}"
    if isinstance(wanted, list):
        each, most = wanted
        is_list = isinstance(value, list | tuple)  # no JSON has the latter
        if not is_list or len(value) > most:
            got = len(value) if is_list else f"{value!r:.60}"
            return f"{field} must be a list of at most {most}, got {got}"
        problems = (_problem(x, each, f"{field}[{i}]") for i, x in enumerate(value))
        return next(filter(None, problems), None)
    if not isinstance(value, dict):
        return f"{field or 'content'} must be a mapping, got {value!r:.60}"
    before = f"{field}." if field else ""
    for key, each in wanted.items():
        own = key.rstrip("?")
        if key == "*" or (own != key and value.get(own) is None):
            continue
        if own not in value:
            return f"{before}{own} is missing"
        if said := _problem(value[own], each, f"{before}{own}"):
            return said
    known = {key.rstrip("?") for key in wanted}
    for key in value.keys() - known:
        if "*" not in wanted:
            return f"{before}{key:.60} is not known"
        if said := _problem(value[key], wanted["*"], f"{before}{key:.60}"):
            return said
    return None


def _number(least: float, most: float, *, whole: bool = False) -> Callable[[Any], str | None]:
    kind = "a whole number" if whole else "a number"

    def wanted(value: Any) -> str | None:
        is_number = type(value) is int or (type(value) is float and not whole)
        is_right = is_number and least <= value <= most
        return None if is_right else f"{kind} from {least:g} to {most:g}"

    return wanted


def _one_of(*choices: Any) -> Callable[[Any], str | None]:
    def wanted(value: Any) -> str | None:
        is_known = any(type(value) is type(choice) and value == choice for choice in choices)
        return None if is_known else f"one of {', '.join(map(str, choices))}"

    return wanted


def _either(first: Wanted, second: Wanted) -> Callable[[Any], str | None]:
    """The first or, of mappings and where the first is wrong, the second."""

    def wanted(value: Any) -> str | None:
        said = _problem(value, first, "it") and _problem(value, second, "it")
        return said and said.removeprefix("it must be ").split(", got ")[0]

    return wanted


def _tensor_of_finite(value: Any) -> str | None:
    is_right = isinstance(value, Tensor) and value.dtype.is_floating_point and value.is_contiguous()
    return None if is_right and bool(value.isfinite().all()) else "a tensor of finite numbers"


_positive, _share = _number(1e-30, 1e30), _number(0, 1)
_finite, _seconds = _number(-1e300, 1e300), _number(0, 1e9)
_threshold = _number(-1e300, math.inf)
_rate = _number(1e-3, 1e7)
_count = _number(0, 2**48, whole=True)
_names = [str, 10**6]
MOST_BIN_SAMPLES, MOST_CHANNELS, MOST_FRAME = 1024, 2048, 4001
"""Of a detector: beyond these its constant matrices take gigabytes or minutes."""

_CHANNELS = [
    {
        **dict.fromkeys(("name", "kind", "finger", "segment"), str),
        "adapting?": _one_of(*get_args(Adapting)),
    },
    MOST_CHANNELS,
]
_FILTERS = {
    "name": str,
    **{name: [_number(-1e6, 1e6), 512] for name in ("dec_lo", "dec_hi", "rec_lo", "rec_hi")},
}
_POOL = {
    "sample_rate_hz": _rate,
    "bin_samples": _number(1, MOST_BIN_SAMPLES, whole=True),
    "wavelet": _either(str, _FILTERS),
    "level": _number(1, 16, whole=True),
    "spectrum": str,
    "arithmetic": str,
}
_KERNEL = {
    "kind": str,
    "degree?": _one_of(1, 2),
    "offset?": _number(0, 1e100),
}
_CALIBRATION = {
    "kind": str,
    "slope?": _number(0, 1e300),
    "offset?": _finite,
    "scores?": [_finite, 10**5],
    "llrs?": [_finite, 10**5],
}
_RULE = {
    "name": str,
    "k?": _number(1, 10**4, whole=True),
    "n?": _number(1, 10**4, whole=True),
    "drift?": _finite,
    "evidence?": _number(1e-12, 1),
    "ceiling?": _number(1e-300, math.inf),
}
_ONSET = {
    "hop_samples": _number(1, 10**5, whole=True),
    "mains_hz": _number(10, 1000),
    "comb_periods": _number(1, 16, whole=True),
    "fast_compression": [_positive, 64],
    "slow_compression": [_positive, 64],
    **{name: [_finite, 4096] for name in ("minimum", "maximum", "linear")},
    "quadratic": [[_finite, 4096], 4096],
    "constant": _finite,
    "threshold": _threshold,
    "lead_s": _number(-1e6, 1e6),
    "least_rms": [[_number(0, 1e300), 64], MOST_CHANNELS],
    "min_alive": _number(1, MOST_CHANNELS, whole=True),
}
_SENSING = {
    "rest_span": [_number(0, 1e300), MOST_CHANNELS],
    "most_span": [_either(_number(0, 1e300), _one_of(None)), MOST_CHANNELS],
    "min_alive": _number(1, MOST_CHANNELS, whole=True),
    "stuck_samples": _count,
}
_ALARM = {
    "hop_samples": _number(1, 10**7, whole=True),
    "calibration": _CALIBRATION,
    "rule": _RULE,
    "threshold": _threshold,
    "target_per_hour?": _number(1e-9, 1e9),
    "slip_share": _share,
    "rearm_s": _seconds,
    "refractory_s": _seconds,
    "hold_s": _seconds,
    "lead_s": _number(-1e6, 1e6),
    "metadata": {"*": object},
    "onset?": _ONSET,
}
_INFO = {
    "alarm?": _ALARM,
    "calibration?": _CALIBRATION,
    "simulated?": bool,
    "units?": str,
    "features_dtype?": _one_of("float64", "float32"),
    "train_materials?": _names,
    "train_sessions?": _names,
    "*": object,
}
CHECKPOINT = "tactslip_torch checkpoint 2"
_epoch = _number(0, 2, whole=True)
_CHECKPOINT = {
    "format": _one_of(CHECKPOINT),
    "epoch": _epoch,
    "fingerprint": str,
    "loops": {
        "fit_loop": {
            "epoch_progress": {"*": {"*": _epoch}},
            "*": object,
        },
        "*": object,
    },
    "plan": {
        "kernel": _KERNEL,
        "penalty": _number(1e-300, math.inf),
        "fractions": [_share, 2],
        "num_bins": _count,
        "imputation": _tensor_of_finite,
        "selected": [_number(0, 10**7, whole=True), 10**6],
        "scaler": {"*": _tensor_of_finite},
        "*": object,
    },
    "*": object,
}
DETECTOR = "tactslip_torch detector 5"
SUMS = "tactslip_torch sums 3"
SIDECAR = "tactslip_torch onnx 2"
SCHEMAS: Mapping[str, Wanted] = {
    DETECTOR: {
        "channels": _CHANNELS,
        "pool": _POOL,
        "window_lengths": [_number(1, MOST_FRAME, whole=True), MOST_CHANNELS],
        "polyorder": _number(0, 20, whole=True),
        "align": str,
        "kernels?": {"*": [_number(-1e6, 1e6), MOST_FRAME]},
        "selected": [_number(0, 10**7, whole=True), 10**6],
        "pooling?": {"names": [[str, 8], 10**6]},
        "kernel?": _KERNEL,
        "sensing": _SENSING,
        "info": _INFO,
    },
    SUMS: {
        "num_features": _number(1, 10**5, whole=True),
        "degree?": _one_of(1, 2),
        "metadata?": {"*": object},
        "batches": {"*": str},
    },
    SIDECAR: {
        "format": _one_of(SIDECAR),
        "graph": _one_of("bin", "stream"),
        "precision": _one_of("float32", "float64"),
        "channels": [str, MOST_CHANNELS],
        "kinds": [str, MOST_CHANNELS],
        "sample_rate_hz": _rate,
        "bin_samples": _number(1, MOST_BIN_SAMPLES, whole=True),
        "onnx_bytes": _count,
        "onnx_sha256": str,
        "detector_sha256": str,
        "calibration?": _CALIBRATION,
        "check": {"worst_sd": _number(0, 1e300), "*": object},
        "*": object,
    },
    CHECKPOINT: _CHECKPOINT,
}
"""What the metadata of each format must be."""
