"""libtactslip, run by ctypes, decides what the package and the exported graph decide."""

import copy
import math
import re
from dataclasses import replace

import hosts
import numpy as np
import pytest
import small_detector
import torch
from extremes import slip_samples
from hosts import alarming_detector, slipping_stream

from tactslip_torch import SlipDetector, StreamingDetector
from tactslip_torch.commands import export
from tactslip_torch.deploy.bins import Precision
from tactslip_torch.deploy.check import runner, session_of
from tactslip_torch.deploy.native import FILE, SOURCE, NativeFile, _NativeStream
from tactslip_torch.deploy.stream import stream_graph
from tactslip_torch.features.sensing import Sensing
from tactslip_torch.onset.decisions import HOST_COLUMNS, KEY, AlarmSettings, score_stream
from tactslip_torch.onset.rules import NOTHING_YET
from tactslip_torch.pretrained import NAME, REAL_NAME, sample_recording

ONSETS = {"onset_score": "onset_score", "by_onset": "by_onset", "hint": "is_hint"}
CLOSE = ("score", "probability", "statistic", "onset_score", "onset_s", "time_s")
NUM = 2600  # samples of a kind: the onset stands at 4000 of the whole stream


def stream_of(detector: SlipDetector, precision: Precision = "float64") -> _NativeStream:
    return NativeFile.of(detector, precision).stream()


def in_pieces(push, samples, sizes=(1, 7, 333, 50)):
    """What pushes of changing length return, put together."""
    found, at, turn = [], 0, 0
    while at < len(samples):
        n = sizes[turn % len(sizes)]
        found.append(push(samples[at : at + n]))
        at, turn = at + n, turn + 1
    return {name: np.concatenate([each[name] for each in found]) for name in found[0]}


def by_package(detector, samples, dtype=torch.float64, threshold=None):
    settings = AlarmSettings.of(detector)
    if threshold is not None:
        settings = settings.at_threshold(threshold)
    decisions = StreamingDetector(detector, settings, dtype=dtype).push(samples)
    columns = HOST_COLUMNS | (ONSETS if settings.onset else {})
    return {name: getattr(decisions, column).numpy() for name, column in columns.items()}


def assert_same(found, wanted, close=1e-12):
    """Flags are the same, numbers to ``close``, of their size where that is above 1."""
    for name, expected in wanted.items():
        own = found[name]
        if name == "onset_score":
            expected = np.where(expected == NOTHING_YET, np.nan, expected)
        assert len(own) == len(expected), name
        if name in CLOSE:
            size = np.maximum(np.abs(expected), 1.0)
            off = np.where(own == expected, 0.0, np.abs(own - expected) / size)
            assert (np.isnan(own) == np.isnan(expected)).all(), name
            assert np.nanmax(off, initial=0.0) <= close, name
        else:
            np.testing.assert_array_equal(own, expected, name)


# Kinds of inputs --------------------------------------------------------------------------------

RNG = np.random.default_rng(7)
ALL, SLOW, FAST = slice(None), slice(0, 14), slice(14, None)


def changed(rows, channels, value):
    """Some samples replaced by a value or, of a function, by what it makes of them."""

    def change(x):
        x[rows, channels] = value(x[rows, channels]) if callable(value) else value
        return x

    return change


def frozen(rows, channels):
    def change(x):
        x[rows, channels] = x[rows.start, channels]
        return x

    return change


def scaled(factor, channels=ALL):
    return changed(ALL, channels, lambda part: part * factor)


def noise(size, channels=ALL):
    return changed(ALL, channels, lambda part: size * RNG.standard_normal(part.shape))


