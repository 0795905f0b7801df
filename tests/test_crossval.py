"""Every choice of unseen materials, each learned without them."""

import itertools
import json
from math import comb

import pytest
from drawing import assert_png
from small_set import SmallSet, small_maker, small_recipe
from test_commands import TINY_DATA, composed

from tactslip_torch.commands.crossval import Materials, crossval, evaluate_split
from tactslip_torch.data.splits import seen6
from tactslip_torch.report.crossval import crossval_table, material_scores
from tactslip_torch.training.datamodule import SlipDataModule

TOLD = (
    *TINY_DATA,
    *("data.materials=[A,B,C,D]", "data.cycles=3", "num_unseen=2", "train_bins=20"),
    "num_workers=0",
    *("recipes.paper.num_features=8", "recipes.paper.penalties=[0.1,1.0]"),
    *("recipes.robust.num_features=[4,8]", "recipes.robust.penalties=[0.01,0.1]"),
    *("~recipes.general", "+recipe@recipes.welch=paper"),
    *("recipes.welch.num_features=4", "recipes.welch.penalties=0.1"),
)


def read(source):
    by_cycle = seen6(source.ids, seen=["a", "b", "c"])[0]
    maker = small_maker(source)
    materials = Materials(maker.pool, 30, 2000)
    for batch in SlipDataModule(maker, by_cycle, 0).loader(["train", "test"]):
        materials.update(batch, by_cycle.roles[batch.recording])
    return materials


@pytest.mark.parametrize("balance", ["undersample", "weights"])
def test_an_unseen_material_teaches_nothing(balance):
    def found(source, unseen):
        return evaluate_split(read(source), small_recipe(balance=balance), [unseen])

    plain = SmallSet()
    louder = SmallSet(gains={r: 5.0 for r in plain.ids if r.material == "c"})
    before, after = found(plain, "c"), found(louder, "c")
    assert (before["test"], before["penalty"]) == (after["test"], after["penalty"])
    assert before["unseen"] != after["unseen"]
    assert found(louder, "a")["test"] != found(plain, "a")["test"]


def test_a_score_is_the_mean_recall_on_all_bins_of_the_unseen_materials():
    materials = read(SmallSet())
    trained = {name: len(s.seen_batches) for name, s in materials.training_statistics.items()}
    assert trained == dict.fromkeys("abc", 4)  # the fifth cycle is for tests
    test = materials.bins_of(["b"], ("test",))
    assert test.sample_weight.tolist() == [1.0] * 37
    found = evaluate_split(materials, small_recipe(), ["a", "c"])
    bins = materials.bins_of(["a", "c"], ("train", "test"))
    assert len(bins.is_slip) == 2 * 5 * 37  # every bin of both materials: none was sampled away
    assert set(found["per_material"]) == {"a", "c"}
    assert found["unseen"] == pytest.approx(sum(found["per_material"].values()) / 2)


def test_the_command_evaluates_every_choice_with_every_recipe(tmp_path, capsys):
    found = crossval(composed(*TOLD, name="crossval"), tmp_path)
    assert json.loads((tmp_path / "crossval.json").read_text()) == found
    assert set(found["splits"]) == {"paper", "robust", "welch"}  # told apart by their keys
    choices = {frozenset(pair) for pair in itertools.combinations("ABCD", 2)}
    for splits in found["splits"].values():
        assert len(splits) == comb(4, 2)
        assert {frozenset(split["materials"]) for split in splits} == choices
        assert all(0 <= split["unseen"] <= 1 for split in splits)
        assert len(material_scores(splits, "A")) == 3
    sizes = {r: {one["num_features"] for one in own} for r, own in found["splits"].items()}
    assert (sizes["paper"], sizes["welch"]) == ({8}, {4})
    assert sizes["robust"] <= {4, 8}
    assert_png(tmp_path / "crossval.png")
    assert (tmp_path / "config.yaml").exists()
    out = capsys.readouterr().out
    assert crossval_table(found) in out
    assert "SIMULATED" not in out  # these recordings say they are not
    several = crossval(composed(*TOLD, "num_workers=2", name="crossval"), tmp_path / "2")
    assert found["splits"] == several["splits"]
