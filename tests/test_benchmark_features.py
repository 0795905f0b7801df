import json
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
import pytest
import torch
from oracles import assert_columns_close
from torch import Tensor

from benchmarks import clocks, outcome
from benchmarks.arithmetic import NATIVE, WIDE
from benchmarks.clocks import Way, paired_ratio
from benchmarks.features import __main__ as bench
from benchmarks.features.guards import measure, report
from benchmarks.features.guards.off import guards_off, replaced, textbook
from benchmarks.features.report import report_text
from benchmarks.features.sizes import PoolSizes, Sizes
from benchmarks.outcome import QUICK_LINE, SIMULATED_LINE
from tactslip_torch import FeaturePool, HandLayout
from tactslip_torch.simulation.extremes import extreme_bins

TINY = Sizes(
    PoolSizes(5, 3, 2, 3, judged=6, threads=1, rounds=2, ceiling_rounds=2, matrix=8, streamed_mb=1),
    bins=3,
    scored=(2,),
    solved=(12,),
    threads=(1,),
    rounds=4,
)


@pytest.fixture(scope="module")
def pool() -> FeaturePool:
    return FeaturePool(HandLayout.paper24())


def bins_of(kind: str) -> Tensor:
    return extreme_bins(kind, (2, 24, 100), torch.Generator().manual_seed(0))


# ------------------------------------------------------------------------------------- guards
@pytest.mark.parametrize("off", [guards_off, textbook])
@pytest.mark.parametrize(
    ("kind", "descriptor"),
    [("constant", "skewness"), ("zero", "peak_factor"), ("zero", "spectral_centroid")],
)
def test_without_guards_an_extreme_bin_gives_nonsense(
    pool: FeaturePool, off: Any, kind: str, descriptor: str
) -> None:
    mine = [i for i, name in enumerate(pool.names) if name.descriptor == descriptor]
    assert pool(bins_of(kind))[:, mine].isfinite().all()
    with off():
        assert pool(bins_of(kind))[:, mine].isnan().any()
    assert pool(bins_of(kind))[:, mine].isfinite().all()


def test_without_guards_rounding_noise_on_an_offset_is_described(pool: FeaturePool) -> None:
    noise = 1e9 + 1e-7 * torch.arange(100.0, dtype=torch.float64).sin().expand(1, 24, 100)
    spread = [i for i, name in enumerate(pool.names) if str(name) == "SG1 raw time std"]
    assert pool(noise)[0, spread] == 0
    with guards_off():
        assert pool(noise)[0, spread] > 0


def test_without_guards_energy_overflows(pool: FeaturePool) -> None:
    bins = 1e30 * torch.randn(1, 24, 100, generator=torch.Generator().manual_seed(0))
    native = FeaturePool(HandLayout.paper24(), arithmetic="native")
    for one in (native, pool):
        energy = [i for i, name in enumerate(one.names) if name.descriptor == "energy"]
        assert one(bins)[:, energy].isfinite().all()
        with guards_off():
            assert one(bins)[:, energy].isinf().any()


@pytest.mark.parametrize("off", [guards_off, textbook])
def test_without_guards_ordinary_bins_have_the_same_features(
    pool: FeaturePool, rng: np.random.Generator, off: Any
) -> None:
    size = 10 ** rng.uniform(-3, 0, (4, 24, 1))
    offset = np.where(np.arange(24) < 14, 1.0, 0.0)[:, None]  # strain gauges are loaded
    bins = torch.from_numpy(size * rng.standard_normal((4, 24, 100)) + offset)
    with off():
        bare = pool(bins)
    assert_columns_close(bare, pool(bins).numpy(), 1e-7)


def test_what_is_replaced_is_there_and_comes_back() -> None:
    def found() -> dict[str, Any]:
        return {name: resolve(name) for name in replaced()}

    before = found()
    assert len(before) >= 7
    for off in (guards_off, textbook):
        with off():
            assert [name for name, inside in found().items() if inside is before[name]] == []
        assert found() == before
        with pytest.raises(RuntimeError), off():
            raise RuntimeError
        assert found() == before


