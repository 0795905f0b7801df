"""Folders of files as a source: what is read, what all must agree in, and what is said."""

import hashlib
import logging
import pickle
import re
from dataclasses import replace

import numpy as np
import pytest
import torch
from hydra.utils import instantiate
from test_commands import composed

from tactslip_torch.data.file_recordings import FileRecordings, _file_digest
from tactslip_torch.data.formats import named_format
from tactslip_torch.data.manifest import Listing
from tactslip_torch.data.public_sets import STEMS, authors_raw, named_recordings, nominal
from tactslip_torch.data.recording import Recording, RecordingId
from tactslip_torch.hand import Channel, HandLayout

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
UNTOLD = dict.fromkeys(("onsets_s", "annotated_onsets_s", "sliding_s", "speeds_mm_s"), ())


def samples(seed=0, num_samples=600, channels=3, dtype=torch.float64):
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(channels, num_samples, generator=generator, dtype=dtype)


def ours(path, content=None, hand=HAND, **changes):
    """A recording of ours in a file."""
    truth = (20.0,), (1.5,), ((1.5, 2.5),), (1.4,), ((0.0, 0.25),)
    facts = {"simulated": False, "operator": "A"}
    content = samples() if content is None else content
    made = replace(Recording(content, RATE_HZ, "wood", *truth, facts), **changes)
    named_format(path.suffix[1:]).save(path, made, hand, {})
    return made


def table(path, content, rate_hz=RATE_HZ, names=("t", "a", "b", "c"), times=None):
    """A table of anybody's: times and channels, with a header."""
    path.parent.mkdir(parents=True, exist_ok=True)
    times = np.arange(content.shape[1]) / rate_hz if times is None else times
    rows = np.column_stack([times, content.numpy().T])
    np.savetxt(path, rows, fmt="%.17g", delimiter=",", header=",".join(names), comments="")


def manifest(root, *lines, columns="file,material,trial,onsets_s,sliding_s,label"):
    (root / "manifest.csv").write_text("\n".join([columns, *lines]) + "\n")


def lines_of(source):
    return [str(problem) for problem in source.problems]


def first(source, windows=None):
    return source.load(source.ids[0], windows).samples


def rows_named(*names):
    """Rows of the hand's first channels under other names."""
    return [row | {"name": name} for row, name in zip(ROWS, names, strict=False)]


def refused(said, root, make=FileRecordings, **options):
    """The source says that, in one line."""
    with pytest.raises((ValueError, FileNotFoundError), match=said) as caught:
        make(root, **options)
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


@pytest.mark.parametrize(("ending", "dtype"), [("npz", torch.float64), ("csv", torch.float32)])
def test_files_of_ours_are_read_with_all_they_say(tmp_path, ending, dtype):
    made = ours(tmp_path / f"a.{ending}", samples(dtype=dtype))
    manifest(tmp_path, f"a.{ending},wood,4,,,")
    source = FileRecordings(tmp_path)
    assert source.ids == (RecordingId("wood", 4),)
    assert (source.hand, source.sample_rate_hz, source.units) == (HAND, RATE_HZ, "V")
    read, times = source.load(source.ids[0]), source.timeline(source.ids[0])
    assert read.samples.dtype == dtype
    assert torch.equal(read.samples, made.samples)
    for truth in TRUTH:
        assert getattr(read, truth) == getattr(times, truth) == getattr(made, truth)
    assert (read.provenance, read.units) == (made.provenance, made.units)
    manifest(tmp_path, f"a.{ending},steel,0,2.0,2.0-2.75,")  # has the word over the file
    source = FileRecordings(tmp_path)
    times = source.timeline(source.ids[0])
    assert (times.onsets_s, times.annotated_onsets_s, times.non_slip_s) == ((2.0,), (2.0,), ())
    said = f"manifest.csv:2: a.{ending}: itself says 'wood', not 'steel'"
    assert [str(warning) for warning in source.warnings] == [said]
    ours(tmp_path / "b.npz", provenance={"simulated": True})
    manifest(tmp_path, f"a.{ending},wood,0,,,", "b.npz,wood,1,,,")  # one makes the set simulated
    assert FileRecordings(tmp_path).is_simulated is True
    assert FileRecordings(tmp_path, cycles=1).is_simulated is False


