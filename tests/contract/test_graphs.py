"""The exported graphs, run by onnxruntime alone, against the detector in torch."""

from itertools import pairwise

import numpy as np
import onnxruntime as ort
import pytest
import torch

from . import names
from .names import BIN_GRAPH, BIN_INPUT, BIN_OUTPUTS, STREAM_GRAPH
from .recordings import NAMES, bins_of, samples_of

pytestmark = pytest.mark.onnx

CASES = [
    ("general", "float32"),
    ("paper", "float32"),
    pytest.param(("paper", "float64"), marks=pytest.mark.slow),
]
CLOSE = {"float32": 1e-4, "float64": 1e-9}
"""Of scores in standard deviations of ordinary scores, and of probabilities."""


@pytest.fixture(scope="module", params=CASES, ids="-".join)
def exported(request, graphs_of):
    """Folder of graphs, detector and precision."""
    recipe, precision = request.param
    detector = request.getfixturevalue(recipe).detector
    return graphs_of(recipe, precision), detector, precision


def session_of(path):
    options = ort.SessionOptions()
    options.intra_op_num_threads = 1
    options.log_severity_level = 3
    return ort.InferenceSession(path, options, providers=["CPUExecutionProvider"])


def kinds_of_bin(detector):
    """Raw bins by kind, float32 ``[N, C, n]``, so that both sides read the same numbers."""
    plain = bins_of(detector, samples_of("D", 2), 211).float().numpy()
    length = plain.shape[-1]
    time = np.arange(length)
    broken = plain.copy()
    broken[::2, 1, 60] = np.nan
    broken[1::2, 2, 70] = np.inf
    broken[3::7, :, 80] = np.nan
    absent = plain.copy()
    absent[:, NAMES.index(detector.pool.hand.names[detector.needed_index[0]])] = np.nan
    shapes = [np.where(time < 75, 0.0, 5.0), np.where(time % 2 == 0, -5.0, 5.0), time / 100.0]
    shapes += [np.eye(length)[75], np.zeros(length), np.full(length, 0.1), 1e-30 * np.sin(time)]
    return {
        "ordinary": plain,
        "broken": broken,
        "without a channel": absent,
        "shapes": np.stack([np.stack([row] * 4) for row in shapes]).astype(np.float32),
        "one": plain[:1],
        "none": plain[:0],
    }


@pytest.mark.parametrize(
    "kind", ["ordinary", "broken", "without a channel", "shapes", "one", "none"]
)
def test_the_bin_graph_scores_as_the_detector(exported, kind):
    folder, detector, precision = exported
    kinds = kinds_of_bin(detector)
    session, bins = session_of(folder / BIN_GRAPH), kinds[kind].astype(precision)
    found = dict(zip(BIN_OUTPUTS, session.run(BIN_OUTPUTS, {BIN_INPUT: bins}), strict=True))
    given = torch.from_numpy(bins)
    expected = detector.predict_raw(given.double(), given=given.dtype)
    ordinary = detector.predict_raw(torch.from_numpy(kinds["ordinary"]).double()).score
    scores = expected.score.numpy()
    valid = expected.is_valid.numpy()
    bound = CLOSE[precision] * (float(ordinary.std()) + np.abs(scores[valid]))
    assert (np.abs(found["score"] - scores)[valid] <= bound).all()
    assert found["score"].dtype == precision
    for name, flags in (("valid", valid), ("channels_lost", expected.channels_lost)):
        assert np.array_equal(found[name], flags), name
    for name in ("score", "probability"):
        assert np.array_equal(np.isfinite(found[name]), valid), name
    assert (found["probability"][valid] >= 0).all()
    assert (found["probability"][valid] <= 1).all()
    assert valid.all() == (kind not in ("broken", "shapes"))
    assert found["channels_lost"].any(-1).all() or kind != "without a channel"


LOST = {False: {()}, True: {(), tuple(NAMES[1:3]), tuple(NAMES)}}
"""Some of the channels that are lost together, in a whole stream and in a broken one."""


class Fed:
    """The stream graph, and what it handed on."""

    def __init__(self, path, precision):
        self.session, self.precision = session_of(path), precision
        self.memory = {
            "tail": np.empty((0, len(NAMES)), precision),
            "state": np.empty(0),
            "threshold": np.empty(0),
        }

    def push(self, samples):
        feeds = {"samples": np.ascontiguousarray(samples, self.precision), **self.memory}
        assert set(feeds) == set(names.STREAM_INPUTS)
        wanted = [*names.STREAM_OUTPUTS, *names.STREAM_HANDED_ON.values()]
        found = dict(zip(wanted, self.session.run(wanted, feeds), strict=True))
        self.memory |= {name: found.pop(handed) for name, handed in names.STREAM_HANDED_ON.items()}
        return found


@pytest.mark.parametrize("cuts", [(), (1, 2, 3, 150, 151, 1000), range(37, 4000, 37)], ids=len)
@pytest.mark.parametrize("is_broken", [False, True], ids=["whole", "broken"])
def test_the_stream_graph_decides_as_the_stream(exported, cuts, is_broken):
    folder, detector, precision = exported
    samples = samples_of("D", 1)[1000:5000].copy()
    if is_broken:
        samples[2000:2010, 1:3] = np.nan
        samples[3000:3010] = np.nan
    graph = Fed(folder / STREAM_GRAPH, precision)
    parts = [graph.push(samples[a:b]) for a, b in pairwise([0, *cuts, len(samples)])]
    stream = names.StreamingDetector(detector, dtype=torch.float64)
    expected = stream.push(samples)
    assert expected.is_alarm.any()
    assert expected.is_valid.all() != is_broken
    assert {expected.names_lost(i) for i in range(len(expected.score))} >= LOST[is_broken]
    spread = {name: np.nanstd(getattr(expected, name)) for name in ("score", "statistic")}
    for name, field in names.STREAM_OUTPUTS.items():
        values = np.concatenate([part[name] for part in parts])
        truth = getattr(expected, field).numpy()
        if truth.dtype == bool:
            assert np.array_equal(values, truth), name
        else:
            close = 1e-9 if name.endswith("_s") else CLOSE[precision] * spread.get(name, 1.0)
            np.testing.assert_allclose(values, truth, rtol=0, atol=close, err_msg=name)
