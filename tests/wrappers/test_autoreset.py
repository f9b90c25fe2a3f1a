from __future__ import annotations

import math

import pytest
import torch

from isaacgymenvs_lite.wrappers.autoreset import AutoresetTask, Transition

# One of each manner: in the next step, on request, within the step.
TASKS = ["Cartpole", "HumanoidAMP", "AnymalTerrain"]
AMP_FEATURES = 105


def run(
    env: AutoresetTask, steps: int, scale: float = 1.0
) -> list[tuple[torch.Tensor, Transition]]:
    """Return (actions, transition) of random steps."""
    generator = torch.Generator().manual_seed(3)
    course = []
    for _ in range(steps):
        draw = torch.rand(env.num_envs, env.task.num_actions, generator=generator)
        actions = scale * (2.0 * draw - 1.0)
        course.append((actions, env.step(actions)))
    return course


def let_time_run_out(env: AutoresetTask) -> Transition:
    env.task.progress_buf[:] = env.task.max_episode_length - 2
    return env.step(env.task.zero_actions())


@pytest.mark.parametrize("name", TASKS)
def test_the_time_limit_truncates(make_task, name):
    env = AutoresetTask(make_task(name), "a test")
    env.reset()
    step = let_time_run_out(env)
    assert step.truncated.all()
    assert not step.terminated.any()
    assert step.episodes.env_ids.tolist() == list(range(6))
    assert not env.task.reset_buf.any()
    assert (env.task.progress_buf == 0).all()
    assert not env.step(env.task.zero_actions()).ended.any()
    assert (env.task.progress_buf == 1).all()


def test_a_fall_terminates_and_its_end_and_the_next_start_are_observed(make_cartpole):
    env = AutoresetTask(make_cartpole(num_envs=64), "a test")
    env.reset()
    falls = [step for _, step in run(env, 60, scale=5.0) if step.ended.any()]
    assert falls
    for step in falls:
        assert not step.truncated.any()
        ended = step.terminated
        cart, _, angle, _ = step.final_observations["obs"][ended].T
        assert ((cart.abs() > 3.0) | (angle.abs() > math.pi / 2)).all()
        first = step.observations["obs"][ended].abs()
        assert (first <= torch.tensor([0.1, 0.25, 0.1, 0.25])).all()
        assert torch.equal(step.rewards[ended], torch.full_like(step.rewards[ended], -2.0))
        others = step.observations["obs"][~ended]
        assert torch.equal(others, step.final_observations["obs"][~ended])


def test_the_first_action_of_an_episode_counts(make_cartpole):
    """Left to itself the task would use it up for a reset."""
    env = AutoresetTask(make_cartpole(), "a test")
    env.reset()
    before = let_time_run_out(env).observations["obs"]
    after = env.step(torch.ones(6, 1)).observations["obs"]
    # 400 N on the cart for 16.6 ms.
    assert (after[:, 1] > before[:, 1] + 1.0).all()


def test_an_amp_observation_is_of_the_steps_end(make_task):
    env = AutoresetTask(make_task("HumanoidAMP", "task.env.stateInit=Random"), "a test")
    env.reset()
    ends = 0
    for _ in range(80):
        ((_, step),) = run(env, 1)
        end = step.final_observations or step.observations
        assert torch.equal(step.per_env["amp_obs"][:, :AMP_FEATURES], end["obs"])
        ids = step.episodes.env_ids
        ends += len(ids)
        started = env.task.amp_obs_of(ids)[:, :AMP_FEATURES]
        assert torch.equal(started, step.observations["obs"][ids])
    assert ends > 0


def test_a_task_that_resets_within_the_step_observes_the_end_too(make_task):
    env = AutoresetTask(make_task("AnymalTerrain"), "a test")
    env.reset()
    run(env, 3)
    env.task.progress_buf[:2] = env.task.max_episode_length - 2
    actions = torch.full((6, 12), 0.3)
    step = env.step(actions)
    assert step.truncated.tolist()[:2] == [True, True]
    # The last twelve observations are the actions, which a new episode has none of.
    assert torch.allclose(step.final_observations["obs"][:2, -12:], actions[:2])
    assert (step.observations["obs"][:2, -12:] == 0.0).all()
    assert torch.allclose(step.observations["obs"][2:, -12:], actions[2:])
    assert any(name.startswith("episode/rew_") for name in step.scalars)


def test_returns_and_lengths_are_those_of_the_steps(make_cartpole):
    env = AutoresetTask(make_cartpole(), "a test")
    env.reset()
    returns, lengths = torch.zeros(6, dtype=torch.float64), torch.zeros(6)
    episodes = 0
    for _, step in run(env, 120, scale=5.0):
        returns += step.rewards
        lengths += 1
        ids = step.episodes.env_ids
        assert torch.equal(step.episodes.returns, returns[ids])
        assert torch.equal(step.episodes.lengths, lengths[ids].long())
        returns[ids], lengths[ids] = 0.0, 0.0
        episodes += len(ids)
    assert episodes > 6


def test_some_environments_begin_anew(make_cartpole):
    env = AutoresetTask(make_cartpole(), "a test")
    env.reset()
    before = run(env, 4)[-1][1].observations["obs"]
    mask = torch.tensor([False, True, False, False, True, False])
    after = env.reset_some(mask)["obs"]
    assert torch.equal(after[~mask], before[~mask])
    assert (after[mask] != before[mask]).any(dim=1).all()
    step = env.step(env.task.zero_actions())
    assert env.task.progress_buf.tolist() == [5, 1, 5, 5, 1, 5]
    assert not step.ended.any()


@pytest.mark.parametrize("name", TASKS)
def test_a_seed_makes_a_course_that_nobody_else_disturbs(make_task, name):
    def course() -> list[torch.Tensor]:
        env = AutoresetTask(make_task(name, seed=1), "a test")
        observations = [env.reset(seed=7)["obs"]]
        torch.rand(3)  # somebody else draws
        env.task.progress_buf[:3] = env.task.max_episode_length - 3
        return observations + [step.observations["obs"] for _, step in run(env, 5)]

    first = course()
    torch.manual_seed(99)
    assert all(torch.equal(a, b) for a, b in zip(first, course(), strict=True))


def test_stepping_in_inference_mode_leaves_a_task_that_can_be_changed(make_task):
    """As rsl_rl does."""
    env = AutoresetTask(make_task("AnymalTerrain"), "a test")
    with torch.inference_mode():
        env.reset()
        run(env, 2)
    assert not env.step(env.task.zero_actions()).rewards.is_inference()
    let_time_run_out(env)