def test_tables_of_anybody_are_channels_of_a_stated_kind(tables):
    source = FileRecordings(tables, kind="taxel", units="counts")
    assert source.hand.names == ("a", "b", "c")
    assert {(c.kind, c.adapting) for c in source.hand.channels} == {("taxel", "slow")}
    assert (source.sample_rate_hz, source.is_simulated) == (RATE_HZ, False)
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
    assert FileRecordings(tables, materials=["iron"]).ids == tuple(IRON)
    assert [str(r) for r in FileRecordings(tables, cycles=1).ids] == ["wood/0", "iron/0"]


def test_rows_of_channels_find_their_columns_by_name_or_by_place(tables):
    source = FileRecordings(tables, channels=rows_named("c", "a"))
    assert source.hand.names == ("c", "a")
    assert torch.equal(first(source), samples(0)[[2, 0]])
    placed = FileRecordings(tables, channels=ROWS, reading={"channels": ["a", "b", "c"]})
    assert placed.hand == HAND
    assert torch.equal(first(placed), samples(0))
    refused(r"has the channels a, b, c, not the 2 of data\.channels", tables, channels=ROWS[:2])
    half = [*rows_named("c"), *ROWS[1:]]  # as many, but who knows which is which
    refused(r"has no channel PVDF1, PVDF2 of .*; it has a, b, c", tables, channels=half)
    said = r"0\.csv: has the channels a, b, c, not the 3 .* as data\.reading\.channels"
    refused(said, tables, channels=ROWS)
    said = r"has the channels a, b, not the 3 of data\.channels"
    refused(said, tables, channels=ROWS, reading={"channels": ["a", "b"]})
    manifest(tables, "0.csv,wood,0,,,slip")  # case and a unit make no other name
    table(tables / "0.csv", samples(0), names=("t", "pvdf1 (mV)", "PVDF2[mV]", " Sg1 (a.u.)"))
    assert torch.equal(first(FileRecordings(tables, channels=ROWS)), samples(0)[[2, 0, 1]])
    table(tables / "0.csv", samples(0), names=("t", "sg1 (V)", "sg1 (mV)", "PVDF1"))
    refused(r"has no channel SG1, PVDF2 of data\.channels", tables, channels=ROWS)
    table(tables / "0.csv", samples(0), names=())
    assert torch.equal(first(FileRecordings(tables, channels=ROWS)), samples(0))
    refused(r"has the channels 3 without names, not the 2 of", tables, channels=ROWS[:2])


@pytest.mark.parametrize("name", ["slip", "Label", "contact [0/1]"])
def test_a_column_that_may_be_the_label_is_no_channel_unless_said(tmp_path, name):
    table(tmp_path / "a.csv", samples(0), names=("t", "a", "b", name))
    manifest(tmp_path, "a.csv,wood,0,,,slip")
    source = FileRecordings(tmp_path)
    assert source.hand.names == ("a", "b")
    assert f"taken for no channels, {name}; if they are" in str(source.warnings[0])
    asked = FileRecordings(tmp_path, channels=rows_named(name.partition(" ")[0], "a"))
    assert torch.equal(first(asked), samples(0)[[2, 0]])
    assert not asked.warnings
    for columns in (("a", "b"), ("a", name)):
        said = FileRecordings(tmp_path, reading={"channels": columns})
        assert said.hand.names == columns
    assert FileRecordings(tmp_path, channels=rows_named("b", "a")).hand.names == ("b", "a")


def test_many_files_keep_their_order(tmp_path):
    for place in range(18):
        table(tmp_path / f"{place}.csv", samples(place, 20))
    manifest(tmp_path, *(f"{place}.csv,wood,{place},,,slip" for place in range(18)))
    source = FileRecordings(tmp_path)
    assert [source.entry(name).file for name in source.ids] == [f"{n}.csv" for n in range(18)]


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
        {"reading": {"tare_s": [0.0, 1.0]}},
        {"channels": rows_named(*"abc")},
        {"reading": {"time": None, "sample_rate_hz": 100.0, "channels": ["a", "b", "c"]}},
        {"reading": {"gaps": "missing"}},
    ):
        assert key(**options) != keys[0]
    with (tables / "zero.csv").open("a") as file:
        file.write("3.0,0,0,0\n")
    assert key() != keys[0]


