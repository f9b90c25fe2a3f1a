from __future__ import annotations

import os

import pytest
import torch

from isaacgymenvs_lite.utils.threads import one_torch_thread, thread_count


@pytest.fixture
def two_threads():
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    yield
    torch.set_num_threads(before)


def test_one_thread_inside_and_the_former_number_after(two_threads):
    with one_torch_thread():
        assert torch.get_num_threads() == 1
    assert torch.get_num_threads() == 2


def test_the_number_comes_back_after_an_error_and_inside_itself(two_threads):
    with pytest.raises(ValueError), one_torch_thread(), one_torch_thread():
        raise ValueError
    assert torch.get_num_threads() == 2


def test_all_allowed_cpus_unless_told_otherwise():
    assert thread_count(3) == 3
    allowed = os.sched_getaffinity(0)
    assert thread_count(0) == len(allowed)
    os.sched_setaffinity(0, {min(allowed)})
    try:
        assert thread_count() == 1
    finally:
        os.sched_setaffinity(0, allowed)
