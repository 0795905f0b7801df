import json
from pathlib import Path
from typing import Any

import pytest
import torch
from test_benchmark_features import TINY

from benchmarks import bins, engines
from benchmarks.clocks import shuffled_turns
from benchmarks.features import __main__ as bench
from benchmarks.features import pool_report, roofline
from benchmarks.features.pool import MINI_ROCKET, ORACLE
from benchmarks.tables import Spread, Table, number

NO_ERROR = {"worst": 0.0, "at": "cv", "entropy_bits": 0.0, "mode_elsewhere": 0.0, "not_finite": 0}


def row(way: str, seconds: list[float], num: int = 10, **changes: Any) -> dict[str, Any]:
    found = {"kind": bins.RANDOM, "way": way, "bins": num, "threads": 2, "features": 2582}
    return found | {"seconds": seconds, "core_s": seconds, "errors": NO_ERROR} | changes


def pool_numbers(*rows: dict[str, Any]) -> dict[str, Any]:
    return {"rows": list(rows), "degenerate": [], "kinds": bins.DESCRIBED}


# ---------------------------------------------------------------------------------------- bins
@pytest.mark.parametrize("kind", bins.DESCRIBED)
def test_generated_bins_are_of_their_kind(kind: str) -> None:
    made = bins.bins_of(kind, 12)
    assert made.shape == (12, 24, 100)
    assert made.dtype == torch.float64
    assert torch.equal(made, bins.bins_of(kind, 12))
    assert not torch.equal(made, bins.bins_of(kind, 12, seed=1))
    num_values = made.unique().numel() / made.numel()
    span = (made.amax(-1) - made.amin(-1)) / made.abs().amax(-1).clamp(min=1e-300)
    if kind == bins.TIED:
        assert num_values < 0.3
        assert ((made * 2**16 / 10).frac() == 0).all()
        assert torch.equal(made.float().double(), made)  # float32 holds them
    if kind == bins.NEAR_CONSTANT:
        assert (span[[0, 1, 3]] < 1e-3).all()
        assert (span[2] < 1e-14).all()
    if kind == bins.RANDOM:
        assert (span > 0.5).all()
        assert num_values > 0.99
    if kind == bins.DEGENERATE:
        assert (span[0] == 0).all()
        assert (span[1::2] > 0.5).all()


def test_raw_bins_have_their_context() -> None:
    made = bins.raw_bins(3)
    assert (made.shape, made.dtype) == ((3, 24, 150), torch.float32)
    assert not torch.equal(made[0], made[1])


# -------------------------------------------------------------------------------------- clocks
def test_turns_keep_seconds_of_every_round_and_the_last_result() -> None:
    made = {"a": 0, "b": 0}

    def call(name: str) -> int:
        made[name] += 1
        return made[name]

    turns = shuffled_turns({name: lambda name=name: call(name) for name in made}, 3, 0, "test")
    assert made == {"a": 4, "b": 4}  # one is not timed
    for of in turns.values():
        assert of.result == 4
        assert len(of.seconds) == len(of.core_s) == 3


# -------------------------------------------------------------------------------------- limits
@pytest.mark.parametrize(("seconds", "is_ok"), [(10 / 6001, True), (10 / 5999, False)])
def test_limit_on_the_rate_is_on_the_median(seconds: float, is_ok: bool) -> None:
    found = pool_report.limit_rows(pool_numbers(row("eager, float32", [seconds, 1e-9, 99.0])))
    (limit,) = [of for of in found if of["what"] == "bins/s, eager, float32, random bins"]
    assert limit["ok"] is is_ok
    assert limit["limit"] == ">= 6,000"


@pytest.mark.parametrize(("peer", "times"), [(ORACLE, 60), (MINI_ROCKET, 7)])
@pytest.mark.parametrize(("more", "is_ok"), [(1.01, True), (0.99, False)])
def test_limit_on_a_ratio_is_per_bin_and_within_rounds(
    peer: str, times: float, more: float, is_ok: bool
) -> None:
    rows = (
        row("compiled, float32", [1.0, 5.0, 1.0], num=10),
        row(peer, [0.1 * times * more, 0.5 * times * more, 9.0 * times], num=1),
    )
    found = pool_report.limit_rows(pool_numbers(*rows))
    of_peer = [of for of in found if of["what"].startswith(f"times {peer}")]
    (limit,) = [of for of in of_peer if of["measured"] != "not measured"]
    assert limit["ok"] is is_ok
    assert len(of_peer) == 2 * len(bins.KINDS)
    assert [of["ok"] for of in of_peer if of is not limit] == [None] * (len(of_peer) - 1)


def test_only_the_fastest_engine_is_held_to_mini_rocket() -> None:
    rows = (row("eager, float32", [1.0]), row(MINI_ROCKET, [1.0]), row("compiled, float32", [1.0]))
    found = pool_report.limit_rows(pool_numbers(*rows))
    eager, compiled = (
        next(of for of in found if f"{MINI_ROCKET}, {engine}" in of["what"])
        for engine in ("eager", "compiled")
    )
    assert (eager["ok"], compiled["ok"]) == (None, False)
    assert "information" in eager["what"]
    assert eager["measured"] == compiled["measured"] == "1 (1 to 1)"


def test_the_oracles_processor_time_stands_beside_its_time() -> None:
    rows = (
        row("eager, float32", [1.0], core_s=[2.0]),
        row(ORACLE, [61.0], core_s=[61.0]),
    )
    found = pool_report.limit_rows(pool_numbers(*rows))
    (limit,) = [of for of in found if ORACLE in of["what"] and of["measured"] != "not measured"]
    assert limit["ok"] is True
    assert limit["measured"] == "61 (61 to 61); of core-us 30.5"