KINDS = {
    "as it is": lambda x: x,
    **{f"{n} NaN": changed(slice(900, 900 + n), ALL, np.nan) for n in (1, 2, 20, 99, 200, 600)},
    "1200 NaN": changed(slice(900, 2100), ALL, np.nan),
    **{f"Inf {n}": changed(slice(900, 900 + n), ALL, np.inf) for n in (1, 40)},
    "minus Inf in one channel": changed(slice(700, 720), 15, -np.inf),
    "NaN at the start": changed(slice(0, 10), ALL, np.nan),
    "NaN in the first bin alone": changed(slice(60, 61), ALL, np.nan),
    "NaN every 100": changed(slice(0, None, 100), ALL, np.nan),
    "NaN every 333 in one": changed(slice(0, None, 333), 20, np.nan),
    "all NaN": changed(ALL, ALL, np.nan),
    **{f"channel {c} missing": changed(ALL, c, np.nan) for c in (0, 13, 14, 23)},
    "half of the fast missing": changed(ALL, slice(14, 19), np.nan),
    "six of ten fast missing": changed(ALL, slice(14, 20), np.nan),
    "all fast missing": changed(ALL, FAST, np.nan),
    "all slow missing": changed(ALL, SLOW, np.nan),
    "fast missing for a while": changed(slice(800, 1700), FAST, np.nan),
    "all but one missing": changed(ALL, slice(0, 23), np.nan),
    **{f"rail {v:g}": changed(slice(800, None), slice(14, 17), v) for v in (0.0, 5.0, -5.0)},
    "a rail for 80 samples": changed(slice(800, 880), FAST, 5.0),
    "all on a rail": changed(slice(800, None), ALL, 5.0),
    **{f"frozen for {n}": frozen(slice(900, 900 + n), ALL) for n in (30, 150, 300, 1500)},
    "one frozen": frozen(slice(900, None), 16),
    "frozen from the start": frozen(slice(0, None), ALL),
    "zeros": changed(ALL, ALL, 0.0),
    "zeros behind the middle": changed(slice(1300, None), ALL, 0.0),
    "zeros for a while": changed(slice(900, 1500), ALL, 0.0),
    **{f"gain {g:g}": scaled(g) for g in (1e-6, 1e-3, 0.12, 0.3, 3.0, 10.0, 1e3, 1e6)},
    "gain of the fast .01": scaled(0.01, FAST),
    "one loud": scaled(100.0, 15),
    "other sign": scaled(-1.0),
    "offset 1": lambda x: x + 1.0,
    "offset 1000": lambda x: x + 1000.0,
    "drift": lambda x: x + np.linspace(0, 5, len(x))[:, None],
    **{f"noise {s:g}": noise(s) for s in (1e-7, 1e-4, 0.1, 10.0)},
    "noise in one": noise(0.5, 18),
    "mains": lambda x: x + 0.2 * np.sin(np.arange(len(x)) * 2 * np.pi * 50 / 2000)[:, None],
    "spikes": changed(slice(0, None, 251), ALL, lambda part: part + 3.0),
    "a step": changed(slice(1200, None), ALL, lambda part: part + 0.5),
    "clipped": lambda x: np.clip(x, -0.01, 0.01),
    "8 bits": lambda x: np.round(x * 128) / 128,
    "16 bits": lambda x: np.round(x * 32768) / 32768,
    "back to front": lambda x: x[::-1].copy(),
    "tiny": scaled(1e-37),
    "huge": scaled(1e30),
    "too short for a bin": lambda x: x[:90],
    "just one bin": lambda x: x[:125],
}  # fmt: skip


def kind_of(name):
    # the slip lies in the middle
    return KINDS[name](slipping_stream()[2700 : 2700 + NUM].astype(np.float64))


@pytest.fixture(scope="module", params=[False, True], ids=["bins", "onset"])
def detector(request):
    return alarming_detector(request.param)


@pytest.fixture(scope="module")
def native(detector):
    return stream_of(detector)


def test_the_inputs_raise_alarms_and_lose_channels(detector):
    found = by_package(detector, kind_of("as it is"))
    assert found["alarm"].any()
    assert not by_package(detector, kind_of("600 NaN"))["valid"].all()


@pytest.mark.parametrize("kind", KINDS)
def test_c_and_package_decide_alike(detector, native, kind):
    native.reset()
    samples = kind_of(kind)
    assert_same(in_pieces(native.push, samples), by_package(detector, samples))


