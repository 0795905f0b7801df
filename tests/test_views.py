"""Views: what leaving groups out measures and decides, and the one machine that comes of it."""

from dataclasses import replace

import numpy as np
import oracles
import pytest
import torch
from small_detector import HAND, raw_bins

from tactslip_torch.deploy.bins import RawBin, bin_graph
from tactslip_torch.deploy.check import runner, session_of
from tactslip_torch.features.pool import FeaturePool, is_simple_of
from tactslip_torch.features.selection import forward_selection
from tactslip_torch.hand import HandLayout
from tactslip_torch.model.ridge import balanced_weights, class_targets
from tactslip_torch.native import reason_unavailable
from tactslip_torch.signals.filtering import ChannelFilter
from tactslip_torch.training import views
from tactslip_torch.training.bins import RecordingBins
from tactslip_torch.training.columns import VIEWS
from tactslip_torch.training.recipe import General
from tactslip_torch.training.views import (
    ViewBins,
    ViewSettings,
    _kernel_of,
    base_views,
    choose_views,
    merged,
    parts_of,
)

POOL = FeaturePool(
    HandLayout.from_rows(
        {"name": f"f{i}", "kind": "fast", "finger": f"f{i}", "segment": "tip", "adapting": "fast"}
        for i in range(4)
    ),
    level=1,
)
DESCRIBED = torch.tensor([name.descriptor in ("std", "range", "skewness") for name in POOL.names])
ALLOWED = {
    "simple": is_simple_of(POOL),
    "channel": DESCRIBED & POOL.is_paper,
    "pooled": DESCRIBED & POOL.is_paper,
}
PENALTIES = (0.1, 1.0, 30.0)
SETTINGS = ViewSettings(VIEWS, PENALTIES, 0.002, "zero", None, ("mean", "std", "max"))


def drawn(num=25, num_classes=2, loud=1.4, num_groups=4, seed=0, level=1.5):
    """Bins of groups of unlike size, level and part of slip; of a class each channel is louder."""
    rng = np.random.default_rng(seed)
    groups = np.repeat(np.arange(num_groups), num + 3 * np.arange(num_groups))
    labels = rng.uniform(size=len(groups)) < 0.3 + 0.1 * groups
    labels = labels.astype(int) + (num_classes - 2) * (rng.uniform(size=len(groups)) < 0.4)
    for group in range(num_groups):  # every class is in every group
        labels[np.flatnonzero(groups == group)[:num_classes]] = range(num_classes)
    x = rng.standard_normal((len(groups), 4, 100)) * loud ** labels[:, None, None]
    x *= level ** groups[:, None, None] * rng.uniform(0.8, 1.25, (len(groups), 4, 1))
    groups, labels = torch.from_numpy(groups), torch.from_numpy(labels)
    names = tuple("abcdefgh"[:num_groups])
    weights = torch.from_numpy(rng.uniform(0.5, 1.5, len(groups)))
    features = POOL(torch.from_numpy(x))
    return ViewBins(features, labels, groups, names, weights, num_classes * groups + labels)


def chosen(bins, allowed=ALLOWED, **changes):
    settings = replace(SETTINGS, **changes)
    return choose_views(bins, base_views(bins, POOL, allowed, settings), settings)


def accuracy(score, labels):
    """Mean recall of classes, of scores ``[N]`` or ``[N, R]``, in NumPy."""
    score, labels = np.asarray(score), np.asarray(labels)
    says = (score[:, 0] >= 0).astype(int) if score.shape[1] == 1 else score.argmax(1)
    return np.mean([(says[labels == one] == one).mean() for one in np.unique(labels)])


# Held-out scores ---------------------------------------------------------------------------------


