"""Simpler methods, fitted to the same sample of training bins and evaluated beside the detector.

- ``best_pooled_number``: the statistic over channels of one descriptor that separates the classes
  best, and its threshold;
- ``logistic_regression``: on the scaled columns of the detector;
- ``logistic_regression_simple``: on the simple statistics of each channel (mean, standard
  deviation, rms, range, mean absolute change), and their logarithms;
- ``random_forest_simple``: on the simple statistics of each channel.

``best_pooled_number`` has the features that are made for the recipe.
"""

from __future__ import annotations

import warnings
from functools import partial
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tactslip_torch.features.pool import FeaturePool, is_rounding, is_simple_of
from tactslip_torch.features.pooling import ChannelPooling
from tactslip_torch.training.bins import SampledBins

POOLED_NUMBER = "best_pooled_number"
CONSTANT_BINS = 1200  # at most, of which compression learns its medians
NUM_TREES = 100  # as scikit-learn has it
MOST_FOLDS = 6  # with 3, C of simple statistics costs two points on held-out materials
PENALTIES = (1e-3, 1e-2, 1e-1, 1.0)
"""scikit-learn's ``C`` of logistic regression, chosen by leaving groups out, strongest first."""
WIDE, WIDE_PENALTY = 256, 1e-2
"""With more columns than this, choosing would take longer than the detector's own validation: ``C``
is fixed. On 672 pooled columns of the simulated hand 1e-3 to 1 differ by .3 points."""
LOG_FLOOR = 1e-2  # of the training median of a magnitude, below which its logarithm levels out


def _fit_regression(columns: Tensor, sample: SampledBins, *, with_logs: bool = False) -> Any:
    """scikit-learn's logistic regression of standardised columns ``[n, K]`` of sampled bins.

    Its ``C`` is chosen by leaving groups out unless columns are many: the best mean balanced
    accuracy, the strongest penalty of equals. ``with_logs`` adds the logarithm of each column's
    magnitude: amplitudes range over decades, so logarithms are worth seven points on the simulated
    hand.
    """
    from sklearn.linear_model import LogisticRegression
    from sklearn.model_selection import GridSearchCV
    from sklearn.pipeline import make_pipeline
    from sklearn.preprocessing import FunctionTransformer, StandardScaler

    before = make_pipeline(StandardScaler())
    if with_logs:
        floor = LOG_FLOOR * columns.abs().median(0).values
        floor = torch.where(floor > 0, floor, 1.0)
        logs = FunctionTransformer(_with_logs, kw_args={"floor": floor.numpy()})
        before = make_pipeline(logs, StandardScaler())
    z = before.fit_transform(columns.double().numpy())
    num_folds, groups = min(len(sample.group_names), MOST_FOLDS), sample.group
    splits = [(groups % num_folds != fold, groups % num_folds == fold) for fold in range(num_folds)]
    folds = [
        [part.nonzero()[:, 0].numpy() for part in split]
        for split in splits
        if all(len(sample.is_slip[part].unique()) == 2 for part in split)
    ]
    is_wide = z.shape[1] > WIDE
    solver = "lbfgs" if is_wide else "newton-cholesky"
    made = LogisticRegression(C=WIDE_PENALTY, class_weight="balanced", max_iter=2000, solver=solver)
    if folds and not is_wide:
        made = GridSearchCV(made, {"C": PENALTIES}, scoring="balanced_accuracy", cv=folds)
    made.fit(z, sample.is_slip.numpy(), sample_weight=sample.weight.numpy())
    return make_pipeline(before, getattr(made, "best_estimator_", made))


def _with_logs(columns: NDArray[np.float64], floor: NDArray[np.float64]) -> NDArray[np.float64]:
    """Columns, and the logarithms of their magnitudes, which level out at the floor."""
    return np.concatenate([columns, np.log(np.abs(columns) + floor)], 1)


def _fit_forest(columns: Tensor, sample: SampledBins) -> Any:
    """scikit-learn's random forest of columns ``[n, K]`` of sampled bins."""
    from sklearn.ensemble import RandomForestClassifier

    made = RandomForestClassifier(NUM_TREES, class_weight="balanced", random_state=0, n_jobs=2)
    truth, weights = sample.is_slip.numpy(), sample.weight.numpy()
    return made.fit(columns.numpy(), truth, sample_weight=weights).set_params(n_jobs=None)


def _says_forest(made: Any, columns: NDArray[np.float64]) -> NDArray[np.bool_]:
    """As ``made.predict``, which starts jobs: twice as long for the bins of a recording."""
    few = columns.astype(np.float32)
    votes = [tree.predict_proba(few, check_input=False) for tree in made.estimators_]
    return np.asarray(made.classes_[np.mean(votes, 0).argmax(1)])


