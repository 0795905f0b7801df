"""The self-check of exports: every kind of wrong graph is refused, a right one is measured."""

import copy
from dataclasses import replace

import numpy as np
import pytest
import torch
from contract.names import STREAM_OUTPUTS
from small_detector import HAND, alarming_detector, raw_bins, small_detector
from streams import onset_of
from test_dead_streams import alarming_with_gaussians
from torch.nn.functional import pad

from tactslip_torch.deploy.bins import RawBin, Timing, bin_graph
from tactslip_torch.deploy.check import (
    DEGENERATE,
    check_bins,
    check_model,
    check_stream,
    runner,
    session_of,
    simulated_stream,
)
from tactslip_torch.deploy.stream import stream_graph
from tactslip_torch.deploy.value import F64, Graph
from tactslip_torch.features.pool import FeaturePool
from tactslip_torch.model.calibration import probability
from tactslip_torch.model.detector import SlipDetector
from tactslip_torch.model.kernels import QuadraticForm
from tactslip_torch.model.scaling import FeatureScaler
from tactslip_torch.onset.decisions import KEY, AlarmSettings
from tactslip_torch.onset.streaming import StreamingDetector
from tactslip_torch.signals.filtering import ChannelFilter

pytestmark = pytest.mark.onnx


@pytest.fixture(scope="module")
def detector():
    return alarming_detector()


# Bins ------------------------------------------------------------------------------------------


def bin_run(detector, change=lambda samples, out: out):
    """What a right bin graph in float32 gives, changed; ``change`` sees the samples."""
    single = copy.deepcopy(detector).float()
    raw, settings = RawBin.of(detector), AlarmSettings.of(detector)
    context = detector.context_before - raw.before, detector.context_after - raw.after

    def run(inputs):
        samples = torch.tensor(inputs["samples"])
        with torch.no_grad():
            score, is_valid, *_ = single.predict_raw(pad(samples, context))
        stated = probability(settings.calibration.llr(score), settings.slip_share)
        out = {"score": score.numpy(), "probability": stated.numpy(), "valid": is_valid.numpy()}
        return change(samples, out)

    return run


def at(is_there, **values):
    """Other outputs on bins that a predicate ``[B]`` of their samples picks."""

    def change(samples, out):
        mask = is_there(samples).numpy()
        for name, value in values.items():
            out = out | {name: np.where(mask, np.array(value, out[name].dtype), out[name])}
        return out

    return change


def one_bin(samples):
    return torch.arange(len(samples)) == 3


def constant(samples):
    return (samples == samples[..., :1]).flatten(1).all(1)


def holds_nan(samples):
    return samples.isnan().flatten(1).any(1)


def behind_nan(samples):
    """Whole bins in one batch with broken ones."""
    return ~holds_nan(samples) & holds_nan(samples).any()


def huge(samples):
    return (samples.abs() > 1e20).flatten(1).any(1)


WRONG_BINS = {
    "another name": (
        lambda samples, out: {n.replace("score", "scores"): x for n, x in out.items()},
        r"it gives .*scores float32\[256\], expected score float32\[256\], scores missing",
    ),
    "another dtype": (
        lambda samples, out: out | {"score": out["score"].astype(np.float64)},
        r"it gives .*score float64.*, expected .*score float32",
    ),
    "one batch size": (
        lambda samples, out: {name: np.resize(value, 7) for name, value in out.items()},
        r"it gives .*\[7\].*, expected .*\[256\]",
    ),
    "rows mixed up": (
        lambda samples, out: out | {"score": out["score"][::-1]},
        "score differs from torch by",
    ),
    "one flag wrong": (
        at(one_bin, valid=False),
        "valid differs from torch at 1 of 256, the first is number 3",
    ),
    "one probability": (at(one_bin, probability=2.0), "probability differs from torch"),
    "trusts the dead": (at(constant, valid=True), r"\(constant\): valid differs from torch at 16"),
    "nan of constants": (at(constant, score=np.nan), r"\(constant\): 16 scores are not finite"),
    "trusts the torn": (at(holds_nan, valid=True), r"\(nan\): valid differs"),
    "overflows": (at(huge, score=np.inf), r"\(huge\): 16 scores are not finite"),
    "one breaks others": (at(behind_nan, score=0.123), "simulated bins behind a degenerate one"),
}


