import os
import threading
import time

import numpy as np
import pytest
import torch

from tactslip_torch.runtime import for_each, in_parts


@pytest.fixture(autouse=True)
def _one_thread_again():
    yield
    torch.set_num_threads(1)


@pytest.mark.parametrize("number", [1, 2, 3])
@pytest.mark.parametrize("num_items", [0, 1, 2, 50])
def test_every_item_is_met_once(number, num_items):
    torch.set_num_threads(number)
    met = []
    for_each(met.append, iter(range(num_items)))
    assert sorted(met) == list(range(num_items))
    assert torch.get_num_threads() == number


def test_as_many_threads_as_asked_work_at_once():
    torch.set_num_threads(3)
    together = threading.Barrier(3, timeout=60)  # breaks, and raises, if fewer come
    for_each(lambda _: together.wait(), range(3))


@pytest.mark.parametrize("number", [1, 2, 3])
def test_inside_there_is_one_thread_and_outside_as_many_as_before(number):
    torch.set_num_threads(number)
    inside = []
    for _ in range(2):
        for_each(lambda _: inside.append(torch.get_num_threads()), range(4))
        assert torch.get_num_threads() == number
    assert inside == [1] * 8


def test_making_the_threads_leaves_the_number_for_others():
    torch.set_num_threads(5)  # of no other test, so the pool is made here
    for_each(lambda _: None, range(5))
    numbers = [torch.get_num_threads()]
    thread = threading.Thread(target=lambda: numbers.append(torch.get_num_threads()))
    thread.start()
    thread.join()
    assert numbers == [5, 5]  # a thread that has not computed yet takes the process's number


def test_a_product_inside_occupies_one_processor():
    torch.set_num_threads(2)
    a = torch.randn(700, 700, dtype=torch.float64)
    used = []

    def product(_):
        own, process = time.thread_time(), time.process_time()
        for _ in range(5):
            a @ a
        used.append((time.thread_time() - own) / (time.process_time() - process))

    for _ in range(6):  # threads that other tests left behind may wake up in one of them
        for_each(product, [0])
    assert max(used) > 0.8  # a second intra-op thread would take half of the process's time


@pytest.mark.parametrize("number", [2, 3])
def test_bits_do_not_depend_on_the_number(rng, number):
    a = torch.from_numpy(rng.standard_normal((300, 500)))
    b = torch.from_numpy(rng.standard_normal((500, 700)))

    def product():
        out = torch.empty(300, 700, dtype=torch.float64)
        for_each(lambda t: torch.mm(a[t : t + 64], b, out=out[t : t + 64]), range(0, 300, 64))
        return out

    one = product()
    torch.set_num_threads(number)
    several = product()
    np.testing.assert_allclose(one.numpy(), a.numpy() @ b.numpy(), rtol=1e-10, atol=1e-10)
    assert torch.equal(one, several)


@pytest.mark.parametrize("number", [1, 2])
def test_an_error_is_raised_and_stops_the_rest(number):
    torch.set_num_threads(number)
    met = []

    def fail_at_three(i):
        met.append(i)
        if i == 3:
            raise KeyError("three")
        time.sleep(0.002)

    with pytest.raises(KeyError, match="three"):
        for_each(fail_at_three, range(1000))
    assert len(met) < 900
    before = list(met)
    time.sleep(0.02)
    assert met == before  # nothing runs on behind the error
    assert torch.get_num_threads() == number


def test_nested_calls_run_where_they_are():
    torch.set_num_threads(2)
    pairs = []
    for_each(lambda i: for_each(lambda j: pairs.append((i, j)), range(3)), range(4))
    assert sorted(pairs) == [(i, j) for i in range(4) for j in range(3)]


def test_grad_and_inference_mode_are_the_callers():
    torch.set_num_threads(2)
    modes = []

    def note(_):
        modes.append((torch.is_grad_enabled(), torch.is_inference_mode_enabled()))

    for_each(note, [0])
    with torch.no_grad():
        for_each(note, [0])
    with torch.inference_mode():
        held = torch.zeros(2)
        for_each(lambda i: held[i].add_(1), range(2))  # refused outside inference mode
        for_each(note, [0])
    assert modes == [(True, False), (False, False), (False, True)]


@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")  # from Python 3.12 on
def test_a_forked_child_makes_its_own_threads():
    torch.set_num_threads(2)
    for_each(lambda _: None, range(2))
    child = os.fork()
    if child == 0:  # the parent's threads are not here; waiting for them would never end
        met = []
        for_each(met.append, range(5))
        os._exit(0 if sorted(met) == list(range(5)) else 1)
    deadline = time.monotonic() + 60
    while (ended := os.waitpid(child, os.WNOHANG)) == (0, 0) and time.monotonic() < deadline:
        time.sleep(0.01)
    if ended == (0, 0):
        os.kill(child, 9)
        os.waitpid(child, 0)
    assert ended == (child, 0)


@pytest.mark.parametrize("number", [1, 2])
def test_parts_come_back_in_their_order(number):
    torch.set_num_threads(number)
    starts = range(0, 30, 4)
    expected = [sum(range(start, min(start + 4, 30))) for start in starts]
    assert in_parts(lambda part: int(part.sum()), torch.arange(30).split(4)) == expected
    assert in_parts(len, []) == []
