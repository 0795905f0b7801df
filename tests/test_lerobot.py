"""Episodes of LeRobot datasets, laid out as its versions 2.1 and 3.0 define them, as recordings."""

import json

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from small_detector import HAND
from test_data_tool import run as data_tool
from test_detect import RATE_HZ, detected, model, recording, save, volts  # noqa: F401

from tactslip_torch.data.folder import recording_files, write_template
from tactslip_torch.data.formats import FORMATS, Reading, open_file

PATHS = {
    "v2.1": "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet",
    "v3.0": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
}
SCALARS = {
    "timestamp": ("float32", pa.float32()),
    **dict.fromkeys(("frame_index", "episode_index", "index", "task_index"), ("int64", pa.int64())),
}
LENGTHS = (300, 200, 450)


def nested(values):
    """Rows ``[T, ...]`` as lists of fixed length, as ``datasets`` keeps them."""
    if values.ndim == 1:
        return pa.array(values)
    inner = nested(values.reshape(-1, *values.shape[2:]))
    return pa.FixedSizeListArray.from_arrays(inner, values.shape[1])


def dataset(root, version, episodes, fps=RATE_HZ, feature="observation.tactile", names=None):
    """A dataset of tactile episodes ``[T, ...]`` beside the state of an arm and a video."""
    shape = list(episodes[0].shape[1:])
    said = {name: {"dtype": of, "shape": [1], "names": None} for name, (of, _) in SCALARS.items()}
    said |= {
        "observation.images.top": {"dtype": "video", "shape": [3, 96, 96], "names": None},
        "observation.state": {"dtype": "float32", "shape": [2], "names": {"motors": ["a", "b"]}},
        feature: {"dtype": "float64", "shape": shape, "names": names},
    }
    info = {
        "codebase_version": version,
        "fps": fps,
        "total_episodes": len(episodes),
        "total_frames": sum(map(len, episodes)),
        "chunks_size": 2,
        "data_path": PATHS[version],
        "features": said,
    }
    (root / "meta").mkdir(parents=True)
    (root / "meta" / "info.json").write_text(json.dumps(info))
    tables, listed, start = {}, [], 0
    for number, values in enumerate(episodes):
        count = np.arange(len(values))
        of = {
            "observation.state": nested(np.zeros((len(values), 2), np.float32)),
            feature: nested(values),
            "timestamp": pa.array((count / fps).astype(np.float32)),
            "frame_index": pa.array(count),
            "episode_index": pa.array(np.full(len(values), number)),
            "index": pa.array(start + count),
            "task_index": pa.array(np.zeros(len(values), np.int64)),
        }
        chunk = number // 2
        own = {"episode_chunk": chunk, "episode_index": number}
        path = PATHS[version].format(**own, chunk_index=chunk, file_index=0)
        tables.setdefault(path, []).append(pa.table(of))
        listed.append({"episode_index": number, "data/chunk_index": chunk, "data/file_index": 0})
        start += len(values)
    for path, parts in tables.items():
        (root / path).parent.mkdir(parents=True, exist_ok=True)
        pq.write_table(pa.concat_tables(parts), root / path)
    if version == "v3.0":
        path = root / "meta/episodes/chunk-000/file-000.parquet"
        path.parent.mkdir(parents=True)
        pq.write_table(pa.Table.from_pylist(listed), path)
    return root


def noise(*shape):
    return np.random.default_rng(0).standard_normal(shape)


@pytest.mark.parametrize("version", PATHS)
def test_every_episode_is_a_recording(version, tmp_path):
    episodes = [noise(length, 4) for length in LENGTHS]
    dataset(tmp_path / "a", version, episodes, names=list(HAND.names))
    paths = recording_files(tmp_path / "a")
    assert recording_files(tmp_path, in_folders=True) == paths
    for path, values in zip(paths, episodes, strict=True):
        with open_file(path) as opened:
            assert opened.names == HAND.names
            assert (opened.archived, opened.sample_rate_hz) == (None, RATE_HZ)
            np.testing.assert_array_equal(opened.samples.read(0, 10**6).T, values)
            np.testing.assert_allclose(opened.times(), np.arange(len(values)) / RATE_HZ, atol=1e-6)