@pytest.mark.parametrize("name", WRONG_BINS)
def test_a_wrong_bin_graph_is_refused(detector, name):
    change, message = WRONG_BINS[name]
    with pytest.raises(ValueError, match=message) as caught:
        check_bins(bin_run(detector, change), detector, "float32")
    assert "\n" not in str(caught.value)


def test_a_right_bin_graph_passes_and_is_measured(detector):
    found = check_bins(bin_run(detector), detector, "float32")
    assert found["bins"] == 320
    assert 0 < found["worst_sd"] < 1e-3
    assert set(found["degenerate_worst_sd"]) == set(DEGENERATE)
    assert list(found["missing_worst_sd"]) == ["the first", "every other", "all"]


def test_a_probability_comes_only_of_a_calibration(detector):
    with pytest.raises(ValueError, match="it gives probability"):
        check_bins(bin_run(detector), small_detector(), "float32")


def test_rounding_is_no_error_where_it_decides_a_score():
    """Of a vibration of 1e-12 of its offset few digits are left: levels of entropy change."""
    pool, channel_filter = FeaturePool(HAND), ChannelFilter([51, 51, 11, 11])
    place = [str(name) for name in pool.names].index("PVDF1 D3 time entropy")
    scaler = FeatureScaler.fit(pool(channel_filter.valid(raw_bins(64)))[:, [place]])
    one, zero = torch.ones(1, dtype=torch.float64), torch.zeros(1, 1, dtype=torch.float64)
    head = QuadraticForm(zero, one, zero[0, 0])
    of_entropy = SlipDetector(pool, channel_filter, [place], scaler, head, {"simulated": True})
    found = check_model(bin_graph(of_entropy, "float64").model(), of_entropy, "bin", "float64")
    assert found["worst_sd"] < 1e-9


# Streams ---------------------------------------------------------------------------------------


class StreamRun:
    """A right stream graph: its memory hides in a ``StreamingDetector``, the state is a counter."""

    def __init__(self, detector, change=lambda out: out, remembers=True):
        self.detector, self.change, self.remembers = detector, change, remembers
        self.timing = Timing.of(detector, AlarmSettings.of(detector))

    def __call__(self, inputs):
        if not inputs["tail"].size or not self.remembers:
            settings = AlarmSettings.of(self.detector)
            settings = replace(settings, threshold=float(inputs["threshold"][0]))
            self.stream = StreamingDetector(self.detector, settings, dtype=torch.float32)
        made = self.stream.push(inputs["samples"])
        out = {name: getattr(made, field).numpy() for name, field in STREAM_OUTPUTS.items()}
        out["next_tail"] = np.zeros((self.timing.tail, 4), np.float32)
        out["next_state"] = np.zeros(self.timing.state_size)
        return self.change(out)


def changed(name, by):
    return lambda out: out | {name: by(out[name])}


def never_early(alarms):
    """No alarm by the first decision of a push: one that forgets its latch."""
    return np.where(np.arange(len(alarms)) == 0, False, alarms)


def growing(out):
    return out | {"next_tail": np.pad(out["next_tail"], ((len(out["score"]), 0), (0, 0)))}


WRONG_STREAMS = {
    "no column": (
        lambda out: {n: x for n, x in out.items() if n != "on"},
        "it gives on missing, expected on bool",
    ),
    "grows": (
        growing,
        r"it gives next_tail float32\[\d+, 4\], expected next_tail float32\[\d+, 4\]",
    ),
    "drops an alarm": (changed("alarm", never_early), "alarm differs from torch at .*, the first"),
    "always on": (changed("on", np.ones_like), "on differs from torch"),
    "trusts all": (changed("valid", np.ones_like), "broken channels: valid differs from torch"),
    "late": (changed("time_s", lambda x: x + 5e-4), "time_s differs from torch by 5.0e-04 s"),
    "onset": (changed("onset_s", lambda x: x - 0.01), "onset_s differs from torch by 1.0e-02 s"),
    "score": (changed("score", lambda x: x * np.float32(1.01)), "score differs from torch"),
    "statistic": (changed("statistic", lambda x: x * np.float32(1.01)), "statistic differs"),
    "probability": (changed("probability", lambda x: x / 2), "probability differs"),
    "wide score": (changed("score", np.float64), r"score float64.*expected score float32"),
    "one too few": (
        changed("score", lambda x: x[:-1]),
        r"at sample \d+: it gives score float32\[\d+\], expected score float32\[\d+\]",
    ),
}


