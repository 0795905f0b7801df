import copy
import shutil

import numpy as np
import onnx
import onnxruntime
import pytest
import torch
from test_detector import VARIANTS, noise, random_detector

from tactslip_torch import export
from tactslip_torch.export import export_onnx, float32_error, onnx_error
from tactslip_torch.features.pool import FeaturePool
from tactslip_torch.model.detector import SlipDetector
from tactslip_torch.model.scaling import FeatureScaler

pytestmark = pytest.mark.onnx

SLOW_OR_MISSING = {  # EXPORT.md trap 7, and what a solve or a loop over samples would leave
    *("DFT", "STFT", "MelWeightMatrix", "Det", "Einsum"),
    *("Loop", "Scan", "If", "SequenceMap", "Unique", "NonZero"),
}


@pytest.fixture(scope="module")
def detector():
    return random_detector()


@pytest.fixture(scope="module")
def exported(detector, tmp_path_factory):
    """The one export of this file (seconds), and the error it reports."""
    path = tmp_path_factory.mktemp("export") / "deep" / "model.onnx"
    before = {name: value.clone() for name, value in detector.state_dict().items()}
    worst = export_onnx(detector, path)
    for name, value in detector.state_dict().items():  # the detector stays as it was: float64
        assert torch.equal(value, before[name])
        assert value.dtype == torch.float64
    return path, worst


@pytest.fixture(scope="module")
def session(exported):
    return onnxruntime.InferenceSession(exported[0], providers=["CPUExecutionProvider"])


@pytest.fixture(scope="module")
def graph(exported):
    return onnx.load(exported[0]).graph


# The file ------------------------------------------------------------------------------------


@pytest.mark.parametrize("batch", [1, 2, 3, 7, 64])
def test_onnxruntime_equals_torch(batch, detector, session):
    """Three is the batch it was traced with; none of the others was seen by the exporter."""
    samples = noise(batch, seed=batch)
    expected = detector.score_raw(samples).numpy()
    got, valid = session.run(None, {"samples": samples.numpy().astype(np.float32)})
    assert valid.tolist() == [True] * batch
    assert got.dtype == np.float32
    assert got.shape == (batch,)
    spread = detector.score_raw(noise(64)).std().item()
    np.testing.assert_allclose(got, expected, rtol=0, atol=1e-3 * spread)


