from __future__ import annotations

from types import SimpleNamespace

import torch

from isaacgymenvs_lite.workflows.playing import play_episodes


def test_the_first_episode_of_each_environment_counts():
    """Episodes last 2, 3 and 7 steps."""
    lengths = torch.tensor([2, 3, 7])
    stepper = SimpleNamespace(num_envs=3, last_step=None, now=0)

    def step() -> None:
        stepper.now += 1
        ended = stepper.now % lengths == 0
        ids = ended.nonzero().flatten()
        # Later episodes would tell another return.
        episodes = SimpleNamespace(
            env_ids=ids,
            lengths=lengths[ids],
            returns=100.0 * (stepper.now // lengths[ids]).double(),
        )
        stepper.last_step = SimpleNamespace(episodes=episodes, truncated=ended & (lengths == 7))

    played = play_episodes(stepper, step)
    assert stepper.now == 7
    assert played.lengths.tolist() == [2, 3, 7]
    assert played.returns.tolist() == [100.0, 100.0, 100.0]
    assert played.truncated.tolist() == [False, False, True]
    assert played.lines()[0] == "episodes: 3, 1 to the time limit"
    assert played.lines()[2] == "length: mean 4.0, min 2, max 7"
