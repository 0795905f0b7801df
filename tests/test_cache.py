"""Cached features: what is stored comes back, damage is noticed, and the folder stays small."""

import os

import pytest
import torch

from tactslip_torch.features.cache import (
    FeatureCache,
    cache_key,
    default_cache_folder,
    source_digest,
)

KEY = cache_key({"what": "a recording"})


@pytest.fixture
def cache(tmp_path):
    return FeatureCache(tmp_path / "cache")


def features(num_bins=7, num_features=11, seed=0):
    return torch.randn(num_bins, num_features, generator=torch.Generator().manual_seed(seed))


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
    assert cache.load(KEY) is None
    assert not cache.folder.exists()
    cache.store(KEY, features(2, 2))
    cache.store(KEY, values)  # replaces
    for _ in range(2):  # what is loaded may be written to
        loaded = cache.load(KEY)
        assert loaded.dtype == torch.float32
        assert torch.equal(loaded.view(torch.int32), values.contiguous().view(torch.int32))
        loaded.zero_()
    assert [path.suffix for path in files(cache)] == [".npz"]


DAMAGES = [
    *(lambda content, n=n: content[:n] for n in (0, 40, -4)),
    *(lambda content, n=n: content[:n] + b"?" + content[n + 1 :] for n in (0, 300)),
    lambda content: b"not features at all" * 20,
    lambda content: bytes(len(content)),
]


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_file_is_absent_with_a_warning_and_is_written_again(cache, caplog, damage):
    cache.store(KEY, features())
    (path,) = files(cache)
    path.write_bytes(damage(path.read_bytes()))
    assert cache.load(KEY) is None
    (record,) = caplog.records
    assert record.levelname == "WARNING"
    assert all(word in caplog.text for word in (str(path), "damaged"))
    cache.store(KEY, features())
    assert torch.equal(cache.load(KEY), features())


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
        cache.store(key, features(seed=i))
        os.utime(cache.folder / key[:2] / f"{key}.npz", (1000 + i, 1000 + i))
    cache.most_bytes = most_files * files(cache)[0].stat().st_size + spare_bytes
    place = cache.folder / keys[0][:2]
    others = [cache.folder / "README", place / f".{keys[0]}.1.tmp.npz"]
    for path in others:  # the second is being written by another run
        path.write_text("mine")
    (place / "gone.npz").symlink_to(cache.folder / "nowhere")
    if read is not None:
        cache.load(keys[read])
    cache.prune()
    assert [i for i, key in enumerate(keys) if cache.load(key) is not None] == left
    assert all(path.exists() for path in others)


def test_the_digest_follows_names_and_content_wherever_the_package_lies(tmp_path):
    one, two = tmp_path / "one", tmp_path / "two"
    for package in (one, two):
        (package / "b").mkdir(parents=True)
        (package / "a.py").write_text("x = 1\n")
        (package / "b" / "c.py").write_text("y = 2\n")
        (package / "notes.txt").write_text(package.name)  # no code
    digests = [source_digest(one)]
    assert digests == [source_digest(two)]
    for change in (
        lambda: (one / "b" / "c.py").write_text("y = 3\n"),
        lambda: (one / "b" / "c.py").rename(one / "b" / "d.py"),
        lambda: (one / "b" / "e.py").touch(),
        lambda: (one / "engine.cpp").touch(),  # makes features too
    ):
        change()
        digests.append(source_digest(one))
    assert len(set(digests)) == 5


def test_the_users_cache_folder(monkeypatch, tmp_path):
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    for value, folder in ((str(tmp_path), tmp_path), ("", tmp_path / "home" / ".cache")):
        monkeypatch.setenv("XDG_CACHE_HOME", value)
        assert default_cache_folder() == folder / "tactslip_torch"
