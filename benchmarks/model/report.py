"""What follows from the measurements of ``benchmarks.model``: ratios, limits, tables."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from statistics import median
from typing import Any

from benchmarks.outcome import limits_table
from tactslip_torch.report.style import table

SYNTHETIC_LINE = "SYNTHETIC features: what the machine costs, nothing about a hand"
QUICK_LINE = "QUICK: sizes too small to mean anything, whatever stands under limits"
# what the project has set itself
HEAD_KB, LATENCY_SPREAD, SVC_LATENCY = 60.0, 1.1, 20.0
OF_DSYRK, OF_GEMM = 0.6, 0.9
OVER_RIDGE, SCORE_DIFFERENCE = 1.0, 1e-8
FOLDS_OVER_FIT, FOLDS_OVER_REFITS, FOLD_DIFFERENCE = 2.5, 0.5, 1e-8
MEMORY_GB = 1.5


# ------------------------------------------------------------------------------------- numbers
def ratios(sections: Mapping[str, Any]) -> dict[str, Any]:
    """What is compared, from what was measured in the same run; medians of the repeats.

    Args:
        sections: name to numbers; any of ``SECTIONS``.
    """
    found: dict[str, Any] = {}
    if "size" in sections:
        rows, svc_s = sections["size"]["rows"], sections["size"]["svc"]["seconds"]
        head_s = {of: [row["head_s"][of] for row in rows] for of in svc_s}
        found["latency_spread"] = {of: max(s) / min(s) for of, s in head_s.items()}
        found["svc_over_head"] = {of: svc_s[of] / max(s) for of, s in head_s.items()}
        found["sum_over_head"] = {of: rows[-1]["sum_s"][of] / max(s) for of, s in head_s.items()}
    if "accumulation" in sections:
        found["update"] = {
            str(row["batch_bins"]): {
                f"of_{bare}": _paired(row[f"{bare}_s"], row["update_s"])
                for bare in ("dsyrk", "gemm")
            }
            for row in sections["accumulation"]["rows"]
        }
    if "fit" in sections:
        seconds = {row["name"]: row["seconds"] for row in sections["fit"]["rows"]}
        found["over_kernel_ridge"] = {
            name: _paired(taken, seconds["KernelRidge"]) for name, taken in seconds.items()
        }
    if "folds" in sections:
        found["folds"] = {
            str(row["num_bins"]): {
                "over_fit": _paired(row["closed_s"], row["fit_s"]),
                "over_refits": _paired(
                    row["closed_s"], map(sum, zip(row["fit_s"], row["refits_s"], strict=True))
                ),
            }
            for row in sections["folds"]["rows"]
        }
    return found


def _paired(seconds: Iterable[float], others: Iterable[float]) -> float:
    """Median over the repeats of the ratio within a repeat: drift between repeats cancels."""
    return median(a / b for a, b in zip(seconds, others, strict=True))


def limit_rows(sections: Mapping[str, Any], settings: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Every limit beside what was measured, and whether it holds.

    Args:
        sections: name to numbers; limits of absent ones are left out.
        settings: ``Sizes`` as a mapping.
    """
    return [
        dict(zip(("what", "measured", "limit", "ok"), row, strict=True))
        for row in _limits(sections, ratios(sections), settings)
    ]