def refitted(view, bins, penalty):
    """Scores of bins, and of second copies, by NumPy's machine of those of other groups."""
    kernel, units = _kernel_of(view.name), view.units(bins.features)
    rows, place = units, np.arange(len(units))
    weights = bins.weights.numpy()
    if bins.is_lost is not None and view.name == "pooled":
        rows = torch.cat([units, view.units(bins.features, bins.is_lost)])
        place, weights = np.tile(place, 2), np.tile(weights, 2) / 2
    labels, groups = bins.labels.numpy(), bins.groups.numpy()
    targets = class_targets(bins.num_classes).numpy()
    scores = np.full((len(rows), targets.shape[1]), np.nan)
    for group in np.unique(groups):
        is_in = groups[place] != group
        given = labels[place][is_in], weights[is_in], 1 / penalty, targets
        scores[~is_in] = machine_scores(kernel, rows[is_in], rows[~is_in], *given)
    return scores.reshape(-1, len(units), targets.shape[1])


def machine_scores(kernel, rows, new, *given):
    """Scores of new bins by the machine that NumPy solves for."""
    beta, intercept = oracles.class_kernel_machine(kernel(rows, rows).numpy(), *given)
    return kernel(new, rows).numpy() @ beta + intercept


@pytest.mark.parametrize("num_classes", [2, 3])
@pytest.mark.parametrize("num", [4, 25])
@pytest.mark.parametrize("with_copies", [False, True])
def test_held_out_scores_are_those_of_machines_fitted_without_the_group(
    num, num_classes, with_copies, rng
):
    """Class weights are those of the other groups; few bins take the dual, many the primal."""
    bins = drawn(num, num_classes)
    if with_copies:
        is_lost = torch.from_numpy(rng.uniform(size=(len(bins.labels), 4)) < 0.3)
        bins = replace(bins, is_lost=is_lost)
    found = chosen(bins)
    assert [view.name for view in found.views] == list(VIEWS)
    for view in found.views:
        for penalty, held in zip(PENALTIES, view.held_out.unbind(1), strict=True):
            np.testing.assert_allclose(held, refitted(view, bins, penalty), rtol=1e-6, atol=1e-7)


@pytest.mark.parametrize("num_features", [None, 4])
def test_labels_of_a_group_change_nothing_of_its_own_held_out_scores(num_features):
    """Nor do they change which columns are selected without it; they change those of others."""
    bins = drawn()
    out = bins.groups == 2
    labels = torch.where(out, 1 - bins.labels, bins.labels)
    one, other = (
        chosen(replace(bins, labels=own), num_features=num_features)
        for own in (bins.labels, labels)
    )
    for before, after in zip(one.views, other.views, strict=True):
        change = (after.held_out - before.held_out).abs()
        assert change[:, :, out].max() < 1e-9  # sums without the group, to rounding
        assert change[:, :, ~out].max() > 1e-2


def test_the_kernel_of_each_view_is_one_for_bins_of_training():
    """In the mean; of degree 2 for a bin of the mean size."""
    bins = drawn()
    for view in chosen(bins).views:
        size = view.units(bins.features).square().sum(1)
        mean = float(bins.weights @ size / bins.weights.sum())
        assert (mean + _kernel_of(view.name).offset) ** view.degree == pytest.approx(1.0, rel=1e-9)
        middle = bins.weights @ view.units(bins.features) / bins.weights.sum()
        assert middle.abs().max() < 1e-12


def test_with_one_group_the_middle_penalty_is_taken_and_views_weigh_alike(caplog):
    bins = drawn(num_groups=1)
    found = chosen(bins)
    assert found.penalties == (1.0,) * 3
    assert found.weights == pytest.approx([1 / 3] * 3)
    assert (found.rows, found.nested, np.isnan(found.accuracy)) == ((), None, True)
    assert "needs two groups with every class, got 1 of a; C=1 is taken" in caplog.text


def test_a_group_without_which_a_class_is_absent_is_not_left_out():
    """It is counted in no score, and the others choose."""
    bins = drawn()
    labels = torch.where(bins.groups == 3, bins.labels, bins.labels * (bins.groups < 2))
    labels = torch.where((bins.groups == 3) & (bins.labels == 0), 2, labels)
    found = chosen(replace(bins, labels=labels))
    for view in found.views:
        assert view.held_out[:, :, bins.groups == 3].isnan().all()
        assert view.held_out[:, :, bins.groups != 3].isfinite().all()


