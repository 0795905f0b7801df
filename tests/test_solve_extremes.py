"""Machines at the extremes against mpmath: 80 digits, a few bins, every route to a score."""

import contextlib
import functools
import json
import logging
import pickle
from dataclasses import dataclass

import mpmath
import numpy as np
import pytest
import torch

from tactslip_torch.model import fit
from tactslip_torch.model.fit import TrainingBins, fit_machine
from tactslip_torch.model.held_out import MOST_CONDITION, HeldOut
from tactslip_torch.model.kernel_elm import solve_primal
from tactslip_torch.model.kernels import PAPER_KERNEL, Polynomial, RadialBasis
from tactslip_torch.model.sufficient import SufficientStats

EPS = 2.0**-52
KINDS = (
    "plain",
    "duplicate features",
    "nearly duplicate features, 1e-7",
    "nearly duplicate features, float32",
    "duplicate bins",
    "duplicate bins that agree",
    "constant column",
    "zero column",
    "more features than bins",
    "one bin of each class",
    "all equal with opposite labels",
    "weights over 12 decades",
    "weights over 12 decades, more features than bins",
)
PENALTIES = (1e-12, 1e-6, 1.0, 1e3, 1e6, 1e9, 1e12, np.inf)
CAPS = {  # of the error where the condition is up to 1e10; 1e-8 for others
    "nearly duplicate features, 1e-7": 1e-5,
    "nearly duplicate features, float32": 5e-3,
    "weights over 12 decades": 1e-5,
    "weights over 12 decades, more features than bins": 1e-5,
}
LIMIT = 1e90  # an infinite penalty, as far as 80 digits tell beside 12 decades of weights


@dataclass
class Case:
    z: np.ndarray
    targets: np.ndarray
    weights: np.ndarray
    new: np.ndarray

    @property
    def bins(self) -> TrainingBins:
        z, targets, weights = map(torch.from_numpy, (self.z, self.targets, self.weights))
        return TrainingBins(z, targets > 0, weights)


@functools.cache
def case(kind: str) -> Case:
    """Sixteen bins and four that were never seen."""
    rng = np.random.default_rng(len(kind))
    num_features = 40 if "more features" in kind else 3
    z, targets = rng.uniform(-1, 1, (16, num_features)), rng.choice([-1.0, 1.0], 16)
    targets[:2] = [1, -1]
    weights, new = np.ones(16), rng.uniform(-1, 1, (4, num_features))
    if kind == "duplicate features":
        z[:, 2] = z[:, 1]
    elif kind.endswith("1e-7"):
        z[:, 2] = z[:, 1] + 1e-7 * z[:, 2]
    elif kind.endswith("float32"):
        z[:, 2] = z[:, 1].astype(np.float32)
    elif kind.startswith("duplicate bins"):
        z[8:] = z[:8]
        targets[8:] = targets[:8]
        if "agree" not in kind:
            targets[8:12] *= -1
    elif kind == "constant column":
        z[:, 2] = 1.0
    elif kind == "zero column":
        z[:, 2] = 0.0
    elif kind == "one bin of each class":
        z, targets, weights = z[:2], targets[:2], weights[:2]
    elif kind == "all equal with opposite labels":
        z[:] = z[0]
    elif kind.startswith("weights"):
        weights = 10.0 ** rng.uniform(-6, 6, 16)
    return Case(z, targets, weights, new)


def exactly(values: np.ndarray) -> list:
    return [mpmath.mpf(float(value)) for value in values]


def kernel(a: np.ndarray, b: np.ndarray) -> list[list]:
    left, right = [exactly(row) for row in a], [exactly(row) for row in b]
    return [[(mpmath.fdot(u, v) + mpmath.mpf(0.5)) ** 2 for v in right] for u in left]


def scores_of(gram: list, across: list, targets, weights, penalty: float) -> np.ndarray:
    """``across (gram + diag(1 / (C w)))^-1 targets``."""
    system = mpmath.matrix(gram)
    for i, weight in enumerate(exactly(weights)):
        system[i, i] += 1 / (mpmath.mpf(min(penalty, LIMIT)) * weight)
    beta = mpmath.lu_solve(system, mpmath.matrix(exactly(targets)))
    return np.array([float(mpmath.fdot(row, list(beta))) for row in across])