@pytest.mark.parametrize("axes", ["time", "channel"])
def test_a_frame_may_hold_several_samples_of_each_channel(axes, tmp_path):
    values = noise(50, 20, 4)
    stored = values if axes == "time" else values.swapaxes(1, 2)
    dataset(tmp_path / "a", "v3.0", [np.ascontiguousarray(stored)], fps=100)
    (path,) = recording_files(tmp_path / "a")
    with open_file(path, Reading(samples_per_row=20, row_order=axes)) as opened:
        assert opened.sample_rate_hz == 2000
        np.testing.assert_array_equal(opened.samples.read(0, 1000).T, values.reshape(-1, 4))


def test_detect_and_the_tool_for_sets_take_a_dataset(model, tmp_path, capsys):  # noqa: F811
    loud = [volts(4.0, ((2.0, 3.0),), seed=seed) for seed in (0, 1)]
    episodes = [samples.double().numpy().T for samples in loud]
    root = dataset(tmp_path / "a", "v3.0", episodes, names=list(HAND.names))
    found = detected(model, root, tmp_path / "out", "figure=none")["recordings"]
    nothing = {"speeds_mm_s": (), "onsets_s": (), "sliding_s": (), "provenance": {}}
    for entry, samples in zip(found, loud, strict=True):
        save(tmp_path / "b.npz", recording(samples.double(), **nothing))
        plain = detected(model, tmp_path / "b.npz", tmp_path / "b", "figure=none")
        assert entry["alarms"] == plain["recordings"][0]["alarms"] != []
        assert entry["material"] is entry["truth"] is None
    write_template(root, "episode_{trial}")
    manifest = root / "manifest.csv"
    manifest.write_text(manifest.read_text().replace(".lerobot,", ".lerobot,wood"))
    assert data_tool("check", root) == 0
    assert "2 recordings of 1 material, 8.0 s, 4 channels at 2000 Hz" in capsys.readouterr().out
    written = data_tool("convert", root, "to=npz", f"output={tmp_path / 'c'}")
    assert len(written) == 2
    again = FORMATS["npz"].load(tmp_path / "c" / "episode_000001.npz").recording.samples
    np.testing.assert_array_equal(again, loud[1])


def edited(**changes):
    def edit(root):
        path = root / "meta" / "info.json"
        path.write_text(json.dumps(json.loads(path.read_text()) | changes))

    return edit


def emptied(root):
    (root / "meta" / "info.json").write_text("{")


def without(name):
    return lambda root: next(root.glob(name)).unlink()


WRONG = {
    "no such feature": (edited(), {"samples": "skin"}, "no feature 'skin'; say reading.samp"),
    "several": (edited(), {"samples": "x"}, "are observation.state, observation.tactile"),
    "frames": (edited(fps="fast"), {}, "fast frames a second"),
    "outside": (edited(data_path="../{episode_index}"), {}, "data_path is '../"),
    "damaged": (emptied, {}, "info.json is damaged"),
    "no table": (without("data/*/*"), {}, "is not there; download it whole"),
    "unlisted": (without("meta/episodes/*/*"), {}, "listed in no file of meta/episodes"),
    "fewer": (edited(total_episodes=0), {}, "none of the 0 episodes"),
    "many": (edited(total_episodes=10**9), {}, "total_episodes is 1000000000"),
}


@pytest.mark.parametrize("name", WRONG)
def test_what_is_wrong_is_one_line(name, tmp_path):
    spoil, said, words = WRONG[name]
    root = dataset(tmp_path / "a", "v3.0", [noise(30, 4)])
    (path,) = recording_files(root)
    spoil(root)
    with pytest.raises(ValueError, match=words) as caught, open_file(path, Reading(**said)):
        pass
    assert str(caught.value).startswith(str(root))
    assert "\n" not in str(caught.value)
