"""Interpolations that repeat themselves."""

from __future__ import annotations

from typing import Any

import pytest
from omegaconf import OmegaConf

from isaacgymenvs_lite.config.compose import compose
from isaacgymenvs_lite.config.expansion import check_expansion
from isaacgymenvs_lite.config.train_files import load_train_file
from isaacgymenvs_lite.errors import ConfigError


def chain(value: Any, length: int = 30) -> dict[str, Any]:
    """Return keys a0, a1, ... with a value that names the next one each; NEXT stands for it."""
    text = {f"a{i}": str(value).replace("NEXT", f"${{.a{i + 1}}}") for i in range(length)}
    return {**text, f"a{length}": "x"}


LAUGHS = chain("NEXTNEXT")

LOOP = {"a": "${.b}", "b": "x${.a}"}
LONG = chain("NEXT", 5000)


@pytest.mark.parametrize(
    ("tree", "said"),
    [
        (LAUGHS, "repeat more than 1,000,000 values"),
        ({"a": {"b": LAUGHS}}, "repeat more than 1,000,000 values"),
        ({"a": "${b}", "b": LOOP}, "leads back to itself"),
        ({"a": {"b": "${a}"}}, "leads back to itself"),
        (LONG, "lead through too many others"),
    ],
)
def test_repetition_without_end_is_one_line(tree: dict[str, Any], said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        check_expansion(OmegaConf.create(tree))


@pytest.mark.parametrize(
    "tree",
    [
        {"a": "${b.c}", "b": {"c": [1, 2, "${d}"]}, "d": 3},
        {"a": "${b.c.d}", "b": "${e}", "e": {"c": {"d": 1}}},  # through another interpolation
        {"a": {"b": "${..c}"}, "c": "${absent.key}"},  # what is absent is said elsewhere
        {"a": ["${.1}", "${b[0]}"], "b": [1]},
        chain("NEXTNEXT", 10),
    ],
)
def test_what_ends_is_fine(tree: dict[str, Any]) -> None:
    check_expansion(OmegaConf.create(tree))


def test_files_from_outside_are_checked(tmp_path) -> None:
    file = tmp_path / "CartpolePPO.yaml"
    content = {"params": {"algo": LAUGHS}}
    file.write_text(OmegaConf.to_yaml(content))
    for read in (
        lambda: compose(["task=Cartpole", f"train={file}"]),
        lambda: load_train_file(file),
    ):
        with pytest.raises(ConfigError, match="repeat more than 1,000,000 values"):
            read()