def test_a_folder_is_hashed_by_all_its_files(tmp_path):
    for place, content in (("one", "b"), ("two", "b"), ("three", "c")):
        (tmp_path / place / "inner").mkdir(parents=True)
        (tmp_path / place / "a").write_text("a")
        (tmp_path / place / "inner" / "b").write_text(content)
    one, two, three = (_file_digest(tmp_path / p) for p in ("one", "two", "three"))
    assert one == two != three
    (tmp_path / "two" / "a").rename(tmp_path / "two" / "c")
    assert _file_digest(tmp_path / "two") != one


# Gaps, tares and rates -------------------------------------------------------------------------


def gappy(root, lost=((100, 104), (300, 360)), num_samples=600):
    """A table from which a logger lost samples; what it was."""
    content = samples(5, num_samples)
    kept = np.ones(num_samples, dtype=bool)
    for start, stop in lost:
        kept[start:stop] = False
    times = np.arange(num_samples) / RATE_HZ
    table(root / "gaps.csv", content[:, torch.from_numpy(kept)], times=times[kept])
    manifest(root, "gaps.csv,wood,0,,,non-slip")
    return content, torch.from_numpy(kept)


def test_gaps_are_refused_missing_or_bridged(tmp_path):
    content, kept = gappy(tmp_path)
    said = r"64 samples are missing in 2 gaps, first 4 at 0\.5.* set data\.reading\.gaps=missing"
    refused(said, tmp_path)
    source = FileRecordings(tmp_path, reading={"gaps": "missing"})
    times = source.timeline(source.ids[0])
    assert (times.duration_s, times.missing_s) == (3.0, ((0.5, 0.52), (1.5, 1.8)))
    assert torch.equal(first(source)[:, kept], content[:, kept])
    assert first(source)[:, ~kept].isnan().all()
    assert "gaps.csv: 64 samples are missing in 2 gaps, first 4 at" in str(source.warnings[0])
    bridged = FileRecordings(tmp_path, reading={"gaps": "bridge", "bridge_ms": 25.0})
    assert bridged.timeline(source.ids[0]).missing_s == ((1.5, 1.8),)
    read = first(bridged)
    assert torch.equal(read[:, kept], content[:, kept])
    line = torch.from_numpy(np.linspace(content[:, 99].numpy(), content[:, 104].numpy(), 6)).T
    assert torch.allclose(read[:, 99:105], line, atol=1e-12, rtol=0)
    assert read[:, 300:360].isnan().all()
    part = first(bridged, [(0.4, 0.51), (1.7, 2.0)])
    assert torch.equal(part[:, 80:102], read[:, 80:102])
    assert torch.equal(part[:, 360:400], read[:, 360:400])


def test_the_mean_of_a_stretch_is_taken_off_without_what_is_missing_there(tables):
    whole = first(FileRecordings(tables))
    tared = FileRecordings(tables, reading={"tare_s": [0.5, 1.5]})
    assert torch.equal(first(tared), whole - whole[:, 100:300].mean(-1, keepdim=True))
    part = first(tared, [(0.5, 1.0), (2.5, 3.0)])  # of the rest nothing is read
    assert torch.equal(part[:, 500:600], first(tared)[:, 500:600])
    assert part[:, 200:500].isnan().all()
    refused(r"0\.csv: lasts 3 s, tare_s wants 4 s", tables, reading={"tare_s": [1.0, 4.0]})
    content, kept = gappy(tables)
    read = first(FileRecordings(tables, reading={"gaps": "missing", "tare_s": [1.4, 1.6]}))
    level = content[:, 280:300].mean(-1, keepdim=True)
    assert torch.allclose(read[:, kept], content[:, kept] - level, atol=1e-12, rtol=0)
    how = {"gaps": "missing", "tare_s": [1.55, 1.75]}
    lost = FileRecordings(tables, reading=how, strict=False)
    assert "nothing is there to tare on" in lines_of(lost)[0]
    content[1, 100:] = torch.nan
    table(tables / "0.csv", content)
    manifest(tables, "0.csv,wood,0,,,slip")
    how = {"gaps": "missing", "tare_s": [0.5, 1.0]}
    refused(r"0\.csv: nothing is there to tare on from 0\.5 to 1 s", tables, reading=how)


