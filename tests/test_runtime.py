"""Threads, processes, files that are written whole, tables of tensors, and batches seen."""

import os
import pickle
import random
import time
import zipfile
from pathlib import Path

import pytest
import torch

from tactslip_torch.package_files import load_table, save_table
from tactslip_torch.runtime import (
    for_each,
    in_processes,
    thread_map,
    whole_file,
)


@pytest.fixture(autouse=True)
def _one_thread_again():
    yield
    torch.set_num_threads(1)


# --- threads ------------------------------------------------------------------------------------


@pytest.mark.parametrize("number", [1, 2, 3])
def test_every_item_is_worked_on_once_with_one_thread_inside(number):
    torch.set_num_threads(number)
    for num_items in (0, 1, 2, 50):
        items, inside = [], []
        for_each(items.append, iter(range(num_items)))
        for_each(lambda _, to=inside: to.append(torch.get_num_threads()), range(num_items))
        assert sorted(items) == list(range(num_items))
        assert inside == [1] * num_items
        assert torch.get_num_threads() == number
    starts = range(0, 30, 4)
    expected = [sum(range(start, min(start + 4, 30))) for start in starts]
    assert thread_map(lambda part: int(part.sum()), torch.arange(30).split(4)) == expected


@pytest.mark.parametrize("number", [1, 2])
def test_an_error_is_raised_and_stops_the_rest(number):
    torch.set_num_threads(number)
    begun = []

    def fail_at_three(i):
        begun.append(i)
        if i == 3:
            raise KeyError("three")
        time.sleep(0.002)

    with pytest.raises(KeyError, match="three"):
        for_each(fail_at_three, range(1000))
    assert len(begun) < 900
    before = list(begun)
    time.sleep(0.02)
    assert begun == before  # nothing runs on behind the error
    assert torch.get_num_threads() == number


@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")  # from Python 3.12 on
def test_a_forked_child_makes_its_own_threads():
    torch.set_num_threads(2)
    for_each(lambda _: None, range(2))
    child = os.fork()
    if child == 0:  # the parent's threads are not here; waiting for them would never end
        items = []
        for_each(items.append, range(5))
        os._exit(0 if sorted(items) == list(range(5)) else 1)
    deadline = time.monotonic() + 60
    while (ended := os.waitpid(child, os.WNOHANG)) == (0, 0) and time.monotonic() < deadline:
        time.sleep(0.01)
    if ended == (0, 0):
        os.kill(child, 9)
    assert ended == (child, 0)


# --- processes ----------------------------------------------------------------------------------


@pytest.mark.parametrize("num_workers", [0, 1, 2, 3])
def test_results_of_processes_come_in_order_and_functions_may_hold_anything(num_workers, capsys):
    here = os.getpid()
    found = list(in_processes(lambda x: (x, os.getpid()), range(7), "w", "item", num_workers))
    assert [x for x, _ in found] == list(range(7))
    assert (here in {process for _, process in found}) == (num_workers < 2)


def test_an_error_in_a_worker_is_raised_here(capsys):
    def fails(x):
        if x == 2:
            raise ValueError("item 2 is bad")
        return x

    with pytest.raises(ValueError, match="item 2 is bad"):
        list(in_processes(fails, range(5), "w", "item", 2))
    for number in (-1, 1.5, "two", True):
        with pytest.raises(ValueError, match="num_workers must be null or a number from 0, got"):
            list(in_processes(abs, range(4), "w", "item", number))


# --- files --------------------------------------------------------------------------------------


def names_in(folder):
    return [path.name for path in folder.iterdir()]


def test_a_file_shows_when_it_is_whole_and_its_folder_is_made(tmp_path):
    path = tmp_path / "b" / "a.png"
    for text in ("old", "new"):
        with whole_file(str(path)) as temporary:
            temporary.write_text(text)
            assert temporary.parent == path.parent  # a rename across file systems is no rename
            assert temporary.suffix == ".png"  # some writers go by it
            assert not path.exists() if text == "old" else path.read_text() == "old"
        assert path.read_text() == text
    assert names_in(path.parent) == ["a.png"]


@pytest.mark.parametrize("old", [None, "old"])
def test_a_failure_leaves_the_old_content_and_no_temporary_file(tmp_path, old):
    path = tmp_path / "a.txt"
    if old is not None:
        path.write_text(old)

    def write(text):
        with whole_file(path) as temporary:
            if text:
                temporary.write_text(text)
            raise RuntimeError("power is out")

    for text in ("half", ""):
        with pytest.raises(RuntimeError, match="power is out"):
            write(text)
        assert [path.read_text() for path in tmp_path.iterdir()] == ([] if old is None else [old])


# --- tables -------------------------------------------------------------------------------------

FORM = "test table 1"
VALUES = {"names": ["M1", "é\n"], "numbers": {"a": 0.1, "b": None}, "is_slip": True}


def tables():
    return {
        "float": torch.arange(12.0).reshape(3, 4) / 7,
        "double": torch.tensor(0.1, dtype=torch.float64),
        "long": torch.tensor([-(2**63), 2**63 - 1]),
        "bool": torch.tensor([[True], [False]]),
        "half": torch.tensor([1.5, -2.0], dtype=torch.bfloat16),
        "empty": torch.zeros(0, 3, dtype=torch.int32),
    }


