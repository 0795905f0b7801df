"""The estimators for scikit-learn: its own checks, and windows up to detectors and files."""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import sklearn
import torch
from numpy.typing import NDArray
from scipy.signal import butter, sosfilt
from sklearn.base import clone
from sklearn.linear_model import LogisticRegression
from sklearn.model_selection import (
    GridSearchCV,
    LeaveOneGroupOut,
    cross_val_predict,
    cross_val_score,
)
from sklearn.pipeline import make_pipeline
from sklearn.utils import estimator_checks, get_tags
from small_set import SMALL_HAND

from tactslip_torch import (
    AlarmSettings,
    SlipClassifier,
    SlipDetector,
    StreamingDetector,
    TactileFeatures,
)
from tactslip_torch.estimators import _fitted_to_classes
from tactslip_torch.training.alarm import DebouncedAlarm

RATE_HZ = 2000.0
Array = NDArray[Any]


NO_FLAT_DATA = """estimator_tags_renamed valid_tag_types estimator_repr no_attributes_set_in_init
mixin_order get_params_invariance set_params do_not_raise_errors_in_init_or_set_params
estimators_unfitted"""


@pytest.mark.parametrize("name", NO_FLAT_DATA.split())
@pytest.mark.parametrize("kind", [TactileFeatures, SlipClassifier])
def test_scikit_learns_checks_that_need_no_flat_data(kind: Any, name: str) -> None:
    features = TactileFeatures(RATE_HZ)
    estimator = features if kind is TactileFeatures else SlipClassifier(features=features)
    getattr(estimator_checks, f"check_{name}")(kind.__name__, estimator)


@pytest.fixture(scope="module")
def data() -> tuple[Array, Array, Array]:
    """Windows of 150 samples of a slow and a fast channel, three materials, slip the louder."""
    rng = np.random.default_rng(0)
    X, y = rng.standard_normal((72, 2, 150)), np.tile(["slip", "stick"], 36)
    X[y == "slip", 1] *= 3
    return X, y, np.repeat(["foam", "glass", "steel"], 24)


def features_of(**options: Any) -> TactileFeatures:
    return TactileFeatures(**{"sample_rate_hz": RATE_HZ, "hand": SMALL_HAND} | options)


@pytest.fixture(scope="module")
def fitted(data: tuple[Array, Array, Array]) -> SlipClassifier:
    return SlipClassifier(features=features_of()).fit(*data)


@pytest.mark.parametrize("use", ["channel", "pooled", None])
def test_features_are_those_of_the_filtered_bins(data: Any, use: str | None) -> None:
    X, options = data[0], {"use": use, "descriptors": ["std", "range"]}
    features = features_of(**options)
    table = features.set_output(transform="pandas").fit_transform(X)
    assert list(table.columns) == list(features.get_feature_names_out())
    assert features.context_ == (25, 25)
    if use != "pooled":
        frames = np.lib.stride_tricks.sliding_window_view(X[:, 0], 51, axis=-1)
        expected = frames.mean(-1).std(-1, ddof=1)  # order 1 is a moving average
        np.testing.assert_allclose(table["SG1 raw time std"], expected, rtol=1e-9)
    flat = features_of(frames={}, **options)
    again = clone(flat).set_params(filtered=True).fit(X)
    np.testing.assert_array_equal(flat.fit_transform(torch.from_numpy(X)), again.transform(X))


def test_pipelines_grids_and_groups_left_out(data: Any) -> None:
    X, y, groups = data
    logo, classifier = LeaveOneGroupOut(), SlipClassifier(features=features_of(use="pooled"))
    plain = make_pipeline(features_of(), LogisticRegression(max_iter=9999))
    assert cross_val_score(plain, X, y, groups=groups, cv=logo).mean() > 0.9
    with sklearn.config_context(enable_metadata_routing=True):
        routed = clone(classifier).set_fit_request(groups=True)
        assert cross_val_score(routed, X, y, params={"groups": groups}, cv=logo).mean() > 0.9
    quick = classifier.set_params(penalties=1.0)
    choices = {"features__frames": [{}, {"SG": 25}]}
    best = GridSearchCV(quick, choices, cv=logo).fit(X, y, groups=groups).best_estimator_
    assert best.detector_.channel_filter.context in (0, 12)