def test_bins_of_a_batch_do_not_meet(session):
    samples = noise(7).numpy().astype(np.float32)
    together, _ = session.run(None, {"samples": samples})
    alone = [session.run(None, {"samples": sample[None]})[0][0] for sample in samples]
    np.testing.assert_allclose(together, alone, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("sample", [0, 75, 149])
def test_a_broken_channel_counts_as_missing(sample, bad, detector, session):
    samples = noise(3).numpy().astype(np.float32)
    channel = detector.pool.hand.names.index(detector.selected_names[0].channel)
    whole, _ = session.run(None, {"samples": samples})
    samples[1, channel, sample] = bad
    scores, valid = session.run(None, {"samples": samples})
    expected = copy.deepcopy(detector).float().judge_raw(torch.from_numpy(samples))
    # a film's frame is 11 samples: the ends of the context belong to the gauges alone
    reaches = expected.is_missing[1, channel].item()
    assert reaches == (detector.selected_names[0].channel.startswith("SG") or sample == 75)
    assert valid.tolist() == [True, not reaches, True]
    assert np.isfinite(scores).all()
    np.testing.assert_allclose(scores, expected.score.numpy(), rtol=1e-4, atol=1e-5)
    assert np.array_equal(scores[[0, 2]], whole[[0, 2]])
    assert (scores[1] != whole[1]) == reaches


def test_a_dead_channel_is_no_valid_bin(detector, session):
    samples = noise(2).numpy().astype(np.float32)
    channel = detector.pool.hand.names.index(detector.selected_names[0].channel)
    samples[1, channel] = 2.5
    scores, valid = session.run(None, {"samples": samples})
    assert valid.tolist() == [True, False]
    assert np.isfinite(scores).all()


def test_input_and_output_are_named_float32_and_of_any_batch(graph):
    (samples,), (score, valid) = graph.input, graph.output
    assert (samples.name, score.name, valid.name) == ("samples", "score", "valid")
    kinds = [value.type.tensor_type.elem_type for value in (samples, score, valid)]
    assert kinds == [onnx.TensorProto.FLOAT, onnx.TensorProto.FLOAT, onnx.TensorProto.BOOL]
    for value in (samples, score, valid):
        batch = value.type.tensor_type.shape.dim[0]
        assert batch.dim_param
        assert not batch.HasField("dim_value")
    fixed = [dim.dim_value for dim in samples.type.tensor_type.shape.dim[1:]]
    assert fixed == [24, 100 + 2 * 25]
    assert len(score.type.tensor_type.shape.dim) == 1


def test_another_dtype_or_shape_is_refused(session):
    with pytest.raises(Exception, match="Unexpected input data type"):
        session.run(None, {"samples": noise(1).numpy()})
    with pytest.raises(Exception, match="invalid dimensions"):
        session.run(None, {"samples": np.zeros((1, 23, 150), np.float32)})


def test_no_operator_is_slow_or_missing(exported, graph):
    operators = {node.op_type for node in graph.node}
    assert "MatMul" in operators or "Gemm" in operators
    assert not operators & SLOW_OR_MISSING
    assert {node.domain for node in graph.node} <= {"", "ai.onnx"}
    model = onnx.load(exported[0])
    assert not model.functions
    assert [(entry.domain, entry.version) for entry in model.opset_import] == [("", export.OPSET)]


def test_what_turns_bins_into_features_is_double_and_the_head_is_single(detector, graph):
    """Rounded constants would move the steps of entropy and mode."""
    kinds = {tuple(tensor.dims): tensor.data_type for tensor in graph.initializer}
    assert kinds[8, 100, 100] == onnx.TensorProto.DOUBLE  # the wavelet branches
    num = detector.head.num_features
    assert kinds[num, num] == onnx.TensorProto.FLOAT


def test_the_file_says_what_a_host_must_know_of_its_input(detector, session):
    facts = session.get_modelmeta().custom_metadata_map
    assert facts["channels"].split(",") == list(detector.pool.hand.names)
    expected = {"unit": "V", "sample_rate_hz": "2000", "bin_samples": "100"}
    expected |= {"context_before_samples": "25", "context_after_samples": "25"}
    expected |= {"look_ahead_samples": "25", "slip_if_score_at_least": "0", "simulated": "true"}
    assert {name: facts[name] for name in expected} == expected


def test_the_file_is_whole_and_valid(exported):
    path, _ = exported
    onnx.checker.check_model(onnx.load(path), full_check=True)
    assert [p.name for p in path.parent.iterdir()] == ["model.onnx"]  # no data beside, no rest


# Heads and scalers ---------------------------------------------------------------------------


class ScoreFeatures(torch.nn.Module):
    """What differs between kinds of detectors: the way from selected features to a score."""

    def __init__(self, detector):
        super().__init__()
        self.detector = detector

    def forward(self, features):
        return self.detector.score_features(features)


def run_tail(module, traced, inputs, path):
    """Export a part of a detector as ``export_onnx`` exports the whole, and run it."""
    export._write_graph(module, traced, path)
    session = onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])
    return [session.run(None, {"samples": one.numpy()})[0] for one in inputs], onnx.load(path).graph


