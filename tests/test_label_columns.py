"""Labels of single samples, in a column of a file: what is slip, what not, what is not known."""

import math

import h5py
import numpy as np
import pandas as pd
import pytest
import scipy.io
from small_set import SmallSet, small_maker
from test_datasets import manifest, refused

from tactslip_torch.data.file_recordings import FileRecordings
from tactslip_torch.data.labels import LabelColumn, LabelRule, bins_of
from tactslip_torch.data.recording import Timeline

RATE_HZ = 100.0
NUM = 400
STATE = np.zeros(NUM)
STATE[200:300] = 1.0  # slip from 2 to 3 s
EMPTY = slice(350, NUM)  # cells
TIMES = np.arange(NUM) / RATE_HZ
VALUES = np.random.default_rng(2).standard_normal((NUM, 2))


def written(path, label, delimiter=",", **further):
    """A file of two channels and a column of labels, of any format."""
    columns = {"t": TIMES, "a": VALUES[:, 0], "b": VALUES[:, 1], "state": label} | further
    if path.suffix == ".csv":
        decimal = "," if delimiter == ";" else "."
        pd.DataFrame(columns).to_csv(path, index=False, sep=delimiter, decimal=decimal)
    elif path.suffix == ".parquet":
        pd.DataFrame(columns).to_parquet(path)
    elif path.suffix == ".h5":
        with h5py.File(path, "w") as file:
            for name, values in columns.items():
                is_text = np.asarray(values).dtype.kind in "OU"
                kind = h5py.string_dtype() if is_text else None
                file.create_dataset(name, data=list(values) if is_text else values, dtype=kind)
    elif path.suffix == ".mat":
        scipy.io.savemat(path, columns)
    else:
        np.savez(path, **columns)
    manifest(path.parent, f"{path.name},wood", columns="file,material")


def source_of(root, reading=None, **rule):
    return FileRecordings(root, reading=reading, label_rule=LabelRule(column="state", **rule))


def times_of(source):
    return source.timeline(source.ids[0])


def in_words(slip="slip", rest="stable", empty=""):
    words = np.where(STATE > 0, slip, rest).astype(object)
    words[EMPTY] = empty
    return words


def numbers(scale=1.0):
    state = STATE * scale
    state[EMPTY] = np.nan
    return state


WHOLE = ((0.0, 2.0), (3.0, 3.5)), ((2.0, 3.0),), ((3.5, 4.0),)
"""What is non-slip, slip and not labelled."""


def stretches(times):
    return times.non_slip_s, times.sliding_s, times.unlabelled_s


KINDS = [
    ("a.csv", numbers(), {}),
    ("a.csv", numbers(-3.0), {"over": 2.0}),
    ("a.csv", in_words(), {}),
    ("a.csv", in_words("TRUE", "No"), {}),
    ("a.csv", in_words("slide fast", "in hand"), {"slip": ["Slide_fast"]}),
    ("a.csv", in_words("2", "1"), {"slip": [2]}),
    ("a.npz", numbers(), {}),
    ("a.npz", in_words().astype(str), {}),
    ("a.h5", in_words("Slip", "non-slip"), {}),
    ("a.mat", numbers(), {}),
    ("a.parquet", in_words(empty=None), {}),
    ("a.parquet", in_words(True, False, None), {}),
]


@pytest.mark.parametrize(("name", "label", "rule"), KINDS)
def test_a_column_of_labels_is_read_as_it_stands(tmp_path, name, label, rule):
    written(tmp_path / name, label)
    source = source_of(tmp_path, **rule)
    assert source.hand.names == ("a", "b")  # it is no channel
    times = times_of(source)
    assert stretches(times) == WHOLE
    assert (times.onsets_s, times.speeds_mm_s) == ((2.0,), (0.0,))  # nobody knows the speed


@pytest.mark.parametrize("name", ["a.npz", "a.h5", "a.mat"])
def test_true_and_false_of_arrays_are_labels(tmp_path, name):
    written(tmp_path / name, STATE > 0)
    assert times_of(source_of(tmp_path)).sliding_s == ((2.0, 3.0),)


