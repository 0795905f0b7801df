"""Detectors side by side on kinds of scenes: what is counted, shown, and learned from scenes."""

import contextlib
import io
import json

import pytest
from small_set import NoiseRecordings, SmallTimeline
from test_commands import composed

from tactslip_torch.commands.evaluate import evaluate
from tactslip_torch.commands.train import train
from tactslip_torch.data.recording import RecordingId, Timeline
from tactslip_torch.report.results import _confound_table

pytestmark = pytest.mark.slow


class SmallScenes(NoiseRecordings):
    """Two channels: the gauge hums while the arm moves, the film rustles while the hand slides.

    ``arm_motion`` has the hum alone, ``pulled`` and ``motor_off`` the rustle alone, all others
    both, as the protocol.
    """

    def __init__(self, *, cycles, materials, scene, extra_scenes, **_):
        kinds = (scene["name"], *extra_scenes)
        self.ids = tuple(
            RecordingId(m, c, k) for k in kinds for m in materials for c in range(cycles)
        )

    def timeline(self, recording):
        if recording.scene != "arm_motion":
            return SmallTimeline()
        return Timeline(duration_s=2.0, non_slip_s=((1.1, 1.95),))

    def shape(self, noise, time_s, recording, generator):
        is_moving = (time_s >= 1.1) & (time_s < 1.95)
        if recording.scene not in ("pulled", "motor_off"):
            noise[0, is_moving] *= 6.0
        if recording.scene != "arm_motion":
            noise[1, is_moving] *= 1.6


SMALL = (
    *("data._target_=test_confound.SmallScenes", "data.materials=[a,b,c]", "data.cycles=2"),
    *("split.seen=[a,b]", "split.unseen=[c]", "split.train_fraction=0.5"),
    *("cache=off", "num_workers=0"),
)


@pytest.fixture(scope="module")
def ran(tmp_path_factory):
    """``+exp=confound`` on the small scenes: the folder, what it printed, what it returned."""
    folder = tmp_path_factory.mktemp("confound")
    recipe = ("recipe=paper", "recipe.num_features=10", "recipe.penalties=[0.1,1.0]")
    told = *SMALL, "+exp=confound", *recipe, "recipe.sample_bins=100", "export=false"
    with contextlib.redirect_stdout(io.StringIO()) as printed:
        returned = train(composed(*told), folder)
    return folder, printed.getvalue(), returned


# The experiment, on small scenes -----------------------------------------------------------------


def test_a_run_on_several_scenes_leaves_table_figure_and_scores_by_fold(ran):
    folder, printed, returned = ran
    metrics = json.loads((folder / "metrics.json").read_text())
    folds = metrics["folds"]
    assert list(folds) == ["protocol", "with_scenes"]
    assert _confound_table(metrics) in printed
    for name in ("confound.png", "confusion.png", *(f"{fold}/detector.pt" for fold in folds)):
        assert (folder / name).is_file(), name
    for role in ("test", "unseen"):  # the same bins of every scene
        scenes = [of["splits"][role]["per_scene"] for of in folds.values()]
        one, other = ({name: s["num_bins"] for name, s in own.items()} for own in scenes)
        assert one == other
        assert len(one) == 8
    places = [(fold, role) for fold in folds for role in ("train", "test", "unseen")]
    for kind in ("splits", "events"):  # each fold's own, and no sums
        assert metrics[kind] == {f"{f}/{role}": folds[f][kind][role] for f, role in places}
    for name, found in metrics["baselines"].items():
        own = {f"{f}/{role}": folds[f]["baselines"][name]["splits"][role] for f, role in places}
        assert found["splits"] == own
    for fold, role in places:
        if role != "train":
            assert metrics["comparison"][f"{fold}/{role}"] == folds[fold]["comparison"][role]
    assert returned["protocol/test/accuracy"] != returned["with_scenes/test/accuracy"]


# A saved detector --------------------------------------------------------------------------------


def test_evaluate_counts_bins_that_both_folds_hold_out_once(ran, tmp_path):
    model = f"model={ran[0] / 'with_scenes' / 'detector.pt'}"
    metrics = evaluate(
        composed("data=simulated", *SMALL, model, "+exp=confound", name="evaluate"), tmp_path
    )
    trained = json.loads((ran[0] / "metrics.json").read_text())["folds"]["with_scenes"]
    for role in ("train", "test", "unseen"):  # with_scenes trains on all that protocol does
        assert metrics["splits"][role]["confusion"] == trained["splits"][role]["confusion"]
    assert list(metrics["overlap"]) == ["protocol", "with_scenes"]
    for fold in metrics["overlap"]:
        assert (tmp_path / fold / "csv" / "metrics.csv").is_file()
