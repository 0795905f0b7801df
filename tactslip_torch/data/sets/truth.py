"""What a person says of a recording: when it slips and when not.

Times are seconds from the first sample. They are written as JSON lists, ``[2.0, 9.0]`` and
``[[2, 7], [9, 11.5]]``, or as people do: ``2.0; 9.0`` and ``2-7; 9-end``.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal, cast

from tactslip_torch.data.sets.manifest_lines import Cell

Stretch = tuple[float, float]
Label = Literal["slip", "non-slip"]
MOMENTS = ("onsets_s", "annotated_onsets_s", "speeds_mm_s")
STRETCHES = ("sliding_s", "slip_s", "non_slip_s", "missing_s")
TRUTH_COLUMNS = (*MOMENTS, *STRETCHES, "label")
_LABELS: dict[str, Label] = {"slip": "slip", "nonslip": "non-slip", "noslip": "non-slip"}
_NUMBER = r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?"
_SPAN = re.compile(rf"({_NUMBER})\s*(?:-|\N{{EN DASH}}|\.\.|to)\s*({_NUMBER}|end)")
_TOUCH_S = 1e-6  # by less than that stretches only touch


@dataclass(frozen=True)
class Truth:
    """When a recording slips, as far as somebody said.

    Args:
        onsets_s: when a slide begins; those of ``sliding_s`` where only they were given.
        annotated_onsets_s: the same as a person marked them, where both are known.
        speeds_mm_s: one for all strokes, or one per onset.
        sliding_s: start and end of the slide behind each onset.
        slip_s: stretches that are slip, begun nobody knows when.
        non_slip_s: stretches that are not.
        missing_s: stretches whose samples are not to be used.
        label: of all of the recording.
    """

    onsets_s: tuple[float, ...] = ()
    annotated_onsets_s: tuple[float, ...] = ()
    speeds_mm_s: tuple[float, ...] = ()
    sliding_s: tuple[Stretch, ...] = ()
    slip_s: tuple[Stretch, ...] = ()
    non_slip_s: tuple[Stretch, ...] = ()
    missing_s: tuple[Stretch, ...] = ()
    label: Label | None = None

    @property
    def is_labelled(self) -> bool:
        """Whether any bin follows from it."""
        return bool(self.onsets_s or self.slip_s or self.non_slip_s or self.label)


def truth_of(cells: Mapping[str, Cell]) -> tuple[Truth | None, list[str]]:
    """The truth that the cells of a line tell, ``None`` if they are all empty, and what is wrong.

    Example:
        >>> truth_of({"onsets_s": "2.0; 9.0", "non_slip_s": "0-1.5"})[0].onsets_s
        (2.0, 9.0)
        >>> truth_of({"onsets_s": "2,5"})[1]
        ["onsets_s: '2,5' is no number; write decimals with a point, and 2.0; 9.0 for several"]
    """
    given = {name: cells[name] for name in TRUTH_COLUMNS if cells.get(name)}
    if not given:
        return None, []
    parts: dict[str, object] = {}
    problems: list[str] = []
    for name, cell in given.items():
        try:
            if name == "label":
                parts[name] = _label(cell)
            elif name in MOMENTS:
                parts[name] = _moments(cell)
            else:
                parts[name] = _stretches(cell)
        except ValueError as error:
            problems.append(f"{name}: {error}")
    if problems:
        return None, problems
    truth = _completed(Truth(**parts))  # type: ignore[arg-type]  # by name
    return truth, _contradictions(truth)


def _completed(truth: Truth) -> Truth:
    """Onsets where only slides or annotations are known, and a speed for every onset."""
    onsets = truth.onsets_s or truth.annotated_onsets_s
    onsets = onsets or tuple(start for start, _ in truth.sliding_s)
    speeds = truth.speeds_mm_s
    speeds = speeds * len(onsets) if len(speeds) == 1 else speeds
    return Truth(**{**vars(truth), "onsets_s": onsets, "speeds_mm_s": speeds})


def _contradictions(truth: Truth) -> list[str]:
    """What cannot all be true, whatever the recording is."""
    found = []
    for name in MOMENTS[:2]:
        moments = getattr(truth, name)
        if any(later <= earlier for earlier, later in pairwise(moments)):
            found.append(f"{name} must ascend, got {_shown(moments)}")
        if any(moment < 0 for moment in moments):
            found.append(f"{name} must not lie before the start, got {_shown(moments)}")
    if any(speed < 0 for speed in truth.speeds_mm_s):
        found.append(f"speeds_mm_s must not be negative, got {_shown(truth.speeds_mm_s)}")
    for name in ("annotated_onsets_s", "sliding_s", "speeds_mm_s"):
        values = getattr(truth, name)
        if values and len(values) != len(truth.onsets_s):
            found.append(
                f"{len(values)} {name} for {len(truth.onsets_s)} onsets; give one for each"
            )
    for name in STRETCHES:
        for start, end in getattr(truth, name):
            if not 0 <= start < end:
                found.append(f"{name}: {start:g}-{end:g} must end behind its start, from 0 on")
    found = found or _overlaps(truth)
    if truth.label and (truth.onsets_s or truth.slip_s or truth.non_slip_s):
        found.append(
            f"label {truth.label} says all of it, and onsets or stretches are given as well; "
            "give one of both"
        )
    return found


def _overlaps(truth: Truth) -> list[str]:
    """Stretches that cannot both be, of a truth whose numbers are fine one by one."""
    found = []
    for name in STRETCHES:
        for clash in _clashes(getattr(truth, name)):
            found.append(f"{name}: {clash} overlap or stand in the wrong order")
    for clash in _clashes((*truth.sliding_s, *truth.slip_s), truth.non_slip_s):
        found.append(f"slip and non-slip overlap: {clash}")
    for clash in _clashes(truth.sliding_s, truth.slip_s):
        found.append(f"sliding_s and slip_s overlap: {clash}")
    if len(truth.sliding_s) == len(truth.onsets_s):
        for onset, (_, end) in zip(truth.onsets_s, truth.sliding_s, strict=True):
            if onset >= end:
                found.append(
                    f"the onset at {onset:g} s is not before the end of its slide, {end:g} s"
                )
    return found


def _clashes(ones: Iterable[Stretch], others: Iterable[Stretch] | None = None) -> list[str]:
    """Stretches that overlap: neighbours of one list, or one of each of two."""
    pairs = pairwise(ones) if others is None else ((a, b) for a in ones for b in others)
    return [
        f"{a[0]:g}-{a[1]:g} and {b[0]:g}-{b[1]:g}"
        for a, b in pairs
        if min(a[1], b[1]) - max(a[0], b[0]) > _TOUCH_S or (others is None and b < a)
    ]


def _label(cell: Cell) -> Label:
    text = cell if isinstance(cell, str) else str(cell)
    known = _LABELS.get(re.sub(r"[\s_-]", "", text.lower()))
    if known is None:
        raise ValueError(f"must be slip, non-slip or empty, got {text[:40]!r}")
    return known


def _moments(cell: Cell) -> tuple[float, ...]:
    return tuple(_number(item) for item in _items(cell))


def _stretches(cell: Cell) -> tuple[Stretch, ...]:
    found = []
    for item in _items(cell):
        if isinstance(item, list) and len(item) == 2:
            found.append((_number(item[0]), _end(item[1])))
        elif isinstance(item, str) and (span := _SPAN.fullmatch(item)):
            found.append((_number(span[1]), _end(span[2])))
        else:
            raise ValueError(
                f"{str(item)[:40]!r} is no stretch; write 2-7; 9-11.5 or [[2, 7], ...]"
            )
    return tuple(found)


def _items(cell: Cell) -> list[Cell]:
    """The parts of a cell; JSON is read to text, so that numbers are judged in one place."""
    if isinstance(cell, list):
        return cell
    if not cell.startswith("["):
        return [part.strip() for part in cell.split(";") if part.strip()]
    try:
        read = json.loads(cell, parse_float=str, parse_int=str, parse_constant=str)
    except (ValueError, RecursionError):
        raise ValueError(f"{cell[:40]!r} is no list; write [2.0, 9.0] or 2.0; 9.0") from None
    return cast("list[Cell]", read)


def _number(item: object) -> float:
    if isinstance(item, str) and re.fullmatch(_NUMBER, item) and math.isfinite(float(item)):
        return float(item)
    raise ValueError(
        f"{str(item)[:40]!r} is no number; write decimals with a point, and 2.0; 9.0 for several"
    )


def _end(item: object) -> float:
    return math.inf if item == "end" else _number(item)


def _shown(values: Iterable[float]) -> str:
    return "; ".join(f"{value:g}" for value in values)
