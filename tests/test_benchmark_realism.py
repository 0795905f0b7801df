"""Statistics of channels, on signals whose statistics are known."""

import json

import numpy as np
import pytest
from biotac_layout import write_biotac

from benchmarks.simulation import realism

STRETCHES, CHANNELS, SAMPLES = 300, 8, 200


def noise(
    *, shape: tuple[int, ...] = (STRETCHES, CHANNELS, realism.WINDOWS, SAMPLES), seed: int = 0
):
    return np.random.default_rng(seed).standard_normal(shape)


def test_independent_channels_of_one_level_differ_by_chance_alone() -> None:
    found = realism.statistics(noise())
    floor = 1 / np.sqrt(2 * SAMPLES)  # standard deviation of the log of an estimated level
    assert found["wander"] == pytest.approx(floor * np.sqrt(1 - 1 / CHANNELS), rel=0.1)
    assert found["common"] == pytest.approx(floor / np.sqrt(CHANNELS), rel=0.1)
    assert found["spread"] == pytest.approx(floor / np.sqrt(realism.WINDOWS), rel=0.15)
    assert found["sample_correlation"] == pytest.approx(found["chance"], rel=0.05)
    assert abs(found["level_correlation"]) < 0.03


def test_gains_are_spread_and_a_common_signal_is_correlation() -> None:
    gains = np.exp(np.linspace(-1, 1, CHANNELS))[:, None, None]
    one = noise(shape=(STRETCHES, 1, realism.WINDOWS, SAMPLES))
    found = realism.statistics(gains * one)
    assert found["spread"] == pytest.approx(np.linspace(-1, 1, CHANNELS).std())
    assert found["wander"] == pytest.approx(0, abs=1e-9)
    for name in ("sample_correlation", "strongest", "level_correlation"):
        assert found[name] == pytest.approx(1)
    half = realism.statistics(one + noise(seed=1))
    assert half["sample_correlation"] == pytest.approx(0.5, abs=0.02)


def test_levels_that_wander_are_wander_or_common() -> None:
    rng = np.random.default_rng(2)
    own = np.exp(0.4 * rng.standard_normal((STRETCHES, CHANNELS, realism.WINDOWS, 1)))
    together = np.exp(0.4 * rng.standard_normal((STRETCHES, 1, realism.WINDOWS, 1)))
    apart, alike = realism.statistics(own * noise()), realism.statistics(together * noise())
    expected = 0.4 * 0.92  # of four windows the mean of a standard deviation is .92 of the truth
    assert apart["wander"] == pytest.approx(expected * np.sqrt(1 - 1 / CHANNELS), rel=0.05)
    assert alike["common"] == pytest.approx(expected, rel=0.05)
    assert alike["level_correlation"] > 0.9 > 0.1 > apart["level_correlation"]


def test_areas_tell_a_louder_class_and_one_whose_channels_differ() -> None:
    louder = realism.areas(2 * noise(), noise(seed=1))
    assert min(louder["mean"], louder["single"]) > 0.99
    gains = np.exp(np.tile([-1.0, 1.0], CHANNELS // 2))[:, None, None]
    apart = realism.areas(gains * noise(), noise(seed=1))
    assert apart["sd"] > 0.99
    assert apart["mean"] == pytest.approx(0.5, abs=0.1)


def test_all_three_sets_are_measured_and_kept(tmp_path, capsys) -> None:
    overrides = write_biotac(tmp_path / "set")
    path = tmp_path / "realism.json"
    assert realism.main(["--quick", "--json", str(path), *overrides]) == 0
    report = json.loads(path.read_text())
    assert [one["simulated"] for one in report["sets"].values()] == [False, True, True]
    assert report["sets"]["real"]["channels"] == 24
    assert len(report["code"]) == 16
    shown = capsys.readouterr().out
    for text in (*realism.SETS, *realism.STATISTICS.values(), report["code"]):
        assert text in shown
