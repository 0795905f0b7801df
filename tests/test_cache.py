"""Cached features: what is stored comes back, damage is noticed, and the folder stays small."""

import ast
import errno
import os
import shutil
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch

from tactslip_torch.features.cache import (
    FeatureCache,
    KeptFeatures,
    cache_key,
    default_cache_folder,
    features_digest,
)
from tactslip_torch.runtime import PACKAGE
from tactslip_torch.training.experiment import feature_cache

KEY = cache_key({"what": "a recording"})
RUN = 7


@pytest.fixture
def cache(tmp_path):
    return FeatureCache(tmp_path / "cache")


def features(num_bins=7, num_features=11, seed=0):
    return torch.randn(num_bins, num_features, generator=torch.Generator().manual_seed(seed))


def sensed(num_bins, num_channels=3):
    random = torch.Generator().manual_seed(1)
    span = torch.rand(num_bins, num_channels, generator=random, dtype=torch.float64)
    return span, torch.randint(1, 9, span.shape, generator=random)


def keep(cache, key, values):
    cache.store(key, range(values.shape[1]), KeptFeatures(values, *sensed(len(values)), RUN))


def kept(cache, key, num_features=11):
    return cache.load(key, range(num_features))


def files(cache):
    return [path for path in cache.folder.rglob("*") if path.is_file()]


TINY = torch.finfo(torch.float32).smallest_normal / 8


@pytest.mark.parametrize(
    "values",
    [
        features(),
        features(0, 11),
        features(11, 7).T[::2],
        torch.tensor([[torch.nan, torch.inf, -torch.inf, -0.0, TINY, 3.4e38]]),
    ],
    ids=["some", "none", "a view", "extremes"],
)
def test_what_is_stored_comes_back_bit_by_bit(cache, values):
    assert kept(cache, KEY) is None
    assert not cache.folder.exists()
    keep(cache, KEY, features(2, 2))
    keep(cache, KEY, values)  # replaces
    for _ in range(2):  # what is loaded may be written to
        loaded, span, run, longest_run = kept(cache, KEY, values.shape[1])
        assert longest_run == RUN
        assert all(map(torch.equal, (span, run), sensed(len(values))))
        assert loaded.dtype == torch.float32
        assert torch.equal(loaded.view(torch.int32), values.contiguous().view(torch.int32))
        loaded.zero_()
    assert [path.suffix for path in files(cache)] == [".npz"]


def is_whole(found):
    return torch.equal(found.features, features()) and found.longest_run == RUN


DAMAGES = [
    *(lambda content, n=n: content[:n] for n in (0, 40, -4)),
    *(lambda content, n=n: content[:n] + b"?" + content[n + 1 :] for n in (0, 300)),
    lambda content: b"not features at all" * 20,
    lambda content: bytes(len(content)),
]


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_file_is_absent_with_a_warning_and_is_written_again(cache, caplog, damage):
    keep(cache, KEY, features())
    (path,) = files(cache)
    path.write_bytes(damage(path.read_bytes()))
    assert kept(cache, KEY) is None
    (record,) = caplog.records
    assert record.levelname == "WARNING"
    assert all(word in caplog.text for word in (str(path), "damaged"))
    keep(cache, KEY, features())
    assert is_whole(kept(cache, KEY))


CAUSES = {
    "full": OSError(errno.ENOSPC, "No space left on device"),
    "read-only": OSError(errno.EROFS, "Read-only file system"),
    "in use": PermissionError(errno.EACCES, "Permission denied"),
}


@pytest.mark.parametrize("cause", CAUSES)
def test_what_cannot_be_written_or_read_is_one_warning_and_no_end(
    cause, cache, caplog, monkeypatch
):
    def refuse(*args, **options):
        raise CAUSES[cause]

    keep(cache, KEY, features())
    monkeypatch.setattr(np, "savez", refuse)
    for number in range(3):
        keep(cache, cache_key({"number": number}), features())
    monkeypatch.setattr(Path, "unlink", refuse)
    cache.most_bytes = 0
    cache.prune()
    assert is_whole(kept(cache, KEY))
    monkeypatch.setattr(zipfile, "ZipFile", refuse)
    for _ in range(3):
        assert kept(cache, KEY) is None
    for record, words in zip(caplog.records, ("cannot be stored", "cannot be read"), strict=True):
        assert all(word in record.getMessage() for word in (words, CAUSES[cause].strerror))


