from collections.abc import Callable

import numpy as np
import pytest
import torch
from engine_bins import KINDS, PLAIN_KINDS, bins_of, worst_errors
from numpy.typing import NDArray
from torch import Tensor

from benchmarks.errors import feature_errors, score_error
from benchmarks.peers import heads, loop, others
from benchmarks.peers.arrays import Way, features
from benchmarks.peers.hard import BY_ROW, VECTORISED
from tactslip_torch import FeaturePool, HandLayout
from tactslip_torch.model.fit import TrainingBins, fit_machine
from tactslip_torch.model.kernels import PAPER_KERNEL
from tactslip_torch.signals.filtering import ChannelFilter

TOLERANCE = 1e-7  # stated for peers; plain sums without shifts lose digits on offsets
LOOP_TOLERANCE = 1e-6  # its cv has no floor under the mean
WAYS = {"by row": BY_ROW, "vectorised": VECTORISED}


@pytest.fixture(scope="module")
def pool() -> FeaturePool:
    return FeaturePool(HandLayout.paper24())


def some(kind: str, num: int = 6) -> Tensor:
    return bins_of(kind, num, HandLayout.paper24(), 100, torch.Generator().manual_seed(0))


# ------------------------------------------------------------------------------ same features
@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("kind", KINDS)
def test_numpy_agrees_with_the_pool(pool: FeaturePool, kind: str, way: str) -> None:
    bins = some(kind)
    found = torch.from_numpy(features(bins.numpy(), 14, WAYS[way]))
    worst = worst_errors(found, pool(bins), pool.names)
    assert {name: error for name, error in worst.items() if error > TOLERANCE} == {}


@pytest.mark.parametrize("way", WAYS.values(), ids=WAYS)
def test_numpy_agrees_on_a_vibration_on_an_offset(pool: FeaturePool, way: Way) -> None:
    bins = 2.0 + 1e-3 * some("random")
    worst = worst_errors(torch.from_numpy(features(bins.numpy(), 14, way)), pool(bins), pool.names)
    assert {name: error for name, error in worst.items() if error > TOLERANCE} == {}


def test_numpy_takes_any_number_of_bins() -> None:
    bins = some("random", 21).numpy()
    whole = features(bins, 14, VECTORISED)
    np.testing.assert_allclose(features(bins, 14, VECTORISED, chunk_bins=5), whole, rtol=1e-9)
    assert whole.shape == (21, 2582)


@pytest.mark.parametrize("kind", ["random", "tied"])
def test_the_loop_agrees_with_the_pool(pool: FeaturePool, kind: str) -> None:
    bins = some(kind, 4)[1::2] + (2.0 if kind == "tied" else 0.0)  # no mean that is exactly 0
    if kind == "tied":
        bins = bins.clone()
        bins[:, :, 0] += 1e-3  # no channel whose branches are all 0
    found = torch.from_numpy(np.stack([looped(pool, one) for one in bins.numpy()]))
    worst = worst_errors(found, pool(bins), pool.names)
    assert {name: error for name, error in worst.items() if error > LOOP_TOLERANCE} == {}


def test_the_loop_makes_only_what_is_wanted(pool: FeaturePool) -> None:
    bin_ = some("random", 2)[1].numpy()
    wanted = [2581, 5, 700, 701, 7]
    whole = looped(pool, bin_)
    np.testing.assert_array_equal(looped(pool, bin_, wanted), whole[wanted])


def looped(
    pool: FeaturePool, bin_: NDArray[np.float64], wanted: list[int] | None = None
) -> NDArray[np.float64]:
    chosen = pool.names if wanted is None else [pool.names[i] for i in wanted]
    names = [(n.channel, n.component, n.domain, n.descriptor) for n in chosen]
    return loop.features(bin_, names, pool.hand.names)


@pytest.mark.parametrize("savgol", [loop.savgol, loop.savgol_in_groups])
def test_the_loop_filters_as_the_package(
    rng: np.random.Generator, savgol: Callable[..., NDArray[np.float64]]
) -> None:
    filters = ChannelFilter([51] * 14 + [11] * 10)
    samples = rng.standard_normal((24, 150))
    found = savgol(samples, filters.window_lengths, 1, filters.context)
    wanted = filters.valid(torch.from_numpy(samples)).numpy()
    np.testing.assert_allclose(found, wanted, atol=1e-12)


def test_the_loop_sums_the_papers_kernel(rng: np.random.Generator) -> None:
    z, support, beta = (torch.from_numpy(rng.uniform(-1, 1, s)) for s in ((3,), (7, 3), (7,)))
    wanted = float(PAPER_KERNEL(z[None], support) @ beta)
    found = loop.kernel_score(z.numpy(), support.numpy(), beta.numpy(), 0.5, 2)
    assert found == pytest.approx(wanted)