def test_a_table_with_commas_and_dropped_rows_is_read_in_blocks_as_line_by_line(tmp_path):
    """Semicolons, decimal commas, words and empty cells: all that keeps rows from being numbers."""
    cells = VALUES[:, 0].copy()
    cells[50] = np.nan
    written(tmp_path / "a.csv", in_words(), ";", a=cells)
    lines = (tmp_path / "a.csv").read_text().splitlines()
    del lines[121:124]
    (tmp_path / "a.csv").write_text("\n".join(lines) + "\n")
    source = source_of(tmp_path, {"gaps": "bridge", "bridge_ms": 30.0})
    assert stretches(times_of(source)) == WHOLE
    read = source.load(source.ids[0]).samples
    kept = np.r_[:50, 51:120, 123:NUM]
    np.testing.assert_allclose(read[:, kept], VALUES[kept].T)
    assert read[0, 50] == pytest.approx((VALUES[49, 0] + VALUES[51, 0]) / 2)


def test_a_gap_that_is_bridged_splits_no_slide(tmp_path):
    written(tmp_path / "a.csv", numbers())
    lines = (tmp_path / "a.csv").read_text().splitlines()
    del lines[251:254]
    (tmp_path / "a.csv").write_text("\n".join(lines) + "\n")
    whole = times_of(source_of(tmp_path, {"gaps": "bridge", "bridge_ms": 30.0}))
    assert whole.sliding_s == ((2.0, 3.0),)
    split = times_of(source_of(tmp_path, {"gaps": "missing"}))
    assert (split.sliding_s, split.slip_s) == (((2.0, 2.5),), ((2.53, 3.0),))


# Words ---------------------------------------------------------------------------------------


def test_a_word_that_is_no_label_is_one_line_with_file_column_word_and_key(tmp_path):
    words = in_words()
    words[7] = "grasping"
    for name in ("a.csv", "a.npz", "a.parquet"):
        written(tmp_path / name, words.astype(str) if name == "a.npz" else words)
        said = rf"{name}.* 'grasping' in column 'state' is no known label; .* labels\.slip="
        refused(said, tmp_path, label_rule=LabelRule(column="state"))
    written(tmp_path / "a.csv", words)
    refused("in line 9: 'grasping'", tmp_path, label_rule=LabelRule(column="state"))
    assert times_of(source_of(tmp_path, slip=["slip"])).sliding_s == ((2.0, 3.0),)
    rule = LabelRule(column="state", unit="mm/s")
    refused("'stable' in column 'state' is no speed", tmp_path, label_rule=rule)


def test_a_column_that_is_not_there_is_one_line(tmp_path):
    written(tmp_path / "a.csv", numbers())
    refused(r"no column 'v' that labels\.column names", tmp_path, label_rule=LabelRule(column="v"))


WRONG = [
    ({"unit": "km/h"}, r"labels\.unit must be one of null, mm/s, cm/s, m/s, um/s, got 'km/h'"),
    ({"over": -1.0}, r"labels\.over must be a finite number of at least 0"),
    ({"slip": "slip"}, r"labels\.slip must be a list of words or null, got 'slip'"),
    ({"slip": ["x"], "unit": "m/s"}, r"labels\.slip is of words, labels\.unit of a speed"),
    ({"column": True}, r"labels\.column must be a name, a number or null, got True"),
]


@pytest.mark.parametrize(("rule", "said"), WRONG)
def test_a_rule_of_a_column_that_cannot_be_is_refused(rule, said):
    with pytest.raises(ValueError, match=said):
        LabelRule(**{"column": "state"} | rule)


def test_bins_and_recordings_go_by_one_column():
    with pytest.raises(ValueError, match=r"labels\.column=state must be that with which"):
        small_maker(SmallSet(), column="state")


# What else is said ----------------------------------------------------------------------------


def test_a_line_of_the_manifest_adds_to_the_column(tmp_path):
    """Both hold; stretches take precedence, and a label of all stands where cells are empty."""
    written(tmp_path / "a.csv", numbers())
    rows = {
        ("missing_s", "1-1.5"): WHOLE,
        ("non_slip_s", "3.5-3.8"): ((*WHOLE[0], (3.5, 3.8)), WHOLE[1], ((3.8, 4.0),)),
        ("slip_s", "2.5-3.2"): (((0.0, 2.0), (3.2, 3.5)), ((2.0, 2.5),), WHOLE[2]),
        ("label", "non-slip"): (((0.0, 2.0), (3.0, 4.0)), WHOLE[1], ()),
    }
    for (column, cell), expected in rows.items():
        manifest(tmp_path, f"a.csv,wood,{cell}", columns=f"file,material,{column}")
        times = times_of(source_of(tmp_path))
        assert stretches(times) == expected, column
        assert times.missing_s == (((1.0, 1.5),) if column == "missing_s" else ())
        assert times.slip_s == (((2.5, 3.2),) if column == "slip_s" else ())
    manifest(tmp_path, "a.csv,wood,0.5; 3.6", columns="file,material,onsets_s")
    times = times_of(source_of(tmp_path))  # slides of half a second, by default
    assert times.sliding_s == ((0.5, 1.0), (2.0, 3.0), (3.6, 4.0))
    assert times.onsets_s == times.annotated_onsets_s == (0.5, 2.0, 3.6)