class _PooledNumber:
    """The mean or deviation over channels of one descriptor with the best balanced accuracy.

    Args:
        pool: of the features.
        sample: of training bins.

    Attributes:
        name: of the statistic.
        metadata: what it is, and its threshold, JSON-able.

    Raises:
        ValueError: if a class is absent.
    """

    def __init__(self, pool: FeaturePool, sample: SampledBins) -> None:
        places = (~is_rounding(pool)).nonzero().flatten()
        names = [pool.names[place] for place in places.tolist()]
        features = sample.features[:: -(-len(sample.features) // CONSTANT_BINS)][:, places]
        layer = ChannelPooling.fit(pool.hand, names, features, ["mean", "std"])
        columns = layer(sample.features[:, pool.places(layer.inputs)].double())
        index, self._threshold, self._sign = _best_threshold(columns, sample.is_slip, sample.weight)
        self._layer = layer.select([index])
        self._inputs = pool.places(self._layer.inputs)
        self.name = self._layer.names[0]
        self.metadata: dict[str, Any] = {
            "feature": str(self.name),
            "threshold": self._threshold,
            "sign": self._sign,
        }

    def __call__(self, features: Tensor) -> Tensor:
        """Decisions, ``[N, F] -> [N]``, bool."""
        value = self._layer(features[:, self._inputs].double())[..., 0]
        decision: Tensor = self._sign * value > self._sign * self._threshold
        return decision


class Baselines:
    """All baselines, fitted to sampled training bins.

    Args:
        pool: of the features.
        scaled: columns of the detector of the sampled bins, ``[n, K]``.
        sample: of training bins.

    Attributes:
        metadata: of each, by name, JSON-able.

    Raises:
        ValueError: if a class is absent.
    """

    def __init__(self, pool: FeaturePool, scaled: Tensor, sample: SampledBins) -> None:
        from threadpoolctl import threadpool_limits  # type: ignore[import-untyped]  # sklearn's own

        self._pooled = _PooledNumber(pool, sample)  # refuses one class
        self._simple = is_simple_of(pool)
        x = sample.features[:, self._simple].double()
        with warnings.catch_warnings(), threadpool_limits(1):  # small: threads would wait
            warnings.simplefilter("ignore")  # newton-cholesky falls back to lbfgs by itself
            self._others = {
                "logistic_regression": _fit_regression(scaled, sample),
                "logistic_regression_simple": _fit_regression(x, sample, with_logs=True),
                "random_forest_simple": _fit_forest(x, sample),
            }
        num_bins = {"num_bins": len(sample.is_slip)}
        self.metadata: dict[str, dict[str, Any]] = {POOLED_NUMBER: self._pooled.metadata | num_bins}
        for name, made in self._others.items():
            own = {"trees": NUM_TREES} if "forest" in name else {"C": made[-1].C}
            self.metadata[name] = own | num_bins

    def __call__(self, features: Tensor, scaled: Tensor) -> dict[str, Tensor]:
        """Decisions by name.

        Shape:
            - features: ``[N, F]``, of the pool
            - scaled: ``[N, K]``, columns of the detector
            - output: each ``[N]``, bool
        """
        found, simple = {POOLED_NUMBER: self._pooled(features)}, features[:, self._simple].double()
        for name, made in self._others.items():
            x = (simple if name.endswith("_simple") else scaled.double()).numpy()
            predict = partial(_says_forest, made) if "forest" in name else made.predict
            found[name] = torch.from_numpy(predict(x) if len(x) else np.zeros(0, bool))
        return found


def _best_threshold(features: Tensor, is_slip: Tensor, weights: Tensor) -> tuple[int, float, int]:
    """The single feature, threshold and sign of the best balanced accuracy on training bins.

    Slip is where ``sign * feature > sign * threshold``.

    Shape:
        - features: ``[N, K]``, finite; is_slip: ``[N]``, bool; weights: ``[N]``

    Raises:
        ValueError: if a class is absent.
    """
    if len(is_slip.unique()) < 2:
        raise ValueError("baselines need training bins of both classes; got only one")
    slip, quiet = weights * is_slip, weights * ~is_slip
    step = slip / slip.sum() - quiet / quiet.sum()
    values, order = features.sort(dim=0)
    below = step[order].cumsum(0)[:-1]  # slip recall minus non-slip recall if cut above this value
    below = torch.where(values[1:] > values[:-1], below, 0.0)  # no cut between equal values
    best = below.abs().flatten().argmax()
    row, index = divmod(int(best), features.shape[1])
    sign = -1 if below[row, index] > 0 else 1
    lower, upper = float(values[row, index]), float(values[row + 1, index])
    threshold = lower + (upper - lower) / 2
    if threshold in (lower, upper):  # neighbouring floats: the side that is not slip
        threshold = lower if sign > 0 else upper
    return index, threshold, sign
