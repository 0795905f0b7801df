"""The table and the figure of stated probabilities, and what the numbers in them weigh."""

import numpy as np
import pytest
import torch
from matplotlib.image import imread

from tactslip_torch.model.calibration import reliability
from tactslip_torch.report.metrics import weights_at_share
from tactslip_torch.report.results import reliability_figure, reliability_table


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
    "test": found(0.0125, 4000, per_material={"M1": found(0.02, 800)}),
    "unseen": found(0.08, 1200, per_material={"iron": found(0.05, 400), "wood": found(0.1, 800)}),
}


def test_the_table_has_each_role_and_its_materials():
    lines = reliability_table(BY_ROLE, simulated=True).splitlines()
    assert lines[0].startswith("SIMULATED")
    rows = [line.split() for line in lines[2:]]
    numbers = ["2.50", "0.0625", "0.2500"]
    assert rows[0] == ["test", "all", "4000", "1.25", *numbers]
    assert rows[1] == ["M1", "800", "2.00", "4.00", "0.0625", "0.2500"]
    assert [row[0] for row in rows[2:]] == ["unseen", "iron", "wood"]
    assert "SIMULATED" not in reliability_table(BY_ROLE, simulated=False)


@pytest.mark.parametrize("by_role", [BY_ROLE, {"test": BY_ROLE["test"]}])
def test_the_figure_is_a_picture_of_some_size(by_role, tmp_path):
    reliability_figure(by_role, tmp_path / "reliability.png", simulated=True)
    height, width, _ = imread(tmp_path / "reliability.png").shape
    assert height > 700
    assert width > 1200


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