def test_files_of_several_rates_are_brought_to_one(tmp_path):
    """A slow tone is the same tone at any rate."""
    for name, rate in (("a.csv", 200.0), ("b.csv", 500.0)):
        time_s = torch.arange(round(3 * rate), dtype=torch.float64) / rate
        table(tmp_path / name, torch.sin(2 * torch.pi * 3.0 * time_s).expand(3, -1), rate)
    manifest(tmp_path, "a.csv,wood,0,1.5,,", "b.csv,wood,1,1.5,,")
    refused(r"is of 500 Hz, manifest\.csv:2 .*resample_hz", tmp_path)
    source = FileRecordings(tmp_path, reading={"resample_hz": 100.0})
    assert source.sample_rate_hz == 100.0
    expected = torch.sin(2 * torch.pi * 3.0 * torch.arange(300, dtype=torch.float64) / 100.0)
    for name in source.ids:
        read = source.load(name)
        assert read.samples.shape == (3, 300)
        assert source.timeline(name).duration_s == read.duration_s == 3.0
        middle = slice(30, 270)
        assert torch.allclose(read.samples[:, middle], expected[middle].expand(3, -1), atol=5e-3)


def test_a_rate_that_time_stamps_show_but_for_rounding_is_resampled_as_it_is_meant(tmp_path):
    table(tmp_path / "A_1.csv", samples(1, 480), times=np.arange(480) / 48)
    table(tmp_path / "A_2.csv", samples(2, 240), times=np.arange(240) / 23.9999968)
    manifest(tmp_path, "A_1.csv,A,1,2,,", "A_2.csv,A,2,2,,")
    source = FileRecordings(tmp_path, reading={"resample_hz": 48.0})
    assert [source.load(one).samples.shape[1] for one in source.ids] == [480, 480]


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


# Samples that are not finite ------------------------------------------------------------------


def broken_cells(root):
    """A table with two short runs of empty cells in b, and a long one in c."""
    content = samples(5)
    content[1, 100:103] = torch.nan
    content[1, 0:2] = torch.nan  # nothing to bridge from
    content[2, 300:340] = torch.inf
    table(root / "a.csv", content)
    manifest(root, "a.csv,wood,0,,,non-slip")
    return content


def test_samples_that_are_not_finite_are_like_a_gap(tmp_path):
    content = broken_cells(tmp_path)
    said = r"a\.csv: b \(and 1 more channel\) is not finite in 5 samples, first at 0\.0000 s; set "
    refused(said + r"data\.reading\.gaps=missing to leave out", tmp_path)
    source = FileRecordings(tmp_path, reading={"gaps": "missing"})
    lost = ((0.0, 0.01), (0.5, 0.515), (1.5, 1.7))
    assert source.timeline(source.ids[0]).missing_s == lost
    assert "b (and 1 more channel) is not finite in 5" in str(source.warnings[0])
    bridged = FileRecordings(tmp_path, reading={"gaps": "bridge", "bridge_ms": 15.0})
    assert bridged.timeline(source.ids[0]).missing_s == (lost[0], lost[2])
    read = first(bridged)
    line = torch.from_numpy(np.linspace(content[1, 99].item(), content[1, 103].item(), 5))
    assert torch.allclose(read[1, 99:104], line, atol=1e-12, rtol=0)
    assert torch.equal(read[0], content[0])
    assert torch.equal(read[1, 2:100], content[1, 2:100])


def test_what_a_manifest_leaves_out_need_not_be_there(tmp_path):
    broken_cells(tmp_path)
    columns = "file,material,label,missing_s"
    manifest(tmp_path, "a.csv,wood,slip,0-0.01; 0.5-0.515; 1.4-1.7", columns=columns)
    assert len(FileRecordings(tmp_path).timeline(RecordingId("wood", 0)).missing_s) == 4
    manifest(tmp_path, "a.csv,wood,slip,0-0.01; 0.5-0.515; 1.4-1.6", columns=columns)
    refused("is not finite", tmp_path)


