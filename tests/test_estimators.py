"""The scikit-learn face: its own checks, and windows all the way to detectors and files."""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import sklearn
import torch
from numpy.typing import NDArray
from sklearn.base import clone
from sklearn.linear_model import LogisticRegression
from sklearn.model_selection import GridSearchCV, LeaveOneGroupOut, cross_val_score
from sklearn.pipeline import make_pipeline
from sklearn.utils import estimator_checks
from sklearn.utils.estimator_checks import parametrize_with_checks
from small_set import SMALL_HAND

from tactslip_torch import SlipClassifier, SlipDetector, TactileFeatures

RATE_HZ = 2000.0
Array = NDArray[Any]


ASKS = "labels such as 1 and 2 do not say which one is slip: it asks for slip_label"
OF_ANY_LABELS = """estimators_dtypes classifier_data_not_an_array classifiers_classes
fit2d_1feature"""


@parametrize_with_checks(
    [SlipClassifier()],
    expected_failed_checks=lambda _: {f"check_{name}": ASKS for name in OF_ANY_LABELS.split()},
)
def test_scikit_learns_checks(estimator: Any, check: Any) -> None:
    check(estimator)


NO_FLAT_DATA = """estimator_tags_renamed valid_tag_types estimator_repr no_attributes_set_in_init
mixin_order get_params_invariance set_params do_not_raise_errors_in_init_or_set_params
estimators_unfitted"""


@pytest.mark.parametrize("name", NO_FLAT_DATA.split())
def test_those_that_need_no_flat_data(name: str) -> None:
    getattr(estimator_checks, f"check_{name}")("TactileFeatures", TactileFeatures(RATE_HZ))


@pytest.fixture(scope="module")
def data() -> tuple[Array, Array, Array]:
    """Windows of 150 samples of a gauge and a film, three materials, slip the louder."""
    rng = np.random.default_rng(0)
    X, y = rng.standard_normal((72, 2, 150)), np.tile(["slip", "stick"], 36)
    X[y == "slip", 1] *= 3
    return X, y, np.repeat(["foam", "glass", "steel"], 24)


@pytest.fixture(scope="module")
def fitted(data: tuple[Array, Array, Array]) -> SlipClassifier:
    return SlipClassifier(RATE_HZ, SMALL_HAND).fit(*data)


@pytest.mark.parametrize("use", ["channel", "pooled", "both"])
def test_features_are_those_of_the_filtered_bins(data: Any, use: str) -> None:
    X, options = data[0], {"use": use, "descriptors": ["std", "range"]}
    features = TactileFeatures(RATE_HZ, SMALL_HAND, **options)
    table = features.set_output(transform="pandas").fit_transform(X)
    assert list(table.columns) == list(features.get_feature_names_out())
    assert features.context_ == (25, 25)
    if use != "pooled":
        frames = np.lib.stride_tricks.sliding_window_view(X[:, 0], 51, axis=-1)
        expected = frames.mean(-1).std(-1, ddof=1)  # order 1 is a moving average
        np.testing.assert_allclose(table["SG1 raw time std"], expected, rtol=1e-9)
    flat = TactileFeatures(RATE_HZ, SMALL_HAND, frames={}, **options)
    again = clone(flat).set_params(filtered=True).fit(X)
    np.testing.assert_array_equal(flat.fit_transform(torch.from_numpy(X)), again.transform(X))


