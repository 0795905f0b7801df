"""Every choice of unseen materials, each learned without them."""

import pytest
from small_set import SmallSet, small_maker, small_recipe

from benchmarks.crossval import evaluate_split, read_materials
from tactslip_torch.training.recipe import General

RECIPES = {
    "paper": small_recipe(),
    "general": General(sample_bins=50, use="channel", num_features=10, degree=1),
}


def read(source):
    return read_materials(small_maker(source), "abc", 30, 2000, num_workers=0)


@pytest.mark.parametrize("recipe", RECIPES)
def test_an_unseen_material_teaches_nothing(recipe):
    def found(source, unseen):
        return evaluate_split(read(source), RECIPES[recipe], [unseen])

    plain = SmallSet()
    louder = SmallSet(gains={r: 5.0 for r in plain.ids if r.material == "c"})
    before, after = found(plain, "c"), found(louder, "c")
    assert (before["test"], before["penalty"]) == (after["test"], after["penalty"])
    assert before["unseen"] != after["unseen"]
    assert found(louder, "a")["test"] != found(plain, "a")["test"]


def test_a_score_is_the_mean_recall_on_all_bins_of_the_unseen_materials():
    materials = read(SmallSet())
    scored = {key: len(sample.is_slip) for key, sample in materials.scored.items()}
    roles = {"train": 4, "test": 1}  # of five cycles
    assert scored == {(name, role): 37 * num for name in "abc" for role, num in roles.items()}
    found = evaluate_split(materials, small_recipe(), ["a", "c"])
    assert found["unseen"] == pytest.approx(sum(found["per_material"].values()) / 2)