@pytest.mark.parametrize("variant", VARIANTS)
def test_every_head_and_scaler_comes_through(variant, tmp_path):
    """The rest of the graph is the same for all; making it takes many times as long."""
    detector = random_detector(**VARIANTS[variant])
    bins = detector.channel_filter.valid(noise(65, seed=1))
    features = detector.pool(bins)[:, list(detector.selected)]
    expected = detector.score_features(features)
    tail = ScoreFeatures(copy.deepcopy(detector).float())
    parts = [features.float()[cut] for cut in (slice(0, 1), slice(1, 65))]
    got, graph = run_tail(tail, features[:3].float(), parts, tmp_path / "tail.onnx")
    assert [len(part) for part in got] == [1, 64]
    spread = float(expected.std())
    np.testing.assert_allclose(np.concatenate(got), expected.numpy(), rtol=0, atol=1e-4 * spread)
    operators = {node.op_type for node in graph.node}
    assert "MatMul" in operators or "Gemm" in operators
    assert not operators & SLOW_OR_MISSING
    assert ("Log" in operators) == ("knee" in variant)
    assert ("Exp" in operators) == ("radial" in variant)
    in_double = [t.dims for t in graph.initializer if t.data_type == onnx.TensorProto.DOUBLE]
    assert max(map(len, in_double)) == 1  # ranges and knees, and nothing of the head


def test_a_knee_survives_the_missing_log1p(rng, tmp_path):
    """Heavy tails, zeros with few spikes, tiny units, both signs, and far below the knee."""
    columns = [
        np.exp(4 * rng.standard_normal(2000)),
        np.where(rng.uniform(size=2000) < 0.7, 0.0, 1e-3 * rng.uniform(size=2000)),
        1e-9 * np.exp(4 * rng.standard_normal(2000)),
        rng.standard_normal(2000) ** 5,
        np.where(np.arange(2000) < 900, 1e-7 * rng.standard_normal(2000), 1.0),
    ]
    features = np.stack(columns, axis=1)
    scaler = FeatureScaler.fit(torch.from_numpy(features), compress=True, tail=0.01)
    knee, low, high = (value.numpy() for value in (scaler.knee, scaler.minimum, scaler.maximum))
    bent = np.sign(features) * knee * np.log1p(np.abs(features) / knee)
    expected = np.clip(2 * (bent - low) / (high - low) - 1, -1, 1)
    single = torch.from_numpy(features).float()
    (got,), _ = run_tail(scaler.float(), single[:3], [single], tmp_path / "scaler.onnx")
    np.testing.assert_allclose(got, expected, rtol=0, atol=2e-6)


# The check -----------------------------------------------------------------------------------


def test_the_error_it_reports_is_small_and_comes_from_the_file(detector, exported):
    path, worst = exported
    assert 0 < worst <= 1e-5 < export.WORST_ERROR  # what float32 leaves of a head
    assert onnx_error(detector, path) == pytest.approx(worst)


def changed_head(detector, by):
    other = copy.deepcopy(detector)
    other.head.linear[-1] += by
    return other


def test_the_error_grows_with_the_difference(detector, exported):
    errors = [onnx_error(changed_head(detector, by), exported[0]) for by in (0.1, 1.0)]
    assert export.WORST_ERROR < errors[0] < errors[1]


def test_a_single_precision_detector_is_checked_in_double_precision(detector, exported):
    single = copy.deepcopy(detector).float()
    assert onnx_error(single, exported[0]) < export.WORST_ERROR


@pytest.fixture
def instant(exported, monkeypatch):
    """The exporter hands out the file made before, so that only the check is new."""

    def copy_file(module, arguments, path, **options):
        shutil.copy(exported[0], path)

    monkeypatch.setattr(torch.onnx, "export", copy_file)


@pytest.mark.usefixtures("instant")
def test_a_graph_that_differs_is_not_written(detector, tmp_path):
    """The file is another detector's: the check runs it and sees."""
    with pytest.raises(ValueError, match=r"onnxruntime and torch differ by .* was not written"):
        export_onnx(changed_head(detector, 0.5), tmp_path / "model.onnx")
    assert not list(tmp_path.iterdir())
    export_onnx(detector, tmp_path / "model.onnx")
    assert [path.name for path in tmp_path.iterdir()] == ["model.onnx"]


