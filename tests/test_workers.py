"""Work in processes: order, closures, and what one of them raises."""

import os

import pytest

from tactslip_torch.runtime import in_processes


@pytest.mark.parametrize("num_workers", [0, 1, 2, 3])
def test_results_come_in_order_and_functions_may_hold_anything(num_workers, capsys):
    held = {"offset": 5}
    found = list(in_processes(lambda x: x + held["offset"], range(7), "w", "item", num_workers))
    assert found == [x + 5 for x in range(7)]


def test_two_workers_are_other_processes(capsys):
    here = os.getpid()
    assert here not in set(in_processes(lambda _: os.getpid(), range(4), "w", "item", 2))
    assert set(in_processes(lambda _: os.getpid(), range(4), "w", "item", 1)) == {here}


def test_an_error_in_a_worker_is_raised_here(capsys):
    def fails(x):
        if x == 2:
            raise ValueError("item 2 is bad")
        return x

    with pytest.raises(ValueError, match="item 2 is bad"):
        list(in_processes(fails, range(5), "w", "item", 2))


@pytest.mark.parametrize("num_workers", [-1, 1.5, "two", True])
def test_what_is_no_number_of_processes_is_refused(num_workers):
    with pytest.raises(ValueError, match="num_workers must be null or a number from 0, got"):
        list(in_processes(abs, range(4), "w", "item", num_workers))