# Columns that are selected -----------------------------------------------------------------------


def test_so_many_columns_of_each_view_are_read_and_selected_anew_without_each_group():
    bins, num = drawn(), 4
    found, whole = chosen(bins, num_features=num), chosen(bins)
    targets = class_targets(2)[bins.labels]
    for view, every in zip(found.views, whole.views, strict=True):
        assert view.selection.size == num
        u = every.units(bins.features)
        share, choices = bins.weights / bins.weights.sum(), set()
        for group in range(4):
            is_in = bins.groups != group
            v = balanced_weights(bins.labels[is_in], bins.weights[is_in], 2)
            taken = forward_selection(u[is_in] / u[is_in].std(0), targets[is_in], v, num)
            own = u[:, taken]
            size = share @ (own - share @ own).square().sum(1)
            own = own / (size * (2 if view.degree == 2 else 1)).sqrt()
            given = bins.labels[is_in].numpy(), bins.weights[is_in].numpy(), 1.0
            expected = machine_scores(
                _kernel_of(view.name), own[is_in], own[~is_in], *given, class_targets(2).numpy()
            )
            np.testing.assert_allclose(view.held_out[0, 1, ~is_in], expected, rtol=1e-6, atol=1e-7)
            choices.add(tuple(taken))
        assert len(choices) > 1  # they do move with the group


def test_few_columns_of_noise_score_half():
    """Selection that had seen the left-out labels would find some that fit them."""
    rng = np.random.default_rng(3)
    bins = drawn(8, loud=1.0)
    noise = torch.from_numpy(10 + rng.standard_normal(bins.features.shape))
    bins = replace(bins, features=noise, labels=torch.from_numpy(rng.permutation(bins.labels)))
    every = {"channel": POOL.is_paper}
    few = {"views": ("channel",), "num_features": 5, "penalties": (1.0,)}
    honest = chosen(bins, every, **few)
    taken = torch.zeros(len(POOL.names), dtype=torch.bool)
    taken[list(honest.views[0].selection.selected)] = True
    leaky = chosen(bins, {"channel": taken}, **few | {"num_features": None})
    assert abs(honest.accuracy - 0.5) < 0.12
    assert leaky.accuracy > honest.accuracy + 0.1


# What they decide --------------------------------------------------------------------------------


@pytest.mark.parametrize("tolerance", [0.0, 0.03, 0.3])
def test_of_each_view_the_strongest_penalty_within_the_tolerance_is_taken(tolerance):
    bins = drawn(loud=1.15)
    found = chosen(bins, tolerance=tolerance)
    for view, penalty in zip(found.views, found.penalties, strict=True):
        means = [accuracy(held, bins.labels) for held in view.held_out[0]]
        rows = [row for row in found.rows if row["view"] == view.name]
        assert [row["mean"] for row in rows] == pytest.approx(means)
        assert [row["penalty"] for row in rows] == list(PENALTIES)
        least = max(means) - tolerance * (1 - max(means))
        near = [p for p, mean in zip(PENALTIES, means, strict=True) if mean >= least]
        assert penalty == min(near)
        assert [row["penalty"] for row in rows if row.get("chosen")] in ([penalty], [])


def held_scores(labels, errors, rng):
    """Scores ``[1, 1, N, 1]`` of which such a part, by class, is on the wrong side."""
    labels = np.asarray(labels)
    score = np.where(labels == 1, 1.0, -1.0) * rng.uniform(0.1, 1, len(labels))
    for label in (0, 1):
        own = rng.permutation(np.flatnonzero(labels == label))
        score[own[: round(errors * len(own))]] *= -1
    return torch.from_numpy(score)[None, None, :, None]