def refusal(path):
    """The one line with which a file is refused; None if it is read as it was saved."""
    try:
        values, tensors = load_table(path, FORM)
    except ValueError as error:
        return str(error)
    assert values == VALUES
    assert tensors.keys() == tables().keys()
    for name, tensor in tables().items():
        assert (tensors[name].dtype, tensors[name].shape) == (tensor.dtype, tensor.shape)
        assert torch.equal(tensors[name], tensor)
    return None


@pytest.fixture
def saved(tmp_path):
    save_table(tmp_path / "a.pt", FORM, VALUES, tables())
    return tmp_path / "a.pt"


def test_a_table_comes_back_and_the_same_content_gives_the_same_bytes(tmp_path, saved):
    assert refusal(saved) is None
    backwards = dict(reversed(tables().items()))
    backwards["float"] = torch.nn.Parameter(backwards["float"].T.contiguous().T)
    backwards["long"] = torch.cat([backwards["long"], backwards["long"]])[:2]
    save_table(tmp_path / "other.name", FORM, dict(reversed(VALUES.items())), backwards)
    assert saved.read_bytes() == (tmp_path / "other.name").read_bytes()
    save_table(tmp_path / "b.pt", FORM, {}, {"a": torch.zeros(100_000)[:5]})
    assert (tmp_path / "b.pt").stat().st_size < 5000  # a view does not bring all it is a view of


def test_a_flipped_byte_is_refused_in_one_line_wherever_it_counts(saved):
    """Some bytes of an archive carry nothing (padding, times); the content stands then."""
    whole, draw, num_refused = saved.read_bytes(), random.Random(0), 0
    content = tables()["float"].numpy().tobytes()
    places = [draw.randrange(len(whole)) for _ in range(40)]
    certain = range(whole.index(content), whole.index(content) + len(content), 5)
    for place in (*places, *certain):
        saved.write_bytes(whole[:place] + bytes([whole[place] ^ 4]) + whole[place + 1 :])
        if (line := refusal(saved)) is not None:
            num_refused += 1
            assert "\n" not in line
            assert str(saved) in line
        assert line is not None or place not in certain
    assert num_refused > len(certain)


class Trap:
    """Makes a folder when it is unpickled."""

    def __init__(self, mark):
        self.mark = mark

    def __reduce__(self):
        return type(self.mark).mkdir, (self.mark,)


def test_other_files_are_refused_and_nothing_in_them_is_executed(tmp_path):
    path, mark = tmp_path / "a.pt", tmp_path / "sprung"
    own = {"format": FORM, "metadata": "{}", "tensors": {"a": torch.zeros(3)}}
    for content in (
        *(torch.zeros(3), {"format": torch.zeros(3)}, [FORM], {}, None, own | {"x": Trap(mark)}),
        *(own | {"metadata": "{"}, own | {"tensors": [1]}, {"format": FORM}),
        *(
            own | {"tensors": {"a": bad}}
            for bad in (torch.tensor(torch.nan), torch.zeros(1).expand(9))
        ),
    ):
        torch.save(content, path)
        assert (refusal(path) or "").startswith(f"{path} is damaged")
    path.write_bytes(pickle.dumps(Trap(mark)))
    assert "no file of this package" in refusal(path)
    assert not mark.exists()
    pickle.loads(path.read_bytes())
    assert mark.exists(), "the trap is none"
    save_table(path, "test table 2", VALUES, tables())
    assert refusal(path) == f"{path} must be of format 'test table 1', got 'test table 2'"
    with pytest.raises(ValueError, match=r"made by version 0\.2\.0 or earlier; make it"):
        load_table(path, "test table 3")
    with pytest.raises(FileNotFoundError, match=r"no file at .*nowhere\.pt"):
        load_table(tmp_path / "nowhere.pt", FORM)


def test_what_unpacks_to_too_much_is_refused_before_it_does(tmp_path, saved):
    packed = tmp_path / "packed.pt"
    with (
        zipfile.ZipFile(saved) as whole,
        zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as file,
    ):
        for member in whole.infolist():
            file.writestr(member.filename, whole.read(member))
        file.writestr("a/data/zeros", bytes(10**6))
    assert packed.stat().st_size < 10**5
    with pytest.raises(ValueError, match="damaged or no file of this package"):
        load_table(packed, FORM, 10**5)


def test_what_is_no_file_is_refused_without_a_wait(tmp_path):
    os.mkfifo(tmp_path / "pipe.pt")
    for path, said in ((tmp_path / "pipe.pt", "a device or pipe"), (tmp_path, "a folder")):
        assert refusal(path) == f"{path} is {said}, expected a file; copy it to a file first"
    with pytest.raises(ValueError, match="bytes, at most 10 can be read"):
        load_table(__file__, FORM, 10)


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="needs Linux")
def test_what_a_killed_process_left_is_removed_and_what_is_being_written_is_not(tmp_path):
    path = tmp_path / "a.txt"
    if (child := os.fork()) == 0:
        with whole_file(path) as left:
            left.write_text("half")
            os._exit(0)
    os.waitpid(child, 0)
    (left,) = tmp_path.iterdir()
    with whole_file(path) as first:
        first.write_text("first")
        with whole_file(path) as second:
            second.write_text("second")
            assert sorted(tmp_path.iterdir()) == sorted([first, second])
    assert path.read_text() == "first"
    assert names_in(tmp_path) == ["a.txt"]
