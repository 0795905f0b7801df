import numpy as np
import pytest
import torch

from tactslip_torch import FeaturePool, HandLayout, SlipDetector
from tactslip_torch.model.kernels import Polynomial, QuadraticForm
from tactslip_torch.model.scaling import FeatureScaler
from tactslip_torch.package_files import DETECTOR, load_table, save_table
from tactslip_torch.runtime import signed_log
from tactslip_torch.signals.filtering import ChannelFilter

PER_KIND = 3
STEPS = ("mode", "entropy")
"""Descriptors that step: in single precision their steps lie elsewhere, and no value is near."""


def noise(num_bins, seed=0, num_samples=150):
    """Raw bins with context: gauges with an offset, films around zero, sizes over two decades."""
    rng = np.random.default_rng(seed)
    size = 10 ** rng.uniform(-2, 0, (num_bins, 1, 1))
    offset = np.where(np.arange(24) < 14, 1.0, 0.0)[:, None]
    return torch.from_numpy(size * rng.standard_normal((num_bins, 24, num_samples)) + offset)


def random_detector(seed=0, compress=False, num_repeated=0, num_quadratic=None, num_factors=None):
    """A detector nobody trained: three features of each kind, a scaler that fits, a random head.

    The last columns are scaled once more, more compressed; the quadratic part may be of the first
    scaled columns alone, and in a few factors.
    """
    rng = np.random.default_rng(seed)
    pool = FeaturePool(HandLayout.paper24())
    channel_filter = ChannelFilter([51] * 14 + [11] * 10)
    names = [(i, name) for i, name in enumerate(pool.names) if name.descriptor not in STEPS]
    kinds = [
        [i for i, n in names if n.component == "raw"],
        [i for i, n in names if n.component != "raw" and n.domain == "time"],
        [i for i, n in names if n.domain == "freq"],
        [i for i, n in names if n.descriptor == "band_energy_ratio"],
    ]
    selected = [int(i) for kind in kinds for i in rng.choice(kind, PER_KIND, replace=False)]
    features = pool(channel_filter.valid(noise(64, seed=99)))[:, selected]
    scaler = FeatureScaler.fit(features, compress=compress)
    if num_repeated:
        scaler = repeated(scaler, range(len(selected) - num_repeated, len(selected)))
    num = len(scaler.minimum)
    quadratic = torch.from_numpy(rng.standard_normal((num, num))) / num
    quadratic = quadratic[:num_quadratic, :num_quadratic]
    linear = torch.from_numpy(rng.standard_normal(num))
    constant = torch.tensor(0.1, dtype=torch.float64)
    if num_factors is None:
        head = QuadraticForm(quadratic + quadratic.T, linear, constant)
    else:
        signs = torch.tensor([1.0, -1.0]).repeat(num_factors)[:num_factors]
        head = QuadraticForm(quadratic[:num_factors], linear, constant, signs)
    info = {"simulated": True, "seed": seed, "penalty": 0.3, "train_recordings": ["M1/0"]}
    return SlipDetector(pool, channel_filter, selected, scaler, head, info)


def repeated(scaler, again):
    """Behind the columns of a scaler with compression some of them again, with a tenth of it."""
    columns = torch.tensor([*range(len(scaler.minimum)), *again])
    scale = torch.cat([scaler.compression, 0.1 * scaler.compression[list(again)]])
    own, ends = scaler.compression, (scaler.minimum, scaler.maximum)
    ends = [own * torch.expm1(end.abs() / own) * end.sign() for end in ends]
    ends = [signed_log(end[columns], scale) for end in ends]
    of_each = columns if scaler.columns is None else scaler.columns[columns]
    return FeatureScaler(*ends, scale, of_each)


VARIANTS = {
    "quadratic form": {},
    "compression": {"compress": True},
    "linear": {"num_quadratic": 0},
    "repeated columns": {"compress": True, "num_repeated": 5},
    "repeated columns, few of them quadratic": {
        "compress": True,
        "num_repeated": 5,
        "num_quadratic": 7,
    },
    "factors": {"num_factors": 5},
    "factors as many as columns": {"num_factors": 12},
    "repeated columns, few of them in factors": {
        "compress": True,
        "num_repeated": 5,
        "num_quadratic": 11,
        "num_factors": 10,
    },
}
"""Arguments of ``random_detector`` for every kind of head and scaler."""


@pytest.fixture(scope="module")
def detector():
    return random_detector()


# Scores --------------------------------------------------------------------------------------