def test_views_weigh_by_their_accuracy_and_those_of_little_weight_are_dropped(rng):
    """``exp(40 (b - best b))``, of those kept again; one that helps stays whatever its weight."""
    labels = torch.from_numpy(np.arange(400) % 2)
    every = torch.ones(400, dtype=torch.bool)
    helds = [held_scores(labels, error, rng) for error in (0.10, 0.13, 0.4)]
    found = views._decided(helds, labels, every, 0.0)
    best = np.array([0.9, 0.87, 0.6])
    assert found.best == pytest.approx(best)
    raw = np.exp(40 * (best[:2] - 0.9))
    assert found.weights == pytest.approx([*(raw / raw.sum()), 0.0])
    truth = (2.0 * labels - 1).double()
    few = torch.arange(400) % 50 < 2  # a few that the first view gets wrong by a hair
    helped = torch.where(few, -1e-6 * truth, helds[0][0, 0, :, 0])[None, None, :, None]
    tiny = 1e-9 * held_scores(labels, 0.22, rng)[0, 0, :, 0]
    helper = torch.where(few, truth, tiny)[None, None, :, None]
    helps = views._decided([helped, helper], labels, every, 0.0)
    assert 0 < helps.weights[1] < views.LITTLE
    useless = views._decided([helped, tiny[None, None, :, None]], labels, every, 0.0)
    assert useless.weights == (1.0, 0.0)


def test_a_view_of_noise_is_dropped_and_costs_nothing():
    bins, rng = drawn(60, loud=3.0), np.random.default_rng(1)
    noise = torch.from_numpy(10 + rng.standard_normal(bins.features.shape))
    features = torch.where(is_simple_of(POOL), bins.features, noise).float()
    recordings = [
        RecordingBins(f"{name}/1", name, features[own], bins.labels[own] == 1)
        for index, name in enumerate(bins.group_names)
        for own in [bins.groups == index]
    ]
    fit = General(penalties=PENALTIES).fit(recordings, POOL)
    alone = General(penalties=PENALTIES, views="simple").fit(recordings, POOL)
    detector = fit.detector(POOL, ChannelFilter([1] * 4), fit.metadata)
    assert detector.info["views"] == {"simple": 1.0, "channel": 0.0, "pooled": 0.0}
    assert fit.metadata["validated"] == alone.metadata["validated"] > 0.8
    assert all(name.is_simple for name in detector.selected_names)
    torch.testing.assert_close(fit.head.linear, alone.head.linear)
    assert {row["view"] for row in fit.validation if row.get("chosen")} == {"simple"}
    assert {row["view"] for row in fit.validation} == set(VIEWS)


def test_the_threshold_is_shifted_by_none_half_or_all_of_the_best_shift():
    """Of the shift that makes held-out decisions best; no other does better."""
    bins = drawn(loud=1.2)
    zero, half, full = (chosen(bins, threshold=name) for name in ("zero", "half", "full"))
    assert (zero.shift, half.shift) == (0.0, full.shift / 2)
    assert full.shift != 0
    held = sum(
        weight * view.held_out[0, PENALTIES.index(penalty)].numpy()
        for view, weight, penalty in zip(full.views, full.weights, full.penalties, strict=True)
    )
    for found in (zero, half, full):
        assert found.accuracy == pytest.approx(accuracy(held - found.shift, bins.labels))
    ordered = np.sort(held[:, 0])
    cuts = [*(ordered[1:] + ordered[:-1]) / 2, ordered[0] - 1, ordered[-1] + 1]
    assert full.accuracy == pytest.approx(max(accuracy(held - cut, bins.labels) for cut in cuts))
    assert full.accuracy > zero.accuracy
    heads = [
        merged(found, {v.name: parts_of(v, bins, 1.0) for v in found.views})[1][0]
        for found in (zero, full)
    ]
    difference = heads[0].constant - heads[1].constant
    assert float(difference) == pytest.approx(full.shift)
    assert torch.equal(heads[0].linear, heads[1].linear)


