import json
import logging
import os
from pathlib import Path

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


def only_file(cache):
    (path,) = (p for p in cache.folder.rglob("*") if p.is_file())
    return path


# Store and load ------------------------------------------------------------------------------


@pytest.mark.parametrize("shape", [(7, 11), (0, 11), (1, 1)])
def test_what_is_stored_comes_back_bit_by_bit(cache, shape):
    values = features(*shape)
    cache.store(KEY, values)
    loaded = cache.load(KEY)
    assert loaded.dtype == torch.float32
    assert loaded.shape == shape
    assert torch.equal(loaded.view(torch.int32), values.view(torch.int32))


def test_extreme_values_come_back_bit_by_bit(cache):
    tiny = torch.finfo(torch.float32).smallest_normal / 8
    values = torch.tensor([[torch.nan, torch.inf, -torch.inf, -0.0, tiny, 3.4e38]])
    cache.store(KEY, values)
    assert torch.equal(cache.load(KEY).view(torch.int32), values.view(torch.int32))


def test_views_are_stored_as_what_they_show(cache):
    values = features(11, 7).T[::2]
    cache.store(KEY, values)
    assert torch.equal(cache.load(KEY), values)


def test_loaded_features_may_be_written_to(cache):
    cache.store(KEY, features())
    cache.load(KEY).zero_()
    assert torch.equal(cache.load(KEY), features())


def test_keys_do_not_meet(cache):
    keys = [cache_key({"cycle": i}) for i in range(5)]
    for i, key in enumerate(keys):
        cache.store(key, features(seed=i))
    for i, key in enumerate(keys):
        assert torch.equal(cache.load(key), features(seed=i))


def test_storing_again_replaces(cache):
    cache.store(KEY, features(seed=1))
    cache.store(KEY, features(3, 2, seed=2))
    assert torch.equal(cache.load(KEY), features(3, 2, seed=2))
    assert only_file(cache)


def test_what_is_not_there_is_none_and_no_complaint(cache, caplog):
    assert cache.load(KEY) is None
    assert not caplog.records
    assert not cache.folder.exists()


# Damage --------------------------------------------------------------------------------------


def flipped(position):
    def damage(content):
        changed = bytearray(content)
        changed[position] ^= 1
        return bytes(changed)

    return damage


@pytest.mark.parametrize(
    "damage",
    [
        *(flipped(position) for position in (0, 8, 24, 32, 40, -1)),
        *(lambda content, n=n: content[:n] for n in (0, 4, 8, 20, 24, 40, -4, -1)),
        lambda content: content + b"\0",
        lambda content: b"not features at all" * 20,
        lambda content: content[:8] + bytes(len(content) - 8),
    ],
)
def test_a_damaged_file_is_absent_with_a_warning_and_can_be_written_anew(cache, caplog, damage):
    cache.store(KEY, features())
    path = only_file(cache)
    path.write_bytes(damage(path.read_bytes()))
    with caplog.at_level(logging.WARNING):
        assert cache.load(KEY) is None
    assert [record.levelname for record in caplog.records] == ["WARNING"]
    assert str(path) in caplog.text
    assert "damaged" in caplog.text
    cache.store(KEY, features())
    assert torch.equal(cache.load(KEY), features())


def test_no_temporary_file_stays(cache):
    cache.store(KEY, features())
    assert [p.suffix for p in cache.folder.rglob("*") if p.is_file()] == [".features"]


