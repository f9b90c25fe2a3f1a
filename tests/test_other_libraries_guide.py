"""The examples of docs/other_libraries.md, with fewer and shorter everything."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

GUIDE = Path(__file__).parents[1] / "docs" / "other_libraries.md"


def example(word: str) -> str:
    """Return the block of code with `word` in it."""
    blocks = re.findall(r"```python\n(.*?)```", GUIDE.read_text(encoding="utf-8"), re.DOTALL)
    (block,) = (block for block in blocks if word in block)
    return block


def shortened(code: str, **sizes: str) -> str:
    """Return code with keyword arguments replaced, each of which must be there."""
    for name, value in sizes.items():
        code, count = re.subn(rf"\b{name}=[\w_]+", f"{name}={value}", code)
        assert count == 1, name
    return code


def run(code: str) -> dict:
    values: dict = {}
    exec(compile(code, str(GUIDE), "exec"), values)
    return values


def test_the_gymnasium_example_runs():
    values = run(shortened(example("make_vec"), num_envs="4"))
    assert values["observations"].shape == (4, 4)
    values["envs"].close()


def test_the_sb3_example_runs():
    pytest.importorskip("stable_baselines3")
    code = shortened(example("VecNormalize(Sb3"), num_envs="4", n_steps="4", batch_size="16")
    values = run(code.replace("1_000_000", "32"))
    values["env"].close()


def test_the_style_example_runs_and_learns():
    pytest.importorskip("stable_baselines3")
    code = shortened(example("StyleReward"), num_envs="16", n_steps="16", batch_size="64")
    code = code.replace("disc_reward_w=1.0", "disc_reward_w=1.0, amp_obs_demo_buffer_size=512")
    values = run(code.replace("10_000_000", "512"))
    assert values["model"].num_timesteps == 512
    assert values["style"].update() == {}  # both rollouts were learned from
    values["env"].close()