def test_the_nested_score_of_a_group_is_of_what_is_decided_without_it(rng):
    """With its labels reversed it is exactly what is missing to one; the whole decision moves."""
    bins = drawn(40)
    helds = [
        torch.cat([held_scores(bins.labels, error, rng) for error in errors], 1)
        + 0.2 * torch.from_numpy(rng.standard_normal((1, 1, len(bins.labels), 1)))
        for errors in ((0.3, 0.28, 0.29), (0.25, 0.31, 0.27))
    ]
    every = torch.ones_like(bins.groups, dtype=torch.bool)
    before = views._nested(helds, bins, 0.0, 1.0)
    names = bins.group_names
    assert before["mean"] == pytest.approx(np.mean(list(before["balanced_accuracy"].values())))
    moved = 0
    for group, name in enumerate(names):
        own = bins.groups == group
        turned = replace(bins, labels=torch.where(own, 1 - bins.labels, bins.labels))
        after = views._nested(helds, turned, 0.0, 1.0)["balanced_accuracy"]
        assert after[name] == pytest.approx(1 - before["balanced_accuracy"][name], abs=1e-12)
        decisions = [views._decided(helds, b.labels, every, 0.0) for b in (bins, turned)]
        moved += decisions[0] != decisions[1]
    assert moved == len(names)  # so that a decision that had seen the group would show
    two = replace(bins, groups=bins.groups % 2, group_names=("a", "b"))
    assert views._nested(helds, two, 0.0, 1.0) is None


# The machine -------------------------------------------------------------------------------------


def part_scores(part, u):
    return u @ part.linear + part.constant + (u @ part.factors.mT).square() @ part.signs


@pytest.mark.parametrize("num_classes", [2, 3])
@pytest.mark.parametrize("is_few", [False, True])
def test_one_head_is_the_weighted_mean_of_the_views(num_classes, is_few):
    """Of each target, the quadratic part in factors; a dropped view adds nothing."""
    bins = drawn(num_classes=num_classes)
    found = chosen(bins, threshold="full", num_features=5 if is_few else None)
    weights = (0.2, 0.5, 0.3), (0.6, 0.4, 0.0)
    new = drawn(seed=1, num_classes=num_classes).features
    for shares in weights:
        own = replace(found, weights=shares, shift=0.125)
        kept = [(v, w) for v, w in zip(own.views, shares, strict=True) if w]
        parts = {view.name: parts_of(view, bins, 1.0) for view, _ in kept}
        assert len(parts["channel"][0].signs) > 0
        selection, heads = merged(own, parts)
        assert len(heads) == (1 if num_classes == 2 else 3)
        for target, head in enumerate(heads):
            means = [w * part_scores(parts[v.name][target], v.units(new)) for v, w in kept]
            expected = torch.stack(means).sum(0) - 0.125
            torch.testing.assert_close(head(selection(new)), expected, rtol=1e-8, atol=1e-9)


def test_factors_leave_out_little_of_the_machine_of_degree_2():
    bins = drawn(60)
    (view,) = chosen(bins, views=("channel",)).views
    (part,) = parts_of(view, bins, 1.0)
    u, targets = view.units(bins.features), class_targets(2).numpy()
    given = bins.labels.numpy(), bins.weights.numpy(), 1.0, targets
    expected = machine_scores(_kernel_of("channel"), u, u, *given)[:, 0]
    error = np.asarray(part_scores(part, u)) - expected
    assert len(part.signs) <= views.MOST_FACTORS
    assert 0 < np.sqrt(np.mean(error**2)) < 0.02 * expected.std()