def test_pipelines_grids_and_groups_left_out(data: Any) -> None:
    X, y, groups = data
    logo, classifier = LeaveOneGroupOut(), SlipClassifier(RATE_HZ, SMALL_HAND, use="pooled")
    features = TactileFeatures(RATE_HZ, SMALL_HAND)
    chain = make_pipeline(features, SlipClassifier())
    plain = make_pipeline(features, LogisticRegression(max_iter=9999))
    for each in (classifier, chain, plain):
        assert cross_val_score(each, X, y, groups=groups, cv=logo).mean() > 0.9
    with sklearn.config_context(enable_metadata_routing=True):
        routed = clone(classifier).set_fit_request(groups=True)
        assert cross_val_score(routed, X, y, params={"groups": groups}, cv=logo).mean() > 0.9
    grid = GridSearchCV(classifier, {"penalties": [0.01, 1.0], "degree": [1]}, cv=logo)
    assert grid.fit(X, y, groups=groups).best_estimator_.penalty_ in (0.01, 1.0)
    chain.fit(X, y, slipclassifier__groups=groups)
    detector = chain[-1].to_detector(chain[0])
    score = -detector.score_raw(torch.from_numpy(X)).numpy()  # "slip" is the smaller label
    np.testing.assert_allclose(score, chain.decision_function(X), atol=1e-12)


def test_a_classifier_of_windows_is_a_detector(
    data: Any, fitted: SlipClassifier, tmp_path: Path
) -> None:
    X, y, groups = data
    assert fitted.score(X, y) > 0.95
    assert {row for v in fitted.validation_ for row in v["balanced_accuracy"]} == set(groups)
    probability = fitted.predict_proba(X)
    assert ((probability[:, 0] > 0.5) == (fitted.predict(X) == "slip")).all()
    detector = fitted.to_detector()
    says_slip = detector.score_raw(torch.from_numpy(X)) >= 0
    np.testing.assert_array_equal(says_slip, fitted.predict(X) == "slip")
    fitted.save(tmp_path / "slip.pt")
    SlipDetector.load(tmp_path / "slip.pt")
    for other in (
        SlipClassifier.load(tmp_path / "slip.pt"),
        SlipClassifier.from_detector(detector),
        pickle.loads(pickle.dumps(fitted)),
    ):
        np.testing.assert_array_equal(other.predict_proba(X), probability)
        assert list(other.classes_) == ["slip", "stick"]


def test_a_classifier_of_features_is_kept_too(data: Any, tmp_path: Path) -> None:
    features = TactileFeatures(RATE_HZ, SMALL_HAND).set_output(transform="pandas")
    table = features.fit_transform(data[0])
    classifier = SlipClassifier(num_features=20).fit(table, data[1])
    classifier.save(tmp_path / "slip.pt")
    again = SlipClassifier.load(tmp_path / "slip.pt")
    expected = classifier.decision_function(table)
    np.testing.assert_array_equal(again.decision_function(table), expected)
    assert list(again.feature_names_in_) == list(table.columns)
    assert again.feature_names_ == classifier.feature_names_
    assert set(again.feature_names_) < set(table.columns)


def test_an_exported_file_scores_as_the_classifier(
    data: Any, fitted: SlipClassifier, tmp_path: Path, capfd: Any
) -> None:
    import onnxruntime

    (path,) = fitted.export_onnx(tmp_path)
    session = onnxruntime.InferenceSession(path)
    given = session.get_inputs()[0]
    (score, *_) = session.run(None, {given.name: data[0].astype(np.float32)})
    np.testing.assert_allclose(-score, fitted.decision_function(data[0]), atol=1e-4)
    assert capfd.readouterr().err == ""


