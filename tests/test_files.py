import threading

import pytest

from tactslip_torch.files import whole_file


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
