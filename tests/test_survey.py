import json
import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from tactslip_torch.features.bin_sample import BinSample
from tactslip_torch.features.selection import ClassMoments
from tactslip_torch.features.survey import FORMAT, Survey
from tactslip_torch.files import load_table, save_table
from tactslip_torch.ledger import content_digest

NUM = 4
ABOUT = {
    "hand": {"name": "paper24", "sample_rate_hz": 2000.0, "kinds": ["SG", "PVDF"]},
    "labels": {"layout": "whole_slide"},
}


def make_recordings(num=9, seed=0):
    rng = np.random.default_rng(seed)
    recordings = []
    for number in range(num):
        size = int(rng.integers(0, 12))
        features = rng.standard_normal((size, NUM)) * 10.0 ** rng.integers(-4, 4, NUM)
        features[:, 3] = rng.choice([0.0, -0.0], size)  # ranges must not show which came first
        features = torch.from_numpy(features.astype(np.float32))
        is_slip = torch.from_numpy(rng.uniform(size=size) < 0.6)
        recordings.append((f"M{number % 3}/{number}", f"M{number % 3}", features, is_slip))
    return recordings


def survey_of(recordings, sample_bins=3, about=ABOUT):
    survey = Survey(NUM, sample_bins, about)
    for recording in recordings:
        survey.update(*recording)
    return survey


def bits_of(survey):
    """All of a survey as bytes and text, so that 0 and -0 differ."""
    state = survey.state_dict()
    tensors = {
        name: (str(tensor.dtype), tuple(tensor.shape), tensor.numpy().tobytes())
        for name, tensor in state["tensors"].items()
    }
    return json.dumps(state["facts"]), tensors


def test_a_survey_is_its_parts():
    recordings = make_recordings()
    survey = survey_of(recordings)
    features = torch.cat([recording[2] for recording in recordings])
    is_slip = torch.cat([recording[3] for recording in recordings])
    moments, sample = ClassMoments(NUM), BinSample(3)
    moments.update(features, is_slip)
    for recording in recordings:
        sample.update(*recording)
    assert torch.equal(survey.moments.count, moments.count)
    assert torch.equal(survey.moments.mean, moments.mean)
    assert torch.equal(survey.moments.sum_sq_dev, moments.sum_sq_dev)
    assert torch.equal(survey.minimum, features.amin(0))
    assert torch.equal(survey.maximum, features.amax(0))
    assert torch.equal(survey.sample.bins().features, sample.bins().features)
    assert survey.ledger.entries == {r[0]: content_digest(r[2], r[3]) for r in recordings}
    assert survey.about == ABOUT
    assert survey.num_features == NUM
    assert survey.minimum.dtype == survey.maximum.dtype == torch.float32


@given(
    seed=st.integers(0, 99),
    order=st.randoms(use_true_random=False),
    num_shards=st.integers(1, 5),
    sample_bins=st.integers(0, 6),
)
def test_any_order_and_sharding_gives_the_same_bits(seed, order, num_shards, sample_bins):
    recordings = make_recordings(seed=seed)
    whole = survey_of(recordings, sample_bins)
    order.shuffle(recordings)
    shards = [survey_of(recordings[i::num_shards], sample_bins) for i in range(num_shards)]
    order.shuffle(shards)
    merged = Survey(NUM, sample_bins, ABOUT)
    for shard in shards:
        before = bits_of(shard)
        merged.merge(shard)
        assert bits_of(shard) == before
    assert bits_of(merged) == bits_of(whole)
    assert bits_of(survey_of(recordings, sample_bins)) == bits_of(whole)


def test_files_come_back_and_have_the_same_bytes(tmp_path):
    recordings = make_recordings()
    survey = survey_of(recordings)
    survey.save(tmp_path / "a.stats")
    loaded = Survey.load(str(tmp_path / "a.stats"))
    assert bits_of(loaded) == bits_of(survey)
    merged = survey_of(recordings[5:])
    merged.merge(survey_of(recordings[:5]))
    merged.save(tmp_path / "b.stats")
    assert (tmp_path / "a.stats").read_bytes() == (tmp_path / "b.stats").read_bytes()
    Survey(NUM, 3).save(tmp_path / "empty.stats")
    assert bits_of(Survey.load(tmp_path / "empty.stats")) == bits_of(Survey(NUM, 3))