@pytest.mark.parametrize("variant", VARIANTS)
def test_the_score_is_the_head_of_scaled_features_and_the_same_from_a_file(variant, tmp_path):
    detector, samples = random_detector(**VARIANTS[variant]), noise(5)
    bins = detector.channel_filter.valid(samples)
    features = detector.pool(bins).numpy()[:, list(detector.selected)]
    if detector.scaler.columns is not None:
        features = features[:, detector.scaler.columns.numpy()]
    if detector.scaler.compression is not None:
        compression = detector.scaler.compression.numpy()
        features = np.sign(features) * compression * np.log1p(np.abs(features) / compression)
    low, high = detector.scaler.minimum.numpy(), detector.scaler.maximum.numpy()
    z = np.clip(2 * (features - low) / (high - low) - 1, -1, 1)
    state = {name: value.numpy() for name, value in detector.head.state_dict().items()}
    first = z[:, : state["quadratic"].shape[1]]
    if "signs" in state:
        expected = np.square(first @ state["quadratic"].T) @ state["signs"]
    else:
        expected = np.einsum("ni,ij,nj->n", first, state["quadratic"], first)
    expected += z @ state["linear"] + 0.1
    np.testing.assert_allclose(detector(bins).numpy(), expected, rtol=1e-9, atol=1e-11)
    detector.save(tmp_path / "detector.pt")
    loaded = SlipDetector.load(tmp_path / "detector.pt")
    for given in (samples, samples.float()):
        assert torch.equal(loaded.score_raw(given), detector.score_raw(given))
    assert (loaded.info, loaded.pool.hand) == (detector.info, detector.pool.hand)
    assert loaded.selected_names == detector.selected_names
    torch.testing.assert_close(loaded.state_dict(), detector.state_dict(), rtol=0, atol=0)


def test_a_file_that_holds_a_sum_over_bins_scores_by_that_sum(detector, tmp_path):
    """As version 0.2.0 wrote it where there were more columns than bins."""
    kernel, rng = Polynomial(2, 0.5), np.random.default_rng(1)
    detector.save(tmp_path / "own.pt")
    metadata, tensors = load_table(tmp_path / "own.pt", DETECTOR)
    support = torch.from_numpy(rng.uniform(-1, 1, (5, detector.head.num_features)))
    beta = torch.from_numpy(rng.standard_normal(5))
    tensors = {name: x for name, x in tensors.items() if not name.startswith("head.")}
    tensors |= {"head.support": support, "head.beta": beta}
    save_table(tmp_path / "sum.pt", DETECTOR, metadata | {"kernel": kernel.to_dict()}, tensors)
    samples = noise(5)
    features = detector.pool(detector.channel_filter.valid(samples))[:, list(detector.selected)]
    expected = (detector.scaler(features) @ support.T + 0.5) ** 2 @ beta
    found = SlipDetector.load(tmp_path / "sum.pt").score_raw(samples)
    torch.testing.assert_close(found, expected, rtol=1e-9, atol=1e-11)


@pytest.mark.parametrize("method", ["predict", "predict_raw"])
@pytest.mark.parametrize("given", [torch.float16, torch.bfloat16, torch.int64])
def test_samples_given_in_another_dtype_are_refused(method, given, detector):
    bins = noise(1, num_samples=150 if method == "predict_raw" else 100)
    with pytest.raises(ValueError, match=r"^given must be torch\.float32 or "):
        getattr(detector, method)(bins, given=given)


# Parts that disagree ---------------------------------------------------------------------------


def test_parts_that_disagree_are_refused(detector):
    names = ("pool", "channel_filter", "selected", "scaler", "head")
    parts = {name: getattr(detector, name) for name in names}
    narrow = FeatureScaler(-torch.ones(3), torch.ones(3))
    for part, other, said in (
        ("selected", detector.selected[:-1], "11 columns, a scaler of 12 and a head of 12"),
        ("scaler", narrow, "12 columns, a scaler of 3 and a head of 12"),
        (
            "scaler",
            FeatureScaler(-torch.ones(12), torch.ones(12), columns=range(1, 13)),
            "the scaler takes column 12 of 12, counted from 0",
        ),
        (
            "scaler",
            FeatureScaler(-torch.ones(13), torch.ones(13), columns=[*range(12), 3]),
            "13 columns, a scaler of 13 and a head of 12",
        ),
        ("channel_filter", ChannelFilter([11] * 23), "of 23 channels does not fit a hand of 24"),
    ):
        with pytest.raises(ValueError, match=said):
            SlipDetector(**(parts | {part: other}))


@pytest.mark.parametrize("method", ["__call__", "score_raw", "predict", "predict_raw"])
def test_many_bins_are_judged_as_few_are(method):
    """In parts, on several threads, with leading axes; a broken channel is found in its part."""
    detector = random_detector()
    samples = noise(600)
    if method.startswith("predict"):
        samples[377, 20, 60] = torch.nan
    bins = samples if method.endswith("raw") else samples[..., 25:125]
    predict = getattr(detector, method)
    few = [predict(part) for part in bins.split(30)]
    many = predict(bins.reshape(3, 200, *bins.shape[1:]))
    if isinstance(many, torch.Tensor):
        few, many = [(one,) for one in few], (many,)
    for parts, whole in zip(zip(*few, strict=True), many, strict=True):
        assert whole.shape[:2] == (3, 200)
        close = {"rtol": 1e-10, "atol": 1e-12, "equal_nan": True}
        torch.testing.assert_close(whole.flatten(0, 1), torch.cat(parts), **close)