def _limits(
    sections: Mapping[str, Any], of: Mapping[str, Any], settings: Mapping[str, Any]
) -> Iterator[tuple[str, str, str, bool]]:
    if "size" in sections:
        kb = max(row["head_bytes"] for row in sections["size"]["rows"]) / 1000
        what = f"head of {settings['num_features']} features, float32"
        yield what, f"{kb:.2f} kB", f"< {HEAD_KB:g} kB", kb < HEAD_KB
        for num, spread in of["latency_spread"].items():
            what = f"latency over training bins, most / least, {_scored(num)}"
            yield what, f"{spread:.3f}", f"< {LATENCY_SPREAD:g}", spread < LATENCY_SPREAD
        over = of["svc_over_head"]["1"]
        yield (
            "latency, SVC / head, one bin",
            f"{over:.1f}",
            f"> {SVC_LATENCY:g}",
            over > SVC_LATENCY,
        )
    for num, share in of.get("update", {}).items():
        measured = f"{share['of_dsyrk']:.2f} of dsyrk, {share['of_gemm']:.2f} of gemm"
        ok = share["of_dsyrk"] >= OF_DSYRK or share["of_gemm"] >= OF_GEMM
        limit = f">= {OF_DSYRK:g} of dsyrk or {OF_GEMM:g} of gemm"
        yield f"accumulation speed, batches of {num}", measured, limit, ok
    if "fit" in sections:
        for row in sections["fit"]["rows"]:
            if row["name"] == "fit_machine":  # the others show what another route would cost
                over = of["over_kernel_ridge"]["fit_machine"]
                what = "seconds, fit_machine / KernelRidge"
                yield what, f"{over:.3f}", f"< {OVER_RIDGE:g}", over < OVER_RIDGE
            if row["name"] not in ("KernelRidge", "SVC"):
                what = f"scores of {row['name']} - KernelRidge"
                ok = row["difference"] < SCORE_DIFFERENCE
                yield what, f"{row['difference']:.1e}", f"< {SCORE_DIFFERENCE:g}", ok
    for row in sections.get("folds", {}).get("rows", ()):
        num = row["num_bins"]
        over = of["folds"][str(num)]
        what, ok = f"fit and folds / fit, {num} bins", over["over_fit"] < FOLDS_OVER_FIT
        yield what, f"{over['over_fit']:.2f}", f"< {FOLDS_OVER_FIT:g}", ok
        what, ok = f"fit and folds / refits, {num} bins", over["over_refits"] < FOLDS_OVER_REFITS
        yield what, f"{over['over_refits']:.2f}", f"< {FOLDS_OVER_REFITS:g}", ok
        what, ok = f"scores of folds - refits, {num} bins", row["difference"] < FOLD_DIFFERENCE
        yield what, f"{row['difference']:.1e}", f"< {FOLD_DIFFERENCE:g}", ok
    if "any_size" in sections:
        numbers = sections["any_size"]
        gb = numbers["peak_bytes"] / 1e9
        what = f"peak memory, {numbers['num_bins']} bins"
        yield what, f"{gb:.2f} GB", f"< {MEMORY_GB:g} GB", gb < MEMORY_GB
    if "workers" in sections:
        same = [all(row["identical"].values()) for row in sections["workers"]["rows"]]
        what = "runs of workers with the same bits"
        yield what, f"{sum(same)} of {len(same)}", "all", all(same)


def _scored(num: str) -> str:
    return "one bin" if num == "1" else f"{num} bins at once"


# -------------------------------------------------------------------------------------- tables
def report_text(report: Mapping[str, Any]) -> str:
    """What is printed.

    Args:
        report: settings, facts and sections, as ``--json`` keeps them.
    """
    sections, of = report["sections"], report["ratios"]
    parts = [_heading(report)]
    parts += [_TABLES[name](numbers, of) for name, numbers in sections.items()]
    parts.append(limits_table(report["limits"]))
    return "\n\n".join(parts + ([QUICK_LINE] if report["quick"] else []))


def _heading(report: Mapping[str, Any]) -> str:
    settings = report["settings"]
    lines = [
        f"the kernel machine: {settings['num_features']} features, C = {settings['penalty']:g}, "
        f"c = {settings['offset']:g}, medians of {settings['repeats']} repeats",
        f"machine   {', '.join(report['machine'].values())}, {report['threads']} threads",
        f"versions  {', '.join(f'{name} {of}' for name, of in report['versions'].items())}",
        SYNTHETIC_LINE,
    ]
    return "\n".join(lines + ([QUICK_LINE] if report["quick"] else []))


def _size_table(numbers: Mapping[str, Any], of: Mapping[str, Any]) -> str:
    svc = numbers["svc"]
    nums = list(svc["seconds"])
    header = ["size", "training bins", "kB", *(f"latency, {_scored(num)}" for num in nums)]
    rows = []
    for row in numbers["rows"]:
        kb = f"{row['head_bytes'] / 1000:.1f}"
        cells = [_time(row["head_s"][num]) for num in nums]
        rows.append(["head", str(row["training_bins"]), kb, *cells])
    for row in numbers["rows"]:
        kb = f"{row['sum_bytes'] / 1000:.1f}"
        cells = [_time(row["sum_s"][num]) for num in nums]
        rows.append(["kernel sum, not folded", str(row["training_bins"]), kb, *cells])
    cells = [_time(svc["seconds"][num]) for num in nums]
    rows.append([f"SVC, {svc['support']} support bins", str(svc["training_bins"]), "-", *cells])
    compared = [
        f"{name} {of[key][num]:.1f} ({_scored(num)})"
        for key, name in (("svc_over_head", "SVC / head"), ("sum_over_head", "largest sum / head"))
        for num in nums
    ]
    return f"{table([header, *rows])}\nhead and sum in float32, one thread; {', '.join(compared)}"