MISTAKES = {
    "channels": (lambda X: X[:, :1], "1 channels, 150 samples], expected 2 channels, SG1 to PVDF1"),
    "transposed": (lambda X: X.transpose(0, 2, 1), "transpose them"),
    "samples": (lambda X: X[..., :140], "windows of 140 samples, expected 150"),
    "one window": (
        lambda X: X[0],
        r"expected windows \[N, C, T\], got an array of shape \(2, 150\)",
    ),
    "ragged": (lambda X: [X[0], X[1, :, :9]], "different shapes; cut them to one"),
    "text": (lambda X: np.full(X.shape, "a"), "convert|numeric|float"),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_mistakes_are_one_line(data: Any, fitted: SlipClassifier, mistake: str) -> None:
    spoil, message = MISTAKES[mistake]
    with pytest.raises(ValueError, match=message):
        fitted.predict(spoil(data[0]))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"sample_rate_hz": None}, "give sample_rate_hz=2000"),
        ({"hand": "paper24"}, "hand must be a HandLayout"),
        ({"frames": {"skin": 5}}, "frames names the kind 'skin'"),
        ({"frames": {"SG": 151}}, "leave nothing, as the filter takes 75 before"),
        ({"slip_label": "slide"}, "slip_label='slide' is none of the labels"),
        ({"use": "some"}, "use must be one of"),
    ],
)
def test_parameters_are_checked_in_the_fit(data: Any, options: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        SlipClassifier(**({"sample_rate_hz": RATE_HZ, "hand": SMALL_HAND} | options)).fit(*data)
    with pytest.raises(ValueError, match="one for each of the 72 rows"):
        SlipClassifier(RATE_HZ).fit(*data[:2], groups=[1, 2])


SAY: list[tuple[Any, Any, int]] = [
    ("Slip", "Stick", 0),
    ("slip", "non-slip", 0),
    ("no slip", "slipping", 1),
    ("gross_slip", "hold", 0),
    (False, True, 1),
    (0, 1, 1),
    (-1.0, 1.0, 1),
]
"""Two labels, and the place of slip."""
SAY_NOT = [("grip", "slide"), (1, 2), ("slip_1", "slip_2"), ("non-slip", "other"), ("slipper", "a")]


@pytest.mark.parametrize("labels", [*SAY, *SAY_NOT], ids=str)
def test_which_label_is_slip_is_told_by_its_name_or_asked_for(labels: tuple[Any, ...]) -> None:
    (first, second, *place), is_second = labels, np.arange(40) % 2
    y = np.array([first, second])[is_second]
    X = np.random.default_rng(0).standard_normal((40, 3)) + is_second[:, None]
    if place:
        assert SlipClassifier().fit(X, y).slip_label_ == labels[place[0]]
    else:
        with pytest.raises(ValueError, match="do not say which one is slip; give it, such as"):
            SlipClassifier().fit(X, y)
    assert SlipClassifier(slip_label=first).fit(X, y).slip_label_ == first


GROUPS = {
    "one row each": (np.arange(80), 5),
    "one label each": (np.arange(80) // 4 * 2 + np.arange(80) % 2, 5),
    "some of one label": (np.where(np.arange(80) < 40, "both", np.arange(80) % 6), 4),
    "none": (np.array([None] * 8 + ["m1"] * 32 + ["m2"] * 40, object), 3),
    "nan": (np.array([np.nan] * 8 + [1.0] * 72), 2),
}


@pytest.mark.parametrize("given", ["features", "windows"])
@pytest.mark.parametrize("kind", GROUPS)
def test_groups_are_put_together_until_both_labels_are_left_out(kind: str, given: str) -> None:
    (groups, num), y = GROUPS[kind], np.arange(80) % 2
    X = np.random.default_rng(0).standard_normal((80, 3, 60)) * (1 + y)[:, None, None]
    X = X.std(-1) if given == "features" else X
    model = SlipClassifier(RATE_HZ, use="pooled", num_features=None, degree=1)
    parts = {
        name for row in model.fit(X, y, groups).validation_ for name in row["balanced_accuracy"]
    }
    assert len(parts) == num
    assert model.score(X, y) > 0.8


@pytest.mark.parametrize("kind", ["a group a label", "slip in one group"])
def test_groups_that_cannot_be_put_together_are_refused_in_a_line_of_this_class(kind: str) -> None:
    row, y = np.arange(80), np.arange(80) % 2
    groups = y if kind == "a group a label" else np.where(y, 1000, row)
    with pytest.raises(ValueError, match="two parts that have both labels") as caught:
        SlipClassifier().fit(np.random.default_rng(0).standard_normal((80, 3)), y, groups)
    assert "recipe" not in str(caught.value)
    assert len(str(caught.value)) < 300


def test_windows_that_are_too_long_are_refused_in_words_of_this_class() -> None:
    with pytest.raises(ValueError, match="at most 1024 can be described; cut shorter windows"):
        SlipClassifier(RATE_HZ).fit(np.zeros((8, 2, 1025)), np.arange(8) % 2)
