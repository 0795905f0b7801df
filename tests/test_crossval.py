"""Every choice of unseen materials, each learned without them."""

import pytest
from small_set import SmallSet, small_maker, small_recipe

from benchmarks.crossval import Materials, evaluate_split
from tactslip_torch.data.splits import seen6
from tactslip_torch.training.datamodule import SlipDataModule


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
    found = evaluate_split(materials, small_recipe(), ["a", "c"])
    bins = materials.bins_of(["a", "c"], ("train", "test"))
    assert len(bins.is_slip) == 2 * 5 * 37  # every bin of both materials: none was sampled away
    assert found["unseen"] == pytest.approx(sum(found["per_material"].values()) / 2)