@functools.cache
def truth(kind: str, penalty: float) -> tuple[np.ndarray, float]:
    """Scores of the training bins, then of the new ones; and the size that scores can have.

    That of labels which all agree: opposite ones may cancel to nothing.
    """
    c = case(kind)
    with mpmath.workdps(80 if np.isfinite(penalty) else 240):
        gram, across = kernel(c.z, c.z), kernel(c.new, c.z)
        scores = scores_of(gram, gram + across, c.targets, c.weights, penalty)
        size = scores_of(gram, gram, np.ones(len(c.z)), c.weights, penalty)
    return scores, float(np.abs(size).max())


def assert_right(
    actual: torch.Tensor, kind: str, penalty: float, tolerance: float, *, trained: bool = False
) -> None:
    (expected, size), num = truth(kind, penalty), len(case(kind).z)
    assert bool(actual.isfinite().all())
    wrong = np.abs(actual.numpy() - expected)
    assert wrong[:num].max() <= tolerance * size
    if trained:
        return
    assert wrong[num:].max() <= tolerance * max(size, np.abs(expected[num:]).max())


# Fit -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("penalty", PENALTIES)
@pytest.mark.parametrize("kind", KINDS)
def test_scores_are_those_of_eighty_digits(kind, penalty, caplog):
    """To 16 times the relative error that the report states, which is eps times the condition.

    A report may not buy its ease: up to a condition of 1e10 the error has a cap of its own. What is
    left out is stated for training bins: new ones tell features apart that were nearly duplicate.
    """
    c, nearly = case(kind), kind.startswith("nearly")
    for route in ("dual", "primal"):
        if route == "primal" and c.z.shape[1] > 3:
            continue
        caplog.clear()
        if kind.endswith("1e-7") and penalty >= 1e12:
            with pytest.raises(
                ValueError, match=r"nearly singular: .* add \de-0[12] to scores, but"
            ):
                fit_machine(c.bins, penalty, route=route)
            continue
        machine = fit_machine(c.bins, penalty, route=route)
        report = machine.solved
        scores = machine(torch.from_numpy(np.r_[c.z, c.new]))
        left_out = report.left_out or 0.0
        assert left_out <= report.error <= max(1e-3, left_out)
        trained = nearly and report.method == "eigen"
        assert_right(scores, kind, penalty, 16 * report.error, trained=trained)
        if report.condition <= 1e10 and not (nearly and penalty > 1e12):
            assert_right(scores, kind, penalty, CAPS.get(kind, 1e-8), trained=trained)
        if report.method == "cholesky":
            assert report.error == pytest.approx(EPS * report.condition)
            assert report.condition <= 1e12
            assert not caplog.records
        elif np.isfinite(penalty):
            assert any(record.levelno == logging.WARNING for record in caplog.records)
        json.dumps(report.facts(), allow_nan=False)


def test_every_rung_is_met():
    methods = {
        fit_machine(case(kind).bins, penalty, route=route).solved.method
        for kind in ("plain", "duplicate features", "duplicate bins that agree")
        for penalty in (1.0, 1e12)
        for route in ("dual", "primal")
    }
    assert methods == {"cholesky", "jittered", "eigen"}


@pytest.mark.parametrize("num_features", [1, 2, 120, 2582])
@pytest.mark.parametrize("penalty", [1e-12, 1.0, 1e12, np.inf])
def test_from_one_feature_to_all_of_them(num_features, penalty):
    rng = np.random.default_rng(num_features)
    z, new = rng.uniform(-1, 1, (8, num_features)), rng.uniform(-1, 1, (2, num_features))
    targets = np.resize([1.0, -1.0], 8)
    machine = fit_machine(
        TrainingBins(torch.from_numpy(z), torch.from_numpy(targets > 0)), penalty, route="dual"
    )
    with mpmath.workdps(240):
        gram, across = kernel(z, z), kernel(new, z)
        expected = scores_of(gram, gram + across, targets, np.ones(8), penalty)
    actual = machine(torch.from_numpy(np.r_[z, new])).numpy()
    tolerance = min(16 * machine.solved.error, 1e-10) * np.abs(expected).max()
    np.testing.assert_allclose(actual, expected, rtol=0, atol=tolerance)