def _accumulation_table(numbers: Mapping[str, Any], of: Mapping[str, Any]) -> str:
    header = ["accumulation", "s / 1000 bins", "dsyrk", "gemm", "of dsyrk", "of gemm"]
    rows = []
    for row in numbers["rows"]:
        each = [
            median(row[f"{name}_s"]) * 1000 / row["batch_bins"]
            for name in ("update", "dsyrk", "gemm")
        ]
        shares = of["update"][str(row["batch_bins"])].values()
        cells = [*(f"{value:.3f}" for value in each), *(f"{share:.2f}" for share in shares)]
        rows.append([f"batches of {row['batch_bins']}", *cells])
    return f"{table([header, *rows])}\ndsyrk and gemm of monomials that exist already, float64"


def _fit_table(numbers: Mapping[str, Any], of: Mapping[str, Any]) -> str:
    rows = [
        [
            row["name"],
            f"{median(row['seconds']):.2f}",
            f"{of['over_kernel_ridge'][row['name']]:.3f}",
            f"{100 * row['accuracy']:.2f}",
            "-" if row["difference"] is None else f"{row['difference']:.1e}",
        ]
        for row in numbers["rows"]
    ]
    title = f"fit of {numbers['num_bins']} bins"
    header = [title, "s", "/ KernelRidge", "accuracy %", "scores - KernelRidge"]
    return f"{table([header, *rows])}\naccuracy on {numbers['test_bins']} held-out bins"


def _folds_table(numbers: Mapping[str, Any], of: Mapping[str, Any]) -> str:
    count = numbers["num_folds"]
    header = [f"{count} folds", "fit, s", "and folds, s", f"{count} refits, s"]
    header += ["folds / fit", "/ refits", "scores - refits"]
    rows = []
    for row in numbers["rows"]:
        seconds = [f"{median(row[f'{name}_s']):.2f}" for name in ("fit", "closed", "refits")]
        over = [f"{value:.2f}" for value in of["folds"][str(row["num_bins"])].values()]
        rows.append([f"{row['num_bins']} bins", *seconds, *over, f"{row['difference']:.1e}"])
    return f"{table([header, *rows])}\n/ refits: fit and folds in closed form / fit and refits"


def _any_size_table(numbers: Mapping[str, Any], of: Mapping[str, Any]) -> str:
    header = ["any size", "made, s", "added up, s", "solved, s", "peak GB", "of it imports"]
    header.append("accuracy %")
    seconds = [f"{numbers[f'{name}_s']:.2f}" for name in ("generate", "accumulate", "solve")]
    memory = [f"{numbers[f'{name}_bytes'] / 1e9:.2f}" for name in ("peak", "resident")]
    row = [f"{numbers['num_bins']} bins", *seconds, *memory, f"{100 * numbers['accuracy']:.2f}"]
    return table([header, row])


def _workers_table(numbers: Mapping[str, Any], of: Mapping[str, Any]) -> str:
    header = ["processes", "shards", "collected, s", "merged, s", "statistics", "detector"]
    rows = []
    for row in numbers["rows"]:
        same = [
            "same bits" if row["identical"][name] else "OTHER BITS"
            for name in ("statistics", "detector")
        ]
        seconds = [f"{row[name]:.2f}" for name in ("collect_s", "merge_s")]
        rows.append([str(row["processes"]), str(row["shards"]), *seconds, *same])
    note = f"{numbers['num_bins']} bins in batches of {numbers['batch_bins']}, merged in any order"
    return f"{table([header, *rows])}\n{note}; bits beside those of the first row"


_TABLES = {
    "size": _size_table,
    "accumulation": _accumulation_table,
    "fit": _fit_table,
    "folds": _folds_table,
    "any_size": _any_size_table,
    "workers": _workers_table,
}


def _time(seconds: float) -> str:
    """Seconds for people."""
    for unit, factor in (("s", 1.0), ("ms", 1e3)):
        if seconds * factor >= 1:
            return f"{seconds * factor:.2f} {unit}"
    return f"{seconds * 1e6:.1f} us"
