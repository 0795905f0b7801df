"""What closed-form validation on held-out groups found for every choice: a table and a figure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from tactslip_torch.report.tables import SIMULATED_LINE, aligned
from tactslip_torch.runtime import whole_file

_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
_DASHES = ("-", "--", ":", "-.")


def validation_table(
    rows: Sequence[Mapping[str, Any]],
    *,
    simulated: bool,
    nested: Mapping[str, Any] | None = None,
) -> str:
    """The mean balanced accuracy of choices and of their worst group.

    Of a nested choice the best penalty of each structure, the chosen row, the worst group at its
    own best threshold, and below what the choice itself scores on groups that it did not see.

    Args:
        rows: of ``metrics["validation"]``.
        simulated: whether the data is.
        nested: of ``metrics["nested_validation"]``.
    """
    is_nested = any("use" in row for row in rows)
    chosen = _chosen(rows)
    shown = list(rows)
    if is_nested:
        best: dict[tuple[str, ...], Mapping[str, Any]] = {}
        for row in rows:
            if row["mean"] > best.get(_structure(row), {"mean": -1.0})["mean"]:
                best[_structure(row)] = row
        shown = [row for row in rows if row is chosen or row is best[_structure(row)]]
    cells = []
    for row in shown:
        scores = {k: v for k, v in row["balanced_accuracy"].items() if v is not None}
        worst = min(scores, key=lambda name: scores[name])
        cell = [
            "*" if row is chosen else "",
            *_structure(row),
            f"{row['penalty']:g}",
            f"{100 * row['mean']:.2f}",
            f"{100 * scores[worst]:.2f}",
            worst,
        ]
        if is_nested:
            cell.append(f"{100 * row['worst']['at_best_threshold']:.2f}")
        cells.append(cell)
    header = ["chosen", *(["features"] if is_nested else []), "K", "kernel", "C", "validation %"]
    header += ["worst %", "group", *(["at its best threshold %"] if is_nested else [])]
    lines = [SIMULATED_LINE] if simulated else []
    lines.append(aligned(header, cells))
    if nested:
        by_group = ", ".join(f"{n} {100 * v:.2f}" for n, v in nested["balanced_accuracy"].items())
        lines.append(
            f"the choice itself, made without each group and evaluated on it: "
            f"{100 * nested['mean']:.2f} % ({by_group})"
        )
    return "\n".join(lines)


def validation_figure(
    rows: Sequence[Mapping[str, Any]], path: str | Path, *, simulated: bool
) -> None:
    """Write the balanced accuracy on left-out groups over C, one line for each structure.

    Thin lines are the groups, of the chosen structure alone.

    Args:
        rows: of ``metrics["validation"]``.
        path: the PNG to write, replaced as a whole if it exists.
        simulated: whether the data is.
    """
    figure = Figure(figsize=(8.4, 4.6), layout="constrained")
    axes = figure.subplots()
    chosen = _chosen(rows)
    structures = list(dict.fromkeys(map(_structure, rows)))
    uses = list(dict.fromkeys(structure[:-2] for structure in structures))
    for place, structure in enumerate(structures):
        own = [row for row in rows if _structure(row) == structure]
        own.sort(key=lambda row: float(row["penalty"]))
        penalties = [row["penalty"] for row in own]
        # of a nested choice a colour is a kind of features, and a dash the rest
        others = list(dict.fromkeys(other[-2:] for other in structures))
        dash = _DASHES[others.index(structure[-2:]) % len(_DASHES)] if len(uses) > 1 else "-"
        colour = _COLOURS[(uses.index(structure[:-2]) if len(uses) > 1 else place) % len(_COLOURS)]
        *use, size, kernel = structure
        label = ", ".join([*use, f"K = {size}", kernel])
        means = [100 * row["mean"] for row in own]
        axes.plot(penalties, means, marker="o", ls=dash, color=colour, label=label, lw=2)
        if structure != _structure(chosen):
            continue
        for group in own[0]["balanced_accuracy"]:
            scores = [100 * (row["balanced_accuracy"][group] or float("nan")) for row in own]
            axes.plot(penalties, scores, color=colour, lw=0.7, alpha=0.6)
        last = {g: own[-1]["balanced_accuracy"][g] or 0.0 for g in own[0]["balanced_accuracy"]}
        for group in {min(last, key=last.__getitem__), max(last, key=last.__getitem__)}:
            place_of = (penalties[-1], 100 * last[group])
            axes.annotate(f"  {group}", place_of, fontsize=8, color="#666666")
    axes.plot(chosen["penalty"], 100 * chosen["mean"], "*", color="black", ms=14, label="chosen")
    axes.set_xscale("log")
    axes.set_xlabel("C")
    axes.set_ylabel("balanced accuracy on the group left out, %")
    kind = " (simulated data)" if simulated else ""
    axes.set_title(f"Choice on training groups left out one at a time{kind}", fontsize=11)
    axes.grid(color="#DDDDDD")
    axes.legend(
        frameon=False, fontsize=8, handlelength=3.5, loc="upper left", bbox_to_anchor=(1.0, 1.0)
    )
    with whole_file(path) as temporary:
        figure.savefig(temporary, format="png", dpi=160, facecolor="white")


def _chosen(rows: Sequence[Mapping[str, Any]]) -> Mapping[str, Any]:
    """The row that was taken: the one that says so, else the first of the best mean."""
    marked = next((row for row in rows if row.get("chosen")), None)
    return marked or max(rows, key=lambda row: row["mean"])


def _structure(row: Mapping[str, Any]) -> tuple[str, ...]:
    """What a choice is but for its penalty, in words."""
    use = (row["use"],) if "use" in row else ()
    return (*use, str(row["num_features"] or "all"), _kernel(row["kernel"]))


def _kernel(facts: Mapping[str, Any]) -> str:
    if facts["kind"] == "polynomial":
        return f"degree {facts['degree']}, c {facts['offset']:g}"
    return f"rbf, gamma {facts['gamma']:g}"