def test_a_gap_beside_an_empty_cell_is_one_that_is_too_long_to_bridge(tmp_path):
    content, kept = gappy(tmp_path, lost=((100, 104),))
    content[0, 104] = torch.nan
    times = (np.arange(600) / RATE_HZ)[kept.numpy()]
    table(tmp_path / "gaps.csv", content[:, kept], times=times)
    source = FileRecordings(tmp_path, reading={"gaps": "bridge", "bridge_ms": 20.0})
    read, (lost,) = first(source), source.timeline(source.ids[0]).missing_s
    assert lost == pytest.approx((0.5, 0.525))
    assert read[0, 100:105].isnan().all()  # five samples, where four are bridged
    assert read[1:].isfinite().all()


# Rows of several samples ----------------------------------------------------------------------


def in_rows(path, order, names=True):
    """Two channels of 600 samples at 300 Hz, three a row, with a gap of two rows."""
    content = samples(2)[:2]
    cube = content.reshape(2, 200, 3)  # channel, row, place in the row
    by_channel = order == "channel"
    columns = cube.permute(*((0, 2, 1) if by_channel else (2, 0, 1))).reshape(6, 200)
    places = [(c, k) for c in "ab" for k in range(3)]
    places.sort(key=lambda place: place if by_channel else place[::-1])
    called = [f"{c}_{k}" for c, k in places] if names else list("uvwxyz")
    times = np.arange(200) / 100.0
    times[150:] += 0.02
    table(path, columns, names=("t", *called), times=times)
    return content


@pytest.mark.parametrize("order", ["channel", "time"])
@pytest.mark.parametrize("names", [True, False])
def test_a_row_may_hold_several_samples_of_each_channel(tmp_path, order, names):
    content = in_rows(tmp_path / "a.csv", order, names)
    manifest(tmp_path, "a.csv,wood,0,,,slip")
    reading = {"samples_per_row": 3, "row_order": None if names else order}
    source = FileRecordings(tmp_path, reading=reading | {"gaps": "missing"})
    assert source.sample_rate_hz == 300.0
    assert source.hand.names == (("a", "b") if names else ("ch1", "ch2"))
    assert source.timeline(source.ids[0]).missing_s[0] == pytest.approx((1.5, 1.52))
    read = first(source)
    assert read.shape == (2, 606)
    assert bool(read[:, 450:456].isnan().all())
    assert torch.equal(torch.cat([read[:, :450], read[:, 456:]], 1), content)
    part = source.load(source.ids[0], [(0.1, 0.25)]).samples  # begins and ends within a row
    assert torch.equal(part[:, 31:75], content[:, 31:75])
    stated = reading | {"time": None, "channels": list(range(1, 7)), "sample_rate_hz": 300.0}
    assert FileRecordings(tmp_path, reading=stated).sample_rate_hz == 300.0


def test_rows_that_do_not_show_their_samples_are_refused(tmp_path):
    in_rows(tmp_path / "a.csv", "channel", names=False)
    manifest(tmp_path, "a.csv,wood,0,,,slip")
    refused("6 columns of samples, which is no multiple", tmp_path, reading={"samples_per_row": 4})
    refused(r"say data\.reading\.row_order=channel", tmp_path, reading={"samples_per_row": 3})
    refused(r"samples_per_row must be a positive", tmp_path, reading={"samples_per_row": 0})
    refused(r"row_order must be one of channel, time", tmp_path, reading={"row_order": "x"})


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
        ("manifest.csv:3: 1.csv", "sliding_s: 1.5-4 s leaves the recording of 3 s"),
        ("manifest.csv:6: narrow.csv", "has 2 channels, not 3 as in manifest.csv:2"),
        ("manifest.csv:7: renamed.csv", "has x as channel 2, not b as in manifest.csv:2"),
        ("manifest.csv:8: slow.csv", "is of 50 Hz, manifest.csv:2 of 200 Hz"),
        ("manifest.csv:9: empty.csv", ""),
        ("manifest.csv:10: words.csv", ""),
    ]