def test_no_bin_takes_a_sample_without_a_label(tmp_path):
    """Neither before an onset nor elsewhere; and each bin has the label of all its samples."""
    label = numbers()
    label[140:160] = np.nan  # within the second before the onset
    label[100:120] = 1.0
    written(tmp_path / "a.csv", label)
    rule = LabelRule(column="state", bin_ms=50.0, hop_ms=10.0)
    source = FileRecordings(tmp_path, label_rule=rule)
    bins = bins_of(rule, times_of(source), RATE_HZ, 0, 0)
    own = label[bins.starts.numpy()[:, None] + np.arange(bins.bin_samples)]
    assert (own == bins.is_slip.numpy()[:, None]).all()
    starts = sorted(
        set(range(NUM - 4)) - {s for s in range(NUM - 4) if len({*label[s : s + 5]}) > 1}
    )
    is_hidden = np.array([np.isnan(label[s : s + 5]).any() for s in starts])
    laid = sorted(bins.starts.tolist())
    assert len(laid) == len(set(laid))
    assert set(laid) <= set(np.array(starts)[~is_hidden].tolist())
    assert bins.is_slip.sum() > 10 < (~bins.is_slip).sum()


# Speeds ----------------------------------------------------------------------------------------


def test_a_speed_that_is_noisy_lost_or_begins_in_slip():
    rate = 1000.0
    speed = np.zeros(1000)
    speed[:100] = 10.0  # slides already
    speed[300:500] = -10.0  # either way
    speed[400:410] = 0.0  # for 10 ms
    speed[600:615] = 10.0  # for 15 ms
    speed[700:750] = np.nan
    speed[750:800] = 10.0  # since when is not known
    column = LabelColumn("v", 5.0, "mm/s")
    found = column.timeline(speed, rate)
    np.testing.assert_allclose(found.slip_s, [[0, 0.0995], [0.75, 0.7995]])
    np.testing.assert_allclose(found.sliding_s, [[0.2995, 0.4995]])
    np.testing.assert_allclose(found.non_slip_s, [[0.0995, 0.2995], [0.4995, 0.7], [0.7995, 1.0]])
    assert found.unlabelled_s == ((0.7, 0.75),)
    assert found.speeds_mm_s == (10.0,)
    assert column.timeline(np.zeros(0), rate) == Timeline()
    slower = LabelColumn("v", 0.5, "cm/s").timeline(speed / 10, rate)
    assert slower.speeds_mm_s == (10.0,)
    np.testing.assert_allclose(slower.sliding_s, found.sliding_s)
    assert len(LabelColumn("v", 5.0).timeline(speed, rate).sliding_s) == 3  # labels do not flicker


@pytest.mark.parametrize("name", ["a.npz", "a.csv"])
def test_a_speed_above_a_threshold_is_slip_in_its_own_unit(tmp_path, name):
    speed = np.concatenate([np.zeros(150), np.linspace(0, -0.02, 101), np.zeros(149)])
    written(tmp_path / name, speed)
    times = times_of(source_of(tmp_path, over=0.005, unit="m/s"))
    # 25 steps of 0.2 mm/s behind 1.5 s; the last but one sample is the last above
    edges = [*times.onsets_s, *times.sliding_s[0], *np.ravel(times.non_slip_s)]
    expected = [1.75, 1.75, 2.5075, 0, 1.75, 2.5075, 4]
    assert edges == pytest.approx(expected, abs=1e-4)
    assert times.speeds_mm_s in ((12.0,), (13.0,))


def test_numbers_stand_for_words_beside_numbers():
    column = LabelColumn("v", 2.0)
    assert [column.number_of(word) for word in ("slip", "no_slip", "?")] == [math.inf, 0.0, None]
    assert column.states(np.array([3.0, -3.0, 2.0, math.inf, np.nan])).tolist() == [1, 1, 0, 1, -1]
