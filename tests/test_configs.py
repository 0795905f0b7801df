"""Every file of ``conf/``: it composes, what it names exists, and its keys are described."""

from collections import Counter

import pytest
from biotac_layout import write_biotac
from hydra.utils import get_object, instantiate
from omegaconf import OmegaConf

from tactslip_torch.commands.configuration import _keys_of, _options_of, checked, compose_config
from tactslip_torch.commands.configuration import presets as presets_of
from tactslip_torch.data.splits import ROLES
from tactslip_torch.simulation.simulate import SimulatedRecordings
from tactslip_torch.training.experiment import feature_maker

RECORDED = {"biotacsp_dos"}
"""Experiments on real recordings, which are not here: a folder of their layout stands in."""
GROUPS = ("data", "labels", "split", "features", "recipe", "onset", "trainer")
SEEN = {"M1", "M2", "M3", "M4", "M5", "M6"}


def folds_of(config):
    source = instantiate(config.data, _convert_="all")
    return source, instantiate(config.split, _convert_="all")(source.ids)


@pytest.mark.parametrize("name", _options_of("exp"))
def test_an_experiment_composes_and_everything_it_names_exists(name, tmp_path):
    where = write_biotac(tmp_path / name) if name in RECORDED else []
    config = checked("train", [f"+exp={name}", "seed=7", *where]).config
    assert config.name == name
    assert config.data.get("seed", 7) == config.split.seed == 7
    source, folds = folds_of(config)
    assert isinstance(source, SimulatedRecordings) == (name not in RECORDED)
    if weights := instantiate(config.recipe, _convert_="all").scene_weights:
        assert set(weights) == set(config.extra_scenes)
    maker = feature_maker(source, instantiate(config.labels), **config.features)
    assert len(maker.channel_filter.window_lengths) == len(source.hand)
    for fold in folds:
        assert set(fold.roles) <= set(source.ids)
        assert set(fold.roles.values()) <= set(ROLES)
    assert len({fold.name for fold in folds}) == len(folds) > 0  # each has a folder of its own


@pytest.mark.parametrize(
    ("group", "option"), [(group, option) for group in GROUPS for option in _options_of(group)]
)
def test_every_option_composes_and_its_keys_are_described(group, option):
    config = checked("train", [f"{group}={option}"]).config
    assert [key.name for key in _keys_of("train", config) if not key.description] == []
    if config[group] and group != "features":  # plain values, for ``feature_maker``
        assert callable(get_object(config[group]._target_))


@pytest.mark.parametrize("name", _options_of("scene"))
def test_every_scene_makes_recordings(name):
    config = compose_config("train", [f"scene={name}", "data.cycles=1", "data.materials=[M3,wood]"])
    source = instantiate(config.data, _convert_="all")
    assert [str(recording.scene) for recording in source.ids] == [name, name]


def test_further_scenes_are_those_of_their_names_and_any_parameter_can_be_set():
    changes = ["extra_scenes.taps.cycles=2", "+extra_scenes.grips.machine_mv=3.0"]
    config = compose_config("train", ["extra_scenes=confound", *changes])
    changed = {"taps": {"cycles": 2}, "grips": {"machine_mv": 3.0}}
    for name, values in config.extra_scenes.items():
        own = presets_of()["scene"][name] | {"cycles": 8}
        assert values == own | changed.get(name, {})
    source = instantiate(config.data, cycles=9, materials=["M1"], _convert_="all")
    counts = Counter(str(r.scene) for r in source.ids)
    assert counts == dict.fromkeys(config.extra_scenes, 8) | {"taps": 2, "paper": 9}


def test_sessions_trains_on_one_and_evaluates_the_same_materials_in_others():
    _, (alone, *rest) = folds_of(compose_config("train", ["+exp=sessions"]))
    assert {r.session for r in alone.having("train")} == {""}
    assert {r.session for r in alone.having("unseen")} == {"2", "3"}
    for fold in (alone, *rest):
        assert {r.material for r in fold.having(*ROLES)} == SEEN
        train, unseen = ({r.session for r in fold.having(role)} for role in ("train", "unseen"))
        assert train.isdisjoint(unseen)
    assert [len({r.session for r in fold.having("train")}) for fold in rest] == [2, 2, 2]


def test_evaluate_of_simulated_recordings_has_the_defaults_of_train():
    train, evaluate = (
        OmegaConf.to_container(compose_config(name, words), resolve=True)
        for name, words in (("train", []), ("evaluate", ["data=simulated", "split=unseen4"]))
    )
    for section in ("data", "labels", "split", "trainer", "seed"):
        assert evaluate[section] == train[section]
