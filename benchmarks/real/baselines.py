"""Baselines beside the rockets; what they choose, they choose inside the fold by objects left out.

Logistic regression on the columns of our detector, and logistic regression and a random forest on
simple statistics of each channel.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from functools import partial
from itertools import product
from typing import Any

import numpy as np
import torch

from benchmarks.real.inner import best_choice
from benchmarks.real.method import Fitted, Method, Training
from benchmarks.real.sizes import Sizes
from benchmarks.real.windows import Array
from tactslip_torch.model.detector import SlipDetector

Grid = Mapping[str, Any]
"""Unfitted scikit-learn classifiers by what is told of the choice."""


def same_features(
    rows: Array, rows_s: float, detectors: Mapping[tuple[str, ...], SlipDetector], sizes: Sizes
) -> Method:
    """Logistic regression on the scaled columns of our detector of the same fold.

    Args:
        rows: of the whole pool.
        rows_s: seconds that one took.
        detectors: by training objects; ours is fitted first and leaves it there.
        sizes: what may be chosen.
    """

    def fit(training: Training) -> Fitted:
        detector = detectors[training.fold]
        selected = list(detector.selected)

        def columns(rows: Array) -> Array:
            with torch.no_grad():
                found: Array = detector.scaled(torch.from_numpy(rows[:, selected]).double()).numpy()
            return found

        grid = _regressions(sizes, {"": None})  # columns are compressed already
        made = _fit(grid, training._replace(rows=columns(training.rows)), sizes)

        def judge(samples: Array) -> Array:
            with torch.no_grad():
                features = detector.extractor(torch.from_numpy(samples)).double()
                return made.decide(detector.scaled(features).numpy())

        return Fitted(lambda rows: made.decide(columns(rows)), judge, made.chosen)

    return Method("our features, logistic regression", rows, rows_s, fit)


def simple_baselines(samples: Array, sizes: Sizes) -> list[Method]:
    """Logistic regression and a random forest on simple statistics."""
    from sklearn.ensemble import RandomForestClassifier
    from sklearn.preprocessing import FunctionTransformer

    started = time.perf_counter()
    rows = statistics(samples)
    taken = (time.perf_counter() - started) / len(rows)
    forests = {
        f"leaf {leaf}": RandomForestClassifier(
            sizes.trees, min_samples_leaf=leaf, class_weight="balanced", random_state=0
        )
        for leaf in sizes.leaves
    }
    forms = {"as they are, ": None, "with logs, ": FunctionTransformer(with_logs)}
    grids = {"logistic regression": _regressions(sizes, forms), "random forest": forests}
    return [
        Method(f"simple statistics, {name}", rows, taken, partial(_fit_simple, grid, sizes))
        for name, grid in grids.items()
    ]


def statistics(samples: Array) -> Array:
    """Mean, std, rms, range and mean size of differences: ``[N, C, n] -> [N, 5 C]``."""
    found = [
        samples.mean(-1),
        samples.std(-1),
        np.sqrt(np.square(samples).mean(-1)),
        np.ptp(samples, axis=-1),
        np.abs(np.diff(samples, axis=-1)).mean(-1),
    ]
    return np.concatenate(found, 1)


def with_logs(rows: Array) -> Array:
    """The rows and their signed logs beside them, ``[N, F] -> [N, 2 F]``."""
    return np.concatenate([rows, np.sign(rows) * np.log1p(np.abs(rows))], 1)


def _regressions(sizes: Sizes, forms: Mapping[str, Any]) -> Grid:
    from sklearn.linear_model import LogisticRegression
    from sklearn.pipeline import make_pipeline
    from sklearn.preprocessing import StandardScaler

    return {
        f"{name}C {penalty:g}": make_pipeline(
            form,
            StandardScaler(),
            LogisticRegression(C=penalty, class_weight="balanced", max_iter=2000),
        )
        for (name, form), penalty in product(forms.items(), sizes.regression_penalties)
    }


def _fit_simple(grid: Grid, sizes: Sizes, training: Training) -> Fitted:
    made = _fit(grid, training, sizes)
    return made._replace(judge=lambda samples: made.decide(statistics(samples)))


def _fit(grid: Grid, training: Training, sizes: Sizes) -> Fitted:
    from sklearn.base import clone

    def fitted(name: str, mask: Array) -> Any:
        return clone(grid[name]).fit(training.rows[mask], training.is_slip[mask])

    def scores(made: Any, rows: Array) -> Array:
        has_scores = hasattr(made, "decision_function")
        found: Array = (
            made.decision_function(rows) if has_scores else made.predict_proba(rows)[:, 1]
        )
        return found if has_scores else found - 0.5

    def trial(train: Array, held: Array) -> list[Array]:
        return [scores(fitted(name, train), training.rows[held]) for name in grid]

    best, _ = best_choice(trial, training.is_slip, training.objects, sizes.inner)
    name = list(grid)[best]
    made = fitted(name, np.ones(len(training.is_slip), bool))
    return Fitted(partial(scores, made), partial(scores, made), {"": name})
