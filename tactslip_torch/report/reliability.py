"""Whether stated probabilities of slip came true: curves by role, calibration error by material.

The content is ``{role: {**Reliability.to_dict(), "per_material": {material: the same}}}``; a role
or a material may have its ``"ece_interval"``, low and high.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from torch import Tensor

from tactslip_torch.report.tables import SIMULATED_LINE, aligned
from tactslip_torch.runtime import whole_file

_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
_INK, _GREY, _GRID = "#222222", "#666666", "#DDDDDD"
_HEADER = ["role", "material", "bins", "ECE %", "interval", "worst cell %", "Brier", "log loss"]


class _Row(NamedTuple):
    """One role, or one material of it; ``material`` is empty for the whole role."""

    role: str
    material: str
    found: Mapping[str, Any]


def weights_at_share(is_slip: Tensor, slip_share: float) -> Tensor:
    """Weights of mean 1 under which this share of the bins is slip.

    With them ``reliability`` judges probabilities that are stated for the balance of a stream on
    bins of another balance.

    Shape:
        - is_slip: ``[N]``, bool; output: ``[N]``, float64

    Raises:
        ValueError: if a class is absent or the share does not lie between 0 and 1.
    """
    if not 0 < slip_share < 1:
        raise ValueError(f"slip_share must lie between 0 and 1, got {slip_share}")
    if not is_slip.any() or is_slip.all():
        raise ValueError(
            f"expected bins of slip and of non-slip, got one of them in {len(is_slip)}"
        )
    own = float(is_slip.double().mean())
    weights = torch.full(is_slip.shape, (1 - slip_share) / (1 - own), dtype=torch.float64)
    return weights.masked_fill(is_slip.cpu(), slip_share / own)


def interval_by_recording(
    measure: Callable[[Tensor], float],
    recordings: Sequence[object],
    *,
    level: float = 0.95,
    num_resamples: int = 200,
    seed: int = 0,
) -> tuple[float, float]:
    """Bootstrap interval of a measure of weighted bins, whole recordings drawn with replacement.

    Neighbouring bins are alike, so one recording's stay together. Percentiles: of an error that is
    never negative, such as the calibration error, chance adds to both.

    Args:
        measure: from a weight per bin, how often its recording was drawn, to a number.
        recordings: which one each bin is of.
        level: of the interval.
        num_resamples: how often recordings are drawn.
        seed: of the draws.

    Raises:
        ValueError: if there is no bin or the level does not lie between 0 and 1.
    """
    if not recordings or not 0 < level < 1:
        raise ValueError(
            f"an interval needs bins and a level between 0 and 1, got {len(recordings)} bins and "
            f"level {level}"
        )
    numbers = {name: number for number, name in enumerate(dict.fromkeys(recordings))}
    of_bin = torch.tensor([numbers[name] for name in recordings])
    draws = torch.Generator().manual_seed(seed)
    found = []
    for _ in range(num_resamples):
        drawn = torch.randint(len(numbers), (len(numbers),), generator=draws)
        times = torch.bincount(drawn, minlength=len(numbers)).double()
        found.append(measure(times[of_bin]))
    ends = torch.tensor([(1 - level) / 2, (1 + level) / 2], dtype=torch.float64)
    low, high = torch.tensor(found, dtype=torch.float64).quantile(ends).tolist()
    return low, high


def reliability_table(by_role: Mapping[str, Mapping[str, Any]], *, simulated: bool) -> str:
    """Calibration error, Brier score and log loss of each role, and of each material in it.

    Args:
        by_role: as above.
        simulated: whether the data is.
    """
    rows = [
        [
            "" if row.material else row.role,
            row.material or "all",
            f"{sum(row.found['counts']):.0f}",
            f"{100 * row.found['ece']:.2f}",
            _interval(row.found),
            f"{100 * row.found['mce']:.2f}",
            f"{row.found['brier']:.4f}",
            f"{row.found['log_loss']:.4f}",
        ]
        for row in _rows(by_role)
    ]
    head = [SIMULATED_LINE] if simulated else []
    return "\n".join([*head, aligned(_HEADER, rows, num_left=2)])


def reliability_figure(
    by_role: Mapping[str, Mapping[str, Any]], path: str | Path, *, simulated: bool
) -> None:
    """Write the reliability curve of each role with its counts, and the error of each material.

    Args:
        by_role: as above.
        path: the PNG to write, replaced as a whole if it exists.
        simulated: whether the data is.

    Raises:
        ValueError: if there is no role.
    """
    if not by_role:
        raise ValueError("there is no role whose probabilities could be drawn")
    rows = list(_rows(by_role))
    figure = Figure(figsize=(10.5, max(5.2, 1.6 + 0.26 * len(rows))), layout="constrained")
    grid = figure.add_gridspec(2, 2, height_ratios=(4, 1), width_ratios=(1.15, 1))
    curves = figure.add_subplot(grid[0, 0])
    counts = figure.add_subplot(grid[1, 0], sharex=curves)
    errors = figure.add_subplot(grid[:, 1])
    colours = {role: _COLOURS[place % len(_COLOURS)] for place, role in enumerate(by_role)}
    _curves(curves, by_role, colours)
    _counts(counts, by_role, colours)
    _errors(errors, rows, colours)
    kind = " (simulated data)" if simulated else ""
    figure.suptitle(f"Does a stated probability of slip come true?{kind}", fontsize=12)
    with whole_file(path) as temporary:
        figure.savefig(temporary, format="png", dpi=160, facecolor="white")


def _rows(by_role: Mapping[str, Mapping[str, Any]]) -> Iterator[_Row]:
    for role, found in by_role.items():
        yield _Row(role, "", found)
        for material, own in found.get("per_material", {}).items():
            yield _Row(role, material, own)


def _interval(found: Mapping[str, Any]) -> str:
    if not found.get("ece_interval"):
        return "-"
    low, high = found["ece_interval"]
    return f"{100 * low:.2f} to {100 * high:.2f}"


def _curves(
    axes: Axes, by_role: Mapping[str, Mapping[str, Any]], colours: Mapping[str, str]
) -> None:
    axes.plot([0, 1], [0, 1], color=_GREY, linewidth=1, linestyle="--", label="as stated")
    for role, found in by_role.items():
        bins = f"{sum(found['counts']):,.0f}".replace(",", "\N{THIN SPACE}")
        label = f"{role}: {bins} bins, ECE {100 * found['ece']:.2f} %"
        style: dict[str, Any] = {"color": colours[role], "linewidth": 1.5, "markersize": 5}
        axes.plot(found["probabilities"], found["slip_shares"], "o-", label=label, **style)
    axes.set_xlim(-0.03, 1.03)
    axes.set_ylim(-0.03, 1.03)
    axes.set_ylabel("share of bins that slip")
    axes.tick_params(labelbottom=False)
    axes.grid(color=_GRID)
    axes.legend(frameon=False, fontsize=9, loc="upper left")


def _counts(
    axes: Axes, by_role: Mapping[str, Mapping[str, Any]], colours: Mapping[str, str]
) -> None:
    """How many bins each cell holds, at its mean probability, the roles side by side."""
    width = 0.01
    for place, (role, found) in enumerate(by_role.items()):
        aside = (place - (len(by_role) - 1) / 2) * width
        at = [probability + aside for probability in found["probabilities"]]
        axes.bar(at, found["counts"], width=width, color=colours[role])
    axes.set_xlabel("stated probability of slip, mean of a cell")
    axes.set_ylabel("bins")
    axes.grid(color=_GRID, axis="y")
    axes.set_axisbelow(True)


def _errors(axes: Axes, rows: Sequence[_Row], colours: Mapping[str, str]) -> None:
    """A bar for each material, and for each role a full one with its interval."""
    for place, row in enumerate(rows):
        value = 100 * row.found["ece"]
        axes.barh(place, value, color=colours[row.role], alpha=0.45 if row.material else 1.0)
        most = value
        if row.found.get("ece_interval"):
            low, high = (100 * end for end in row.found["ece_interval"])
            axes.plot([low, high], [place, place], color=_INK, linewidth=1.5)
            most = max(value, high)
        axes.text(most, place, f" {value:.2f}", va="center", fontsize=8, color=_GREY)
    axes.set_yticks(range(len(rows)), [row.material or f"{row.role}, all" for row in rows])
    axes.tick_params(axis="y", length=0, labelsize=9)
    axes.invert_yaxis()
    axes.margins(x=0.15)
    axes.set_xlim(left=0)
    axes.set_xlabel("expected calibration error, %")
    axes.grid(color=_GRID, axis="x")
    axes.set_axisbelow(True)