def test_every_file_that_differs_is_named_at_once_or_left_out(tmp_path, caplog):
    expected = broken(tmp_path)
    source = FileRecordings(tmp_path, strict=False)
    for line, (place, what) in zip(lines_of(source), expected, strict=True):
        assert line.startswith(f"{place}: ")
        assert what in line
        assert str(tmp_path) not in line
    assert [str(name) for name in source.ids] == ["wood/0", "iron/0", "iron/1"]
    assert "action=check" in refused(r"manifest\.csv:3: 1\.csv: .* 6 problems", tmp_path)
    with caplog.at_level(logging.WARNING):
        skipped = FileRecordings(tmp_path, skip_failed=True)
    assert skipped.ids == source.ids
    said = [record.getMessage() for record in caplog.records]
    assert said == [f"left out: {line}" for line in lines_of(source)]
    text = (tmp_path / "manifest.csv").read_text()
    (tmp_path / "manifest.csv").write_text(text.replace("non-slip", "no idea"))
    refused(r"label: must be slip", tmp_path, skip_failed=True)


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
    ours(tmp_path / "e.npz", sample_rate_hz=400.0, **UNTOLD)
    manifest(tmp_path, *(f"{name}.npz,wood,{place},,," for place, name in enumerate("abcde")))
    in_mv, of_another, at_400 = lines_of(FileRecordings(tmp_path, strict=False))
    assert "c.npz: is in mV, manifest.csv:2 in V" in in_mv
    assert "d.npz: has SG1 of another kind or place" in of_another
    assert "e.npz: is of 400 Hz" in at_400
    manifest(tmp_path, "a.npz,wood,0,,,", "c.npz,wood,1,,,")  # most are more than half
    (line,) = lines_of(FileRecordings(tmp_path, strict=False))
    assert line.endswith("is in mV, manifest.csv:2 in V")


def test_what_is_worth_a_look_is_said(tables):
    manifest(tables, "0.csv,wood,0,,,", "1.csv,wood,1,0.5,0.5-1.5,")
    assert [str(w) for w in FileRecordings(tables).warnings] == [
        "manifest.csv:2: 0.csv: has no label, so no bin is taken from it",
        "manifest.csv:3: 1.csv: slips at 0.5 s already; labels=whole_slide takes as non-slip the "
        "second before an onset, as far as it was recorded",
    ]


def test_a_rate_that_nobody_says_is_asked_for(tmp_path):
    table(tmp_path / "a.csv", samples(0))
    manifest(tmp_path, "a.csv,wood,0,,,")
    said = r"no rate and has no times; give data\.reading\.sample_rate_hz"
    refused(said, tmp_path, reading={"time": None})
    manifest(tmp_path, "a.csv,wood,250.00003", columns="file,material,sample_rate_hz")
    assert FileRecordings(tmp_path, reading={"time": None}).sample_rate_hz == 250.0
    refused(r"its times are 200 Hz, but 250 Hz is stated", tmp_path)


@pytest.mark.parametrize(
    ("rate", "is_read"), [(0.5, False), (1.0, True), (1e6, True), (2e6, False)]
)
def test_a_rate_that_no_sensor_has_is_asked_for(tmp_path, rate, is_read):
    table(tmp_path / "a.csv", samples(0, 50), rate)
    manifest(tmp_path, "a.csv,wood,0,,,slip")
    if is_read:
        assert FileRecordings(tmp_path).sample_rate_hz == rate
    else:
        said = re.escape(f"a.csv: is of {rate:g} Hz; tactile sensors have 1 Hz to 1 MHz:")
        refused(f"{said} .* say data.reading.time_unit=", tmp_path)


REFUSED = [
    ({"materials": ["steel", "iron"]}, r"data\.materials steel; the set has wood, iron"),
    ({"materials": []}, r"data\.materials is empty; the set has wood, iron"),
    ({"manifest": Listing(())}, "no recording of .* is listed; list one or more"),
    ({"cycles": 0}, r"data\.cycles must be a number of trials or null, got 0"),
    ({"reading": {"gaps": "ignore"}}, r"reading\.gaps must be one of refuse, missing, bridge"),
    ({"reading": {"tare_s": [1.0, 0.5]}}, r"reading\.tare_s must be \[start, end\] in seconds"),
    ({"slide_s": "long"}, r"data\.slide_s must be a finite number .*, got 'long'"),
    ({"reading": {"bridge_ms": 0.0}}, r"reading\.bridge_ms must be a positive finite .* 0"),
    ({"channels": 3}, r"data\.channels must be a list of rows of name, .* got 3"),
    ({"channels": ["a"]}, r"data\.channels must be a list of rows of name, .* got \['a'\]"),
    ({"reading": 3}, "reading must be of sample_rate_hz, time"),
    ({"reading": {"rate": 5}}, "reading must be of sample_rate_hz, time"),
    ({"reading": {"channels": 3}}, r"reading\.channels must be a list of columns, .* got 3"),
    ({"reading": {"channels": ["a", "a"]}}, r"reading\.channels names a column twice"),
    ({"reading": {"time_unit": "h"}}, r"reading\.time_unit must be one of s, ms, us, ns"),
    ({"reading": {"resample_hz": 199.9999}}, "is no ratio of whole numbers up to 50000"),
    ({"adapting": "quick"}, "adapting must be slow or fast, got 'quick'"),
    ({"channels": [{"name": "a"}]}, "channel row 1: expected name, kind"),
    ({"manifest": "other.csv"}, r"no manifest at .*other\.csv"),
]


