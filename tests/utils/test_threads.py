from __future__ import annotations

import os

import gymnasium
import pytest
import torch

import isaacgymenvs_lite
from isaacgymenvs_lite.registration import register_env
from isaacgymenvs_lite.utils import threads
from isaacgymenvs_lite.utils.threads import (
    limit_torch_threads,
    one_torch_thread,
    release_torch_threads,
    thread_count,
    threads_for_envs,
    threads_for_products,
)
from isaacgymenvs_lite.wrappers.rl_games_env import RLGPUEnv


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


def test_all_allowed_cpus_unless_told_otherwise():
    assert thread_count(3) == 3
    allowed = os.sched_getaffinity(0)
    assert thread_count(0) == len(allowed)
    os.sched_setaffinity(0, {min(allowed)})
    try:
        assert thread_count() == 1
    finally:
        os.sched_setaffinity(0, allowed)


# --- the limit while tasks are open ---------------------------------------------------------------


class Task:
    """What a limit is for; anything that can be closed."""


@pytest.fixture
def four_cpus(monkeypatch):
    """Torch has a thread for each of four CPUs, and no user has said anything."""
    for name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(threads, "thread_count", lambda num_threads=0: num_threads or 4)
    monkeypatch.setattr(threads, "torch_threads", threads.TorchThreads())
    before = torch.get_num_threads()
    torch.set_num_threads(4)
    yield
    torch.set_num_threads(before)


def test_a_limit_lasts_until_its_task_is_closed_and_is_told_once(four_cpus, caplog):
    small, smaller = Task(), Task()
    limit_torch_threads(small, 2)
    assert torch.get_num_threads() == 2
    limit_torch_threads(smaller, 1)
    assert torch.get_num_threads() == 2  # the highest counts
    release_torch_threads(small)
    assert torch.get_num_threads() == 1
    release_torch_threads(smaller)
    release_torch_threads(smaller)
    assert torch.get_num_threads() == 4
    assert len(caplog.records) == 1
    assert "torch computes on 2 thread(s), not 4" in caplog.text


def test_what_the_user_says_wins(four_cpus, monkeypatch):
    torch.set_num_threads(3)  # neither for each CPU nor for each core
    task = Task()
    limit_torch_threads(task, 1)
    assert torch.get_num_threads() == 3
    torch.set_num_threads(4)
    monkeypatch.setenv("OMP_NUM_THREADS", "4")
    limit_torch_threads(task, 1)
    assert torch.get_num_threads() == 4
    limit_torch_threads(task, 1, num_threads=2)  # the key is the user's, too
    assert torch.get_num_threads() == 2
    release_torch_threads(task)
    assert torch.get_num_threads() == 4


def test_more_work_more_threads():
    assert [threads_for_envs(n) for n in (1, 64, 511, 512, 4096)] == [1, 1, 1, 2, 16]
    # Minibatches of 512 and of 4096 rows through networks of 17,000 parameters.
    assert threads_for_products(512 * 17_000) == 1
    assert threads_for_products(4096 * 17_000) == 3


def test_torch_imported_first_is_told_where_threads_stay(four_cpus, monkeypatch, caplog):
    monkeypatch.setattr(threads, "threads_spin", lambda: True)
    limit_torch_threads(Task(), 16)
    assert "import isaacgymenvs_lite first, or set OMP_WAIT_POLICY=PASSIVE" in caplog.text


def test_whoever_makes_a_small_task_gets_one_thread_but_rl_games(four_cpus):
    def make(**kwargs):
        return isaacgymenvs_lite.make(task="Cartpole", num_envs=4, **kwargs)

    task = make()
    assert torch.get_num_threads() == 1
    task.close()
    assert torch.get_num_threads() == 4
    envs = gymnasium.make_vec("IsaacGymEnvsLite/Cartpole-v0", num_envs=4)
    assert torch.get_num_threads() == 1
    envs.close()
    register_env(make)
    env = RLGPUEnv("rlgpu", 4)  # rl_games has a key of its own
    register_env()
    assert torch.get_num_threads() == 4
    env.close()