def resolve(name: str) -> Any:
    parts = name.split(".")
    for at in range(len(parts) - 1, 0, -1):
        try:
            found = import_module(".".join(parts[:at]))
        except ModuleNotFoundError:
            continue
        for part in parts[at:]:
            found = getattr(found, part)
        return found
    raise LookupError(name)


def test_both_solves_are_of_the_same_system(rng: np.random.Generator) -> None:
    z = torch.from_numpy(rng.uniform(-1, 1, (9, 4)))
    gram, targets = (z @ z.mT + 0.5) ** 2, torch.from_numpy(rng.standard_normal(9))
    wanted = np.linalg.solve(gram.numpy() + np.eye(9) / measure.PENALTY, targets.numpy())
    for way in (measure._reported, measure._bare):
        before = gram.clone()
        np.testing.assert_allclose(way(gram, targets), wanted)
        assert torch.equal(gram, before)


# ------------------------------------------------------------------------------------- clocks
def test_what_a_way_runs_under_is_not_timed(monkeypatch: pytest.MonkeyPatch) -> None:
    now, inside = [0.0], [False]
    monkeypatch.setattr(clocks.time, "perf_counter", lambda: now[0])

    @contextmanager
    def under() -> Iterator[None]:
        now[0] += 100.0
        inside[0] = True
        yield
        inside[0] = False
        now[0] += 100.0

    def call() -> None:
        now[0] += 2.0 if inside[0] else 0.5

    found = clocks.shuffled_rounds({"a": Way(call, under), "b": Way(call)}, 6, seed=0)
    assert found == {"a": [2.0] * 6, "b": pytest.approx([0.5] * 6)}


def test_ratios_are_of_rounds(rng: np.random.Generator) -> None:
    a, b = rng.uniform(1, 2, (2, 9))
    wanted = np.quantile(a / b, [0.5, 0.25, 0.75])
    np.testing.assert_allclose(paired_ratio(a.tolist(), b.tolist()), wanted)
    assert paired_ratio([3.0], [2.0]) == (1.5, 1.5, 1.5)
    with pytest.raises(ValueError, match="zip"):
        paired_ratio([1.0, 2.0], [1.0])


# ------------------------------------------------------------------------------------- report
def row(arithmetic: str = "float64", **seconds: list[float]) -> dict[str, Any]:
    return {"bins": 2, "arithmetic": arithmetic, "threads": 1} | seconds


@pytest.mark.parametrize(("busy_s", "is_ok"), [(1.09, True), (1.11, False)])
def test_limit_is_on_the_middle_ratio(busy_s: float, is_ok: bool) -> None:
    seconds = {"guards_s": [0.2, 3 * busy_s, 0.3, 9.0, 7.0], "off_s": [1.0, 3.0, 1.0, 1.0, 1.0]}
    sections = {"score": {"rows": [row(**seconds)]}}
    (limit,) = report.limit_rows(sections)
    assert limit["ok"] is is_ok
    assert limit["what"] == "scores with validity, guards / off, float64, 2 at once, 1 thread"
    assert report.ratios(sections)["score"][0]["over_off"]["median"] == pytest.approx(busy_s)


def test_the_price_of_arithmetic_is_of_the_guarded_calls() -> None:
    rows = [
        row(WIDE, guards_s=[3.0], off_s=[1.0], textbook_s=[1.0]),
        row(NATIVE, guards_s=[2.0], off_s=[1.0], textbook_s=[1.0]),
    ]
    found = report.ratios({"extract": {"rows": rows}})["wide_over_native"]
    assert found == {"1": {"median": 1.5, "low": 1.5, "high": 1.5}}