def test_a_survey_goes_on_from_a_checkpoint(tmp_path):
    recordings = make_recordings()
    before = survey_of(recordings[:4])
    torch.save(before.state_dict(), tmp_path / "checkpoint")
    survey = Survey.from_state_dict(torch.load(tmp_path / "checkpoint", weights_only=True))
    for recording in recordings[4:]:
        survey.update(*recording)
    assert bits_of(survey) == bits_of(survey_of(recordings))
    assert bits_of(before) == bits_of(survey_of(recordings[:4]))


def test_a_state_is_apart_from_its_survey():
    recordings = make_recordings()
    survey = survey_of(recordings[:4])
    state = survey.state_dict()
    for recording in recordings[4:]:
        survey.update(*recording)
    assert bits_of(Survey.from_state_dict(state)) == bits_of(survey_of(recordings[:4]))


def test_ranges_without_bins_take_in_any_other():
    survey = Survey(2, 3)
    assert survey.minimum.tolist() == [math.inf] * 2
    assert survey.maximum.tolist() == [-math.inf] * 2
    survey.update("none", "a", torch.zeros(0, 2), torch.zeros(0))
    assert survey.minimum.tolist() == [math.inf] * 2
    other = Survey(2, 3)
    other.update("one", "a", torch.tensor([[-3.0, 5.0]]), torch.ones(1))
    survey.merge(other)
    assert survey.minimum.tolist() == survey.maximum.tolist() == [-3, 5]
    assert len(survey.ledger) == 2


def test_layout_labels_and_gradients_do_not_matter():
    name, group, features, is_slip = make_recordings()[1]
    strided = torch.stack([features, features], dim=-1)[..., 0].requires_grad_()
    survey = survey_of([(name, group, strided, is_slip.long())])
    assert bits_of(survey) == bits_of(survey_of([(name, group, features, is_slip)]))
    assert not survey.minimum.requires_grad


def broken_bins(value):
    features = torch.zeros(5, NUM)
    features[2, 1] = value
    return features


@pytest.mark.parametrize(
    ("name", "features", "labels", "match"),
    [
        ("M1/1", torch.zeros(5, NUM), torch.zeros(5), "'M1/1' is in these statistics already"),
        ("new", torch.zeros(5, 3), torch.zeros(5), r"'new'.*\[N, 4\].*\(5, 3\)"),
        ("new", torch.zeros(5, NUM), torch.zeros(4), r"'new'.*\(5, 4\) and \(4,\)"),
        ("new", torch.zeros(5, NUM), torch.zeros(()), r"'new'.*\(5, 4\) and \(\)"),
        ("new", torch.zeros(5, NUM).double(), torch.zeros(5), "'new'.*hand float32"),
        ("new", broken_bins(math.nan), torch.zeros(5), "'new'.*nan in row 2, column 1"),
        ("new", broken_bins(-math.inf), torch.zeros(5), "'new'.*-inf in row 2, column 1"),
    ],
)
def test_a_refused_recording_changes_nothing(name, features, labels, match):
    survey = survey_of(make_recordings())
    before = bits_of(survey)
    with pytest.raises(ValueError, match=match) as error:
        survey.update(name, "M1", features, labels)
    assert "\n" not in str(error.value)
    assert bits_of(survey) == before
    if name == "new":
        survey.update(name, "M1", torch.zeros(5, NUM), torch.zeros(5))