@pytest.mark.parametrize(("options", "line"), REFUSED)
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


# Files whose names say what they are -------------------------------------------------------------

NAMED = {
    "pattern": "{scene:n|t}/{material}{trial}",
    "labels": {"n": "slip", "t": "non-slip"},
    "rename": {"caze": "case"},
    "reading": {"sample_rate_hz": 100.0, "time": None},
    "skip_s": 0.5,
}


@pytest.fixture
def folder(tmp_path):
    for seed, name in enumerate(["n/pen0", "n/pen7", "n/caze1", "t/pen0", "t/case1", ".x/n/pen3"]):
        table(tmp_path / f"set/{name}.csv", samples(seed, 150))
    (tmp_path / "set" / "README.md").write_text("not one of them")
    (tmp_path / "linked" / "n").mkdir(parents=True)
    (tmp_path / "linked" / "n" / "pen9.csv").symlink_to(tmp_path / "set" / "n" / "pen0.csv")
    return tmp_path / "set"


def test_paths_say_what_recordings_are(folder):
    found = named_recordings(folder, **NAMED)
    slips = [RecordingId("case", 1, "n"), RecordingId("pen", 0, "n"), RecordingId("pen", 7, "n")]
    touches = [RecordingId("case", 1, "t"), RecordingId("pen", 0, "t")]
    assert set(found.ids) == {*slips, *touches}
    assert found.entry(slips[0]).file == "n/caze1.csv"
    assert {found.timeline(name).slip_s for name in slips} == {((0.5, 1.5),)}
    assert {found.timeline(name).non_slip_s for name in touches} == {((0.5, 1.5),)}
    lines = ["file,material,trial,onsets_s", "n/pen0.csv,pen,0,0.75"]  # tells what names do not
    (folder / "onsets.csv").write_text("\n".join(lines))
    found = named_recordings(folder, **NAMED, manifest="onsets.csv", slide_s=0.5)
    told, other = map(found.timeline, slips[1:])
    assert (told.onsets_s, told.slip_s) == ((0.75,), ())
    assert (other.onsets_s, other.slip_s) == ((), ((0.5, 1.5),))


@pytest.mark.parametrize("form", ["{label}_{material}_{n}", "{label}/{material}_{n}"])
@pytest.mark.parametrize("words", [("slip", "noslip"), ("Slip", "stick")])
def test_names_that_are_read_by_themselves_have_their_labels(tmp_path, form, words):
    for label in words:
        for material in ("cup", "box", "can"):
            for n in (1, 2):
                name = form.format(label=label, material=material, n=n)
                table(tmp_path / f"{name}.csv", samples(n))
    found = named_recordings(tmp_path, pattern="auto")
    assert {one.material for one in found.ids} == {"cup", "box", "can"}
    assert {one.scene for one in found.ids} == {RecordingId.scene}
    for one in found.ids:
        is_slip = found.entry(one).file.startswith(words[0])
        times = found.timeline(one)
        assert (bool(times.slip_s), bool(times.non_slip_s)) == (is_slip, not is_slip)


def test_a_trial_of_each_session_is_a_recording_of_its_own(folder):
    pattern = "{session}/{material:pen}{trial}"
    found = named_recordings(folder, pattern=pattern, reading=NAMED["reading"])
    expected = [(0, "n"), (7, "n"), (0, "t")]
    assert set(found.ids) == {RecordingId("pen", trial, session=day) for trial, day in expected}