@pytest.mark.onnx
def test_a_detector_of_several_views_scores_alike_by_torch_native_and_onnx():
    """A quadratic part in factors, columns of two scales, pools, and channels that are lost."""
    channel_filter, rng = ChannelFilter([51, 51, 11, 11]), np.random.default_rng(0)
    pool, recordings = FeaturePool(HAND, level=2), []
    for index, name in enumerate("abcd"):
        is_slip = torch.from_numpy(rng.permutation(np.arange(60) % 2 == 0))
        x = raw_bins(60, seed=index) - raw_bins(60, seed=index).mean((1, 2), keepdim=True)
        x = x / x.std((1, 2), keepdim=True) * (1 + 0.4 * is_slip[:, None, None])
        x = x * torch.from_numpy(rng.uniform(0.8, 1.25, (60, 4, 1)))
        features = pool(channel_filter.valid(x)).float()
        recordings.append(RecordingBins(f"{name}/1", name, features, is_slip))
    fit = General(penalties=(0.3, 3.0), tolerance=0.9, num_features=20).fit(recordings, pool)
    assert fit.head.signs is not None  # the view of channels is kept
    assert fit.metadata["views"]["channel"] > 0
    detector = fit.detector(pool, channel_filter, fit.metadata)
    bins = raw_bins(40, seed=9)
    bins[5:9, 1], bins[9:12, 2], bins[12:15, :2] = torch.nan, 0.25, torch.nan
    expected = copy_of(detector, "torch").predict_raw(bins)
    assert expected.is_valid.sum() > 30
    features, is_lost = pool(channel_filter.valid(bins[:5])), None
    straight = fit.head(fit.selection(features, is_lost))
    spread = float(expected.score.std())
    torch.testing.assert_close(expected.score[:5], straight, rtol=0, atol=1e-6 * spread)
    if not reason_unavailable():
        native = copy_of(detector, "native").predict_raw(bins)
        torch.testing.assert_close(native.score, expected.score, rtol=0, atol=1e-9 * spread)
        assert torch.equal(native.channels_lost, expected.channels_lost)
    raw = RawBin.of(detector)
    start = detector.context_before - raw.before
    cut = bins[..., start : start + raw.length].contiguous().numpy()
    got = runner(session_of(bin_graph(detector, "float64").model()))({"samples": cut})
    np.testing.assert_allclose(got["score"], expected.score, rtol=0, atol=1e-9 * spread)


def copy_of(detector, backend):
    return type(detector)(
        detector.pool, detector.channel_filter, detector.selected, detector.scaler, detector.head,
        detector.info, detector.imputation, detector.pooling, sensing=detector.sensing,
        backend=backend,
    )  # fmt: skip


def test_second_copies_keep_the_accuracy_when_half_of_the_channels_are_lost():
    found = {}
    bins, new = drawn(60, loud=1.3, level=1.0), drawn(60, loud=1.3, level=1.0, seed=5)
    rng = np.random.default_rng(0)
    half = np.tile([True, True, False, False], (len(new.labels), 1))
    is_lost = torch.from_numpy(rng.permuted(half, axis=1))
    for part in (0.0, 0.5):
        recordings = [
            RecordingBins(f"{n}/1", n, bins.features[own].float(), bins.labels[own] == 1)
            for index, n in enumerate(bins.group_names)
            for own in [bins.groups == index]
        ]
        fit = General(views="pooled", penalties=30.0, drop_channels=part).fit(recordings, POOL)
        found[part] = [
            accuracy(fit.head(fit.selection(new.features.float(), lost))[:, None], new.labels)
            for lost in (None, is_lost)
        ]
    assert found[0.5][0] > 0.9
    assert found[0.5][1] > 0.8
    assert found[0.5][1] > found[0.0][1] + 0.04


@pytest.mark.parametrize("view", VIEWS)
def test_held_out_scores_are_differentiable_in_the_features(view):
    """Through scales, quantiles, pools, standardisation, class weights and either solve."""
    bins, wanted = drawn(3, num_groups=3), ("mean", "std") if view == "simple" else ("std", "range")
    component = "raw" if view == "simple" else "A1"
    few = [
        place
        for place, name in enumerate(POOL.names)
        if (name.component, name.domain) == (component, "time") and name.descriptor in wanted
    ]
    pool, every = POOL.select(few), {view: torch.ones(len(few), dtype=torch.bool)}
    settings = replace(SETTINGS, views=(view,), penalties=(1.0,))

    def scores(features):
        own = replace(bins, features=features)
        (base,) = base_views(own, pool, every, settings)
        return views._validated(base, own, settings, None).held_out

    assert torch.autograd.gradcheck(scores, bins.features[:, few].clone().requires_grad_())