@pytest.mark.parametrize("degree", [1, 2])
def test_a_bin_that_weighs_1e14_does_not_drown_the_others(degree, rng, monkeypatch):
    """X'WX holds bins of weight 1 to 2 % beside it, behind any jitter; the dual holds all."""
    z, targets = rng.uniform(-1, 1, (40, 3)), rng.choice([-1.0, 1.0], 40)
    weights = np.ones(40)
    weights[3] = 1e14
    tensors = torch.from_numpy(z), torch.from_numpy(targets > 0), torch.from_numpy(weights)
    bins, paper = TrainingBins(*tensors), Polynomial(degree, 0.5)
    with mpmath.workdps(80):
        half, rows = mpmath.mpf(0.5), [exactly(row) for row in z]
        gram = [[(mpmath.fdot(u, v) + half) ** degree for v in rows] for u in rows]
        expected = scores_of(gram, gram, targets, weights, 1.0)
    actual = fit_machine(bins, 1.0, paper)(tensors[0]).numpy()
    np.testing.assert_allclose(actual, expected, rtol=0, atol=1e-9)
    refused = r"weights from 1\.0e\+00 to 1\.0e\+14 .* loses [2-9]e-02 of the lightest bin"
    with pytest.raises(ValueError, match=refused):
        fit_machine(bins, 1.0, paper, route="primal")
    with pytest.raises(ValueError, match="condition"):
        HeldOut(bins, torch.arange(40) // 4, paper, route="primal").at(1.0)
    for heavy in (1e14, 1e16):
        far = torch.where(bins.weights > 1, heavy, 1.0).double()
        with pytest.raises(ValueError, match="too far apart for X'WX, by 1e"):
            solve_primal(bins.features, bins.targets, 1.0, far)
    monkeypatch.setattr(fit, "_MOST_DUAL", 39)
    with pytest.raises(ValueError, match=refused):
        fit_machine(bins, 1.0, paper)
    assert fit_machine(bins, 1e-13, paper, route="primal").solved.method == "cholesky"


@pytest.mark.parametrize("kernel", [Polynomial(3), RadialBasis(0.5), Polynomial(1, 0.5)], ids=str)
@pytest.mark.parametrize("penalty", [1e12, np.inf])
def test_other_kernels_meet_duplicates(kernel, penalty):
    """Each bin thrice with two labels: the scores are a third, whatever the kernel."""
    z = torch.from_numpy(np.random.default_rng(0).uniform(-1, 1, (6, 8))).repeat(3, 1)
    is_slip = torch.tensor([True] * 12 + [False] * 6)
    for route in ("dual", "auto"):
        machine = fit_machine(TrainingBins(z, is_slip), penalty, kernel, route=route)
        assert machine.solved.method in ("eigen", "jittered")
        third = torch.full((18,), 1 / 3, dtype=torch.float64)
        torch.testing.assert_close(machine(z), third, rtol=0, atol=1e-8)


def test_single_precision_features_are_promoted_exactly():
    c = case("plain")
    single = TrainingBins(c.bins.features.float(), c.bins.is_slip, c.bins.weights.float())
    double = TrainingBins(single.features.double(), c.bins.is_slip, c.bins.weights)
    groups = torch.arange(16) // 4
    for route in ("dual", "primal"):
        for a, b in (
            (fit_machine(single, 1e9, route=route), fit_machine(double, 1e9, route=route)),
            *zip(
                HeldOut(single, groups, route=route).at(1e3),
                HeldOut(double, groups, route=route).at(1e3),
                strict=True,
            ),
        ):
            if isinstance(a, torch.Tensor):
                assert torch.equal(a, b)
                continue
            assert a.solved == b.solved
            for name, value in a.state_dict().items():
                assert torch.equal(value, b.state_dict()[name])


def test_a_head_remembers_its_solve_and_its_file_does_not(rng):
    machine = fit_machine(case("plain").bins, 1.0)
    assert set(machine.state_dict()) == {"quadratic", "linear", "constant"}
    assert pickle.loads(pickle.dumps(machine)).solved == machine.solved
    assert machine.solved.facts()["method"] == "cholesky"
    kept = fit_machine(case("plain").bins, 1.0, RadialBasis(1.0))
    assert set(kept.state_dict()) == {"support", "beta"}
    assert kept.solved.size == 16
    assert type(machine)(machine.quadratic, machine.linear, machine.constant).solved is None
    assert type(kept)(kept.support, kept.beta, kept.kernel).solved is None


# Sums and held-out scores --------------------------------------------------------------------


@pytest.mark.parametrize("penalty", PENALTIES)
@pytest.mark.parametrize("kind", [k for k in KINDS if "more features" not in k])
def test_sums_give_the_scores_or_refuse(kind, penalty):
    """Their grid leaves an error of 1e-11; what it would decide is refused."""
    c = case(kind)
    stats = SufficientStats(3, grid_bits=26 if "weights" in kind else 38)
    z, targets, weights = map(torch.from_numpy, (c.z, c.targets, c.weights))
    stats.update("one", z, targets > 0, weights)
    machine = None
    with contextlib.suppress(ValueError):
        machine = stats.solve(penalty, balance="none")
    if machine is None:
        assert penalty >= 1e9 or "weights" in kind
        with pytest.raises(ValueError, match="lower the penalty, or make it exactly"):
            stats.solve(penalty, balance="none")
        return
    assert kind.startswith(("plain", "weights")) or penalty <= 1e6
    grid = 64 * 2.0**-26 / c.weights.min() if "weights" in kind else 0.0  # light bins drown
    scores = machine(torch.from_numpy(np.r_[c.z, c.new]))
    assert machine.solved.error <= 1e-3
    assert_right(scores, kind, penalty, 16 * machine.solved.error + grid)


@pytest.mark.parametrize("penalty", [1e-12, 1.0, 1e3, 1e6, 1e9, 1e12])
@pytest.mark.parametrize("route", ["dual", "primal"])
@pytest.mark.parametrize(
    "kind", ["plain", "duplicate features", "duplicate bins", "weights over 12 decades"]
)
def test_held_out_scores_are_those_of_refits_or_refused(kind, route, penalty):
    """To 100 eps times the condition of all bins."""
    c, groups = case(kind), np.arange(16) // 4
    assert len({*zip(groups, c.targets, strict=True)}) > 4
    machine, fit = HeldOut(c.bins, torch.from_numpy(groups), route=route), None
    with contextlib.suppress(ValueError):
        fit = machine.at(penalty)
    if fit is None:
        assert penalty >= 1e6 or (penalty >= 1e3 and "weights" in kind)
        with pytest.raises(ValueError, match=r"condition|the machine without group \d is too far"):
            machine.at(penalty)
        return
    expected = np.empty(16)
    with mpmath.workdps(80):
        gram = np.array(kernel(c.z, c.z), dtype=object)
        for group in range(4):
            own, rest = groups == group, groups != group
            expected[own] = scores_of(
                gram[np.ix_(rest, rest)].tolist(),
                gram[np.ix_(own, rest)].tolist(),
                c.targets[rest],
                c.weights[rest],
                penalty,
            )
    condition = fit.head.solved.condition
    assert condition <= MOST_CONDITION
    tolerance = 100 * EPS * condition * max(1.0, np.abs(expected).max())
    np.testing.assert_allclose(fit.scores.numpy(), expected, rtol=0, atol=tolerance)


def test_held_out_scores_of_a_default_machine_are_far_from_the_limit(rng):
    c = case("plain")
    for route in ("dual", "primal"):
        fit = HeldOut(c.bins, torch.arange(16), PAPER_KERNEL, route).at(1.0)
        assert fit.head.solved.condition < 1e-6 * MOST_CONDITION
