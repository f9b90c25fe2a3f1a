"""The tables of hooks in the docstrings of the agents, against what the agents override."""

from __future__ import annotations

import re
from types import FunctionType, ModuleType

import pytest

from isaacgymenvs_lite.learning import amp_continuous, common_agent
from isaacgymenvs_lite.learning.amp_continuous import AMPAgent
from isaacgymenvs_lite.learning.common_agent import CommonAgent
from isaacgymenvs_lite.learning.gen_amp import GenAMPAgent
from isaacgymenvs_lite.learning.hrl_continuous import HRLAgent

AGENTS = {"AMP": AMPAgent, "GenAMP": GenAMPAgent, "HRL": HRLAgent}


def table(module: ModuleType) -> dict[str, set[str]]:
    """Return {hook: agents that override one of its row} and check that no hook comes twice."""
    found: dict[str, set[str]] = {}
    for line in (module.__doc__ or "").splitlines():
        if line.startswith("| `"):
            hooks, _, agents = (cell.strip() for cell in line.strip("|").split("|"))
            for hook in re.findall(r"`(\w+)`", hooks):
                assert hook not in found, hook
                found[hook] = set(agents.split(", ")) - {"-"}
    return found


def overridden(agent: type, base: type) -> set[str]:
    """Methods of an agent's own class body that its base or rl_games have too."""
    own = {name for name, value in vars(agent).items() if isinstance(value, FunctionType)}
    return {name for name in own if hasattr(base, name)}


@pytest.mark.parametrize("name", AGENTS)
def test_every_override_is_in_the_table(name):
    hooks = table(common_agent)
    missing = {hook for hook in overridden(AGENTS[name], CommonAgent) if hook not in hooks}
    assert not missing


def test_the_table_names_the_agents_that_override():
    for hook, agents in table(common_agent).items():
        assert hasattr(CommonAgent, hook), hook
        assert agents == {n for n, cls in AGENTS.items() if hook in overridden(cls, CommonAgent)}


def test_the_hooks_of_amp():
    hooks = table(amp_continuous)
    for hook, agents in hooks.items():
        assert callable(getattr(AMPAgent, hook)), hook
        assert agents == ({"GenAMP"} if hook in overridden(GenAMPAgent, AMPAgent) else set()), hook
    own = {hook for hook in overridden(GenAMPAgent, AMPAgent) if not hasattr(CommonAgent, hook)}
    assert own <= set(hooks)