@pytest.mark.parametrize("name", WRONG_STREAMS)
def test_a_wrong_stream_graph_is_refused(detector, name):
    change, message = WRONG_STREAMS[name]
    with pytest.raises(ValueError, match=message) as caught:
        check_stream(StreamRun(detector, change), detector, "float32")
    assert "\n" not in str(caught.value)


def test_a_stream_that_forgets_between_pushes_is_refused(detector):
    run = StreamRun(detector, remembers=False)
    with pytest.raises(
        ValueError,
        match=r"at sample 140: it gives .* score float32\[0\].* expected .*score float32\[1\]",
    ):
        check_stream(run, detector, "float32")


def test_a_threshold_that_is_not_listened_to_is_refused(detector):
    right, own = StreamRun(detector), np.array([AlarmSettings.of(detector).threshold])
    with pytest.raises(ValueError, match=r"another threshold: .* differs"):
        check_stream(lambda inputs: right(inputs | {"threshold": own}), detector, "float32")


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        (None, None, None),
        ("onset_score", lambda x: x + 1e-8, "onset_score differs from torch by 1.0e-08"),
        ("by_onset", np.zeros_like, "another threshold: by_onset differs"),
        ("onset_score", np.float32, "gives onset_score float32"),
    ],
)
def test_onset_scores_are_checked(detector, name, change, message):
    joint, samples = copy.deepcopy(detector), simulated_stream(HAND, 2000.0, torch.float64)
    onset = onset_of(torch.cat([samples] * 2, 1), quantile=0.999)
    settings = replace(AlarmSettings.of(detector), onset=replace(onset, threshold=1e9))
    joint.info[KEY] = settings.to_dict()
    run = runner(session_of(stream_graph(joint, settings).model()))
    if name is None:
        found = check_stream(run, joint, "float32")
        assert found["decisions"] > 400
        return
    with pytest.raises(ValueError, match=message):
        check_stream(lambda x: changed(name, change)(run(x)), joint, "float32")


@pytest.mark.parametrize("hop", [20, 70, 3000])
def test_a_right_stream_graph_of_any_hop_passes_and_is_measured(detector, hop):
    """The last samples are of no whole hop, or the hop is longer than the simulated slip."""
    other = copy.deepcopy(detector)
    settings = replace(AlarmSettings.of(detector), hop_samples=hop)
    other.info[KEY] = settings.to_dict()
    found = check_stream(StreamRun(other), other, "float32")
    assert found["decisions"] >= 12
    assert 0 <= found["worst_sd"] < 1e-3
    if hop == 20:
        assert found["alarms"] > 0


# Models ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["bin", "stream"])
@pytest.mark.parametrize("precision", ["float32", pytest.param("float64", marks=pytest.mark.slow)])
def test_a_model_of_other_gaussians_is_refused(kind, precision):
    detector, other = alarming_with_gaussians(), alarming_with_gaussians()
    other.gaussians.mean += 0.5
    for made_of in (detector, other):
        if kind == "bin":
            model = bin_graph(made_of, precision).model()
        else:
            model = stream_graph(made_of, AlarmSettings.of(made_of), precision).model()
        if made_of is detector:
            assert check_model(model, detector, kind, precision)["simulated"] is True
        else:
            with pytest.raises(ValueError, match=r"differ.* from torch"):
                check_model(model, detector, kind, precision)


def test_a_model_that_cannot_be_run_is_told_in_one_line():
    graph = Graph()
    graph.output("score", graph.input("samples", F64, ("batch", 8)).sum(1), ("batch",))
    with pytest.raises(ValueError, match=r"cannot run it on samples \[3, 7\]: .*") as one:
        runner(session_of(graph.model()))({"samples": np.ones((3, 7))})
    assert "\n" not in str(one.value)
    broken = graph.model()
    broken.graph.node[0].input[0] = "nowhere"
    with pytest.raises(ValueError, match=r"onnxruntime cannot load it: .*nowhere"):
        session_of(broken)


# Signals ---------------------------------------------------------------------------------------
