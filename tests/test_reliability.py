"""The table and the figure of stated probabilities, and what the numbers in them weigh."""

import numpy as np
import pytest
import torch
from matplotlib.image import imread

from tactslip_torch.model.calibration import reliability
from tactslip_torch.report.results import (
    interval_by_recording,
    reliability_figure,
    reliability_table,
    weights_at_share,
)


def found(ece, count, **more):
    return {
        "probabilities": [0.1, 0.8],
        "slip_shares": [0.2, 0.7],
        "counts": [count / 4, 3 * count / 4],
        "ece": ece,
        "mce": 2 * ece,
        "brier": 0.0625,
        "log_loss": 0.25,
        **more,
    }


BY_ROLE = {
    "test": found(0.0125, 4000, ece_interval=(0.01, 0.02), per_material={"M1": found(0.02, 800)}),
    "unseen": found(0.08, 1200, per_material={"iron": found(0.05, 400), "wood": found(0.1, 800)}),
}


def test_the_table_has_each_role_and_its_materials():
    lines = reliability_table(BY_ROLE, simulated=True).splitlines()
    assert lines[0].startswith("SIMULATED")
    rows = [line.split() for line in lines[2:]]
    numbers = ["2.50", "0.0625", "0.2500"]
    assert rows[0] == ["test", "all", "4000", "1.25", "1.00", "to", "2.00", *numbers]
    assert rows[1] == ["M1", "800", "2.00", "-", "4.00", "0.0625", "0.2500"]
    assert [row[0] for row in rows[2:]] == ["unseen", "iron", "wood"]
    assert "SIMULATED" not in reliability_table(BY_ROLE, simulated=False)


@pytest.mark.parametrize("by_role", [BY_ROLE, {"test": BY_ROLE["test"]}])
def test_the_figure_is_a_picture_of_some_size(by_role, tmp_path):
    reliability_figure(by_role, tmp_path / "reliability.png", simulated=True)
    height, width, _ = imread(tmp_path / "reliability.png").shape
    assert height > 700
    assert width > 1200


def test_the_figure_takes_what_reliability_says(tmp_path, rng):
    p = torch.from_numpy(rng.uniform(size=300))
    stated = reliability(p, p > 0.5).to_dict()
    reliability_figure({"test": stated}, tmp_path / "a.png", simulated=False)
    assert (tmp_path / "a.png").stat().st_size > 10_000
    assert "test" in reliability_table({"test": stated}, simulated=False)


def test_no_role_is_no_figure(tmp_path):
    with pytest.raises(ValueError, match="no role"):
        reliability_figure({}, tmp_path / "a.png", simulated=True)
    assert not (tmp_path / "a.png").exists()


# ------------------------------------------------------------------------------------- weights
@pytest.mark.parametrize("share", [0.05, 0.5, 0.9])
def test_weights_bring_bins_to_the_share_of_a_stream(share, rng):
    is_slip = torch.from_numpy(rng.uniform(size=500) < 0.7)
    weights = weights_at_share(is_slip, share)
    assert weights.mean() == pytest.approx(1)
    assert weights[is_slip].sum() / weights.sum() == pytest.approx(share)
    assert len(weights.unique()) == 2


def test_bins_weighed_so_tell_of_a_stream_of_that_share(rng):
    """Probabilities that are right at 5 % are right on bins of 70 %, if these weigh so."""
    gap, share = 2.0, 0.05

    def stated(of_slip):
        is_slip = rng.uniform(size=60_000) < of_slip
        score = gap * is_slip + rng.normal(size=60_000)
        odds = np.exp(gap * score - gap**2 / 2) * share / (1 - share)  # two Gaussians
        return torch.from_numpy(odds / (1 + odds)), torch.from_numpy(is_slip)

    p, is_slip = stated(0.7)
    weighed = reliability(p, is_slip, weights=weights_at_share(is_slip, share))
    of_stream = reliability(*stated(share))
    assert weighed.ece < 0.01
    assert weighed.brier == pytest.approx(of_stream.brier, abs=0.005)
    assert reliability(p, is_slip).ece > 0.2


@pytest.mark.parametrize("is_slip", [[True, True], [False], []])
def test_a_class_that_is_not_there_cannot_be_weighed(is_slip):
    with pytest.raises(ValueError, match="bins of slip and of non-slip"):
        weights_at_share(torch.tensor(is_slip, dtype=torch.bool), 0.5)


@pytest.mark.parametrize("share", [0.0, 1.0, float("nan")])
def test_a_share_lies_between_0_and_1(share):
    with pytest.raises(ValueError, match="slip_share must lie between 0 and 1"):
        weights_at_share(torch.tensor([True, False]), share)


# ------------------------------------------------------------------------------------ interval
def test_the_interval_is_that_of_recordings_not_of_bins(rng):
    """Bins of a recording are copies: the interval of a mean is that of the few recordings."""
    of_recording = rng.normal(size=30)
    values = torch.from_numpy(np.repeat(of_recording, 50))
    names = [f"r{number}" for number in np.repeat(np.arange(30), 50)]

    def mean(weights):
        return float((weights * values).sum() / weights.sum())

    low, high = interval_by_recording(mean, names, num_resamples=2000, seed=3)
    error = of_recording.std() / np.sqrt(30)  # what the bootstrap's own law says
    assert (high - low) / (2 * 1.96 * error) == pytest.approx(1, abs=0.12)
    assert low < of_recording.mean() < high
    narrow = interval_by_recording(mean, names, num_resamples=2000, seed=3, level=0.5)
    assert (narrow[1] - narrow[0]) / (2 * 0.674 * error) == pytest.approx(1, abs=0.15)


def test_the_interval_covers_what_the_world_holds(rng):
    """Recordings that lean to either side: the share of intervals that hold the truth."""
    held = 0
    for seed in range(100):
        leaning = rng.normal(size=25)
        values = torch.from_numpy(np.repeat(leaning, 4) + 0.1 * rng.normal(size=100))
        low, high = interval_by_recording(
            lambda w, values=values: float((w * values).sum() / w.sum()),
            np.repeat(np.arange(25), 4).tolist(),
            level=0.9,
            seed=seed,
        )
        held += low <= 0 <= high
    assert 80 <= held <= 97  # of 100, meant to be 90


def test_the_interval_is_the_same_again_and_of_one_recording_a_point():
    values = torch.arange(12.0).double()

    def mean(weights):
        return float((weights * values).sum() / weights.sum())

    names = [1, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9]
    assert interval_by_recording(mean, names) == interval_by_recording(mean, names)
    assert interval_by_recording(mean, names) != interval_by_recording(mean, names, seed=1)
    assert interval_by_recording(mean, ["a"] * 12) == (5.5, 5.5)


@pytest.mark.parametrize(("names", "level"), [([], 0.95), (["a"], 0.0), (["a"], 1.0)])
def test_no_bins_or_no_level_is_no_interval(names, level):
    with pytest.raises(ValueError, match="an interval needs bins"):
        interval_by_recording(lambda weights: 0.0, names, level=level)
