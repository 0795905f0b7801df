"""Rivals beside MiniRocket; what they choose, they choose inside the fold."""

from __future__ import annotations

import time
from collections.abc import Sequence
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks.peers.others import tsfel_features
from benchmarks.real.inner import best_choice
from benchmarks.real.method import Fitted, Method, Training
from benchmarks.real.sizes import Sizes
from benchmarks.real.tsfel_rows import finite, tsfel_rows
from benchmarks.real.windows import Array, Windows
from tactslip_torch.features.extractor import FeatureExtractor
from tactslip_torch.features.selection import ClassMoments, rank_features, t_scores
from tactslip_torch.model.scaling import FeatureScaler


# ------------------------------------------------------------------------------------------- TSFEL
def forest(windows: Windows, sizes: Sizes, folder: Path) -> Method:
    """All of TSFEL's features and a random forest; rows are kept in the folder."""
    rows, rows_s = tsfel_rows(windows, folder)
    describe = tsfel_features(windows.maker.pool.sample_rate_hz)
    fit = partial(_fit_forest, describe, sizes)
    return Method("TSFEL, random forest", rows, rows_s, fit, is_slow=True)


def _fit_forest(describe: Any, sizes: Sizes, training: Training) -> Fitted:
    from sklearn.ensemble import RandomForestClassifier

    grid = list(product(sizes.leaves, sizes.tree_features))

    def fitted(choice: tuple[int, Any], trees: int, mask: Array) -> Any:
        leaf, share = choice
        made = RandomForestClassifier(
            trees,
            min_samples_leaf=leaf,
            max_features=share,
            class_weight="balanced",
            random_state=0,
            n_jobs=1,
        )
        return made.fit(training.rows[mask], training.is_slip[mask])

    def scores(made: Any, rows: Array) -> Array:
        found: Array = made.predict_proba(rows)[:, 1] - 0.5
        return found

    def trial(train: Array, held: Array) -> list[Array]:
        return [scores(fitted(c, sizes.inner_trees, train), training.rows[held]) for c in grid]

    best, _ = best_choice(trial, training.is_slip, training.objects, sizes.inner)
    made = fitted(grid[best], sizes.trees, np.ones(len(training.is_slip), bool))

    def judge(samples: Array) -> Array:
        return scores(made, finite(np.stack([describe(window) for window in samples])))

    chosen = dict(zip(("leaf", "features of a split"), grid[best], strict=True))
    return Fitted(partial(scores, made), judge, chosen)


# ---------------------------------------------------------------------------- RBF SVC on our pool
def svc(windows: Windows, sizes: Sizes, rows: Array, rows_s: float) -> Method:
    """A support vector machine on features of our pool, ranked and scaled as robust scales."""
    return Method("our pool, RBF SVC", rows, rows_s, partial(_fit_svc, windows, sizes))


def _fit_svc(windows: Windows, sizes: Sizes, training: Training) -> Fitted:
    from sklearn.svm import SVC

    most = training.rows.shape[1]
    numbers = sorted({min(number, most) for number in sizes.svc_features})
    grid = list(product(numbers, sizes.svc_penalties, sizes.svc_widths))

    def fitted(choice: tuple[int, float, float], scaled: Array, is_slip: Array) -> Any:
        number, penalty, width = choice
        made = SVC(C=penalty, gamma=width / number, class_weight="balanced")
        return made.fit(scaled[:, :number], is_slip)

    def trial(train: Array, held: Array) -> list[Array]:
        is_slip = training.is_slip[train]
        order, scaler = _ranked(training.rows[train], is_slip, numbers[-1])
        here, there = (_scaled(scaler, training.rows[mask][:, order]) for mask in (train, held))
        return [fitted(c, here, is_slip).decision_function(there[:, : c[0]]) for c in grid]

    best, _ = best_choice(trial, training.is_slip, training.objects, sizes.inner)
    number = grid[best][0]
    order, scaler = _ranked(training.rows, training.is_slip, number)
    made = fitted(grid[best], _scaled(scaler, training.rows[:, order]), training.is_slip)
    extractor = FeatureExtractor(windows.maker.pool, order)

    def decide(rows: Array) -> Array:
        found: Array = made.decision_function(_scaled(scaler, rows[:, order]))
        return found

    def judge(samples: Array) -> Array:
        with torch.no_grad():
            features = extractor(torch.from_numpy(samples)).numpy()
        found: Array = made.decision_function(_scaled(scaler, features))
        return found

    chosen = dict(zip(("features", "C", "gamma x features"), grid[best], strict=True))
    return Fitted(decide, judge, chosen)


def _ranked(rows: Array, is_slip: Array, number: int) -> tuple[list[int], FeatureScaler]:
    moments = ClassMoments(rows.shape[1])
    moments.update(torch.from_numpy(rows), torch.from_numpy(is_slip))
    order: list[int] = rank_features(t_scores(moments, "pooled"), number).tolist()
    chosen = torch.from_numpy(rows[:, order]).double()
    return order, FeatureScaler.fit(chosen, compress=True, tail=0.01)


def _scaled(scaler: FeatureScaler, rows: Array) -> Array:
    found: Array = scaler(torch.from_numpy(rows).double()).numpy()
    return found


# ------------------------------------------------------- logistic regression on simple statistics
def regression(windows: Windows, sizes: Sizes) -> Method:
    """Logistic regression on five statistics of each channel, as they are or in logs."""
    started = time.perf_counter()
    rows = statistics(windows.samples)
    taken = (time.perf_counter() - started) / len(rows)
    fit = partial(_fit_regression, sizes)
    return Method("simple statistics, logistic regression", rows, taken, fit)


def statistics(samples: Array) -> Array:
    """Mean, std, range, std and mean size of differences: ``[N, C, n] -> [N, 5 C]``."""
    steps = np.diff(samples, axis=-1)
    found = [
        samples.mean(-1),
        samples.std(-1),
        np.ptp(samples, axis=-1),
        steps.std(-1),
        np.abs(steps).mean(-1),
    ]
    return np.concatenate(found, 1)


def _fit_regression(sizes: Sizes, training: Training) -> Fitted:
    from sklearn.linear_model import LogisticRegression
    from sklearn.pipeline import make_pipeline
    from sklearn.preprocessing import FunctionTransformer, StandardScaler

    forms = {"as they are": FunctionTransformer(), "with logs": FunctionTransformer(with_logs)}
    grid = list(product(forms, sizes.regression_penalties))

    def fitted(choice: tuple[str, float], mask: Array) -> Any:
        form, penalty = choice
        machine = LogisticRegression(C=penalty, class_weight="balanced", max_iter=2000)
        made = make_pipeline(forms[form], StandardScaler(), machine)
        return made.fit(training.rows[mask], training.is_slip[mask])

    def trial(train: Array, held: Array) -> Sequence[Array]:
        return [fitted(c, train).decision_function(training.rows[held]) for c in grid]

    most = len(set(training.objects.tolist()))  # cheap: each object is left out alone
    best, _ = best_choice(trial, training.is_slip, training.objects, most)
    made = fitted(grid[best], np.ones(len(training.is_slip), bool))

    def judge(samples: Array) -> Array:
        found: Array = made.decision_function(statistics(samples))
        return found

    chosen = dict(zip(("statistics", "C"), grid[best], strict=True))
    return Fitted(made.decision_function, judge, chosen)


def with_logs(rows: Array) -> Array:
    """The rows and their signed logs beside them, ``[N, F] -> [N, 2 F]``."""
    return np.concatenate([rows, np.sign(rows) * np.log1p(np.abs(rows))], 1)
