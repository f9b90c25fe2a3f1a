"""Delays `torch.compile` of imported functions to their first call.

rl_games compiles a network of its own tests where it is imported. That imports the back end of
torch's compiler, a second or two of each start, and a training here never calls it. (Its front end,
`torch._dynamo`, is imported all the same: by rl_games' runner and by torch's optimisers.)
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any


@contextmanager
def compiling_late() -> Iterator[None]:
    """Let functions that are decorated with `torch.compile` in this block compile when called."""
    import torch

    compile_now = torch.compile

    def compile_late(function: Callable[..., Any] | None = None, **settings: Any) -> Any:
        if function is None:
            return functools.partial(compile_late, **settings)
        compiled = functools.cache(functools.partial(compile_now, function, **settings))

        @functools.wraps(function)
        def call(*args: Any, **kwargs: Any) -> Any:
            return compiled()(*args, **kwargs)

        return call

    torch.compile = compile_late  # type: ignore[assignment]
    try:
        yield
    finally:
        torch.compile = compile_now
