"""Every file of ``conf/``: it composes, what it names exists, and nothing in it is misspelt."""

from collections import Counter

import pytest
import yaml
from biotac_layout import write_biotac
from hydra.utils import get_object, instantiate
from omegaconf import OmegaConf
from test_commands import composed

from tactslip_torch.commands.configuration import Composed, checked, conf_dir
from tactslip_torch.data.splits import ROLES
from tactslip_torch.simulation.simulate import SimulatedRecordings
from tactslip_torch.training.experiment import feature_maker

RECORDED = {"biotacsp_dos"}
"""Experiments on real recordings, which are not here: a folder of their layout stands in."""
OPTIONS = {
    folder.name: sorted(path.stem for path in folder.glob("*.yaml"))
    for folder in conf_dir().iterdir()
    if folder.is_dir()
}
EXPERIMENTS = OPTIONS["exp"]
ALONE = ("exp", "extra_scenes", "scene", "search")
"""Groups whose options are looked at one by one; those of the others go together."""
SEEN = ["M1", "M2", "M3", "M4", "M5", "M6"]


@pytest.fixture(scope="module")
def layouts(tmp_path_factory):
    """What an experiment on recordings needs to be told, by name."""
    return {"biotacsp_dos": write_biotac(tmp_path_factory.mktemp("biotacsp_dos"))}


def folds_of(config):
    source = instantiate(config.data, _convert_="all")
    return source, instantiate(config.split, _convert_="all")(source.ids)


# Experiments ---------------------------------------------------------------------------------


@pytest.mark.parametrize("name", EXPERIMENTS)
def test_an_experiment_composes_and_everything_it_names_exists(name, layouts):
    text = (conf_dir() / "exp" / f"{name}.yaml").read_text()
    assert text.startswith("# @package _global_\n")
    told = [f"+exp={name}", "seed=7", *layouts.get(name, ())]
    config = checked("train", told).composed.config  # it refuses keys that nothing takes
    assert config.name == name
    assert config.data.get("seed", 7) == config.split.seed == 7
    assert ("seed" in config.data) == (name not in RECORDED)
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


def test_further_scenes_are_those_of_their_files_and_any_parameter_can_be_set():
    config = composed(
        "extra_scenes=confound", "extra_scenes.taps.cycles=2", "+extra_scenes.grips.machine_mv=3.0"
    )
    changed = {"taps": {"cycles": 2}, "grips": {"machine_mv": 3.0}}
    for name, values in config.extra_scenes.items():
        own = yaml.safe_load((conf_dir() / "scene" / f"{name}.yaml").read_text())
        assert values == own | {"cycles": 8} | changed.get(name, {})
    source = instantiate(config.data, cycles=9, materials=["M1"], _convert_="all")
    counts = Counter(str(r.scene) for r in source.ids)
    assert counts == dict.fromkeys(config.extra_scenes, 8) | {"taps": 2, "paper": 9}


# What the published experiments are ------------------------------------------------------------


def test_sessions_trains_on_one_and_judges_the_same_materials_in_others():
    source, (alone, *rest) = folds_of(composed("+exp=sessions"))
    assert {r.session for r in alone.having("train")} == {""}
    assert {r.session for r in alone.having("unseen")} == {"2", "3"}
    for fold in (alone, *rest):
        assert {r.material for r in fold.having(*ROLES)} == set(SEEN)
        sessions = [{r.session for r in fold.having(role)} for role in ("train", "unseen")]
        assert sessions[0].isdisjoint(sessions[1])
    assert [len({r.session for r in fold.having("train")}) for fold in rest] == [2, 2, 2]
    assert len(source.ids) < 280


# The rest of conf/ ---------------------------------------------------------------------------


@pytest.mark.parametrize(
    "number", range(max(len(own) for group, own in OPTIONS.items() if group not in ALONE))
)
def test_every_option_composes_and_its_keys_are_described(number):
    """The first option of each group, the second, and so on, as far as any group has one."""
    groups = {k: own[number] for k, own in OPTIONS.items() if k not in ALONE and number < len(own)}
    config = described("train", *(f"{group}={option}" for group, option in groups.items()))
    for group, option in groups.items():
        assert config[group] or (option == "none" and group == "onset")
        if config[group] and group != "features":  # plain values, for ``feature_maker``
            assert callable(get_object(config[group]._target_))
    for option in OPTIONS["extra_scenes"][number : number + 1]:
        config = described("train", f"extra_scenes={option}")
        assert config.data.extra_scenes == config.extra_scenes
        assert bool(config.extra_scenes) == (option != "none")
    for option in OPTIONS["search"][number : number + 1]:
        assert callable(get_object(described("pareto", f"search={option}").search._target_))


def described(command, *chosen):
    """The configuration of a command, of which every key is described."""
    composed = Composed(command, list(chosen))
    assert [key.name for key in composed.keys if not key.description] == []
    return composed.config


def test_every_scene_makes_recordings():
    config = composed("scene=hard", "data.cycles=1", "data.materials=[M3,wood]")
    assert config.scene.name == "hard"
    for option in OPTIONS["scene"]:
        own = yaml.safe_load((conf_dir() / "scene" / f"{option}.yaml").read_text())
        assert own["name"] == option
        source = instantiate(config.data, scene=own, _convert_="all")
        assert [str(r.scene) for r in source.ids] == [option, option]


def test_evaluate_judges_on_the_same_defaults_as_train():
    train = OmegaConf.to_container(composed(), resolve=True)
    evaluate = OmegaConf.to_container(composed("model=a.pt", name="evaluate"), resolve=True)
    for section in ("data", "labels", "split", "trainer", "seed"):
        assert evaluate[section] == train[section]
