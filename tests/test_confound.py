"""Detectors side by side on kinds of scenes: what is counted, shown, and learned from scenes."""

import contextlib
import io
import json

import pytest
import torch
from small_set import RATE_HZ, SMALL_HAND, SmallTimeline
from test_commands import composed

from tactslip_torch.commands.evaluate import evaluate
from tactslip_torch.commands.train import train
from tactslip_torch.data.recording import Recording, RecordingId
from tactslip_torch.report.results import confound_table

pytestmark = pytest.mark.slow


class SmallScenes:
    """Two channels: the gauge hums while the arm moves, the film rustles while the hand slides.

    ``arm_motion`` has the hum alone, ``pulled`` and ``motor_off`` the rustle alone, all others
    both, as the protocol.
    """

    is_simulated = True
    hand = SMALL_HAND
    sample_rate_hz = RATE_HZ

    def __init__(self, *, cycles, materials, scene, extra_scenes, **_):
        kinds = (scene["name"], *extra_scenes)
        self.ids = tuple(
            RecordingId(m, c, k) for k in kinds for m in materials for c in range(cycles)
        )

    def timeline(self, recording):
        if recording.scene != "arm_motion":
            return SmallTimeline()
        rest = dict.fromkeys(("onsets_s", "annotated_onsets_s", "sliding_s", "speeds_mm_s"), ())
        return SmallTimeline(**rest, non_slip_s=((1.1, 1.95),))

    def key(self, recording):
        return {"scenes": str(recording)}

    def load(self, recording, windows=None):
        generator = torch.Generator().manual_seed(sum(str(recording).encode()) * 7919)
        gauge, film = torch.randn(2, 4000, generator=generator)
        moving = slice(2200, 3900)
        if recording.scene not in ("pulled", "motor_off"):
            gauge[moving] *= 6.0
        if recording.scene != "arm_motion":
            film[moving] *= 1.6
        times = self.timeline(recording)
        facts = (times.speeds_mm_s, times.onsets_s, times.sliding_s)
        return Recording(torch.stack([gauge, film]), RATE_HZ, recording.material, *facts)


SMALL = (
    "data._target_=test_confound.SmallScenes",
    "data.materials=[a,b,c]",
    "data.cycles=2",
    "split.seen=[a,b]",
    "split.unseen=[c]",
    "split.train_fraction=0.5",
    "cache=off",
    "num_workers=0",
)


@pytest.fixture(scope="module")
def ran(tmp_path_factory):
    """``+exp=confound`` on the small scenes: the folder, what it printed, what it returned."""
    folder = tmp_path_factory.mktemp("confound")
    recipe = ("recipe=robust", "recipe.num_features=10", "recipe.penalties=[0.1,1.0]")
    with contextlib.redirect_stdout(io.StringIO()) as printed:
        returned = train(
            composed(*SMALL, "+exp=confound", *recipe, "recipe.sample_bins=100", "export=false"),
            folder,
        )
    return folder, printed.getvalue(), returned


# The experiment, on small scenes -----------------------------------------------------------------


def test_a_run_on_several_scenes_leaves_table_and_figure(ran):
    folder, printed, _ = ran
    metrics = json.loads((folder / "metrics.json").read_text())
    assert list(metrics["folds"]) == ["protocol", "with_scenes"]
    assert confound_table(metrics) in printed
    for name in (
        "confound.png",
        "confusion.png",
        "protocol/detector.pt",
        "with_scenes/detector.pt",
    ):
        assert (folder / name).is_file(), name


def test_scores_on_the_same_bins_are_each_ones_own_and_no_sums(ran):
    metrics = json.loads((ran[0] / "metrics.json").read_text())
    roles = ("train", "test", "unseen")
    for role in roles[1:]:
        one, other = (
            {
                scene: [sum(row) for row in scores["confusion"]]
                for scene, scores in fold["splits"][role]["per_scene"].items()
            }
            for fold in metrics["folds"].values()
        )
        assert one == other
        assert len(one) == 8
    expected = {
        f"{fold}/{role}": metrics["folds"][fold]["splits"][role]
        for fold in ("protocol", "with_scenes")
        for role in roles
    }
    assert metrics["splits"] == expected
    assert metrics["events"] == {
        f"{fold}/{role}": metrics["folds"][fold]["events"][role]
        for fold in ("protocol", "with_scenes")
        for role in roles
    }
    assert len(metrics["baselines"]) == 4
    for name, found in metrics["baselines"].items():
        assert found["splits"] == {
            f"{fold}/{role}": of["baselines"][name]["splits"][role]
            for fold, of in metrics["folds"].items()
            for role in roles
        }
    assert ran[2] == {
        f"{place}/{name}": scores[name]
        for place, scores in expected.items()
        for name in ("accuracy", "balanced_accuracy")
    }
    assert ran[2]["protocol/test/accuracy"] != ran[2]["with_scenes/test/accuracy"]


# A saved detector --------------------------------------------------------------------------------


def evaluated(ran, folder, *overrides):
    model = f"model={ran[0] / 'with_scenes' / 'detector.pt'}"
    return evaluate(composed(*SMALL, model, *overrides, name="evaluate"), folder)


def test_evaluate_counts_bins_that_both_folds_hold_out_once(ran, tmp_path):
    metrics = evaluated(ran, tmp_path, "+exp=confound", "cache=off")
    trained = json.loads((ran[0] / "metrics.json").read_text())["folds"]["with_scenes"]
    for role in ("train", "test", "unseen"):  # with_scenes trains on all that protocol does
        assert metrics["splits"][role]["confusion"] == trained["splits"][role]["confusion"]
    assert list(metrics["overlap"]) == ["protocol", "with_scenes"]
    for fold in metrics["overlap"]:
        assert (tmp_path / fold / "csv" / "metrics.csv").is_file()