def test_a_classifier_is_a_detector_before_and_after_it_was_kept(
    data: Any, fitted: SlipClassifier, tmp_path: Path
) -> None:
    X, y, groups = data
    assert fitted.score(X, y) > 0.95
    assert {row for v in fitted.validation_ for row in v["balanced_accuracy"]} == set(groups)
    probability = fitted.predict_proba(X)
    assert ((probability[:, 0] > 0.5) == (fitted.predict(X) == "slip")).all()
    says_slip = fitted.detector_.score_raw(torch.from_numpy(X)) >= 0
    np.testing.assert_array_equal(says_slip, fitted.predict(X) == "slip")
    fitted.save(tmp_path / "slip.pt")
    other = SlipDetector.load(tmp_path / "slip.pt")
    own = AlarmSettings.of(other).to_dict()
    DebouncedAlarm()(other)  # as onset=debounced, the default of training
    calibration = own["calibration"]
    assert AlarmSettings.of(other).to_dict() | {"calibration": calibration} == own
    stream = StreamingDetector(SlipDetector.load(tmp_path / "slip.pt"))
    slips = np.concatenate(X[y == "slip"][:6], -1).T
    assert stream.push(slips).alarms
    for other in (
        SlipClassifier.load(tmp_path / "slip.pt"),
        SlipClassifier.from_detector(fitted.detector_),
        pickle.loads(pickle.dumps(fitted)),
    ):
        np.testing.assert_array_equal(other.predict_proba(X), probability)
        assert list(other.classes_) == ["slip", "stick"]


def test_windows_that_were_filtered_are_scored_as_raw_ones(
    data: Any, fitted: SlipClassifier
) -> None:
    bins = fitted.detector_.channel_filter.valid(torch.from_numpy(data[0]))
    filtered = SlipClassifier.from_detector(fitted.detector_, filtered=True)
    np.testing.assert_allclose(
        filtered.decision_function(bins), fitted.decision_function(data[0]), atol=1e-9
    )


@pytest.mark.onnx
def test_an_exported_file_scores_as_the_classifier(
    data: Any, fitted: SlipClassifier, tmp_path: Path, capfd: Any
) -> None:
    import onnxruntime

    path, _ = fitted.export_onnx(tmp_path)
    session = onnxruntime.InferenceSession(path)
    given = session.get_inputs()[0]
    (score, *_) = session.run(None, {given.name: data[0].astype(np.float32)})
    np.testing.assert_allclose(-score, fitted.decision_function(data[0]), atol=1e-4)
    assert capfd.readouterr().err == ""


MISTAKES = {
    "channels": (lambda X: X[:, :1], "1 channels, 150 samples], expected 2 channels"),
    "transposed": (lambda X: X.transpose(0, 2, 1), "transpose them"),
    "samples": (lambda X: X[..., :140], "windows of 140 samples, expected 150"),
    "one window": (lambda X: X[0], r"expected windows \[N, C, T\], .* \(2, 150\)"),
    "features": (lambda X: X[:, 0], r"expected windows \[N, C, T\], .* \(72, 150\)"),
    "ragged": (lambda X: [X[0], X[1, :, :9]], "different shapes"),
    "text": (lambda X: np.full(X.shape, "a"), "convert|numeric|float"),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_in_the_windows_is_one_line(
    data: Any, fitted: SlipClassifier, mistake: str
) -> None:
    spoil, message = MISTAKES[mistake]
    with pytest.raises(ValueError, match=message):
        fitted.predict(spoil(data[0]))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"hand": "paper24"}, "hand must be a HandLayout"),
        ({"frames": {"skin": 5}}, "frames names the kind 'skin'"),
        ({"frames": {"SG": 151}}, "leave nothing, as the filter takes 75 before"),
        ({"use": "some"}, "use must be one of"),
    ],
)
def test_parameters_are_checked_in_the_fit(data: Any, options: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        SlipClassifier(features=features_of(**options)).fit(*data)


def test_windows_that_do_not_differ_are_a_warning(data: Any) -> None:
    X, y, groups = data
    with pytest.warns(UserWarning, match="no feature of X differs between windows"):
        SlipClassifier(features=features_of()).fit(np.ones_like(X), y, groups)


def test_what_the_fit_is_given_is_checked(data: Any) -> None:
    X, y, groups = data
    model = SlipClassifier(features=features_of())
    with pytest.raises(ValueError, match="one for each of the 72 rows"):
        model.fit(X, y, groups[:2])
    with pytest.raises(ValueError, match="must have two classes or more, got 1 class;"):
        model.fit(X[::2], y[::2])
    with pytest.raises(ValueError, match="slip_label='slide' is none of the labels"):
        clone(model).set_params(slip_label="slide").fit(X, y)
    with pytest.raises(TypeError, match="give TactileFeatures"):
        SlipClassifier(features=RATE_HZ).fit(X, y)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="give sample_rate_hz="):
        SlipClassifier().fit(X, y)
    with pytest.raises(ValueError, match="or features=, which has both"):
        SlipClassifier(RATE_HZ, features=TactileFeatures(RATE_HZ)).fit(X, y)
    message = r"at most 1024 samples.*got 1025; cut shorter windows"
    with pytest.raises(ValueError, match=message) as said:
        SlipClassifier(RATE_HZ).fit(np.zeros((8, 2, 1025)), np.arange(8) % 2)
    assert "labels." not in str(said.value)  # no keys of the commands


