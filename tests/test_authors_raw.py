"""The authors' own files, if they come: names, times, protocol, and the paper's experiment."""

import json

import numpy as np
import pytest
import torch
from test_commands import composed

from tactslip_torch.commands.train import train
from tactslip_torch.data.manifest import Truth, read_manifest
from tactslip_torch.data.public_sets import (
    STEMS,
    authors_raw,
    better_told,
    named_files,
    nominal,
)
from tactslip_torch.data.recording import RecordingId
from tactslip_torch.hand import HandLayout

PROTOCOL = nominal((20.0, 40.0, 60.0), 100.0, 2.0)
SHORT = {"speeds_mm_s": [100.0, 200.0], "distance_mm": 100.0, "pause_s": 1.2}
"""Strokes at 1.2 s and 3.4 s, of a second and of half a second: small files."""
SHORT_S = 4.0


def written(path, seed, duration_s=SHORT_S, num_channels=24, slides=((1.2, 2.2), (3.4, 3.9))):
    """A table as the authors' is said to be: times and channels, no header, tabs; what it holds."""
    path.parent.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(seed)
    time_s = np.arange(round(duration_s * 2000)) / 2000
    volts = rng.normal(0.0, 0.05, (len(time_s), num_channels))
    for start, end in slides:
        volts[(time_s >= start) & (time_s < end)] *= 1.4
    np.savetxt(path, np.column_stack([time_s, volts]), fmt="%.6f", delimiter="\t")
    return np.round(volts, 6).T


def empty(root, *names):
    for name in names:
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text("")


# Names ---------------------------------------------------------------------------------------


def test_names_say_material_and_trial(tmp_path):
    empty(tmp_path, *(f"{stem}-slip{trial}.txt" for stem in STEMS for trial in (1, 2, 12)))
    empty(tmp_path, "notes.txt", "abs-slip.txt", "abs-slip3.mat", ".abs-slip4.txt", "abs_slip5.txt")
    found = named_files(tmp_path, STEMS, PROTOCOL)
    assert found.problems == ()
    assert [(e.recording.material, e.recording.cycle) for e in found.entries] == [
        (material, trial) for material in STEMS.values() for trial in (1, 2, 12)
    ]
    by_name = {entry.recording: entry.file for entry in found.entries}
    assert by_name[RecordingId("M2", 1)] == "lb-slip1.txt"  # not bxlb
    assert by_name[RecordingId("M3", 1)] == "bxlb-slip1.txt"
    assert by_name[RecordingId("cloth", 12)] == "bj-slip12.txt"
    assert all(entry.truth == PROTOCOL for entry in found.entries)


def test_folders_and_other_capitals_are_taken(tmp_path):
    empty(tmp_path, "seen/ABS-Slip1.TXT", "unseen/iron-slip01.txt", ".hidden/abs-slip2.txt")
    found = named_files(tmp_path, STEMS, PROTOCOL)
    assert [(str(e.recording), e.file) for e in found.entries] == [
        ("M1/1", "seen/ABS-Slip1.TXT"),
        ("iron/1", "unseen/iron-slip01.txt"),
    ]


def test_every_name_that_cannot_be_is_listed(tmp_path):
    empty(tmp_path, "a/abs-slip1.txt", "b/abs-slip01.txt", "wod-slip1.txt", "glass-slip1.txt")
    (tmp_path.parent / "outside.txt").write_text("")
    (tmp_path / "Cu-slip1.txt").symlink_to(tmp_path.parent / "outside.txt")
    found = [str(problem) for problem in named_files(tmp_path, STEMS, PROTOCOL).problems]
    begins = ", ".join(STEMS)
    assert found == [
        "Cu-slip1.txt: is a link out of the folder; copy it there",
        "b/abs-slip01.txt: is trial 1 of M1, as a/abs-slip1.txt is",
        f"glass-slip1.txt: its name begins with none of {begins}; data.stems names more",
        f"wod-slip1.txt: its name begins with none of {begins}; did you mean 'wood'?; data.stems "
        "names more",
    ]


def test_a_folder_without_any_says_what_names_are_wanted(tmp_path):
    with pytest.raises(ValueError, match=r"named as the authors' are, such as abs-slip1\.txt"):
        authors_raw(tmp_path)
    with pytest.raises(FileNotFoundError, match="no folder at"):
        authors_raw(tmp_path / "nowhere")


# The protocol --------------------------------------------------------------------------------