@pytest.mark.usefixtures("instant")
@pytest.mark.parametrize("worst", [1.0, float("nan")])
def test_a_failed_check_leaves_no_file(detector, tmp_path, monkeypatch, worst):
    monkeypatch.setattr(export, "onnx_error", lambda detector, path: worst)
    with pytest.raises(ValueError, match=r"model\.onnx was not written"):
        export_onnx(detector, tmp_path / "model.onnx")
    assert not list(tmp_path.iterdir())


@pytest.mark.usefixtures("instant")
def test_a_graph_with_other_flags_is_not_written(detector, tmp_path, monkeypatch):
    """The detector trusts what the file does not."""
    trusting = copy.deepcopy(detector)
    monkeypatch.setattr(FeaturePool, "is_alive", lambda pool, bins: bins.isfinite().all(-1))
    with pytest.raises(ValueError, match=r"disagree on which bins are valid \(kinds .*'constant'"):
        export_onnx(trusting, tmp_path / "model.onnx")
    assert not list(tmp_path.iterdir())


@pytest.mark.usefixtures("instant")
def test_a_failed_check_keeps_the_file_that_was_there(detector, tmp_path, monkeypatch):
    (tmp_path / "model.onnx").write_bytes(b"yesterday's")
    monkeypatch.setattr(export, "onnx_error", lambda detector, path: 1.0)
    with pytest.raises(ValueError, match="was not written"):
        export_onnx(detector, tmp_path / "model.onnx")
    assert (tmp_path / "model.onnx").read_bytes() == b"yesterday's"
    assert len(list(tmp_path.iterdir())) == 1


def frozen(path, batch):
    """A graph that only takes, or always gives, one batch size."""
    shape = ("batch", 24, 150)
    samples = onnx.helper.make_tensor_value_info("samples", onnx.TensorProto.FLOAT, shape)
    score = onnx.helper.make_tensor_value_info("score", onnx.TensorProto.FLOAT, (batch,))
    value = onnx.numpy_helper.from_array(np.zeros(batch, np.float32), "zeros")
    node = onnx.helper.make_node("Identity", ["zeros"], ["score"])
    graph = onnx.helper.make_graph([node], "frozen", [samples], [score], [value])
    opset = onnx.helper.make_opsetid("", export.OPSET)
    onnx.save(onnx.helper.make_model(graph, opset_imports=[opset], ir_version=10), path)


def test_a_graph_frozen_to_one_batch_is_seen(detector, tmp_path):
    frozen(tmp_path / "model.onnx", 1)
    with pytest.raises(ValueError, match=r"gives scores \(1,\) at batch 7, expected \(7,\)"):
        onnx_error(detector, tmp_path / "model.onnx")


def test_what_single_precision_costs_is_measured(detector):
    """Little; much for one that reads a mode out of features made in float32."""
    cost = float32_error(detector)
    assert 0 < cost["float32_median"] <= cost["float32_p95"] < 1e-2
    assert 0 <= cost["float32_flips"] < 0.05
    mode = [i for i, n in enumerate(detector.pool.names) if n.descriptor == "mode"][20:32]
    bins = detector.channel_filter.valid(noise(64, seed=99))
    scaler = FeatureScaler.fit(detector.pool(bins)[:, mode])
    stepping = SlipDetector(detector.pool, detector.channel_filter, mode, scaler, detector.head)
    in_double = float32_error(stepping)["float32_p95"]
    assert in_double < 1e-4
    native = FeaturePool(detector.pool.hand, arithmetic="native")
    parts = (detector.channel_filter, mode, scaler, detector.head)
    stepping = SlipDetector(native, *parts, engine="reference")
    assert float32_error(stepping)["float32_p95"] > 10 * in_double
