"""Functions that another package compiles at import compile at their first call."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from isaacgymenvs_lite.utils.late_compile import compiling_late
from tests.utils.test_openmp import said


@pytest.fixture
def compiled(monkeypatch: pytest.MonkeyPatch) -> list[tuple[Any, dict[str, Any]]]:
    """Stand in for the compiler, which takes seconds; return what it was given."""
    given = []

    def compile_now(function, **settings):
        given.append((function, settings))
        return lambda x: 10 * function(x)

    monkeypatch.setattr(torch, "compile", compile_now)
    return given


def test_a_function_compiles_once_when_it_is_called(compiled):
    before = torch.compile
    with compiling_late():

        @torch.compile
        def one(x: int) -> int:
            """Say what it does."""
            return x + 1

        @torch.compile(dynamic=True)
        def two(x: int) -> int:
            return x + 2

    assert torch.compile is before
    assert compiled == []
    assert (one.__name__, one.__doc__) == ("one", "Say what it does.")
    assert [one(1), one(2), two(1)] == [20, 30, 30]
    assert [settings for _, settings in compiled] == [{}, {"dynamic": True}]


def test_it_compiles_at_once_after_an_error(compiled):
    before = torch.compile
    with pytest.raises(ValueError, match="no"), compiling_late():
        raise ValueError("no")
    assert torch.compile is before


def test_a_training_imports_no_compiler(tmp_path):
    """Nor what only clips need."""
    words = "['train.py', 'task=Ant', 'max_iterations=1', 'num_envs=8', 'hydra.run.dir=.']"
    small = "'train.params.config.horizon_length=4', 'train.params.config.minibatch_size=32'"
    code = (
        f"import os, sys; os.chdir({str(tmp_path)!r}); sys.argv = {words} + [{small}];"
        "from isaacgymenvs_lite import train; train.main();"
        "names = ('rl_games', 'torch._inductor.compile_fx', 'scipy.interpolate');"
        "print([name in sys.modules for name in names])"
    )
    assert said(code).splitlines()[-1] == "[True, False, False]"
    assert list(tmp_path.glob("runs/*/nn/Ant.pth"))