def test_tables_say_what_is_missed() -> None:
    rows = [row(guards_s=[2e-6 * 1.5], off_s=[2e-6], textbook_s=[1e-6])]
    sections = {"extract": {"rows": rows}}
    made = {
        "quick": True,
        "machine": {"processor": "abacus"},
        "versions": {"torch": "2.13.0"},
        "settings": {"rounds": 1},
        "replaced": ["pool.settle"],
        "sections": sections,
        "ratios": report.ratios(sections),
        "limits": report.limit_rows(sections),
    }
    text = report_text(made)
    (line,) = [line for line in text.splitlines() if line.startswith("float64")]
    assert line.split()[1:] == ["1", "2", "2", "1", "0", "1.500", "3.000"]
    assert [line.split()[-1] for line in text.splitlines() if "<= 1.10" in line] == ["MISSED"]
    assert SIMULATED_LINE in text
    assert text.count(QUICK_LINE) == 2
    assert "pool.settle" in text


# --------------------------------------------------------------------------------------- main
def test_quick_run_measures_every_guard(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(bench, "QUICK", TINY)
    path = tmp_path / "numbers.json"
    before = torch.get_num_threads()
    assert bench.main(["--quick", "--only", *measure.SECTIONS, "--json", str(path)]) == 0
    assert torch.get_num_threads() == before
    made = json.loads(path.read_text())
    assert made["quick"] is made["simulated"] is True
    assert list(made["sections"]) == list(measure.SECTIONS)
    assert made["replaced"] == replaced()
    for name, numbers in made["sections"].items():
        assert numbers["rows"]
        for found, ratio in zip(numbers["rows"], made["ratios"][name], strict=True):
            pairs = zip(found["guards_s"], found["off_s"], strict=True)
            wanted = median(a / b for a, b in pairs)
            assert len(found["guards_s"]) == TINY.rounds
            assert ratio["over_off"]["median"] == pytest.approx(wanted)
    assert len(made["limits"]) == sum(len(of["rows"]) for of in made["sections"].values())
    assert QUICK_LINE in capsys.readouterr().out


def test_runs_in_part_or_in_brief_leave_the_results_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(outcome, "RESULTS", tmp_path)
    monkeypatch.setattr(bench, "QUICK", TINY)
    monkeypatch.setattr(bench, "Sizes", lambda: TINY)
    monkeypatch.setattr(bench, "SECTIONS", {"extract": measure.extract})
    monkeypatch.setattr(bench, "figure", lambda report, path: path.touch())
    bench.main(["--quick"])
    bench.main(["--only", "extract"])
    assert list(tmp_path.iterdir()) == []
    bench.main([])
    assert json.loads((tmp_path / "features.json").read_text())["quick"] is False
    assert (tmp_path / "features.png").exists()


def test_a_folder_is_no_file(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as error:
        bench.main(["--json", "."])
    assert error.value.code == 2
    assert "--json needs a file, . is a folder" in capsys.readouterr().err


def test_a_path_is_tried_before_anything_is_measured(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bench, "measure", lambda *_: pytest.fail("measured"))
    (tmp_path / "file").touch()
    with pytest.raises(SystemExit) as error:
        bench.main(["--quick", "--json", str(tmp_path / "file" / "numbers.json")])
    assert error.value.code == 2
    assert "--json cannot be written to" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_a_folder_that_takes_no_file_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(dir: Path) -> None:
        raise PermissionError(13, f"{dir.name} is locked")

    monkeypatch.setattr(bench, "measure", lambda *_: pytest.fail("measured"))
    monkeypatch.setattr(outcome.tempfile, "TemporaryFile", refuse)
    with pytest.raises(SystemExit) as error:
        bench.main(["--quick", "--figure", str(tmp_path / "shut" / "it.png")])
    assert error.value.code == 2
    assert "--figure cannot be written to" in (shown := capsys.readouterr().err)
    assert "shut is locked" in shown


def test_a_figure_shows_the_pool(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as error:
        bench.main(["--only", "solve", "--figure", "nowhere.png"])
    assert error.value.code == 2
    assert "--figure shows the section pool" in capsys.readouterr().err