@pytest.mark.parametrize(
    ("about", "line"),
    [
        ({}, r'about\.hand: {"kinds": .* and nothing'),
        (
            ABOUT | {"labels": {"layout": "half_second"}},
            'about.labels.layout: "whole_slide" and "half_second"',
        ),
        (ABOUT | {"more": None}, "about.more: nothing and null"),
        (
            ABOUT | {"hand": ABOUT["hand"] | {"sample_rate_hz": 1000, "kinds": ["SG", "SG"]}},
            'about.hand.kinds.1: "PVDF" and "SG"',
        ),
        (
            ABOUT | {"hand": ABOUT["hand"] | {"kinds": ["SG"]}},
            'about.hand.kinds.1: "PVDF" and nothing',
        ),
        (ABOUT | {"hand": ABOUT["hand"] | {"name": "x" * 99}}, r'name: "paper24" and "x+\.\.\.'),
        (ABOUT | {"hand": 3}, r"about.hand: .* and 3"),
    ],
)
def test_surveys_about_other_things_do_not_merge(about, line):
    survey = survey_of(make_recordings()[:4])
    other = survey_of(make_recordings()[4:], about=about)
    before = bits_of(survey)
    with pytest.raises(ValueError, match=f"cannot merge surveys that differ in .*{line}") as error:
        survey.merge(other)
    assert "\n" not in str(error.value)
    assert len(str(error.value)) < 250
    assert bits_of(survey) == before


def test_what_is_about_the_same_merges_whatever_its_order_and_types():
    about = {"labels": ABOUT["labels"], "hand": ABOUT["hand"] | {"kinds": ("SG", "PVDF")}}
    survey, other = survey_of([]), survey_of(make_recordings(), about=about)
    survey.merge(other)
    assert bits_of(survey) == bits_of(survey_of(make_recordings()))


def test_other_refusals_of_merge_change_nothing():
    recordings = make_recordings()
    survey = survey_of(recordings[:5])
    before = bits_of(survey)
    for other, match in [
        (survey_of(recordings[4:]), "1 batches are in both statistics, such as 'M1/4'"),
        (survey, "5 batches are in both"),
        (survey_of(recordings[5:], sample_bins=4), "differ in sample_bins: 3 and 4"),
        (Survey(NUM + 1, 3, ABOUT), "4 and 5 features"),
    ]:
        with pytest.raises(ValueError, match=match):
            survey.merge(other)
        assert bits_of(survey) == before


@pytest.mark.parametrize("about", [{"a": object()}, {"a": math.nan}, {"a": {1, 2}}])
def test_about_is_json(about):
    with pytest.raises(ValueError, match="about must be what JSON holds"):
        Survey(NUM, 3, about)


def test_about_is_apart_from_what_was_given():
    about = {"hand": {"name": "a"}}
    survey = Survey(NUM, 3, about)
    about["hand"]["name"] = "b"
    assert survey.about == {"hand": {"name": "a"}}


def test_a_damaged_file_is_refused_in_one_line(tmp_path):
    path = tmp_path / "a.stats"
    survey_of(make_recordings()).save(path)
    whole = path.read_bytes()
    place = whole.index(survey_of(make_recordings()).minimum.numpy().tobytes())
    for content in (
        whole[: len(whole) // 2],
        b"",
        whole[:place] + bytes([whole[place] ^ 1]) + whole[place + 1 :],
    ):
        path.write_bytes(content)
        with pytest.raises(ValueError, match=r"a\.stats is damaged.*make it again") as error:
            Survey.load(path)
        assert "\n" not in str(error.value)
    with pytest.raises(FileNotFoundError, match=r"no file at .*nowhere\.stats"):
        Survey.load(tmp_path / "nowhere.stats")
    save_table(path, "tactslip_torch sums 1", {}, {})
    with pytest.raises(ValueError, match=r"must be of format 'tactslip_torch survey 1', got"):
        Survey.load(path)


@pytest.mark.parametrize("name", ["about", "sample", "minimum", "moments.place", "sample.features"])
def test_a_whole_file_that_lacks_something_is_refused_in_one_line(tmp_path, name):
    path = tmp_path / "a.stats"
    survey_of(make_recordings()).save(path)
    facts, tensors = load_table(path, FORMAT)
    facts.pop(name, None)
    tensors.pop(name, None)
    save_table(path, FORMAT, facts, tensors)
    with pytest.raises(ValueError, match=r"a\.stats is a damaged survey; make it again"):
        Survey.load(path)