def test_the_nominal_protocol_is_the_papers():
    assert PROTOCOL.onsets_s == (2.0, 9.0, 13.5)
    assert PROTOCOL.speeds_mm_s == (20.0, 40.0, 60.0)
    assert [end - start for start, end in PROTOCOL.sliding_s] == pytest.approx([5, 2.5, 5 / 3])
    with pytest.raises(ValueError, match=r"data\.speeds_mm_s, .* must be positive, got \[20\.0, 0"):
        nominal((20.0, 0.0), 100.0, 2.0)


def test_a_file_is_the_papers_hand_at_the_rate_of_its_times(tmp_path):
    volts = written(tmp_path / "ypz-slip7.txt", 0)
    source = authors_raw(tmp_path, **SHORT)
    (name,) = source.ids
    assert name == RecordingId("M4", 7)
    assert source.hand == HandLayout.paper24()
    assert source.sample_rate_hz == 2000.0
    assert source.is_simulated is False
    read = source.load(name)
    assert np.array_equal(read.samples.double().numpy(), volts)
    assert read.onsets_s == pytest.approx((1.2, 3.4))
    assert np.array(read.sliding_s) == pytest.approx(np.array([(1.2, 2.2), (3.4, 3.9)]))
    assert read.speeds_mm_s == (100.0, 200.0)


def test_a_slide_that_a_file_does_not_hold_to_the_end_is_cut(tmp_path):
    written(tmp_path / "abs-slip1.txt", 0, duration_s=3.6)
    written(tmp_path / "abs-slip2.txt", 0, duration_s=3.0)
    source = authors_raw(tmp_path, **SHORT, strict=False)
    (name,) = source.ids
    assert source.timeline(name).sliding_s[1] == pytest.approx((3.4, 3.6))
    assert [str(problem) for problem in source.problems] == [
        "abs-slip2.txt: sliding_s: 3.4-3.9 s leaves the recording of 3 s",
        "abs-slip2.txt: onsets_s: 3.4 s is behind the end, 3 s",
    ]


def test_a_manifest_can_say_onsets_better(tmp_path):
    empty(tmp_path, "abs-slip1.txt", "abs-slip2.txt", "lb-slip1.txt", "other.txt")
    (tmp_path / "marked.csv").write_text(
        "file,material,trial,onsets_s,sliding_s\n"
        "abs-slip2.txt,M1,2,2.1; 9.2; 13.6,2.1-7; 9.2-11.5; 13.6-15\n"
        "lb-slip1.txt,M2,1,,\n"
        "other.txt,M2,2,,\n"
    )
    told = read_manifest(tmp_path / "marked.csv", tmp_path)
    found = better_told(named_files(tmp_path, STEMS, PROTOCOL), told)
    first, second, third = found.entries
    assert (first.truth, third.truth) == (PROTOCOL, PROTOCOL)
    assert second.truth == Truth(
        onsets_s=(2.1, 9.2, 13.6), sliding_s=((2.1, 7.0), (9.2, 11.5), (13.6, 15.0))
    )
    assert [e.is_nominal for e in found.entries] == [True, False, True]
    assert [str(problem) for problem in found.problems] == [
        "marked.csv:4: file 'other.txt' has no name that says what it is"
    ]


def test_files_of_another_number_of_channels_are_refused(tmp_path):
    written(tmp_path / "abs-slip1.txt", 0, num_channels=23)
    with pytest.raises(ValueError, match=r"not the 24 of data\.channels") as caught:
        authors_raw(tmp_path, **SHORT)
    assert "\n" not in str(caught.value)


# The paper's experiment ----------------------------------------------------------------------


def test_the_papers_experiment_runs_on_their_files(tmp_path):
    """Four cycles of three materials, the strokes shortened; synthetic, so scores mean nothing."""
    root = tmp_path / "raw"
    for number, stem in enumerate(("abs", "dg", "Iron")):
        for trial in range(1, 4 if stem != "Iron" else 2):
            written(root / f"{stem}-slip{trial}.txt", 10 * number + trial)
    config = composed(
        "+exp=unseen4",
        "data=authors_raw",
        f"data.root={root}",
        *(f"data.{name}={value}" for name, value in SHORT.items()),
        "split.seen=[M1,M6]",
        "split.unseen=[iron]",
        "recipe=paper",
        "recipe.num_features=10",
        "recipe.penalties=[0.1,1.0]",
        "cache=off",
        "num_workers=0",
        "export=false",
    )
    train(config, tmp_path / "run")
    metrics = json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert metrics["simulated"] is False
    assert metrics["splits"]["unseen"]["num_bins"] == 20 + 20 + 20 + 10
    assert metrics["num_features_pool"] == 2582
    assert set(metrics["splits"]) == {"train", "test", "unseen"}
    assert torch.load(tmp_path / "run" / "detector.pt", weights_only=True)