UNSAID = [
    ({"root": "../linked"}, r"n/pen9.csv: is a link out of the folder"),
    ({"pattern": "{scene}"}, r"data.pattern must name \{material\}, got"),
    ({"pattern": "{material}{thing}"}, "pattern must name each of"),
    ({"pattern": "{trial:c}{material}1"}, "trial 'c' is no number"),
    ({"pattern": "{material}.{trial}.x"}, "no file in .* has a path that matches"),
    ({"labels": {"n": "slips"}}, "data.labels must be of slip and non-slip, got 'slips'"),
    ({"labels": {"n": "slip"}}, r"t/case1.csv: 't' is none of data.labels: n .*2 problems"),
    (
        {"pattern": "{material}{trial}", "labels": None},
        "trial 1 of case, scene paper, was listed in n/caze1.csv",
    ),
]


@pytest.mark.parametrize(("options", "said"), UNSAID)
def test_what_names_do_not_say_is_said_in_a_line(folder, options, said):
    given = {"root": "", **NAMED, **options}
    refused(said, folder / given.pop("root"), named_recordings, **given)


# The authors' own files --------------------------------------------------------------------------

SHORT = {"speeds_mm_s": [100.0, 200.0], "distance_mm": 100.0, "pause_s": 1.2}
"""Strokes at 1.2 s and 3.4 s, of a second and of half a second."""


def authors(path, seed=0, num_channels=24):
    """A table as the authors' is said to be: times and channels, no header, tabs; what it holds."""
    path.parent.mkdir(parents=True, exist_ok=True)
    volts = np.round(np.random.default_rng(seed).normal(0.0, 0.05, (800, num_channels)), 6)
    rows = np.column_stack([np.arange(800) / 200, volts])
    np.savetxt(path, rows, fmt="%.6f", delimiter="\t")
    return volts.T


def test_the_authors_files_are_the_papers_hand_and_protocol(tmp_path):
    for seed, stem in enumerate(STEMS):
        volts = authors(tmp_path / f"{stem}-slip{seed + 1}.txt", seed)
    authors(tmp_path / "more" / "ABS-Slip12.TXT")
    for name in ("notes.txt", "abs-slip.txt", ".abs-slip4.txt", "abs_slip5.txt"):
        (tmp_path / name).write_text("")
    short = [f"data.{name}={value}" for name, value in SHORT.items()]
    source = instantiate(composed("data=authors_raw", f"data.root={tmp_path}", *short).data)
    named = {(recording.material, recording.cycle) for recording in source.ids}
    assert named == {("M1", 12), *zip(STEMS.values(), range(1, 11), strict=True)}
    assert (source.hand, source.sample_rate_hz) == (HandLayout.paper24(), 200.0)
    assert source.is_simulated is False
    read = source.load(RecordingId("wood", 10))
    assert np.array_equal(read.samples.double().numpy(), volts)
    assert read.onsets_s == pytest.approx((1.2, 3.4))
    assert np.ravel(read.sliding_s) == pytest.approx([1.2, 2.2, 3.4, 3.9])
    assert read.speeds_mm_s == (100.0, 200.0)
    paper = nominal((20.0, 40.0, 60.0), 100.0, 2.0)
    assert (paper.onsets_s, paper.speeds_mm_s) == ((2.0, 9.0, 13.5), (20.0, 40.0, 60.0))
    assert [end - start for start, end in paper.sliding_s] == pytest.approx([5, 2.5, 5 / 3])


def test_what_is_wrong_with_the_authors_names(tmp_path):
    refused(r"data\.speeds_mm_s, .* must be positive", tmp_path, authors_raw, speeds_mm_s=[20, 0])
    for name in ("a/abs-slip1.txt", "b/abs-slip01.txt", "wod-slip1.txt", "glass-slip1.txt"):
        authors(tmp_path / name)
    twice, glass, wod = sorted(lines_of(authors_raw(tmp_path, **SHORT, strict=False)))
    assert twice == "b/abs-slip01.txt: trial 1 of M1, scene paper, was listed in a/abs-slip1.txt"
    for line, file in ((glass, "glass"), (wod, "wod")):
        assert line.startswith(f"{file}-slip1.txt: its name begins with none of abs, lb, ")
    (tmp_path / "one").mkdir()
    authors(tmp_path / "one" / "abs-slip1.txt", num_channels=23)
    refused(r"not the 24 of data\.channels", tmp_path / "one", authors_raw, **SHORT)
