"""How each of the 17 descriptors answers when the signal it describes is changed.

From the definitions of REFERENCE.md section 4, quirks included; ``tests/test_invariance.py`` proves
every cell, "neither" by a counterexample. In the time domain a row speaks of the signal itself (a
gauge's bin or a film's branch), in the frequency domain of a signal whose spectrum is described.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

from tactslip_torch.features.descriptors import SPECTRUM_DESCRIPTORS, TIME_DESCRIPTORS

Offset = Literal["same", "shifts", "neither"]
Polarity = Literal["even", "odd", "neither"]
Order = Literal["same", "neither"]


@dataclass(frozen=True)
class Invariance:
    """One descriptor's answers to changes of its signal.

    Args:
        descriptor: name in ``descriptors.py``, or ``"band_energy_ratio"``.
        domain: ``"time"`` or ``"freq"``.
        gain: the signal times ``g > 0`` gives the value times ``g`` to this power.
        offset: the signal plus ``c`` gives the same value, the value plus ``c``, or neither.
        detail_offset: the same for a detail branch D, when ``c`` is added to the bin it is of.
        polarity: the negated signal gives the same value, the negated value, or neither.
        reversal: samples in reverse order.
        permutation: samples in any other order.
        note: where the answer ends, or why it is what it is.
        channels: with the channels of a kind in another order, the pool's features follow them.
    """

    descriptor: str
    domain: Literal["time", "freq"]
    gain: Literal[0, 1, 2]
    offset: Offset
    detail_offset: Offset
    polarity: Polarity
    reversal: Order
    permutation: Order
    note: str = ""
    channels: Literal["equivariant"] = "equivariant"


_MODE = "an offset widens what counts as one value"
_CV = "positive where the mean is 0"
_ENERGY = "up to the largest finite number"
_ENTROPY = "halves round up, the two highest levels share a cell"
_PEAK = "the signed maximum"
_CORRELATION = "branch and bin changed together"
_RATIO = "the offset is energy of the A branches"


def _in_time(
    descriptor: str, gain: Literal[0, 1, 2], offset: Offset, polarity: Polarity, note: str = ""
) -> Invariance:
    """No descriptor of values looks at their order; a detail has no offset."""
    return Invariance(descriptor, "time", gain, offset, "same", polarity, "same", "same", note)


def _of_spectrum(descriptor: str, gain: Literal[0, 1, 2], note: str = "") -> Invariance:
    """A spectrum knows neither polarity nor the direction of time; an offset leaks into it."""
    is_ratio = descriptor == "band_energy_ratio"
    detail: Offset = "neither" if is_ratio else "same"
    return Invariance(descriptor, "freq", gain, "neither", detail, "even", "same", "neither", note)


INVARIANCES = (
    _in_time("mean", 1, "shifts", "odd"),
    _in_time("median", 1, "shifts", "odd"),
    _in_time("mode", 1, "shifts", "neither", f"smallest of ties; {_MODE}"),
    _in_time("range", 1, "same", "even"),
    _in_time("mean_deviation", 1, "same", "even"),
    _in_time("std", 1, "same", "even"),
    _in_time("cv", 0, "neither", "odd", _CV),
    _in_time("iqr", 1, "same", "even"),
    _in_time("skewness", 0, "same", "odd"),
    _in_time("kurtosis", 0, "same", "even"),
    _in_time("energy", 2, "neither", "even", _ENERGY),
    _in_time("entropy", 0, "same", "neither", _ENTROPY),
    _in_time("peak_factor", 0, "neither", "neither", _PEAK),
    _in_time("correlation", 0, "same", "even", _CORRELATION),
    _of_spectrum("mean", 1),
    _of_spectrum("median", 1),
    _of_spectrum("mode", 1, _MODE),
    _of_spectrum("range", 1),
    _of_spectrum("mean_deviation", 1),
    _of_spectrum("std", 1),
    _of_spectrum("cv", 0),
    _of_spectrum("iqr", 1),
    _of_spectrum("skewness", 0),
    _of_spectrum("kurtosis", 0),
    _of_spectrum("energy", 2, _ENERGY),
    _of_spectrum("entropy", 0),
    _of_spectrum("peak_factor", 0),
    _of_spectrum("spectral_centroid", 0),
    _of_spectrum("spectral_spread", 0),
    _of_spectrum("band_energy_ratio", 0, _RATIO),
)
_BY_NAME: dict[tuple[str, str], Invariance] = {
    (row.domain, row.descriptor): row for row in INVARIANCES
}
_ANSWERS = ("gain g", "offset c", "offset, D", "polarity", "reversed", "permuted", "channels")
_HEADER = ("descriptor", "of", *_ANSWERS, "remark")
_LEGEND = """\
Gain g > 0 and offset c are of the signal itself: of a gauge's bin, of a branch, or of the signal
whose spectrum is described. "Offset, D" is for the detail branches, and their spectra, of a bin
that is offset; the approximations A follow the column before. Reversed and permuted are the
samples of the signal; no branch of a bin is that of the reversed or permuted bin, so of films every
feature is neither. Channels: put in another order within their kind, features follow. Exact
numbers are meant: the limits are rounding, and a span below 16 eps of the bin's magnitude, which
counts as constant."""


def feature_invariance(component: str, domain: str, descriptor: str) -> Invariance:
    """The answers of a feature of the pool to changes of its channel's bin.

    Those of the descriptor, but that a branch of a reversed or permuted bin is another branch.
    ``offset`` is the one that holds for the component.

    Args:
        component: ``"raw"`` or a branch, as ``FeatureName`` has it.
        domain: ``"time"`` or ``"freq"``.
        descriptor: as ``FeatureName`` has it.

    Raises:
        ValueError: if there is no such feature.

    Example:
        >>> feature_invariance("D2", "time", "mean").offset
        'same'
    """
    row = _BY_NAME.get((domain, descriptor))
    if row is None or component[:1] not in ("r", "A", "D"):
        known = sorted({*TIME_DESCRIPTORS, *SPECTRUM_DESCRIPTORS, "band_energy_ratio"})
        raise ValueError(
            f"no feature {component} {domain} {descriptor}; components are raw, A1, D1, ..., "
            f"domains time and freq, descriptors {', '.join(known)}"
        )
    if component == "raw":
        return row
    offset = row.detail_offset if component[0] == "D" else row.offset
    return replace(row, offset=offset, reversal="neither", permutation="neither")


def invariance_table() -> str:
    """The table in Markdown, columns aligned, and how to read it; README.md carries it.

    Example:
        >>> print(invariance_table().splitlines()[0][:39])
        | descriptor        | of       | gain g
    """
    gains = {0: "same", 1: "g", 2: "g^2"}
    offsets = {"same": "same", "shifts": "+ c", "neither": "neither"}
    lines: list[tuple[str, ...]] = [_HEADER]
    lines += [
        (
            row.descriptor.replace("_", " "),
            "signal" if row.domain == "time" else "spectrum",
            gains[row.gain],
            offsets[row.offset],
            offsets[row.detail_offset],
            row.polarity,
            row.reversal,
            row.permutation,
            row.channels,
            row.note,
        )
        for row in INVARIANCES
    ]
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    lines.insert(1, tuple("-" * width for width in widths))
    table = [
        " | ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True))
        for line in lines
    ]
    return "\n".join([*(f"| {line} |" for line in table), "", _LEGEND])