@pytest.mark.parametrize(
    ("name", "value"),
    [("worst", 1.1e-4), ("entropy_bits", 0.11), ("mode_elsewhere", 0.04), ("not_finite", 1)],
)
def test_limit_on_errors_is_on_the_worst_kind_of_bin(name: str, value: float) -> None:
    good = row("eager, float32", [1.0])
    bad = {"way": "eager, float32", "errors": NO_ERROR | {name: value}}

    def missed(degenerate: list[dict[str, Any]]) -> int:
        limits = pool_report.limit_rows(pool_numbers(good) | {"degenerate": degenerate})
        return sum(of["ok"] is False for of in limits if "every kind" in of["what"])

    assert missed([]) == 0
    assert missed([bad]) == 1


def test_float64_is_held_to_more() -> None:
    one = row("eager, float64", [1.0], errors=NO_ERROR | {"worst": 1e-9, "mode_elsewhere": 1e-9})
    limits = pool_report.limit_rows(pool_numbers(one))
    assert [of["what"].split(",")[0] for of in limits if of["ok"] is False] == [
        "error of any feature",
        "modes elsewhere",
    ]


# ------------------------------------------------------------------------------------ roofline
def test_work_of_a_bin_is_the_models() -> None:
    found = roofline.work(engines.pool_of(engines.FLOAT32), engines.FLOAT32)
    assert found["bytes"] == 4 * (2400 + 2582)
    small = 51 + 27 + 15 + 9 + 10  # ranks of D1 to D4 and A4; A1 to A3 are sums
    assert found["products"] == 10 * (small * (400 + 400) + 3 * 300)
    wide = roofline.work(engines.pool_of(engines.FLOAT64), engines.FLOAT64)
    assert wide["bytes"] == 2 * found["bytes"]
    assert wide["statistics"] == found["statistics"]


def test_least_time_is_of_the_ceiling_that_binds() -> None:
    work = {"bytes": 10.0, "products": 6.0, "statistics": 8.0}
    ceilings = {"memory": 1.0, "gemm float32": 4.0, "gemm float64": 2.0}
    found = roofline.least_seconds(work, ceilings, "float32")
    assert found == {"memory": 10.0, "arithmetic": 5.0, "least": 10.0}
    assert roofline.least_seconds(work, ceilings | {"memory": 5.0}, "float64")["least"] == 7.0


def test_fraction_is_of_the_time_taken() -> None:
    numbers = {
        "ceilings": {"2": {"memory": 1e9, "gemm float32": 1e9, "gemm float64": 1e9}},
        "work": {"float32": {"bytes": 1e3, "products": 1e6, "statistics": 1e6}},
    }
    rows = pool_numbers(row("eager, float32", [0.08], num=10), row(ORACLE, [1.0]))
    (found,) = pool_report.fractions(numbers, rows)
    assert found["fraction"] == pytest.approx(0.25)  # 2 ms at least, 8 taken
    assert found["operations_a_byte"] == 2e3
    assert pool_report.fractions(numbers, None) == []


# -------------------------------------------------------------------------------------- tables
def test_a_table_is_text_and_markdown() -> None:
    table = Table(["what", "s"], [["a", "1"], ["b", "22"]], "a note")
    assert table.text().splitlines() == ["what   s", "a      1", "b     22", "a note"]
    assert table.markdown().splitlines() == [
        "| what | s |",
        "| --- | ---: |",
        "| a | 1 |",
        "| b | 22 |",
        "",
        "a note",
    ]


def test_spread_and_numbers() -> None:
    assert Spread.of([4.0]) == (4.0, 4.0, 4.0)
    assert Spread.of([1.0, 2.0, 3.0, 4.0, 100.0]).times(2).text() == "6 (4 to 8)"
    assert [number(value) for value in (0, 1.23456, 1234.5, 2e-7)] == [
        "0",
        "1.23",
        "1,234",
        "2.0e-07",
    ]


# ---------------------------------------------------------------------------------------- main
@pytest.mark.slow
def test_quick_run_measures_the_pool(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("tsfel", "aeon"):
        pytest.importorskip(name)
    monkeypatch.setattr(bench, "QUICK", TINY)
    path, drawing = tmp_path / "numbers.json", tmp_path / "figure.png"
    arguments = ["--quick", "--only", "pool", "roofline", "--json", str(path)]
    assert bench.main([*arguments, "--figure", str(drawing)]) == 0
    made = json.loads(path.read_text())
    rows = made["sections"]["pool"]["rows"]
    ways = {f"{e}, {d}" for e in (*engines.ENGINES, "reference") for d in engines.DTYPES}
    for kind in bins.KINDS:
        found = {of["way"]: of for of in rows if of["kind"] == kind}
        assert ways <= set(found)
        assert len(found) == len(ways) + 5
        for of in found.values():
            assert len(of["seconds"]) == TINY.pool.rounds
            assert of["features"] == 2582 or of["errors"] is None
        assert found["reference, float64"]["errors"]["worst"] < 1e-11  # chunks round otherwise
    for of in made["limits"]:
        assert (
            of["ok"] is not False
            or "bins/s" in of["what"]
            or "times" in of["what"]
            or "mode" in of["what"]
        )
    assert len(made["fractions"]) == len(ways)
    assert drawing.stat().st_size > 0
