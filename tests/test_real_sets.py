"""Sets of real windows: how public sets are cut, what is refused, and what a fold may see."""

import numpy as np
import pytest
from sklearn.metrics import balanced_accuracy_score

from benchmarks.real import (
    FLOOR,
    SimpleStatistics,
    balanced_accuracy,
    confusions,
    left_out_scores,
    recording_confusions,
    word,
)
from benchmarks.real_onsets import Trials
from benchmarks.real_sets import RealSet, biotacsp, biotacsp_direction, main, osu, read_set


def write_biotacsp(root, **num_rows):
    """Files ``<object><number>.csv`` of electrodes that count rows, offset by 1000."""
    for place, (name, num) in enumerate(num_rows.items()):
        scene = "t" if place % 2 else "cw"
        (root / "csvs" / scene).mkdir(parents=True, exist_ok=True)
        rows = 1000.0 + np.arange(num)[:, None] + np.zeros(24)
        header = ",".join(f"ff_e{i}" for i in range(24))
        path = root / "csvs" / scene / f"{name}{place}.csv"
        np.savetxt(path, rows, delimiter=",", header=header, comments="", fmt="%d")


def test_a_biotac_recording_is_tared_on_half_a_second_and_cut_every_half_window(tmp_path):
    write_biotacsp(tmp_path, bottle=50 + 64 + 32 + 31, strippes=50 + 64, striped=50 + 63)
    found = biotacsp(tmp_path)
    assert found.X.shape == (3, 24, 64)
    assert found.X[:, 0, 0].tolist() == [50 - 24.5, 82 - 24.5, 50 - 24.5]
    assert found.y.tolist() == [True, True, False]
    assert found.group.tolist() == ["bottle", "bottle", "striped"]
    assert found.recording.tolist() == ["cw/bottle0"] * 2 + ["t/strippes1"]
    directions = biotacsp_direction(tmp_path)
    assert directions.y.tolist() == ["cw", "cw", "t"]
    np.testing.assert_array_equal(directions.X, found.X)


def write_osu(path, values, labels, step_s=0.04):
    """A file of a trial; a value of None is a gap, a label of None is a frame without tracking."""
    names = "time,lx,rx,ly,ry,lz,rz,lgx,rgx,lgy,rgy,lgz,rgz,slip_over_cm_s"
    rows = [
        ",".join("" if x is None else str(x) for x in (i * step_s, *row, label))
        for i, (row, label) in enumerate(zip(values, labels, strict=True))
    ]
    path.write_text("\n".join([names, *rows]))


def test_a_row_without_a_label_and_a_window_with_a_gap_are_left_out(tmp_path):
    values = [[float(i)] * 12 for i in range(45)]
    labels = [0] * 45
    labels[19], labels[24], labels[29], labels[34] = 1, None, 0.75, 1
    values[15][0] = None  # windows up to row 34 hold it
    write_osu(tmp_path / "soup_can_C_3_1.csv", values, labels)
    found = osu(tmp_path)
    assert found.X[:, 0, -1].tolist() == [39 - 7.0, 44 - 7.0]
    assert found.y.tolist() == [False, False]
    assert set(found.group) == {"soup_can"}
    assert found.layout.channels[6].kind == "gyro"
    assert found.layout.channels[7].finger == "right"
    values[15][0] = 15.0
    write_osu(tmp_path / "soup_can_C_3_1.csv", values, labels)
    assert osu(tmp_path).y.tolist() == [True, False, True, False, False]


def test_frames_of_slip_near_each_other_are_one_slip_and_what_is_not_tracked_is_cut(tmp_path):
    labels = np.repeat([0, 0, 1, 1, 0.75, 1, 0, 0, 0, 1, 0, None], 5).tolist()  # frames of .2 s
    write_osu(tmp_path / "soup_can_C_3_1.csv", [[i / 2] * 12 for i in range(60)], labels)
    trials = Trials(tmp_path)
    (name,) = trials.ids
    times = trials.timeline(name)
    assert name.material == "soup_can"
    np.testing.assert_allclose(times.sliding_s, [(0.4, 1.2), (1.8, 2.0)], atol=1e-9)
    assert times.duration_s == pytest.approx(2.2, abs=0.05)
    np.testing.assert_allclose(trials.load(name).samples[3, :3], [0.0, 0.5, 1.0], atol=1e-9)


@pytest.fixture
def small(rng):
    x = rng.standard_normal((12, 2, 8)).astype(np.float32)
    hand = [(name, "force", "finger", "distal", "slow") for name in "ab"]
    group = np.repeat(["cup", "can", "box"], 4)
    names = np.tile(["1", "1", "2", "2"], 3)
    others = np.array(100.0), np.array(hand), np.array("made here")
    return RealSet(x, np.tile([False, True], 6), group, names, *others)