def loud_windows(num: int) -> tuple[Array, Array]:
    """Windows of which every second is louder, and which these are."""
    is_slip = np.arange(num) % 2
    X = np.random.default_rng(0).standard_normal((num, 3, 60)) * (1 + is_slip)[:, None, None]
    return X, is_slip


QUICK: dict[str, Any] = {"views": "pooled", "penalties": 1.0}
SAY: list[tuple[Any, Any, int]] = [
    ("Slip", "non-slip", 0),
    ("no slip", "slipping", 1),
    (False, True, 1),
    (-1.0, 1.0, 1),
]
"""Two labels, and the place of slip."""
SAY_NOT = [(1, 2), ("slip_1", "slip_2"), ("non-slip", "other"), ("slipper", "a")]


@pytest.mark.parametrize("labels", [*SAY, *SAY_NOT], ids=str)
def test_slip_is_the_label_that_says_so_or_that_is_given(labels: tuple[Any, ...]) -> None:
    first, second, *place = labels
    X, is_second = loud_windows(40)
    y = np.array([first, second])[is_second]
    model = SlipClassifier(features=TactileFeatures(RATE_HZ))
    model.set_params(**QUICK)
    if place:
        assert model.fit(X, y).slip_label_ == labels[place[0]]
    else:
        with pytest.raises(ValueError, match="do not say which one is slip; give it, such as"):
            model.fit(X, y)
    assert model.set_params(slip_label=first).fit(X, y).slip_label_ == first


GROUPS = {
    "one row each": (np.arange(80), 10),
    "one label each": (np.arange(80) // 4 * 2 + np.arange(80) % 2, 10),
    "some of one label": (np.where(np.arange(80) < 40, "both", np.arange(80) % 6), 4),
    "none": (np.array([None] * 8 + ["m1"] * 32 + ["m2"] * 40, object), 3),
    "nan": (np.array([np.nan] * 8 + [1.0] * 72), 2),
}


@pytest.mark.parametrize("kind", GROUPS)
def test_groups_are_put_together_until_both_labels_are_left_out(kind: str) -> None:
    (groups, num), (X, y) = GROUPS[kind], loud_windows(80)
    model = SlipClassifier(RATE_HZ, views="pooled")
    rows = model.fit(X, y, groups).validation_
    assert len({name for row in rows for name in row["balanced_accuracy"]}) == num
    assert model.score(X, y) > 0.8


@pytest.mark.parametrize("kind", ["a group a label", "slip in one group"])
def test_groups_that_cannot_be_put_together_are_refused(kind: str) -> None:
    X, y = loud_windows(80)
    groups = y if kind == "a group a label" else np.where(y, 1000, np.arange(80))
    with pytest.raises(ValueError, match="two parts that have all labels") as caught:
        SlipClassifier(RATE_HZ).fit(X, y, groups)
    assert "recipe" not in str(caught.value)


BANDS = {"rolls": (0.02, 0.08), "slides": (0.15, 0.4), "touch": (0.6, 0.9)}
"""Of three kinds of contact, as parts of half the rate; each is as loud as the others."""


@pytest.fixture(scope="module")
def kinds() -> tuple[Array, Array, Array]:
    """Windows of three kinds on four objects, of which each has loudnesses of its own."""
    rng = np.random.default_rng(1)
    y, groups = np.tile(list(BANDS), 40), np.repeat(["can", "cup", "pen", "tin"], 30)
    X = rng.standard_normal((120, 2, 200))
    for kind, band in BANDS.items():
        X[y == kind] = sosfilt(butter(2, band, "band", output="sos"), X[y == kind])
    X /= X.std(-1, keepdims=True)
    gain = {"can": 1.0, "cup": 3.0, "pen": 0.4, "tin": 1.5}
    X *= np.array([gain[group] for group in groups])[:, None, None]
    return X + 0.2 * rng.standard_normal(X.shape), y, groups


@pytest.fixture(scope="module")
def of_kinds(kinds: Any) -> tuple[SlipClassifier, Array]:
    """A classifier that was not fitted to the last object, and which rows are of it."""
    X, y, groups = kinds
    held = groups == "tin"
    return SlipClassifier(RATE_HZ).fit(X[~held], y[~held], groups[~held]), held


def test_kinds_of_slip_are_told_on_an_object_that_was_left_out(kinds: Any, of_kinds: Any) -> None:
    (X, y, _), (model, held) = kinds, of_kinds
    assert model.score(X[held], y[held]) > 0.9
    assert list(model.classes_) == sorted(BANDS)
    assert get_tags(model).classifier_tags.multi_class


def test_probabilities_of_kinds_add_up_and_agree_with_the_decision(
    kinds: Any, of_kinds: Any
) -> None:
    X, (model, _) = kinds[0], of_kinds
    found, scores = model.predict_proba(X), model.decision_function(X)
    assert scores.shape == found.shape == (len(X), 3)
    np.testing.assert_allclose(found.sum(1), 1)
    assert (found > 0).all()
    for values in (found, scores):
        np.testing.assert_array_equal(model.classes_[values.argmax(1)], model.predict(X))
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(model)).predict_proba(X), found)