def test_a_file_that_nobody_may_touch_is_still_read(cache, monkeypatch, caplog):
    keep(cache, KEY, features())
    monkeypatch.setattr(os, "utime", lambda path: (_ for _ in ()).throw(PermissionError("no")))
    assert is_whole(kept(cache, KEY))
    assert not caplog.records


def test_a_folder_that_cannot_be_made_does_not_end_a_run(tmp_path, monkeypatch):
    monkeypatch.setattr(Path, "mkdir", lambda *_, **__: (_ for _ in ()).throw(CAUSES["read-only"]))
    with feature_cache(str(tmp_path / "new")) as cache:
        keep(cache, KEY, features())
        assert kept(cache, KEY) is None


PRUNED = [
    (3, 0, None, [2, 3, 4]),
    (2, 0, 0, [0, 4]),  # reading counts as use
    (5, 0, None, [0, 1, 2, 3, 4]),
    (5, -1, None, [1, 2, 3, 4]),
    (0, 0, None, []),
]


@pytest.mark.parametrize(("most_files", "spare_bytes", "read", "left"), PRUNED)
def test_prune_drops_what_was_used_longest_ago_and_nothing_else(
    cache, most_files, spare_bytes, read, left
):
    cache.prune()  # of nothing
    keys = [cache_key({"cycle": i}) for i in range(5)]
    for i, key in enumerate(keys):
        keep(cache, key, features(seed=i))
        os.utime(cache.folder / key[:2] / f"{key}.npz", (1000 + i, 1000 + i))
    cache.most_bytes = most_files * files(cache)[0].stat().st_size + spare_bytes
    place = cache.folder / keys[0][:2]
    others = [cache.folder / "README", place / f".{keys[0]}.1.tmp.npz"]
    for path in others:  # the second is being written by another run
        path.write_text("mine")
    (place / "gone.npz").symlink_to(cache.folder / "nowhere")
    if read is not None:
        kept(cache, keys[read])
    cache.prune()
    assert [i for i, key in enumerate(keys) if kept(cache, key) is not None] == left
    assert all(path.exists() for path in others)


def test_only_what_makes_features_changes_their_digest(tmp_path):
    counts = ("hand.py", "signals/filtering.py", "features/pool.py", "native/engine.cpp")
    counts += ("data/clock.py", "training/datamodule.py")
    others = ("commands/train.py", "live/pump.py", "export/host.py", "report/a.py", "conf/a.yaml")
    samples = "simulation/simulate.py"
    for name in (*counts, *others, samples):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text("1")

    def digests():
        return [features_digest(tmp_path, simulated=each) for each in (False, True)]

    for name in (*counts, *others, samples):
        before = digests()
        (tmp_path / name).write_text("2")
        changed = [now != then for now, then in zip(digests(), before, strict=True)]
        assert changed == [name in counts, name in (*counts, samples)], name


def test_all_that_makes_features_is_in_their_digest(tmp_path):
    """Each module that is imported on the way from samples to features, and by these again."""
    modules, seen = ["training.datamodule", "data.file_recordings", "simulation.simulate"], set()
    copy = tmp_path / "tactslip_torch"
    shutil.copytree(PACKAGE, copy, ignore=shutil.ignore_patterns("__pycache__"))
    while modules:
        path = copy / modules.pop().replace(".", "/")
        path = path / "__init__.py" if path.is_dir() else path.with_suffix(".py")
        if path in seen or not path.exists():
            continue
        seen.add(path)
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith(PACKAGE.name):
                name = node.module.removeprefix(PACKAGE.name).lstrip(".")
                modules += [name, *(f"{name}.{each.name}" for each in node.names)] if name else []
    assert len(seen) > 20
    for path in sorted(seen):
        before = features_digest(copy, simulated=True)
        path.write_text(path.read_text() + "\n")
        assert features_digest(copy, simulated=True) != before, path


def test_the_users_cache_folder(monkeypatch, tmp_path):
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    for value, folder in ((str(tmp_path), tmp_path), ("", tmp_path / "home" / ".cache")):
        monkeypatch.setenv("XDG_CACHE_HOME", value)
        assert default_cache_folder() == folder / "tactslip_torch"
