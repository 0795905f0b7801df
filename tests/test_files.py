import pickle
import random
import threading

import pytest
import torch

from tactslip_torch.runtime import load_table, save_table, table_form, whole_file


def test_what_was_written_is_there(tmp_path):
    with whole_file(tmp_path / "a.bin") as temporary:
        temporary.write_bytes(b"all of it")
    assert (tmp_path / "a.bin").read_bytes() == b"all of it"
    assert [p.name for p in tmp_path.iterdir()] == ["a.bin"]


def test_nothing_shows_before_the_end(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("old")
    with whole_file(path) as temporary:
        temporary.write_text("new")
        assert path.read_text() == "old"
    assert path.read_text() == "new"


@pytest.mark.parametrize("old", [None, "old"])
def test_a_failure_leaves_the_old_content_and_no_temporary_file(tmp_path, old):
    path = tmp_path / "a.txt"
    if old is not None:
        path.write_text(old)

    def write_half():
        with whole_file(path) as temporary:
            temporary.write_text("half")
            raise RuntimeError("power is out")

    with pytest.raises(RuntimeError, match="power is out"):
        write_half()
    assert [p.name for p in tmp_path.iterdir()] == ([] if old is None else ["a.txt"])
    if old is not None:
        assert path.read_text() == old


def test_a_failure_before_anything_is_written_shows_as_it_is(tmp_path):
    def fail():
        with whole_file(tmp_path / "a.txt"):
            raise ValueError("nothing yet")

    with pytest.raises(ValueError, match="nothing yet"):
        fail()
    assert not list(tmp_path.iterdir())


def test_folders_are_made_and_strings_do(tmp_path):
    with whole_file(str(tmp_path / "b" / "c" / "a.txt")) as temporary:
        temporary.write_text("deep")
    assert (tmp_path / "b" / "c" / "a.txt").read_text() == "deep"


def test_the_temporary_name_lies_beside_and_keeps_the_suffix(tmp_path):
    """Beside: a rename across file systems is no rename. Suffix: some writers go by it."""
    with whole_file(tmp_path / "figure.png") as temporary:
        temporary.write_bytes(b"")
        assert temporary.parent == tmp_path
        assert temporary.suffix == ".png"
        assert temporary.name != "figure.png"


def test_two_writers_of_one_file_do_not_meet(tmp_path):
    """Process ids do not tell them apart: threads share one, and so may two containers."""
    with whole_file(tmp_path / "a.txt") as first, whole_file(tmp_path / "a.txt") as second:
        assert first != second
        first.write_text("first")
        second.write_text("second")
    assert (tmp_path / "a.txt").read_text() == "first"  # the outer one ends last
    assert [p.name for p in tmp_path.iterdir()] == ["a.txt"]


def test_two_files_of_one_folder_do_not_meet(tmp_path):
    with whole_file(tmp_path / "a.txt") as a, whole_file(tmp_path / "b.txt") as b:
        assert a != b
        a.write_text("a")
        b.write_text("b")
    assert [p.read_text() for p in sorted(tmp_path.iterdir())] == ["a", "b"]


def test_a_reader_never_sees_half_a_file(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("x" * 100_000)
    seen, done = set(), threading.Event()

    def read():
        while not done.is_set():
            seen.add(len(path.read_text()))

    reader = threading.Thread(target=read)
    reader.start()
    for _ in range(20):
        with whole_file(path) as temporary, temporary.open("w") as file:
            for _ in range(100):
                file.write("y" * 1000)
    done.set()
    reader.join()
    assert seen == {100_000}


# -------------------------------------------------------------------------------- tables
FORM = "test table 1"
FACTS = {"names": ["M1", "é\n"], "numbers": {"a": 0.1, "b": None}, "is_slip": True}


def tables():
    return {
        "float": torch.arange(12.0).reshape(3, 4) / 7,
        "double": torch.tensor(0.1, dtype=torch.float64),
        "long": torch.tensor([-(2**63), 2**63 - 1]),
        "bool": torch.tensor([[True], [False]]),
        "half": torch.tensor([1.5, float("nan"), float("inf")], dtype=torch.bfloat16),
        "empty": torch.zeros(0, 3, dtype=torch.int32),
    }


def assert_tables(found, wanted):
    assert found.keys() == wanted.keys()
    for name, tensor in wanted.items():
        assert found[name].dtype == tensor.dtype
        assert found[name].shape == tensor.shape
        assert found[name].numpy(force=True).tobytes() == tensor.numpy(force=True).tobytes()


def without_half():
    return {name: tensor for name, tensor in tables().items() if name != "half"}


def test_a_table_comes_back(tmp_path):
    save_table(tmp_path / "a.pt", FORM, FACTS, tables())
    facts, tensors = load_table(tmp_path / "a.pt", FORM)
    assert facts == FACTS
    assert torch.equal(tensors.pop("half").view(torch.int16), tables()["half"].view(torch.int16))
    assert_tables(tensors, without_half())
    assert table_form(str(tmp_path / "a.pt")) == FORM
    assert [p.name for p in tmp_path.iterdir()] == ["a.pt"]
    save_table(tmp_path / "b.pt", FORM, {}, {})
    assert load_table(tmp_path / "b.pt", FORM) == ({}, {})


def test_the_same_content_gives_the_same_bytes(tmp_path):
    save_table(tmp_path / "a.pt", FORM, FACTS, tables())
    backwards = dict(reversed(tables().items()))
    backwards["float"] = torch.nn.Parameter(backwards["float"].T.contiguous().T)
    backwards["long"] = torch.cat([backwards["long"], backwards["long"]])[:2]
    save_table(tmp_path / "other.name", FORM, dict(reversed(FACTS.items())), backwards)
    assert (tmp_path / "a.pt").read_bytes() == (tmp_path / "other.name").read_bytes()


def test_a_view_does_not_bring_what_it_is_a_view_of(tmp_path):
    save_table(tmp_path / "a.pt", FORM, {}, {"a": torch.zeros(100_000)[:5]})
    assert (tmp_path / "a.pt").stat().st_size < 5000


def test_saving_changes_no_tensor(tmp_path):
    tensors = tables()
    save_table(tmp_path / "a.pt", FORM, FACTS, tensors)
    tensors.pop("half")
    assert_tables(tensors, without_half())


def refusal(path):
    """The one line with which a file is refused; None if it is read as it was saved."""
    try:
        facts, tensors = load_table(path, FORM)
    except ValueError as error:
        return str(error)
    assert facts == FACTS
    assert_tables(tensors, without_half())
    return None


def test_a_flipped_byte_is_refused_in_one_line_wherever_it_counts(tmp_path):
    """Some bytes of an archive carry nothing (padding, times); the content stands then."""
    path = tmp_path / "a.pt"
    save_table(path, FORM, FACTS, without_half())
    whole = path.read_bytes()
    draw = random.Random(0)
    num_refused = 0
    for _ in range(400):
        content = bytearray(whole)
        place = draw.randrange(len(content))
        content[place] ^= draw.choice([1 << draw.randrange(8), 0xFF])
        path.write_bytes(content)
        line = refusal(path)
        if line is not None:
            num_refused += 1
            assert "\n" not in line
            assert str(path) in line
            assert "make it again" in line or "must be of format" in line
    assert num_refused > 100


def test_every_byte_of_a_tensor_and_of_the_facts_counts(tmp_path):
    path = tmp_path / "a.pt"
    save_table(path, FORM, FACTS, without_half())
    whole = path.read_bytes()
    for content in (without_half()["float"].numpy().tobytes(), b'"is_slip": true'):
        start = whole.index(content)
        for place in range(start, start + len(content)):
            path.write_bytes(whole[:place] + bytes([whole[place] ^ 4]) + whole[place + 1 :])
            assert "is damaged" in refusal(path)


@pytest.mark.parametrize("share", [0.0, 0.2, 0.5, 0.9, 0.999])
def test_a_cut_file_is_refused(tmp_path, share):
    path = tmp_path / "a.pt"
    save_table(path, FORM, FACTS, without_half())
    whole = path.read_bytes()
    path.write_bytes(whole[: int(share * len(whole))])
    assert refusal(path) == f"{path} is damaged or no file of ours; make it again"


@pytest.mark.parametrize(
    "change",
    [
        {"digest": "0" * 32},
        {"digest": None},
        {"facts": "{}"},
        {"facts": ""},
        {"facts": 3},
        {"tensors": {}},
        {"tensors": [1, 2]},
        {"tensors": None},
        {"tensors": {"float": 1.0}},
        {"tensors": {3: torch.zeros(2), "a": torch.zeros(2)}},
        {"tensors": {"float": torch.zeros(3).to_sparse()}},
    ],
)
@pytest.mark.parametrize("is_gone", [False, True])
def test_content_that_does_not_fit_its_digest_is_refused(tmp_path, change, is_gone):
    path = tmp_path / "a.pt"
    save_table(path, FORM, FACTS, without_half())
    content = torch.load(path, weights_only=True) | change
    if is_gone:
        content.pop(next(iter(change)))
    torch.save(content, path)
    assert refusal(path) == f"{path} is damaged; make it again"


@pytest.mark.parametrize(
    "content",
    [torch.zeros(3), {"a": torch.zeros(3)}, {"format": torch.zeros(30, 30)}, [FORM], {}, None],
)
def test_another_file_of_torch_is_refused(tmp_path, content):
    torch.save(content, tmp_path / "a.pt")
    for read in (refusal, table_form):
        try:
            line = read(tmp_path / "a.pt")
        except ValueError as error:
            line = str(error)
        assert line == f"{tmp_path / 'a.pt'} is damaged or no file of ours; make it again"


def test_another_format_is_named(tmp_path):
    save_table(tmp_path / "a.pt", "test table 2", FACTS, without_half())
    assert refusal(tmp_path / "a.pt").endswith(
        "a.pt must be of format 'test table 1', got 'test table 2'"
    )
    assert table_form(tmp_path / "a.pt") == "test table 2"


def test_a_missing_file_is_named(tmp_path):
    for read in (lambda path: load_table(path, FORM), table_form):
        with pytest.raises(FileNotFoundError, match=r"no file at .*nowhere\.pt"):
            read(tmp_path / "nowhere.pt")


class Trap:
    """Makes a folder when it is unpickled."""

    def __init__(self, mark):
        self.mark = mark

    def __reduce__(self):
        return type(self.mark).mkdir, (self.mark,)


def test_nothing_in_a_file_is_executed(tmp_path):
    mark, path = tmp_path / "sprung", tmp_path / "a.pt"
    torch.save({"format": FORM, "facts": "{}", "tensors": {}, "digest": Trap(mark)}, path)
    assert "no file of ours" in refusal(path)
    path.write_bytes(pickle.dumps(Trap(mark)))
    assert "no file of ours" in refusal(path)
    assert not mark.exists()
    pickle.loads(path.read_bytes())
    assert mark.exists(), "the trap is none"


def test_a_failed_save_leaves_the_old_table(tmp_path):
    path = tmp_path / "a.pt"
    save_table(path, FORM, FACTS, without_half())
    with pytest.raises(TypeError, match="JSON"):
        save_table(path, FORM, {"a": object()}, {})
    with pytest.raises(AttributeError):
        save_table(path, FORM, {}, {"a": 3})
    assert refusal(path) is None
    assert [p.name for p in tmp_path.iterdir()] == ["a.pt"]