def test_probabilities_of_kinds_are_about_what_happens_on_an_object_left_out(kinds: Any) -> None:
    """Where noise hides the kind, a third of what is said with probability 2/3 is wrong."""
    rng, (X, y, groups) = np.random.default_rng(2), kinds
    X = X / X.std(-1, keepdims=True) + 5 * rng.standard_normal(X.shape)
    folds = LeaveOneGroupOut()
    models = SlipClassifier(RATE_HZ, views="simple")
    found = cross_val_predict(models, X, y, groups=groups, cv=folds, method="predict_proba")
    is_right = np.array(sorted(BANDS))[found.argmax(1)] == y
    assert 0.4 < is_right.mean() < 0.95
    assert found.max(1).mean() == pytest.approx(is_right.mean(), abs=0.12)


def test_a_window_with_a_lost_channel_is_scored_without_it_and_a_silent_one_is_not_valid(
    kinds: Any, of_kinds: Any
) -> None:
    (X, y, _), (model, held) = kinds, of_kinds
    broken, silent = X[held].copy(), np.zeros_like(X[:2])
    broken[:, 1] = np.nan
    assert model.predict_valid(broken).all()
    assert model.score(broken, y[held]) > 0.6
    assert not model.predict_valid(silent).any()
    np.testing.assert_array_equal(model.decision_function(silent), 0)
    np.testing.assert_allclose(model.predict_proba(silent), 1 / 3)


def test_two_labels_by_the_machines_of_several_are_the_machine_of_two(
    data: Any,
) -> None:
    X, y, groups = data
    model = SlipClassifier(features=features_of(), drop_channels=0.0, slip_label="stick")
    expected = clone(model).fit(X, y, groups).decision_function(X)
    described = features_of()
    windows = described._lay_out(X)
    recipe, pool = described._recipe(drop_channels=0.0), described._pool
    rows = pool(described._bins(windows), torch.float64)
    labels, group = (torch.from_numpy(np.unique(of, return_inverse=True)[1]) for of in (y, groups))
    fit = _fitted_to_classes(recipe, pool, rows, labels, group, ("a", "b", "c"))
    (head,) = fit.heads
    np.testing.assert_allclose(head(fit.selection(rows)).numpy(), expected, atol=1e-9)


@pytest.mark.parametrize(
    "ask",
    [
        lambda model, path: model.save(path / "kinds.pt"),
        lambda model, path: model.export_onnx(path),
        lambda model, path: model.detector_,
    ],
    ids=["save", "export_onnx", "detector_"],
)
def test_kinds_of_slip_make_no_detector_and_leave_no_file(
    of_kinds: Any, tmp_path: Path, ask: Any
) -> None:
    with pytest.raises(AttributeError, match=r"of 3 labels is no detector: .* y == label") as said:
        ask(of_kinds[0], tmp_path)
    assert "\n" not in str(said.value)
    assert not list(tmp_path.iterdir())


def test_what_several_kinds_cannot_be_fitted_to_is_refused(kinds: Any) -> None:
    X, y, groups = kinds
    with pytest.raises(ValueError, match="slip_label is for two labels, and y has 3; leave it out"):
        SlipClassifier(RATE_HZ, slip_label="rolls").fit(X, y, groups)
    rare = np.where((y == "touch") & (groups != "cup"), "rolls", y)
    message = "of the 4 groups 1 has the label 'touch'; give groups of which two have it"
    with pytest.raises(ValueError, match=message):
        SlipClassifier(RATE_HZ).fit(X, rare, groups)


def test_recordings_of_one_kind_each_are_put_together_to_ten_groups(kinds: Any) -> None:
    X, y, _ = kinds
    recordings = np.arange(120) // 6 * 3 + np.arange(120) % 3  # 60 of two windows
    model = SlipClassifier(RATE_HZ, views="simple").fit(X, y, recordings)
    assert {len(row["balanced_accuracy"]) for row in model.validation_} == {10}