# ----------------------------------------------------------------------------- other features
def test_heads_of_scikit_learn_have_the_papers_kernel(rng: np.random.Generator) -> None:
    z = rng.uniform(-1, 1, (40, 5))
    is_slip = z[:, 0] * z[:, 1] + 0.3 * z[:, 2] > 0
    targets = np.where(is_slip, 1.0, -1.0)
    ours = fit_machine(TrainingBins(torch.from_numpy(z), torch.from_numpy(is_slip)), 10.0)
    ridge = heads.kernel_ridge(z, targets, 0.5, 10.0)
    np.testing.assert_allclose(ridge.predict(z), ours(torch.from_numpy(z)).numpy(), atol=1e-8)
    svc = heads.svc(z, targets, 0.5)
    by_hand = (svc.support_vectors_ @ z.T + 0.5) ** 2
    wanted = svc.dual_coef_[0] @ by_hand + svc.intercept_[0]
    np.testing.assert_allclose(svc.decision_function(z), wanted, atol=1e-8)


def test_tsfel_describes_a_bin_of_every_channel() -> None:
    pytest.importorskip("tsfel")
    bin_ = some("random", 2)[1].numpy()
    one, all_ = (others.tsfel_features()(part) for part in (bin_[:1], bin_))
    assert len(all_) == 24 * len(one)
    assert np.isin(bin_[0].max(), one)


@pytest.mark.slow
def test_mini_rocket_and_ridge_learn_what_is_plain() -> None:
    pytest.importorskip("aeon")
    bins = some("random", 40).numpy().astype(np.float32)
    targets = np.where(np.arange(40) % 2 == 0, 1.0, -1.0)
    bins[targets > 0, :3] = np.cumsum(bins[targets > 0, :3], axis=-1)
    scores = others.mini_rocket_ridge(bins[:30], targets[:30], threads=1, num_kernels=168)
    assert ((scores(bins[30:]) > 0) == (targets[30:] > 0)).all()


# ------------------------------------------------------------------------------------- errors
@pytest.mark.parametrize("kind", PLAIN_KINDS)
def test_errors_are_those_that_the_engines_are_held_to(pool: FeaturePool, kind: str) -> None:
    # two independent writings of one rule
    bins = some(kind, 12)
    reference = pool(bins)
    found = reference * (1 + 1e-5 * torch.randn_like(reference))
    wanted = worst_errors(found, reference, pool.names)
    made = feature_errors(found, reference, pool.names)
    assert made["entropy_bits"] == pytest.approx(wanted.pop("entropy"))
    assert made["mode_elsewhere"] == pytest.approx(wanted.pop("mode"))
    assert made["worst"] == pytest.approx(max(wanted.values()))
    assert wanted[made["at"]] == max(wanted.values())
    assert made["not_finite"] == 0


@pytest.mark.parametrize(
    ("cv", "found", "error"),
    [(1e6, -1e6, 0.0), (1e6, 2e6, 1.0), (5e5, -5e5, 2.0), (2e4, 4e4, 1.0)],
)
def test_only_the_sign_of_a_cv_at_the_floor_may_differ(
    cv: float, found: float, error: float
) -> None:
    reference, other = (torch.tensor([[of]], dtype=torch.float64) for of in (cv, found))
    assert feature_errors(other, reference, ["a cv"])["worst"] == error
    assert worst_errors(other, reference, ["a cv"])["cv"] == error
    assert feature_errors(-reference, reference, ["a mean"])["worst"] == 2.0


def test_errors_count_what_is_not_finite() -> None:
    reference = torch.tensor([[1.0, 2.0], [3.0, 5.0]])
    found = torch.tensor([[1.0, torch.nan], [torch.inf, 5.0]])
    made = feature_errors(found, reference, ["a mean", "a std"])
    assert made["not_finite"] == 2
    assert made["worst"] == 0


def test_an_error_is_measured_by_value_or_column() -> None:
    reference = torch.tensor([[0.0, 100.0], [2.0, 100.0]])
    found = torch.tensor([[0.5, 100.0], [2.0, 90.0]])
    assert feature_errors(found, reference, ["a mean", "a std"])["worst"] == 0.5  # std is 1
    assert feature_errors(found[:, 1:], reference[:, 1:], ["a std"])["worst"] == 0.1


def test_a_score_error_is_in_standard_deviations() -> None:
    reference = torch.tensor([-3.0, 3.0])
    assert score_error(torch.tensor([-3.0, 4.5]), reference) == 0.5
