"""How much ``benchmarks.model`` measures."""

from __future__ import annotations

from dataclasses import dataclass

from benchmarks.model.synthetic import SyntheticBins
from tactslip_torch.model.kernels import Polynomial


@dataclass(frozen=True)
class Sizes:
    """How much is measured.

    Args:
        num_features: K.
        penalty: the paper's ``C``.
        offset: the paper's ``c``.
        repeats: of whatever takes seconds.
        rounds: of whatever takes less.
        latency_bins: training bins of the heads whose latency is compared.
        latency_batch: bins scored at once, beside one bin.
        svc_bins: training bins of the SVC whose latency is compared.
        update_bins: bins of a batch that is accumulated.
        fit_bins: training bins of the fits.
        test_bins: held-out bins they are judged on.
        fold_bins: training bins of the folds: fewer than monomials, and more.
        num_folds: groups that are left out in turn.
        any_bins: bins that are accumulated without holding them.
        any_batch: how many of them at a time.
        worker_bins: bins that several processes share.
        worker_batch: how many of them at a time.
        processes: how many, one after the other.
        shards: of one more run, in the most processes.
        seed: of the data.
    """

    num_features: int = 120
    penalty: float = 0.1
    offset: float = 0.5
    repeats: int = 3
    rounds: int = 60
    latency_bins: tuple[int, ...] = (1_000, 10_000, 100_000)
    latency_batch: int = 256
    svc_bins: int = 8_000
    update_bins: tuple[int, ...] = (243, 2_048)
    fit_bins: int = 8_000
    test_bins: int = 4_000
    fold_bins: tuple[int, ...] = (6_000, 16_000)
    num_folds: int = 6
    any_bins: int = 20_000
    any_batch: int = 2_048
    worker_bins: int = 20_000
    worker_batch: int = 243
    processes: tuple[int, ...] = (1, 2, 4)
    shards: int = 7
    seed: int = 0

    @property
    def source(self) -> SyntheticBins:
        """The data."""
        return SyntheticBins(**self.bins)

    @property
    def bins(self) -> dict[str, int]:
        """Arguments of ``SyntheticBins``, for workers."""
        return {"num_features": self.num_features, "seed": self.seed}

    @property
    def kernel(self) -> Polynomial:
        """The paper's, with this offset."""
        return Polynomial(2, self.offset)


QUICK = Sizes(
    num_features=20,
    rounds=20,
    latency_bins=(100, 300, 1_000),
    svc_bins=500,
    update_bins=(100, 500),
    fit_bins=500,
    test_bins=200,
    fold_bins=(200, 1_000),
    any_bins=2_000,
    any_batch=500,
    worker_bins=2_000,
    worker_batch=100,
)
