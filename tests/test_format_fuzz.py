"""No file makes reading crash, run code, take memory or say more than a line, whatever is in it."""

import itertools
import os
import pickle
import shutil

import pytest
from fuzz import (
    MANIFEST_TRAPS,
    TRAPS,
    Prober,
    Runs,
    assert_read_or_refused,
    assert_refused,
    content_of,
    damage,
    write,
    write_seeds,
    write_trap,
)
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tactslip_torch.data.formats import FORMATS


@pytest.fixture(scope="module")
def seeds(tmp_path_factory):
    return write_seeds(tmp_path_factory.mktemp("seeds"))


@pytest.fixture(scope="module")
def prober(tmp_path_factory, seeds):
    every = [(name, path) for name, paths in seeds.items() for path in paths]
    one = Prober(tmp_path_factory.mktemp("prober"), every)
    yield one
    one.stop()


@pytest.fixture
def place(tmp_path_factory):
    """Where the next file goes; of the last one nothing is left there."""
    folder = tmp_path_factory.mktemp("fuzzed")
    numbers = itertools.count()

    def empty():
        for path in folder.iterdir():
            shutil.rmtree(path)
        path = folder / str(next(numbers))
        path.mkdir()
        return path

    return empty


@pytest.mark.parametrize("name", FORMATS)
@given(data=st.data())
@settings(max_examples=100, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_damaged_files(name, data, prober, seeds, place):
    seed = data.draw(st.sampled_from(seeds[name]))
    others = [part for path in seeds[name] for part in content_of(path).values()]
    content = content_of(seed)
    part = data.draw(st.sampled_from(sorted(content)))
    content[part] = data.draw(damage(content[part], others))
    path = write(place() / seed.name, content)
    assert_read_or_refused(prober, name, path)


# What is no recording at all -----------------------------------------------------------------

FOREIGN = {
    "empty": b"",
    "one byte": b"\x93",
    "NULs": bytes(5000),
    "words": b"to be or not to be, that is the question\n" * 50,
    "picture": b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR" + bytes(range(256)) * 8,
    "archive": b"PK\x05\x06" + bytes(18),
    "binary": bytes(range(256)) * 40,
}


@pytest.mark.parametrize("name", FORMATS)
def test_what_is_no_such_file_is_refused(name, prober, seeds, tmp_path):
    form = FORMATS[name]
    same = {name} | ({"hdf5"} if name == "mat" else set())  # MAT files of version 7.3 are HDF5
    others = [content_of(paths[0]) for other, paths in seeds.items() if other not in same]
    contents = [{".": content} for content in FOREIGN.values()] + others
    for ending in form.endings or ("",):
        for number, content in enumerate(contents):
            path = tmp_path / f"{number}.{ending}"
            if form.is_folder:
                content = {f"{part}.db3": held for part, held in content.items() if held}
            elif "." not in content:
                continue  # a folder
            write(path, content)
            if path.exists():
                assert_refused(prober, name, path)
        (tmp_path / f"folder.{ending}").mkdir()
        assert_refused(prober, name, tmp_path / f"folder.{ending}")
        os.mkfifo(tmp_path / f"pipe.{ending}")  # reading it would wait for ever
        assert_refused(prober, name, tmp_path / f"pipe.{ending}")
        assert_refused(prober, name, tmp_path / f"nothing.{ending}")


@pytest.mark.parametrize("name", FORMATS)
def test_a_cut_file_of_ours_gives_all_or_nothing(name, prober, seeds, tmp_path):
    seed = next(path for path in seeds[name] if path.name.startswith("ours"))
    _, all_of_it = prober.ask(name, seed)["load"]
    for part, whole in content_of(seed).items():
        for share in range(0, 97, 4):
            content = content_of(seed) | {part: whole[: len(whole) * share // 97]}
            path = write(tmp_path / f"{share}{part}" / seed.name, content)
            kind, said = assert_read_or_refused(prober, name, path)["load"]
            assert kind == "refused" or said == all_of_it, path


@pytest.mark.parametrize(
    ("name", "trap"), [(name, trap) for name, traps in TRAPS.items() for trap in traps]
)
def test_traps(name, trap, prober, tmp_path):
    canary = tmp_path / "canary"
    path = tmp_path / "inside" / trap
    path.parent.mkdir()
    write_trap(path, canary, TRAPS[name][trap])
    before = sorted(tmp_path.iterdir())
    assert_refused(prober, name, path)
    assert sorted(tmp_path.iterdir()) == before  # nothing ran, nothing was put anywhere
    assert canary not in before


# Manifests -----------------------------------------------------------------------------------

CSV = (
    "file;material;trial;scene;onsets_s;sliding_s;label;sample_rate_hz\n"
    'a.csv;M1;0;paper;"2.0; 9.0";"2-7; 9-11.5";;2000\nsub/b.csv;wood;;;[2.0];[[2.0, 7.0]];;\n'
    "c.csv;cloth;3;;;;slip;100\n"
)
COMMAS = 'file,object,sliding_s,label\na.csv,M1,"2-7; 9-11.5",\nc.csv,cloth,,non-slip\n'
YAML = (
    "recordings:\n- {file: a.csv, material: M1, onsets_s: [2.0, 9.0],\n"
    "   sliding_s: [[2, 7], [9, 11]]}\n"
    "- file: sub/b.csv\n  object: wood\n  label: non-slip\n  trial: 4\n"
)
MANIFESTS = {"manifest.csv": CSV, "comma.csv": COMMAS}
MANIFESTS |= {"manifest.yaml": YAML}


def set_of_files(folder, name, content):
    """A manifest in a folder with the files that it names, and one outside."""
    for file in ("a.csv", "sub/b.csv", "c.csv", "../outside.csv"):
        (folder / "set" / file).parent.mkdir(parents=True, exist_ok=True)
        (folder / "set" / file).write_text("t,a\n0,1\n1,2\n")
    (folder / "set" / name).write_bytes(content)
    return folder / "set" / name


@pytest.mark.parametrize("name", MANIFESTS)
def test_whole_manifests_are_read(name, prober, tmp_path):
    path = set_of_files(tmp_path, name, MANIFESTS[name].encode())
    assert prober.ask("manifest", path) == {"read": ("read", "None")}


@pytest.mark.parametrize("name", MANIFESTS)
@given(data=st.data())
@settings(max_examples=100, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_damaged_manifests(name, data, prober, place):
    whole = MANIFESTS[name].encode()
    content = data.draw(damage(whole, [other.encode() for other in MANIFESTS.values()]))
    assert_read_or_refused(prober, "manifest", set_of_files(place(), name, content))


@pytest.mark.parametrize("trap", MANIFEST_TRAPS)
def test_manifest_traps(trap, prober, tmp_path):
    canary = tmp_path / "canary"
    name, content = MANIFEST_TRAPS[trap]
    path = set_of_files(tmp_path, name, content.replace(b"CANARY", os.fsencode(canary)))
    (path.parent / "link.csv").symlink_to("../outside.csv")
    (path.parent / "circle.csv").symlink_to("circle.csv")
    assert_refused(prober, "manifest", path)
    assert not canary.exists()


def test_nothing_was_said_beside_the_line(prober):
    assert prober.said() == ""


def test_the_canary_sings(tmp_path):
    """The code in the traps would be seen if it ran."""
    pickle.loads(pickle.dumps(Runs(tmp_path / "canary")))
    assert (tmp_path / "canary").exists()
