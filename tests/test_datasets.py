"""Folders of files as a source: what is read, what all must agree in, and what is said."""

import csv
import hashlib
import logging
import os
import pickle
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from tactslip_torch.data import file_recordings as module
from tactslip_torch.data.file_recordings import FileRecordings, file_digest
from tactslip_torch.data.formats import named_format
from tactslip_torch.data.labels import LabelRule
from tactslip_torch.data.recording import Recording, RecordingId
from tactslip_torch.features.pool import FeaturePool
from tactslip_torch.hand import Channel, HandLayout
from tactslip_torch.signals.filtering import ChannelFilter
from tactslip_torch.training.datamodule import FeatureMaker

HAND = HandLayout(
    (
        Channel("SG1", "SG", "index", "distal"),
        Channel("PVDF1", "PVDF", "index", "distal"),
        Channel("PVDF2", "PVDF", "thumb", "distal"),
    )
)
RATE_HZ = 200.0
ROWS = HAND.to_rows()
TRUTH = ("onsets_s", "sliding_s", "annotated_onsets_s", "non_slip_s", "speeds_mm_s", "duration_s")
IRON = [RecordingId("iron", cycle) for cycle in (0, 1)]


def samples(seed=0, num_samples=600, channels=3, dtype=torch.float64):
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(channels, num_samples, generator=generator, dtype=dtype)


def ours(path, content=None, hand=HAND, **changes):
    """A recording of ours in a file."""
    made = Recording(
        samples() if content is None else content,
        RATE_HZ,
        "wood",
        (20.0,),
        (1.5,),
        ((1.5, 2.5),),
        (1.4,),
        ((0.0, 0.25),),
        {"simulated": False, "operator": "A"},
    )
    made = replace(made, **changes)
    named_format(path.suffix[1:]).save(path, made, hand, {})
    return made


def table(path, content, rate_hz=RATE_HZ, names=("t", "a", "b", "c"), times=None):
    """A table of anybody's: times and channels, with a header."""
    times = np.arange(content.shape[1]) / rate_hz if times is None else times
    with path.open("w", newline="") as file:
        rows = csv.writer(file)
        rows.writerow(names)
        rows.writerows(
            [repr(float(t)), *(repr(v) for v in row)]
            for t, row in zip(times, content.T.tolist(), strict=True)
        )


def manifest(root, *lines, columns="file,material,trial,onsets_s,sliding_s,label"):
    (root / "manifest.csv").write_text("\n".join([columns, *lines]) + "\n")


def lines_of(source):
    return [str(problem) for problem in source.problems]


def rows_named(*names):
    """Rows of the hand's first channels under other names."""
    return [row | {"name": name} for row, name in zip(ROWS, names, strict=False)]


def refused(said, root, **options):
    """``FileRecordings`` says that, in one line."""
    with pytest.raises((ValueError, FileNotFoundError), match=said) as caught:
        FileRecordings(root, **options)
    assert "\n" not in str(caught.value)
    return str(caught.value)


@pytest.fixture
def tables(tmp_path):
    """Four tables of anybody's, two of each material."""
    for place in range(4):
        table(tmp_path / f"{place}.csv", samples(place))
    manifest(
        tmp_path,
        "0.csv,wood,0,1.5,1.5-2.5,",
        "1.csv,wood,1,1.5,1.5-2.5,",
        "2.csv,iron,0,,,slip",
        "3.csv,iron,1,,,non-slip",
    )
    return tmp_path


# What is read --------------------------------------------------------------------------------