@pytest.mark.slow
@pytest.mark.onnx
def test_c_and_graph_decide_alike(detector, native):
    graph = stream_graph(detector, AlarmSettings.of(detector), "float64")
    run = runner(session_of(graph.model()))
    for kind in KINDS:
        native.reset()
        samples = kind_of(kind)
        feeds = {"samples": samples, "tail": samples[:0], "state": np.empty(0)}
        wanted = run({**feeds, "threshold": np.empty(0)})
        names = set(wanted) - {"next_tail", "next_state"}
        assert_same(native.push(samples), {name: wanted[name] for name in names}, 1e-9)


OUT_OF_FLOAT32 = ("huge",)  # export/native/README.md says so


def test_in_float32_scores_are_near_and_decisions_alike():
    """Of the shipped detector; to 1e-3 of the scores' standard deviation on any kind of input."""
    detector = SlipDetector.pretrained(NAME)
    stream = stream_of(detector, "float32")
    spread = np.nanstd(by_package(detector, kind_of("as it is"))["score"])
    for kind in set(KINDS) - {*OUT_OF_FLOAT32}:
        stream.reset()
        samples = kind_of(kind).astype(np.float32)
        found, wanted = stream.push(samples), by_package(detector, samples, torch.float32)
        np.testing.assert_allclose(found["score"], wanted["score"], 0, 1e-3 * spread, err_msg=kind)
        for name in ("valid", "in_range", "alarm", "on", "channels_lost"):
            np.testing.assert_array_equal(found[name], wanted[name], f"{kind}: {name}")


def test_another_threshold_counts_at_once(detector):
    samples, changes = kind_of("as it is"), False
    for value in (0.5, -1.0, 3.0):
        stream = stream_of(detector)
        stream.set_threshold(value)
        found = stream.push(samples)
        assert_same(found, by_package(detector, samples, threshold=value))
        changes |= (found["on"] != by_package(detector, samples)["on"]).any()
    assert changes


@pytest.mark.parametrize("hint", [-0.5, math.inf])
def test_a_hint_is_never_above_the_threshold_and_comes_only_where_there_is_one(hint):
    detector, samples = copy.deepcopy(alarming_detector(True)), kind_of("as it is")
    settings = AlarmSettings.of(detector)
    detector.info[KEY] = replace(settings, onset=replace(settings.onset, hint=hint)).to_dict()
    stream = stream_of(detector)
    stream.set_threshold(-0.8)
    found = stream.push(samples)
    assert_same(found, by_package(detector, samples, threshold=-0.8))
    assert found["hint"].any() == math.isfinite(hint)


def test_samples_that_repeat_are_counted_over_pushes(detector):
    samples = kind_of("frozen from the start")
    assert not by_package(detector, samples)["valid"][-1]
    assert_same(in_pieces(stream_of(detector).push, samples, (1,)), by_package(detector, samples))


def test_detectors_side_by_side_do_not_meet(detector):
    samples = kind_of("as it is")
    one, other = stream_of(detector), stream_of(detector, "float32")
    third = stream_of(alarming_detector())
    together = [[], [], []]
    for at in range(0, len(samples), 40):
        for stream, found, factor in zip(
            (one, other, third), together, (1.0, 0.3, 2.0), strict=True
        ):
            found.append(stream.push(factor * samples[at : at + 40]))
    for found, factor, of, precision in (
        (together[0], 1.0, detector, "float64"),
        (together[1], 0.3, detector, "float32"),
        (together[2], 2.0, alarming_detector(), "float64"),
    ):
        alone = in_pieces(stream_of(of, precision).push, factor * samples, (40,))
        for name, wanted in alone.items():
            joined = np.concatenate([each[name] for each in found])
            np.testing.assert_array_equal(joined, wanted, name)


# Shipped detectors, other rules -----------------------------------------------------------------


@pytest.mark.parametrize("precision", ["float64", "float32"])
def test_the_sample_recording_has_the_alarms_of_the_package(precision):
    """Simulated. Scores in float32 to 1e-4 of their standard deviation."""
    detector, samples = SlipDetector.pretrained(NAME), sample_recording().samples.T.numpy()
    dtype = getattr(torch, precision)
    found = stream_of(detector, precision).push(samples.astype(precision))
    wanted = by_package(detector, samples, dtype)
    assert found["alarm"].sum() == 1
    near = 1e-12 if precision == "float64" else 1e-4 * np.nanstd(wanted["score"])
    np.testing.assert_allclose(found["score"], wanted["score"], rtol=0, atol=near)
    for name in ("alarm", "on", "valid", "in_range", "channels_lost", "time_s", "onset_s"):
        np.testing.assert_array_equal(found[name], wanted[name], name)