def test_a_set_comes_back_from_its_file(small, tmp_path):
    np.savez(tmp_path / "set.npz", **small._asdict())
    for name, value in read_set(tmp_path / "set.npz")._asdict().items():
        np.testing.assert_array_equal(value, getattr(small, name))
    assert len(small.trials()[1]) == 6  # names of recordings repeat in other groups


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"X": np.zeros((12, 2, 8))}, "float32 X"),
        ({"X": np.full((12, 2, 8), np.nan, np.float32)}, "finite"),
        ({"y": np.zeros(11, bool)}, "expected y"),
        ({"y": np.zeros(12, bool)}, "2 classes"),
        ({"y": np.arange(12) < 2}, "group cup alone"),
        ({"group": np.repeat(["cup", "can"], 6)}, "3 groups"),
        ({"hand": np.array([["a", "force", "finger", "distal", "slow"]])}, "expected hand"),
        ({"hand": np.array([["a", "force", "finger", "distal", "odd"]] * 2)}, "channel row 1"),
        ({"sample_rate_hz": np.array(0.0)}, "positive sample_rate_hz"),
        ({"recording": np.array([{"a": 1}] * 12, dtype=object)}, "allow_pickle"),
    ],
)
def test_a_damaged_set_is_refused(small, tmp_path, changed, message):
    np.savez(tmp_path / "set.npz", **small._asdict() | changed)
    with pytest.raises(ValueError, match=message):
        read_set(tmp_path / "set.npz")


def test_a_file_without_an_array_is_refused(small, tmp_path):
    arrays = small._asdict()
    del arrays["group"]
    np.savez(tmp_path / "set.npz", **arrays)
    with pytest.raises(ValueError, match="has no group"):
        read_set(tmp_path / "set.npz")


def test_a_method_never_sees_the_group_that_it_scores(small):
    seen = []

    def fit(train, known, seed):
        seen.append((set(train.group.tolist()), len(known), seed))
        return lambda x: x[:, 0, 0]

    scores, cpu_s = left_out_scores(small, fit, 7)
    names = {"cup", "can", "box"}
    assert seen == [(names - {left}, 8, 7) for left in sorted(names)]
    np.testing.assert_array_equal(scores[:, 0], small.X[:, 0, 0])
    assert len(cpu_s) == 3


@pytest.mark.parametrize("words", [None, ["low", "none", "high"]])
def test_balanced_accuracy_is_scikit_learns(small, words, rng):
    """Of a score at the threshold 0, and of the largest of three."""
    of = small if words is None else small._replace(y=np.tile(words, 4))
    scores = rng.standard_normal((12, 1 if words is None else 3))
    decided = scores[:, 0] >= 0 if words is None else scores.argmax(1)
    counts = confusions(of, scores)
    assert counts.shape[0] == 6
    expected = balanced_accuracy_score(of.classes()[1], decided)
    assert balanced_accuracy(counts.sum(0)[None, None]).item() == pytest.approx(expected)


def test_a_recording_is_decided_by_the_mean_of_its_windows_and_not_by_their_number(small):
    of = small._replace(y=small.recording)  # "1" and "2": two windows of each recording
    first, second = of.recording == "1", of.recording == "2"
    scores = np.where(second, 1.0, -1.0)[:, None]
    first_of_cup = np.flatnonzero(first & (of.group == "cup"))
    scores[first_of_cup, 0] = -1.0, 3.0  # their mean is 1
    counts = recording_confusions(of, scores).sum(0)
    assert counts.tolist() == [[2, 1], [0, 3]]
    both = np.concatenate([-scores, scores], 1)  # one score for each class
    np.testing.assert_array_equal(recording_confusions(of, both).sum(0), counts)
    assert recording_confusions(small, scores) is None  # windows of both classes


def test_simple_statistics_of_a_ramp_with_floors_of_training_windows():
    ramp = np.arange(4, dtype=np.float32)[None, None]
    found = SimpleStatistics(with_logs=True).fit(np.stack([ramp[0], 3 * ramp[0]])).transform(ramp)
    spread = np.array([np.sqrt(1.25), np.sqrt(3.5), 3.0, 1.0])
    logs = np.log(spread + FLOOR * 2 * spread)  # the median of 1 and 3 is 2
    np.testing.assert_allclose(found[0], [1.5, *spread, *logs])


@pytest.mark.parametrize(
    ("ends", "expected"),
    [
        ([(1.0, 3.0), (0.5, 4.0)], "ahead"),
        ([(-3.0, -1.0), (-2.0, -0.1)], "behind"),
        ([(0.1, 3.0), (-0.1, 3.0)], "interval includes 0"),
        ([(None, None), (None, None)], "interval includes 0"),
    ],
)
def test_ours_is_ahead_only_where_every_interval_excludes_zero(ends, expected):
    assert (
        word({str(i): {"low": low, "high": high} for i, (low, high) in enumerate(ends)}) == expected
    )


def test_a_folder_without_sets_is_refused_in_one_line(tmp_path, capsys):
    with pytest.raises(SystemExit):
        main([str(tmp_path), str(tmp_path / "out")])
    assert "has no folder biotacsp-dos or osu-imu" in capsys.readouterr().err