@pytest.mark.parametrize("ending", ["npz", "csv"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_files_of_ours_are_read_with_all_they_say(tmp_path, ending, dtype):
    made = ours(tmp_path / f"a.{ending}", samples(dtype=dtype))
    manifest(tmp_path, f"a.{ending},wood,4,,,")
    source = FileRecordings(tmp_path)
    (name,) = source.ids
    assert name == RecordingId("wood", 4)
    assert (source.hand, source.sample_rate_hz, source.units) == (HAND, RATE_HZ, "V")
    assert source.is_simulated is False
    read, times = source.load(name), source.timeline(name)
    assert read.samples.dtype == dtype
    assert torch.equal(read.samples, made.samples)
    for truth in TRUTH:
        assert getattr(read, truth) == getattr(times, truth) == getattr(made, truth)
    assert (read.provenance, read.units) == (made.provenance, made.units)


def test_the_manifest_has_the_word_over_the_file(tmp_path):
    ours(tmp_path / "a.npz")
    manifest(tmp_path, "a.npz,steel,0,2.0,2.0-2.75,")
    source = FileRecordings(tmp_path)
    times = source.timeline(source.ids[0])
    assert (times.onsets_s, times.annotated_onsets_s) == ((2.0,), (2.0,))
    assert (times.sliding_s, times.non_slip_s) == (((2.0, 2.75),), ())
    (warning,) = source.warnings
    assert str(warning) == "manifest.csv:2: a.npz: itself says 'wood', not 'steel'"


def test_tables_of_anybody_are_channels_of_a_stated_kind(tables):
    source = FileRecordings(tables, kind="taxel", units="counts")
    assert source.hand.names == ("a", "b", "c")
    assert {(c.kind, c.adapting) for c in source.hand.channels} == {("taxel", "slow")}
    assert source.sample_rate_hz == RATE_HZ
    assert [str(name) for name in source.ids] == ["wood/0", "wood/1", "iron/0", "iron/1"]
    for place, name in enumerate(source.ids):
        read = source.load(name)
        assert torch.equal(read.samples, samples(place))
        assert read.provenance == {"simulated": False, "file": f"{place}.csv"}
        assert read.units == "counts"
    slip, quiet = map(source.timeline, IRON)
    assert (slip.slip_s, slip.non_slip_s) == (((0.0, 3.0),), ())
    assert (quiet.slip_s, quiet.non_slip_s) == ((), ((0.0, 3.0),))
    late = FileRecordings(tables, kind="PVDF", skip_s=0.5)
    assert late.hand.fast == (0, 1, 2)
    assert late.timeline(IRON[0]).slip_s == late.load(IRON[0]).slip_s == ((0.5, 3.0),)


def test_rows_of_channels_find_their_columns_by_name_or_by_place(tables):
    source = FileRecordings(tables, channels=rows_named("c", "a"))
    assert source.hand.names == ("c", "a")
    assert torch.equal(source.load(source.ids[0]).samples, samples(0)[[2, 0]])
    placed = FileRecordings(tables, channels=ROWS, reading={"channels": ["a", "b", "c"]})
    assert placed.hand == HAND
    assert torch.equal(placed.load(placed.ids[0]).samples, samples(0))
    refused(r"has the channels a, b, c, not the 2 of data\.channels", tables, channels=ROWS[:2])
    half = [*rows_named("c"), *ROWS[1:]]  # as many, but who knows which is which
    refused(r"has no channel PVDF1, PVDF2 of .*; it has a, b, c", tables, channels=half)
    said = r"0\.csv: has the channels a, b, c, not the 3 .* as reading\.channels"
    refused(said, tables, channels=ROWS)
    said = r"has the channels a, b, not the 3 of data\.channels"
    refused(said, tables, channels=ROWS, reading={"channels": ["a", "b"]})


def test_case_and_a_unit_make_no_other_name(tmp_path):
    table(tmp_path / "a.csv", samples(0), names=("t", "pvdf1 (mV)", "PVDF2[mV]", " Sg1 (a.u.)"))
    manifest(tmp_path, "a.csv,wood,0,,,slip")
    source = FileRecordings(tmp_path, channels=ROWS)
    assert torch.equal(source.load(source.ids[0]).samples, samples(0)[[2, 0, 1]])
    table(tmp_path / "a.csv", samples(0), names=("t", "sg1 (V)", "sg1 (mV)", "PVDF1"))
    refused(r"has no channel SG1, PVDF2 of data\.channels", tmp_path, channels=ROWS)


@pytest.mark.parametrize("name", ["slip", "is_slip", "Label", "material", "contact [0/1]"])
def test_a_column_that_may_be_the_label_is_no_channel_unless_said(tmp_path, name):
    table(tmp_path / "a.csv", samples(0), names=("t", "a", "b", name))
    manifest(tmp_path, "a.csv,wood,0,,,slip")
    assert repr(name) in refused(r"a\.csv: has a column .* as reading\.channels", tmp_path)
    for columns in (("a", "b"), ("a", name)):
        said = FileRecordings(tmp_path, reading={"channels": columns})
        assert said.hand.names == columns
    assert FileRecordings(tmp_path, channels=rows_named("b", "a")).hand.names == ("b", "a")


def test_columns_without_names_go_by_their_place(tmp_path):
    rows = np.column_stack([np.arange(600) / RATE_HZ, samples(0).numpy().T])
    np.savetxt(tmp_path / "a.csv", rows, delimiter=",", fmt="%.17g")
    manifest(tmp_path, "a.csv,wood,0,,,slip")
    source = FileRecordings(tmp_path, channels=ROWS)
    assert torch.equal(source.load(source.ids[0]).samples, samples(0))
    refused(r"has the channels 3 without names, not the 2 of", tmp_path, channels=ROWS[:2])


def test_samples_outside_the_windows_are_not_read(tables):
    source = FileRecordings(tables)
    read = source.load(source.ids[0], [(0.5, 1.0), (2.5, 3.0)]).samples
    wanted = torch.zeros(600, dtype=torch.bool)
    wanted[100:200] = wanted[500:600] = True
    assert torch.equal(read[:, wanted], samples(0)[:, wanted])
    assert read[:, ~wanted].isnan().all()


def test_materials_and_trials_can_be_chosen(tables):
    assert FileRecordings(tables, materials=["iron"]).ids == tuple(IRON)
    assert [str(r) for r in FileRecordings(tables, cycles=1).ids] == ["wood/0", "iron/0"]
    said = r"data\.materials steel; the set has wood, iron"
    refused(said, tables, materials=["steel", "iron"])
    refused(r"data\.cycles must be a number of trials or null, got 0", tables, cycles=0)


def test_one_simulated_file_makes_the_set_simulated(tmp_path):
    ours(tmp_path / "a.npz")
    ours(tmp_path / "b.npz", provenance={"simulated": True})
    manifest(tmp_path, "a.npz,wood,0,,,", "b.npz,wood,1,,,")
    assert FileRecordings(tmp_path).is_simulated is True
    assert FileRecordings(tmp_path, cycles=1).is_simulated is False


# Keys ----------------------------------------------------------------------------------------


def test_a_key_is_of_what_a_file_holds_and_how_it_is_read(tables):
    source = FileRecordings(tables)
    again = pickle.loads(pickle.dumps(source))  # sent to another process
    keys = [source.key(name) for name in source.ids]
    assert keys == [again.key(name) for name in again.ids]
    assert torch.equal(again.load(IRON[0]).samples, source.load(IRON[0]).samples)
    assert len({key["sha256"] for key in keys}) == 4
    assert keys[0]["sha256"] == hashlib.sha256((tables / "0.csv").read_bytes()).hexdigest()
    (tables / "0.csv").rename(tables / "zero.csv")
    manifest(tables, "zero.csv,steel,7,2.0,,")

    def key(**options):
        changed = FileRecordings(tables, **options)
        return changed.key(changed.ids[0])

    assert key() == keys[0]
    for options in (
        {"tare_s": [0.0, 1.0]},
        {"channels": rows_named(*"abc")},
        {"reading": {"time": None, "sample_rate_hz": 100.0, "channels": ["a", "b", "c"]}},
        {"gaps": "missing"},
    ):
        assert key(**options) != keys[0]
    with (tables / "zero.csv").open("a") as file:
        file.write("3.0,0,0,0\n")
    assert key() != keys[0]


def test_a_file_is_hashed_once_until_it_changes(tables, monkeypatch):
    hashed, whole = [], hashlib.file_digest

    def counted(file, how):
        hashed.append(file.name)
        return whole(file, how)

    monkeypatch.setattr(hashlib, "file_digest", counted)
    source = FileRecordings(tables)
    for _ in range(3):
        for name in source.ids:
            source.key(name)
    assert len(hashed) == 4
    os.utime(tables / "2.csv", ns=(1, 1))
    assert [source.key(name) for name in source.ids]
    assert hashed[4:] == [str(tables / "2.csv")]


def test_a_folder_has_a_digest_of_all_its_files(tmp_path):
    for place in ("one", "two", "three"):
        (tmp_path / place / "inner").mkdir(parents=True)
        (tmp_path / place / "a").write_text("a")
        (tmp_path / place / "inner" / "b").write_text("b" if place != "three" else "c")
    one, two, three = (file_digest(tmp_path / p) for p in ("one", "two", "three"))
    assert one == two != three
    (tmp_path / "two" / "a").rename(tmp_path / "two" / "c")
    assert file_digest(tmp_path / "two") != one


# Gaps, tares and rates -------------------------------------------------------------------------


def gappy(root, lost=((100, 104), (300, 360)), num_samples=600):
    """A table from which a logger lost samples; what it was."""
    content = samples(5, num_samples)
    kept = np.ones(num_samples, dtype=bool)
    for first, stop in lost:
        kept[first:stop] = False
    times = np.arange(num_samples) / RATE_HZ
    table(root / "gaps.csv", content[:, torch.from_numpy(kept)], times=times[kept])
    manifest(root, "gaps.csv,wood,0,,,non-slip")
    return content, torch.from_numpy(kept)


def test_gaps_are_refused_missing_or_bridged(tmp_path):
    content, kept = gappy(tmp_path)
    refused(r"64 samples are missing in 2 gaps, first 4 at 0\.5", tmp_path)
    source = FileRecordings(tmp_path, gaps="missing")
    (name,) = source.ids
    times = source.timeline(name)
    assert (times.duration_s, times.missing_s) == (3.0, ((0.5, 0.52), (1.5, 1.8)))
    read = source.load(name).samples
    assert torch.equal(read[:, kept], content[:, kept])
    assert read[:, ~kept].isnan().all()
    assert "gaps.csv: lacks 64 samples in 2 gaps, first at 0.5 s" in str(source.warnings[0])
    bridged = FileRecordings(tmp_path, gaps="bridge", bridge_ms=25.0)
    assert bridged.timeline(name).missing_s == ((1.5, 1.8),)
    read = bridged.load(name).samples
    assert torch.equal(read[:, kept], content[:, kept])
    line = torch.from_numpy(np.linspace(content[:, 99].numpy(), content[:, 104].numpy(), 6)).T
    assert torch.allclose(read[:, 99:105], line, atol=1e-12, rtol=0)
    assert read[:, 300:360].isnan().all()


def test_bins_that_need_missing_samples_are_left_out(tmp_path):
    gappy(tmp_path)
    reading = {"channels": ["a", "b", "c"]}
    source = FileRecordings(tmp_path, channels=ROWS, reading=reading, gaps="missing")
    pool = FeaturePool(HAND, RATE_HZ, bin_samples=20, level=2)
    maker = FeatureMaker(source, pool, ChannelFilter([5, 5, 5]), LabelRule(bin_ms=100.0))
    cut, bins = maker.filtered_bins(source.ids[0])
    assert cut.isfinite().all()
    assert 0 < len(bins.starts) < 30
    assert not bins.is_slip.any()


def test_the_mean_of_a_stretch_is_taken_off(tables):
    plain, tared = FileRecordings(tables), FileRecordings(tables, tare_s=[0.5, 1.5])
    name = plain.ids[0]
    whole, less = plain.load(name).samples, tared.load(name).samples
    assert torch.equal(less, whole - whole[:, 100:300].mean(-1, keepdim=True))
    part = tared.load(name, [(2.0, 2.5)]).samples
    assert torch.equal(part[:, 400:500], less[:, 400:500])
    refused(r"0\.csv: lasts 3 s, tare_s wants 4 s", tables, tare_s=[1.0, 4.0])


def test_what_is_missing_or_not_finite_is_no_part_of_a_tare(tmp_path):
    content, kept = gappy(tmp_path)
    source = FileRecordings(tmp_path, gaps="missing", tare_s=[1.4, 1.6])
    level = content[:, 280:300].mean(-1, keepdim=True)
    read = source.load(source.ids[0]).samples
    assert torch.allclose(read[:, kept], content[:, kept] - level, atol=1e-12, rtol=0)
    lost = FileRecordings(tmp_path, gaps="missing", tare_s=[1.55, 1.75], strict=False)
    assert "nothing is there to tare on" in lines_of(lost)[0]
    content = samples(0)
    content[1, 100:200] = torch.nan
    content[2, 110:190] = torch.inf
    table(tmp_path / "a.csv", content)
    manifest(tmp_path, "a.csv,wood,0,,,slip")
    source = FileRecordings(tmp_path, tare_s=[0.5, 1.0])
    said = r"a\.csv has nothing finite in its column 2 .* 0\.5 to 1 s"
    with pytest.raises(ValueError, match=said):
        source.load(source.ids[0])
    part = FileRecordings(tmp_path, tare_s=[0.25, 0.6])
    level = [content[0, 50:120].mean(), content[1, 50:100].mean(), content[2, 50:110].mean()]
    read = part.load(part.ids[0]).samples
    assert torch.allclose(read[:, 300:], content[:, 300:] - torch.tensor(level)[:, None].double())


def test_files_of_several_rates_are_brought_to_one(tmp_path):
    """A slow tone is the same tone at any rate."""
    for name, rate in (("a.csv", 200.0), ("b.csv", 500.0)):
        time_s = torch.arange(round(3 * rate), dtype=torch.float64) / rate
        table(tmp_path / name, torch.sin(2 * torch.pi * 3.0 * time_s).expand(3, -1), rate)
    manifest(tmp_path, "a.csv,wood,0,1.5,,", "b.csv,wood,1,1.5,,")
    refused(r"is of 500 Hz, manifest\.csv:2 .*data\.resample_hz", tmp_path)
    source = FileRecordings(tmp_path, resample_hz=100.0)
    assert source.sample_rate_hz == 100.0
    expected = torch.sin(2 * torch.pi * 3.0 * torch.arange(300, dtype=torch.float64) / 100.0)
    for name in source.ids:
        read = source.load(name)
        assert read.samples.shape == (3, 300)
        assert source.timeline(name).duration_s == read.duration_s == 3.0
        middle = slice(30, 270)
        assert torch.allclose(read.samples[:, middle], expected[middle].expand(3, -1), atol=5e-3)


def test_truth_follows_the_clock_of_the_file(tmp_path):
    """A logger that counts 199.5 Hz is taken as 200 Hz; its fifth second is not ours."""
    rates = (199.5, 199.6, 200.2)
    for place, rate in enumerate(rates):
        table(tmp_path / f"{place}.csv", samples(1, 1995), rate)
    manifest(tmp_path, *[f"{place}.csv,wood,{place},5.0,5.0-7.0," for place in range(3)])
    source = FileRecordings(tmp_path)
    assert source.sample_rate_hz == 200.0
    for name, rate in zip(source.ids, rates, strict=True):
        times = source.timeline(name)
        assert times.onsets_s[0] * 200.0 == pytest.approx(5.0 * rate, abs=1e-3)
        assert times.sliding_s[0][1] * 200.0 == pytest.approx(7.0 * rate, abs=1e-3)
        assert times.duration_s == 1995 / 200.0


def test_streams_of_a_file_are_channels_of_one_hand(tables):
    streams = {
        "one": {"reading": {"channels": ["a"]}, "kind": "SG"},
        "two": {"reading": {"channels": ["c", "b"]}, "kind": "PVDF"},
    }
    source = FileRecordings(tables, streams=streams)
    assert source.hand.names == ("one_a", "two_c", "two_b")
    assert (source.hand.slow, source.hand.fast) == ((0,), (1, 2))
    assert torch.equal(source.load(source.ids[0]).samples, samples(0)[[0, 2, 1]])
    rates = {
        name: {"reading": {"time": None, "channels": [column], "sample_rate_hz": rate}}
        for name, column, rate in (("one", "a", 200.0), ("two", "b", 198.0))
    }
    refused(r"one has 200 Hz, two has 198 Hz: resample_hz=", tables, streams=rates)
    both = FileRecordings(tables, streams=rates, resample_hz=50.0)
    assert both.load(both.ids[0]).samples.shape == (2, 150)  # as long as the shorter one
    rates["two"]["reading"]["sample_rate_hz"] = 100.0
    apart = FileRecordings(tables, streams=rates, resample_hz=50.0, strict=False)
    assert "its streams last 3 to 6 s; cut the longer" in lines_of(apart)[0]
    refused(r"a stream has reading, .* got colour", tables, streams={"one": {"colour": "red"}})


# What is wrong -------------------------------------------------------------------------------


def broken(root):
    """A set in which most is fine; what is wrong with the rest."""
    for place in range(4):
        table(root / f"{place}.csv", samples(place))
    table(root / "narrow.csv", samples(7, channels=2), names=("t", "a", "b"))
    table(root / "renamed.csv", samples(8), names=("t", "a", "x", "c"))
    table(root / "slow.csv", samples(9), 50.0)
    (root / "empty.csv").write_text("")
    (root / "words.csv").write_text("this is\nno table\n")
    manifest(
        root,
        "0.csv,wood,0,1.5,1.5-2.5,",
        "1.csv,wood,1,1.5,1.5-4.0,",
        "2.csv,iron,0,,,slip",
        "3.csv,iron,1,,,non-slip",
        "narrow.csv,iron,2,,,",
        "renamed.csv,iron,3,,,",
        "slow.csv,iron,4,,,",
        "empty.csv,iron,5,,,",
        "words.csv,iron,6,,,",
    )
    return [
        ("manifest.csv:9: empty.csv", ""),
        ("manifest.csv:10: words.csv", ""),
        ("manifest.csv:3: 1.csv", "sliding_s: 1.5-4 s leaves the recording of 3 s"),
        ("manifest.csv:6: narrow.csv", "has 2 channels, not 3 as in manifest.csv:2"),
        ("manifest.csv:7: renamed.csv", "has x as channel 2, not b as in manifest.csv:2"),
        ("manifest.csv:8: slow.csv", "is of 50 Hz, manifest.csv:2 and most others of 200 Hz"),
    ]


def test_every_file_that_differs_is_named_at_once_or_left_out(tmp_path, caplog):
    expected = broken(tmp_path)
    source = FileRecordings(tmp_path, strict=False)
    for line, (place, what) in zip(lines_of(source), expected, strict=True):
        assert line.startswith(f"{place}: ")
        assert what in line
        assert str(tmp_path) not in line
    assert [str(name) for name in source.ids] == ["wood/0", "iron/0", "iron/1"]
    assert "action=check" in refused(r"6 problems in .*narrow\.csv.*and 1 more", tmp_path)
    with caplog.at_level(logging.WARNING):
        skipped = FileRecordings(tmp_path, skip_failed=True)
    assert skipped.ids == source.ids
    said = [record.getMessage() for record in caplog.records]
    assert said == [f"left out: {line}" for line in lines_of(source)]
    text = (tmp_path / "manifest.csv").read_text()
    (tmp_path / "manifest.csv").write_text(text.replace("non-slip", "no idea"))
    refused(r"1 problem in .*label: must be slip", tmp_path, skip_failed=True)


def test_a_set_of_which_nothing_can_be_read_is_refused(tmp_path):
    (tmp_path / "a.csv").write_text("")
    manifest(tmp_path, "a.csv,wood,0,,,")
    said = r"no recording of .* is left: manifest\.csv:2: a\.csv"
    refused(said, tmp_path, skip_failed=True)
    nothing = FileRecordings(tmp_path, strict=False)
    assert nothing.ids == ()
    with pytest.raises(ValueError, match="can be read"):
        _ = nothing.hand


def test_units_kinds_and_rates_must_agree(tmp_path):
    for name in ("a", "b"):
        ours(tmp_path / f"{name}.npz")
    ours(tmp_path / "c.npz", units="mV")
    others = (replace(HAND.channels[0], finger="thumb"), *HAND.channels[1:])
    ours(tmp_path / "d.npz", hand=HandLayout(others))
    none = dict.fromkeys(("onsets_s", "annotated_onsets_s", "sliding_s", "speeds_mm_s"), ())
    ours(tmp_path / "e.npz", sample_rate_hz=400.0, **none)
    manifest(tmp_path, *(f"{name}.npz,wood,{place},,," for place, name in enumerate("abcde")))
    in_mv, of_another, at_400 = lines_of(FileRecordings(tmp_path, strict=False))
    assert "c.npz: is in mV, manifest.csv:2 and most others in V" in in_mv
    assert "d.npz: has SG1 of another kind or place" in of_another
    assert "e.npz: is of 400 Hz" in at_400
    manifest(tmp_path, "a.npz,wood,0,,,", "c.npz,wood,1,,,")  # most are more than half
    (line,) = lines_of(FileRecordings(tmp_path, strict=False))
    assert line.endswith("is in mV, manifest.csv:2 in V")


def test_what_is_worth_a_look_is_said(tables):
    manifest(tables, "0.csv,wood,0,,,", "1.csv,wood,1,0.5,0.5-1.5,")
    assert [str(w) for w in FileRecordings(tables).warnings] == [
        "manifest.csv:2: 0.csv: has no label, so no bin is taken from it",
        "manifest.csv:3: 1.csv: slips at 0.5 s already; labels=whole_slide takes the second before "
        "an onset",
    ]


def test_a_rate_that_nobody_says_is_asked_for(tmp_path):
    table(tmp_path / "a.csv", samples(0))
    manifest(tmp_path, "a.csv,wood,0,,,")
    said = r"no rate and has no times; give reading\.sample_rate_hz"
    refused(said, tmp_path, reading={"time": None})
    manifest(tmp_path, "a.csv,wood,250", columns="file,material,sample_rate_hz")
    assert FileRecordings(tmp_path, reading={"time": None}).sample_rate_hz == 250.0
    refused(r"its times are 200 Hz, but 250 Hz is stated", tmp_path)


@pytest.mark.parametrize(
    ("options", "line"),
    [
        ({"gaps": "ignore"}, r"data\.gaps must be one of refuse, missing, bridge"),
        ({"tare_s": [1.0, 0.5]}, r"data\.tare_s must be \[start, end\] in seconds"),
        ({"skip_s": -1.0}, r"data\.skip_s must be seconds from 0, got -1"),
        ({"slide_s": "long"}, r"data\.slide_s must be seconds from 0, got 'long'"),
        ({"bridge_ms": 0.0, "gaps": "bridge"}, r"data\.bridge_ms must be a positive number, got 0"),
        ({"bridge_ms": "abc"}, r"data\.bridge_ms must be a positive number, got 'abc'"),
        ({"tare_s": [0, "a"]}, r"data\.tare_s must be \[start, end\] in seconds, got \[0, 'a'\]"),
        ({"tare_s": 0.5}, r"data\.tare_s must be \[start, end\] in seconds, got 0\.5"),
        ({"tare_s": "ab"}, r"data\.tare_s must be \[start, end\] in seconds, got 'ab'"),
        ({"streams": 3}, r"data\.streams must be sets of channels by name, .* got 3"),
        ({"streams": {"a": 3}}, r"data\.streams must be sets of channels by name, .* got {'a': 3}"),
        ({"channels": 3}, r"data\.channels must be a list of rows of name, .* got 3"),
        ({"channels": ["a"]}, r"data\.channels must be a list of rows of name, .* got \['a'\]"),
        ({"reading": 3}, r"data\.reading must be what is said of files, got 3"),
        ({"reading": {"channels": 3}}, r"reading\.channels must be a list of columns, .* got 3"),
        ({"reading": {"channels": [[1]]}}, r"reading\.channels must be a list of columns"),
        ({"reading": {"time": [1]}}, r"reading\.time must be a name, a number or null, got \[1\]"),
        ({"reading": {"delimiter": 3}}, r"reading\.delimiter must be one character, got 3"),
        ({"reading": {"samples": 3}}, r"reading\.samples must be the name of a dataset"),
        ({"reading": {"time_first": "abc"}}, r"reading\.time_first must be true, false or null"),
        ({"resample_hz": 199.9999}, "is no ratio of whole numbers up to 50000"),
        ({"resample_hz": -5}, r"data\.resample_hz must be a positive number or null"),
        ({"reading": {"rate": 5}}, "reading must be of sample_rate_hz, time"),
        ({"reading": {"time_unit": "h"}}, r"reading\.time_unit must be one of s, ms, us, ns"),
        ({"adapting": "quick"}, "adapting must be slow or fast, got 'quick'"),
        ({"kind": "two words"}, "kind must be one word"),
        ({"channels": [{"name": "a"}]}, "channel row 1: expected name, kind, finger, segment"),
        ({"manifest": "other.csv"}, r"no manifest at .*other\.csv"),
    ],
)
def test_options_that_cannot_be_are_named(tables, options, line):
    refused(line, tables, **options)


def test_a_file_that_changed_since_is_refused(tables):
    source = FileRecordings(tables)
    table(tables / "0.csv", samples(0, 500))
    with pytest.raises(ValueError, match=r"0\.csv has changed since it was looked at; start again"):
        source.load(source.ids[0])
    (tables / "1.csv").unlink()
    with pytest.raises(FileNotFoundError, match=r"1\.csv"):
        source.load(source.ids[1])


# Slow files ----------------------------------------------------------------------------------


@pytest.fixture
def impatient(tmp_path_factory, monkeypatch):
    """Every file counts as slow; what they said is kept in a folder of the test's own."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
    monkeypatch.setattr(module, "_PATIENCE_S", 0.0)
    looked = []

    def counted(path, *rest):
        looked.append(path.name)
        return look(path, *rest)

    look = module.look
    monkeypatch.setattr(module, "look", counted)
    monkeypatch.setattr(module, "in_processes", lambda function, items, *_: map(function, items))
    return looked


def of_set(source):
    return [(source.parts(name)[0][1], source.timeline(name)) for name in source.ids]


def test_many_slow_files_are_looked_at_in_processes(tables, monkeypatch, tmp_path, capfd):
    whole = FileRecordings(tables)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(module, "_PATIENCE_S", 0.0)
    assert of_set(FileRecordings(tables)) == of_set(whole)
    assert re.search(r"looking at files .* 2/2", capfd.readouterr().err)


def test_slow_files_are_looked_at_once_until_they_change(tables, impatient):
    first = FileRecordings(tables)
    assert impatient == ["0.csv", "1.csv", "2.csv", "3.csv"]
    assert of_set(FileRecordings(tables)) == of_set(first)
    assert len(impatient) == 4
    FileRecordings(tables, reading={"channels": ["a"]})  # another way to read them
    assert len(impatient) == 8
    table(tables / "2.csv", samples(2, 400))
    changed = FileRecordings(tables)
    assert impatient[8:] == ["2.csv"]
    assert changed.timeline(RecordingId("iron", 0)).duration_s == 2.0


def test_what_files_of_ours_and_gaps_said_is_kept_to_the_bit(tmp_path, impatient):
    content, _ = gappy(tmp_path)
    ours(tmp_path / "a.npz", samples(3), provenance={"simulated": True, "seeds": [1, 2]})
    ours(tmp_path / "b.npz")
    manifest(tmp_path, "gaps.csv,wood,0,,,non-slip", "a.npz,wood,1,,,", "b.npz,wood,2,,,")
    options = {"gaps": "missing", "strict": False}
    first = FileRecordings(tmp_path, **options)
    again = FileRecordings(tmp_path, **options)
    assert len(impatient) == 3
    assert of_set(again) == of_set(first)
    assert [str(p) for p in again.problems] == [str(p) for p in first.problems]
    assert content.shape[1] == 600


def test_a_damaged_memory_is_none(tables, impatient):
    first = FileRecordings(tables)
    (memory,) = Path(os.environ["XDG_CACHE_HOME"]).rglob("*.json")
    for text in ("", "[1]", '{"0.csv": 5}', '{"0.csv": [[], []]}', "{" * 9, '"a"'):
        memory.write_text(text)
        assert of_set(FileRecordings(tables)) == of_set(first)
    shutil.rmtree(memory.parent)
    memory.parent.write_text("no folder")
    assert of_set(FileRecordings(tables)) == of_set(first)
