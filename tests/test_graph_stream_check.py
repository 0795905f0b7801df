"""The self-check of stream graphs: every kind of wrong one is refused, a right one is not."""

import copy
from dataclasses import replace

import numpy as np
import pytest
import torch
from small_detector import alarming_detector

from tactslip_torch.graph.form import Form
from tactslip_torch.graph.stream import Timing
from tactslip_torch.graph.stream_check import (
    broken_stream,
    check_stream,
    cuts,
    middle_threshold,
    slowed,
)
from tactslip_torch.onset.settings import KEY, AlarmSettings
from tactslip_torch.onset.streaming import StreamingDetector

pytestmark = pytest.mark.onnx

SINGLE = Form("float32")


@pytest.fixture(scope="module")
def detector():
    return alarming_detector()


# A stream graph that is torch, and what may be wrong with it ----------------------------------


class StreamRun:
    """A right stream graph: its memory hides in a ``StreamingDetector``, the state is a counter."""

    def __init__(self, detector, change=lambda out: out, remembers=True):
        self.detector, self.change, self.remembers = detector, change, remembers
        self.timing = Timing.of(detector, AlarmSettings.of(detector))

    def __call__(self, inputs):
        samples = inputs["samples"]
        if not len(inputs["state"]) or not self.remembers:
            settings = AlarmSettings.of(self.detector)
            if len(inputs["threshold"]):
                settings = replace(settings, threshold=float(inputs["threshold"][0]))
            dead = torch.from_numpy(inputs.get("masked_channels", np.zeros(4, bool)))
            self.stream = StreamingDetector(self.detector, settings, masked_channels=dead)
        made = self.stream.push(samples)
        out = {
            "score": made.score,
            "probability": made.probability,
            "statistic": made.statistic,
            "valid": made.is_valid,
            "alarm": made.is_alarm,
            "on": made.is_on,
            "time_s": made.available_s,
            "onset_s": made.onset_s,
        }
        out = {name: column.numpy() for name, column in out.items()}
        out |= {
            "next_tail": np.zeros((self.timing.tail, 4), np.float32),
            "next_state": np.zeros(self.timing.state_size),
        }
        return self.change(out)


def test_a_right_stream_graph_passes_and_is_measured(detector):
    run = StreamRun(detector)
    facts = check_stream(run, detector, SINGLE)
    assert facts["simulated"] is True
    assert facts["decisions"] > 100
    assert facts["alarms"] > 0
    assert facts["alarms_at_another_threshold"] > 0
    assert 0 < facts["worst_sd"] < 1e-3
    assert 0 < facts["broken"]["not_valid"] < facts["decisions"]
    assert facts["dead"]["not_valid"] == facts["decisions"]


def changed(name, by):
    """A column that is changed where it has entries."""
    return lambda out: out | {name: by(out[name])}


def never_early(alarms):
    """No alarm by the first decision of a push: one that forgets its latch."""
    return np.where(np.arange(len(alarms)) == 0, False, alarms)


def growing(out):
    return out | {"next_tail": np.pad(out["next_tail"], ((len(out["score"]), 0), (0, 0)))}


WRONG_STREAMS = {
    "no column": (lambda out: {n: x for n, x in out.items() if n != "on"}, "outputs .*: on"),
    "grows": (growing, r"next_tail is float32\[\d+, 4\], expected float32\[\d+, 4\] always"),
    "drops an alarm": (changed("alarm", never_early), "alarm differs from torch at .*, the first"),
    "always on": (changed("on", np.ones_like), "on differs from torch"),
    "trusts all": (changed("valid", np.ones_like), "broken sensors: valid differs from torch"),
    "late": (changed("time_s", lambda x: x + 5e-4), "time_s differs from torch by 5.0e-04 s"),
    "onset": (changed("onset_s", lambda x: x - 0.01), "onset_s differs from torch by 1.0e-02 s"),
    "score": (changed("score", lambda x: x * np.float32(1.01)), "score differs from torch"),
    "statistic": (changed("statistic", lambda x: x * np.float32(1.01)), "statistic differs"),
    "probability": (changed("probability", lambda x: x / 2), "probability differs"),
    "wide score": (changed("score", np.float64), r"score is float64.*expected float32"),
    "one too few": (changed("on", lambda x: x[:-1]), r"on is bool\[\d+\], expected bool\[\d+\]"),
}


@pytest.mark.parametrize("name", WRONG_STREAMS)
def test_a_wrong_stream_graph_is_refused(detector, name):
    change, message = WRONG_STREAMS[name]
    run = StreamRun(detector, change)
    with pytest.raises(ValueError, match=message) as caught:
        check_stream(run, detector, SINGLE)
    assert "\n" not in str(caught.value)