def test_a_slow_hand_of_96_channels_decides_alike():
    detector = SlipDetector.pretrained(REAL_NAME)
    samples = 1e4 + 300 * np.random.default_rng(3).standard_normal((900, 96))
    samples[400:600, 10:20] = np.nan
    assert_same(stream_of(detector).push(samples), by_package(detector, samples))


@pytest.mark.parametrize("num", [300, 1000, 1024])
def test_long_bins_are_decided_alike_and_their_files_stay_small(num):
    detector = small_detector.alarming_detector(bin_samples=num)
    samples = slip_samples(detector.pool.hand).T.numpy()
    wanted = by_package(detector, samples)
    assert wanted["alarm"].any()
    assert_same(stream_of(detector).push(samples), wanted)
    rounded = stream_of(detector, "float32").push(samples.astype(np.float32))["score"]
    spread = np.nanstd(wanted["score"])
    np.testing.assert_allclose(rounded, wanted["score"], rtol=0, atol=1e-3 * spread)
    finest = 2 * num * (num // 2)  # numbers of the matrix to the lines of D1
    assert len(NativeFile.of(detector).content) < 4 * finest


def test_decisions_are_in_range_by_what_set_the_threshold():
    detector = copy.deepcopy(alarming_detector())
    samples = kind_of("as it is")
    settings = AlarmSettings.of(detector)
    levels = Sensing.fit(8.0 * score_stream(detector, torch.from_numpy(samples.T), 20).span, 1, 1)
    detector.info[KEY] = replace(settings, levels=levels).to_dict()
    wanted = by_package(detector, samples)
    assert (wanted["in_range"] != by_package(alarming_detector(), samples)["in_range"]).any()
    assert_same(stream_of(detector).push(samples), wanted)


# Counts, files ------------------------------------------------------------------------------------


def test_counts_are_samples_by_scale_and_offset(detector):
    num = len(detector.pool.hand)
    scale, offset = 1e-6 * np.arange(1, num + 1), np.linspace(-1, 1, num)
    counts = np.round((kind_of("as it is") - offset) / scale).astype(np.int32)
    content = NativeFile.of(detector, "float64", scale=scale, offset=offset)
    wanted = stream_of(detector).push(counts * scale + offset)
    found = content.stream().push(counts)
    assert_same(found, {name: wanted[name] for name in wanted if name != "number"})
    assert found["alarm"].any()
    with pytest.raises(ValueError, match=r"native.scale must be a finite number.*of 24 channels"):
        NativeFile.of(detector, scale=[1.0, 2.0])


WRONG = {
    "nothing": (lambda content: b"", "not a .tslip file"),
    "text": (lambda content: b"volts\n" * 10, "not a .tslip file"),
    "another version": (lambda c: c[:8] + b"\2" + c[9:], "another format version"),
    "cut off": (lambda c: c[: len(c) // 2], "damaged"),
    "one bit": (lambda c: c[:5000] + bytes([c[5000] ^ 1]) + c[5001:], "damaged"),
    "longer": (lambda c: c + bytes(8), "damaged"),
}


@pytest.mark.parametrize("wrong", WRONG)
def test_a_wrong_file_is_an_error_in_words(detector, wrong):
    change, words = WRONG[wrong]
    with pytest.raises(ValueError, match=words):
        NativeFile(change(NativeFile.of(detector).content)).stream()


def test_the_command_writes_the_file_and_its_constants(typed, tmp_path):
    model = tmp_path / "detector.pt"
    alarming_detector().save(model)
    words = "graph=native", "native.source=true", f"model={model}"
    status, out, err = typed(export, *words)
    assert status == 0, err
    assert str(tmp_path / FILE) in out
    content = (tmp_path / FILE).read_bytes()
    words = (tmp_path / SOURCE).read_text().split("{\n")[1].split("}")[0].split(",")
    assert np.array([int(w.strip(" \nul"), 16) for w in words], "<u8").tobytes() == content
    assert NativeFile(content).stream().channels == alarming_detector().pool.hand.names


def scores_off(monkeypatch, is_off):
    """Scores of the streams of which ``is_off`` says so are a hundredth larger than they are."""
    right = _NativeStream.push

    def push(self, samples):
        found = right(self, samples)
        return found | {"score": found["score"] * (1.01 if is_off(self) else 1.0)}

    monkeypatch.setattr(_NativeStream, "push", push)


@pytest.mark.parametrize("precision", ["auto", "float32", "float64"])
def test_a_file_that_decides_otherwise_is_refused(precision, monkeypatch):
    scores_off(monkeypatch, lambda stream: True)
    with pytest.raises(ValueError, match=r"detector.tslip was not written: .*score differs"):
        NativeFile.checked(alarming_detector(), precision)


def test_where_float32_is_off_the_default_is_float64_and_says_why(typed, tmp_path, monkeypatch):
    scores_off(monkeypatch, lambda stream: not stream._info.is_double)
    model = tmp_path / "detector.pt"
    alarming_detector().save(model)
    status, out, err = typed(export, "graph=native", f"model={model}")
    assert status == 0, err
    (line,) = out.splitlines()
    assert "float64, as in float32 " in line
    assert "score differs from torch" in line
    assert NativeFile((tmp_path / FILE).read_bytes()).precision == "float64"
    (tmp_path / FILE).unlink()
    status, _, err = typed(export, "graph=native", "precision=float32", f"model={model}")
    assert status == 2
    assert err.strip().endswith("give precision=float64 or auto")
    assert not (tmp_path / FILE).exists()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["graph=native", "native.scale=0"], "native.scale must not be 0, got 0"),
        (
            ["graph=native", "native.scale=[" + "1.0," * 23 + "0]"],
            "native.scale must not be 0, got",
        ),
        (["graph=native", "native.scale=true"], "native.scale must be a finite number.* got True"),
        (
            ["graph=native", "native.offset=abc"],
            "native.offset must be a finite number, .* got 'abc'",
        ),
        (["native.scale=3e-5"], "native.scale=3e-05 .* are of graph=native"),
        (["native.source=true"], "native.source=True, .* are of graph=native"),
        (["graph=native", "native.source=no"], "native.source must be true or false, got 'no'"),
    ],
)
def test_a_converter_that_makes_no_volts_is_refused(words, said, typed, tmp_path):
    model = tmp_path / "detector.pt"
    alarming_detector().save(model)
    status, _, err = typed(export, *words, f"model={model}")
    assert status == 2
    assert re.search(said, err)
    assert [path.name for path in tmp_path.iterdir()] == ["detector.pt"]


@pytest.mark.parametrize("graph", ["native", "bin"])
def test_a_mean_that_was_subtracted_for_training_is_told(graph, typed, tmp_path):
    """The files do not subtract it."""
    model, detector = tmp_path / "detector.pt", copy.deepcopy(alarming_detector())
    detector.save(model)
    assert "tare_s" not in typed(export, f"graph={graph}", f"model={model}")[2]
    detector.info["reading"] = {"tare_s": [0.0, 0.5]}
    detector.save(model)
    status, _, err = typed(export, f"graph={graph}", f"model={model}")
    assert status == 0
    assert "the mean of 0 to 0.5 s was taken off each channel (reading.tare_s)" in err


@pytest.mark.parametrize("graph", ["native", "stream"])
def test_another_precision_is_refused_with_all_that_there_are(graph, typed, tmp_path):
    model = tmp_path / "detector.pt"
    alarming_detector().save(model)
    status, _, err = typed(export, f"graph={graph}", "precision=double", f"model={model}")
    assert status == 2
    assert "precision must be one of auto, float32, float64, got 'double'" in err


def test_without_an_alarm_there_is_no_file():
    with pytest.raises(ValueError, match="no alarm threshold"):
        NativeFile.of(hosts.random_detector(seed=1))
