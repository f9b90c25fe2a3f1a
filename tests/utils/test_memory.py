"""What does not fit into memory is refused before it is taken."""

from __future__ import annotations

import pytest

from isaacgymenvs_lite.config.compose import compose
from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.runner import run
from isaacgymenvs_lite.utils.memory import check_memory

_GIB = 2**30


def test_the_message_has_both_sizes_and_the_large_parts() -> None:
    with pytest.raises(ConfigError) as refused:
        check_memory({"a": 30 * _GIB, "b": 10 * _GIB, "c": 1.0}, "x", total_bytes=16 * _GIB)
    assert str(refused.value) == (
        "not enough memory: this needs at least 40.0 GiB (a 30.0 GiB, b 10.0 GiB), and this"
        " machine has 16.0 GiB; lower x"
    )


def test_a_run_beyond_memory_makes_nothing(tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    for words in [
        ["train.params.config.horizon_length=4000000"],
        ["train.params.network.mlp.units=[1000000,1000000]"],
        ["train.params.network.mlp.units=[1000000,1000000]", "test=True"],
    ]:
        with pytest.raises(ConfigError, match=r"^not enough memory"):
            run(compose(["task=Cartpole", "rl_device=cpu", *words]))
        assert list(tmp_path.iterdir()) == []