def test_a_failed_write_leaves_the_old_features(cache, monkeypatch):
    cache.store(KEY, features())

    def full(self, data):
        raise OSError("no space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(OSError, match="no space"):
        cache.store(KEY, features(seed=1))
    assert torch.equal(cache.load(KEY), features())
    assert only_file(cache)


# Prune ---------------------------------------------------------------------------------------


def filled(folder, most_files, num_files=5):
    cache = FeatureCache(folder)
    keys = [cache_key({"cycle": i}) for i in range(num_files)]
    for i, key in enumerate(keys):
        cache.store(key, features(seed=i))
    paths = [folder / key[:2] / f"{key}.features" for key in keys]
    for i, path in enumerate(paths):
        os.utime(path, (1000 + i, 1000 + i))
    cache.most_bytes = most_files * paths[0].stat().st_size
    return cache, keys


def test_prune_drops_the_least_recently_written_first(tmp_path):
    cache, keys = filled(tmp_path, most_files=3)
    cache.prune()
    assert [cache.load(key) is not None for key in keys] == [False, False, True, True, True]


def test_reading_counts_as_use(tmp_path):
    cache, keys = filled(tmp_path, most_files=2)
    cache.load(keys[0])
    cache.prune()
    assert [cache.load(key) is not None for key in keys] == [True, False, False, False, True]


@pytest.mark.parametrize("spare_bytes", [0, -1])
def test_prune_keeps_what_fits(tmp_path, spare_bytes):
    cache, keys = filled(tmp_path, most_files=5)
    cache.most_bytes += spare_bytes
    cache.prune()
    assert [cache.load(key) is not None for key in keys] == [spare_bytes == 0] + 4 * [True]


def test_prune_touches_nothing_else(tmp_path):
    cache, _ = filled(tmp_path, most_files=0)
    (tmp_path / "README").write_text("mine")
    (tmp_path / "aa").mkdir(exist_ok=True)
    (tmp_path / "aa" / "notes.txt").write_text("mine too")
    cache.prune()
    left = sorted(p.name for p in tmp_path.rglob("*") if p.is_file())
    assert left == ["README", "notes.txt"]


def test_prune_of_no_folder_is_nothing(cache):
    cache.prune()
    assert not cache.folder.exists()


def test_prune_leaves_files_that_another_run_is_writing(tmp_path):
    cache, keys = filled(tmp_path, most_files=0)
    unfinished = tmp_path / keys[0][:2] / f".{keys[0]}.123.tmp.features"
    unfinished.write_bytes(b"half")
    cache.prune()
    assert [path.name for path in tmp_path.rglob("*.features")] == [unfinished.name]


def test_prune_bears_files_that_vanish_meanwhile(tmp_path):
    """Another run prunes, or renames its temporary file, between the listing and the look."""
    cache, keys = filled(tmp_path, most_files=5)
    gone = tmp_path / keys[0][:2] / "gone.features"
    gone.symlink_to(tmp_path / "nowhere")
    cache.prune()
    assert all(cache.load(key) is not None for key in keys)


# Keys ----------------------------------------------------------------------------------------

FACTS = {"recording": {"seed": 0, "material": "M1"}, "starts": [1, 2], "filter": [[51, 11], 1]}


def test_equal_facts_have_one_key():
    turned = dict(reversed(list(FACTS.items())))
    assert cache_key(turned) == cache_key(FACTS) == cache_key(json.loads(json.dumps(FACTS)))


@pytest.mark.parametrize(
    "other",
    [
        FACTS | {"recording": {"seed": 1, "material": "M1"}},
        FACTS | {"recording": {"seed": 0, "material": "M2"}},
        FACTS | {"starts": [2, 1]},
        FACTS | {"starts": [1, 2, 3]},
        FACTS | {"filter": [[51], 11, 1]},
        FACTS | {"torch": "2.13.0"},
        {k: v for k, v in FACTS.items() if k != "filter"},
    ],
)
def test_any_other_fact_is_another_key(other):
    assert cache_key(other) != cache_key(FACTS)


def test_facts_that_equal_nothing_are_refused():
    with pytest.raises(ValueError, match="not JSON compliant"):
        cache_key({"gain": float("nan")})


def test_the_digest_follows_names_and_content(tmp_path):
    (tmp_path / "a.py").write_text("x = 1\n")
    (tmp_path / "b").mkdir()
    (tmp_path / "b" / "c.py").write_text("y = 2\n")
    first = source_digest(tmp_path)
    assert source_digest(tmp_path) == first
    (tmp_path / "notes.txt").write_text("no code")
    assert source_digest(tmp_path) == first

    (tmp_path / "b" / "c.py").write_text("y = 3\n")
    changed = source_digest(tmp_path)
    (tmp_path / "b" / "c.py").rename(tmp_path / "b" / "d.py")
    renamed = source_digest(tmp_path)
    (tmp_path / "b" / "e.py").write_text("")
    assert len({first, changed, renamed, source_digest(tmp_path)}) == 4


def test_the_digest_does_not_depend_on_where_the_package_lies(tmp_path):
    for folder in ("one", "two"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "a.py").write_text("x = 1\n")
    assert source_digest(tmp_path / "one") == source_digest(tmp_path / "two")


def test_the_users_cache_folder(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert default_cache_folder() == tmp_path / "tactslip_torch"
    monkeypatch.setenv("XDG_CACHE_HOME", "")
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    assert default_cache_folder() == tmp_path / "home" / ".cache" / "tactslip_torch"