def test_a_stream_that_forgets_between_pushes_is_refused(detector):
    run = StreamRun(detector, remembers=False)
    with pytest.raises(ValueError, match="it has made 0 decisions of 140 samples, its facts say 1"):
        check_stream(run, detector, SINGLE)


def test_a_threshold_that_is_not_listened_to_is_refused(detector):
    right = StreamRun(detector)

    def deaf(inputs):
        return right(inputs | {"threshold": np.empty(0)})

    with pytest.raises(ValueError, match="another threshold: alarm differs"):
        check_stream(deaf, detector, SINGLE)


def test_memory_of_another_shape_is_refused(detector):
    flat = StreamRun(detector, changed("next_tail", np.ravel))
    with pytest.raises(ValueError, match=r"next_tail is float32\[\d+\], expected .*, 4\]"):
        check_stream(flat, detector, SINGLE)
    single = StreamRun(detector, changed("next_state", np.float32))
    with pytest.raises(ValueError, match=r"next_state is float32\[7\], expected float64"):
        check_stream(single, detector, SINGLE)


def with_hop(detector, hop):
    """A copy that decides every so many samples."""
    other = copy.deepcopy(detector)
    settings = replace(AlarmSettings.of(detector), hop_samples=hop)
    other.info[KEY] = settings.to_dict()
    return other


@pytest.fixture(scope="module")
def usual_sd(detector):
    return check_stream(StreamRun(detector), detector, SINGLE)["score_sd"]


@pytest.mark.parametrize("hop", [64, 70, 600, 2999, 3000, 6001])
def test_a_right_stream_graph_of_any_hop_passes(detector, usual_sd, hop):
    """The last samples are of no whole hop, or the hop is longer than the simulated slip."""
    other = with_hop(detector, hop)
    facts = check_stream(StreamRun(other), other, SINGLE)
    assert facts["decisions"] >= 12
    assert facts["score_sd"] > 0.1 * usual_sd
    assert facts["broken"]["not_valid"] > 0


def test_a_hop_that_is_too_long_to_be_checked_is_refused(detector):
    other = with_hop(detector, 20_001)
    with pytest.raises(ValueError, match="a hop of 20001 samples is too long to be checked") as one:
        check_stream(StreamRun(other), other, SINGLE)
    assert "\n" not in str(one.value)


def test_decisions_that_come_when_the_facts_do_not_say_so_are_refused(detector, monkeypatch):
    late = replace(Timing.of(detector, AlarmSettings.of(detector)), first=126)
    monkeypatch.setattr(Timing, "of", lambda *given: late)
    with pytest.raises(ValueError, match=r"made \d+ decisions of \d+ samples, its facts say"):
        check_stream(StreamRun(detector), detector, SINGLE)


def test_every_decision_of_a_long_hop_sees_another_part(detector):
    samples = torch.arange(3000)[:, None]
    timing = replace(Timing.of(detector, AlarmSettings.of(detector)), hop=6000)
    slow = slowed(samples, timing)
    assert timing.decisions(len(slow)) == 12
    assert timing.decisions(len(slow) - 1) == 11
    assert slow[::6000, 0].tolist() == list(range(0, 3000, 250))
    assert slowed(samples, replace(timing, hop=20)) is samples


@pytest.mark.parametrize("num", [0, 1, 299, 300, 301, 2999, 3000])
def test_every_cut_is_of_the_whole_stream(num):
    for name, sizes in cuts(num, 20).items():
        assert sum(sizes) == num, name
        assert min(sizes, default=0) >= 0, name
    if num > 300:
        ways = cuts(num, 20)
        assert 0 in ways["anyhow"]
        assert ways["by sample"][:300] == [1] * 300


def test_a_middle_threshold_is_crossed_with_room():
    statistic = np.array([0, 0, 0, 0, 1, 2, 3, 6, 7, 8, 9.0, 9.5])
    assert middle_threshold(statistic) == 4.5
    assert middle_threshold(np.zeros(5)) == 0.0


def test_a_broken_stream_is_broken_where_it_is_looked_at(rng):
    samples = torch.from_numpy(rng.standard_normal((600, 4)))
    broken = broken_stream(samples, [1, 3])
    assert broken[100:200, 1].unique().numel() == 1
    assert broken[300:400, 3].isinf().all()
    assert broken[500:530].isnan().all()
    same = torch.ones(600, 4, dtype=torch.bool)
    same[100:200, 1] = same[300:400, 3] = same[500:530] = False
    assert torch.equal(broken[same], samples[same])
