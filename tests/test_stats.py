"""Shards without an engine: they add up to what one process learns, and bad ones are refused."""

import itertools
import random
import shutil

import pytest
import torch
from test_commands import TINY, composed, run_train, tensors

from tactslip_torch import SlipDetector
from tactslip_torch.stats import stats

MANY = ("data.cycles=8", "split.train_share=0.75")  # more bins than the 66 monomials of 10
TINY_STATS = tuple(o for o in TINY if not o.startswith("export"))


def act(action, out, *overrides):
    return stats(composed(*TINY_STATS, *MANY, f"action={action}", f"out={out}", *overrides,
                          name="stats"))  # fmt: skip


def collected(folder, parts, *overrides, stem="part"):
    paths = [folder / f"{stem}-{part}-of-{parts}.stats" for part in range(1, parts + 1)]
    for part, path in enumerate(paths, 1):
        act("collect", path, f"shard={part}/{parts}", *overrides)
    return paths


def listed(paths):
    return f"inputs=[{','.join(map(str, paths))}]"


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Both passes in one shard and in seven, from the features of one cache."""
    folder = tmp_path_factory.mktemp("stats")
    cache = f"cache={folder / 'cache'}"
    surveys = collected(folder, 7, cache, stem="survey")
    act("merge", folder / "survey.stats", listed(surveys))
    act("plan", folder / "plan.stats", f"inputs={folder / 'survey.stats'}")
    plan = f"plan={folder / 'plan.stats'}"
    sums = collected(folder, 7, cache, plan, stem="sums")
    act("merge", folder / "sums.stats", f"inputs={folder}/sums-*.stats")
    act("solve", folder / "detector.pt", plan, f"inputs={folder / 'sums.stats'}")
    return folder, cache, surveys, sums


def bytes_of(path):
    return path.read_bytes()


def test_shards_give_the_detector_of_one_process(made, tmp_path):
    folder, cache, *_ = made
    run_train(tmp_path, *TINY, "recipe=robust", *MANY, cache)
    own, theirs = tensors(tmp_path), tensors(folder)
    assert own.keys() == theirs.keys()
    for name, value in own.items():
        assert torch.equal(value, theirs[name]), name
    ours = SlipDetector.load(folder / "detector.pt")
    assert ours.selected == SlipDetector.load(tmp_path / "detector.pt").selected
    trained = SlipDetector.load(tmp_path / "detector.pt").info
    for key in ("simulated", "split", "seed", "train_recordings", "train_materials", "penalty"):
        assert ours.info[key] == trained[key], key


def test_any_order_and_number_of_shards_gives_the_same_statistics(made, tmp_path):
    folder, cache, surveys, sums = made
    random.Random(3).shuffle(surveys)
    act("merge", tmp_path / "survey.stats", listed(surveys))
    assert bytes_of(tmp_path / "survey.stats") == bytes_of(folder / "survey.stats")
    (whole,) = collected(tmp_path, 1, cache, f"plan={folder / 'plan.stats'}", stem="whole")
    act("merge", tmp_path / "sums.stats", listed(random.Random(4).sample(sums, 7)))
    act("merge", tmp_path / "whole.stats", listed([whole]))
    assert bytes_of(tmp_path / "sums.stats") == bytes_of(folder / "sums.stats")
    assert bytes_of(tmp_path / "whole.stats") == bytes_of(folder / "sums.stats")


def test_a_lost_shard_is_named_and_made_again(made, tmp_path):
    folder, cache, _, sums = made
    act("merge", tmp_path / "sums.stats", listed(sums[:3] + sums[4:]))
    plan, merged = f"plan={folder / 'plan.stats'}", f"inputs={tmp_path / 'sums.stats'}"
    with pytest.raises(ValueError, match=r"2 of 12 training recordings are missing, such as"):
        act("solve", tmp_path / "detector.pt", plan, merged)
    assert not (tmp_path / "detector.pt").exists()
    act("collect", tmp_path / "again.stats", cache, plan, "shard=4/7")
    assert bytes_of(tmp_path / "again.stats") == bytes_of(sums[3])


def test_a_shard_counts_once(made, tmp_path):
    _, _, surveys, sums = made
    for twice in (surveys[:2] + surveys[:1], sums[:2] + sums[:1]):
        with pytest.raises(ValueError, match="in both"):
            act("merge", tmp_path / "merged.stats", listed(twice))
    assert not (tmp_path / "merged.stats").exists()


@pytest.mark.parametrize("kind", [2, 3], ids=["survey", "sums"])
@pytest.mark.parametrize("harm", ["cut", "flipped", "empty"])
def test_a_damaged_shard_is_refused_and_nothing_is_lost(made, tmp_path, kind, harm):
    content = bytearray(made[kind][0].read_bytes())
    if harm == "flipped":
        content[len(content) // 2] ^= 1
    broken = tmp_path / "broken.stats"
    broken.write_bytes({"cut": content[: len(content) // 2], "empty": b""}.get(harm, content))
    merged = tmp_path / "merged.stats"
    shutil.copy(made[kind][1], merged)
    before = merged.read_bytes()
    with pytest.raises(ValueError, match=r"broken.stats is damaged"):
        act("merge", merged, listed([made[kind][1], broken]))
    assert merged.read_bytes() == before


@pytest.mark.parametrize(
    ("override", "key"),
    [
        ("features.level=3", "pool"),
        ("data.channels=3", "channels"),
        ("labels.bin_ms=100", "pool"),
        ("seed=5", "seed: 0 and 5"),
        ("features.dtype=float32", "features_dtype"),
    ],
)
def test_shards_of_other_features_do_not_mix(made, tmp_path, override, key):
    _, cache, surveys, _ = made
    other = tmp_path / "other.stats"
    act("collect", other, cache, override, "shard=1/7")
    with pytest.raises(ValueError, match=key):
        act("merge", tmp_path / "merged.stats", listed([other, surveys[1]]))


def test_a_plan_of_other_data_is_refused(made, tmp_path):
    folder, cache, *_ = made
    plan = f"plan={folder / 'plan.stats'}"
    with pytest.raises(ValueError, match=r"this run and .*plan.stats differ in "):
        act("collect", tmp_path / "sums.stats", cache, plan, "split.train_share=0.5")


@pytest.mark.parametrize(
    ("action", "overrides", "line"),
    [
        ("fold", (), "action must be one of collect, merge, plan, solve, got 'fold'"),
        ("collect", ("shard=0/3",), "shard must be like 3/16"),
        ("collect", ("shard=4/3",), "shard must be like 3/16"),
        ("collect", ("shard=x",), "shard must be like 3/16"),
        ("collect", ("shard=1/99",), "99 processes or shards for 12 recordings"),
        ("merge", (), "no inputs"),
        ("merge", ("inputs=nowhere-*.stats",), "no file fits inputs=nowhere"),
        ("merge", ("inputs=nowhere.stats",), "no file at nowhere.stats"),
        ("plan", ("inputs=nowhere.stats",), "no file at nowhere.stats"),
        ("solve", ("inputs=nowhere.stats",), "no plan; give plan="),
        ("solve", ("inputs=a.stats", "plan=nowhere.stats"), "no file at nowhere.stats"),
    ],
    ids=lambda value: "-".join(value) if isinstance(value, tuple) else str(value)[:12],
)
def test_bad_input_is_one_line(tmp_path, action, overrides, line):
    with pytest.raises((ValueError, OSError)) as error:
        act(action, tmp_path / "out.stats", *overrides)
    assert line in str(error.value)
    assert "\n" not in str(error.value)
    assert list(tmp_path.iterdir()) == []


def test_an_output_never_takes_the_place_of_an_input(made, tmp_path):
    folder, cache, *_ = made
    plan = tmp_path / "plan.stats"
    shutil.copy(folder / "plan.stats", plan)
    shutil.copy(folder / "survey.stats", tmp_path / "survey.stats")
    for action, out, override in (
        ("collect", plan, f"plan={plan}"),
        ("plan", tmp_path / "survey.stats", f"inputs={tmp_path / 'survey.stats'}"),
        ("merge", tmp_path / "survey.stats", f"inputs={tmp_path}/surv*.stats"),
    ):
        before = out.read_bytes()
        with pytest.raises(ValueError, match="is read by this action; give another name"):
            act(action, out, cache, override)
        assert out.read_bytes() == before


def test_a_kernel_that_does_not_add_up_is_refused_at_once(tmp_path):
    for override in ("recipe.degree=3", "recipe.degree=1"):
        with pytest.raises(ValueError, match=r"sums need recipe.kernel=polynomial"):
            act("collect", tmp_path / "survey.stats", override)
    with pytest.raises(ValueError, match=r"recipe.num_features=3000 exceeds"):
        act("collect", tmp_path / "survey.stats", "recipe.num_features=3000")


def test_few_bins_agree_with_train_to_rounding(made, tmp_path):
    _, cache, *_ = made
    few = ("recipe.num_features=40", cache)  # 861 monomials
    run_train(tmp_path, *TINY, "recipe=robust", *MANY, *few)
    act("collect", tmp_path / "survey.stats", *few)
    act("plan", tmp_path / "plan.stats", f"inputs={tmp_path / 'survey.stats'}")
    plan = f"plan={tmp_path / 'plan.stats'}"
    act("collect", tmp_path / "sums.stats", *few, plan)
    act("solve", tmp_path / "shards.pt", f"inputs={tmp_path / 'sums.stats'}", plan)
    ours = SlipDetector.load(tmp_path / "shards.pt").head
    theirs = SlipDetector.load(tmp_path / "detector.pt").head
    z = torch.rand(50, 40, dtype=torch.float64) * 2 - 1
    torch.testing.assert_close(ours(z), theirs(z), rtol=1e-8, atol=1e-8)


def test_files_of_two_kinds_do_not_mix(made, tmp_path):
    folder, _, surveys, sums = made
    for pair in itertools.permutations((surveys[0], sums[0])):
        with pytest.raises(ValueError, match="two kinds"):
            act("merge", tmp_path / "merged.stats", listed(pair))
    with pytest.raises(ValueError, match="must be of format"):
        act("plan", tmp_path / "plan.stats", f"inputs={folder / 'sums.stats'}")
    with pytest.raises(ValueError, match="one merged file is wanted, got 7"):
        act("plan", tmp_path / "plan.stats", listed(surveys))
