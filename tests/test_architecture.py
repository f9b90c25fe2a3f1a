"""Rules of the house that can be read off the syntax tree."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import isaacgymenvs_lite

PACKAGE = "isaacgymenvs_lite"
ROOT = Path(isaacgymenvs_lite.__file__).parent
FILES = sorted(ROOT.rglob("*.py"))
LOOPS = {"play_steps", "train_epoch", "calc_gradients"}

# Every package and top-level module, from the lowest to the highest. Each may import only what
# stands before it; modules of one package may import each other, but never in a circle.
LAYERS = (
    *("errors", "_version", "paths", "typed_command"),
    *("schema", "utils", "distributed", "config"),
    *("simulation", "robots", "rendering", "command_line", "motion"),
    *("env_interface", "gymnasium_ids"),
    *("tasks", "evaluation", "run", "checkpoints", "learning", "pbt", "viewers"),
    *("env_factory", "wrappers", "registration", "runner"),
    *("train", "isaacgymenvs_compat", "commands"),
    *("report", "export", "workflows", "__main__"),
)
# Pairs that do not import each other, although their layers would allow it, directly or through
# others: agents and tasks meet in the contract of `env_interface` alone.
STRANGERS = (
    *(("learning", "tasks"), ("learning", "simulation"), ("wrappers", "learning")),
    *(("evaluation", "tasks"), ("checkpoints", "tasks"), ("report", "learning")),
)


@cache
def tree(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"))


def module_of(path: Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join((PACKAGE, *(part for part in parts if part != "__init__")))


def room_of(module: str) -> str:
    """First name below the package: 'learning' for isaacgymenvs_lite.learning.sac."""
    return module.split(".")[1] if "." in module else ""


MODULES = {module_of(path): path for path in FILES}


def imported(path: Path) -> Iterator[str]:
    """Modules of the project that a file imports anywhere, functions and TYPE_CHECKING included."""
    of_program = {
        node
        for block in tree(path).body
        if isinstance(block, ast.If) and ast.unparse(block.test) == "__name__ == '__main__'"
        for node in ast.walk(block)
    }
    for node in ast.walk(tree(path)):
        if node in of_program:
            continue
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: a relative import"
            base = node.module or ""
            inner = [f"{base}.{alias.name}" for alias in node.names]
            names = [name if name in MODULES else base for name in inner]
        else:
            continue
        for name in names:
            if name in MODULES:
                yield name


@cache
def direct(module: str) -> frozenset[str]:
    own = set(imported(MODULES[module])) - {module, PACKAGE}
    return frozenset(own)


def reachable(module: str) -> set[str]:
    """Every module that importing `module` may bring with it."""
    seen: set[str] = set()
    todo = [module]
    while todo:
        for other in direct(todo.pop()):
            if other not in seen:
                seen.add(other)
                todo.append(other)
    return seen


def test_the_loops_exist_once():
    """rl_games calls these three; copies of them hid bugs in the originals."""
    owners = [
        (module, cls.name, function.name)
        for module, path in MODULES.items()
        for cls in ast.walk(tree(path))
        if isinstance(cls, ast.ClassDef)
        for function in cls.body
        if isinstance(function, (ast.FunctionDef, ast.AsyncFunctionDef)) and function.name in LOOPS
        if f"super().{function.name}(" not in ast.unparse(function)  # work before or after it
    ]
    agent = (f"{PACKAGE}.learning.common_agent", "CommonAgent")
    assert sorted(owners) == sorted((*agent, loop) for loop in LOOPS)


def test_nobody_rewrites_rl_games_train_loop():
    """Best-checkpoint saving, score_to_win and max_frames live in it."""
    for module, path in MODULES.items():
        for cls in ast.walk(tree(path)):
            if isinstance(cls, ast.ClassDef) and cls.name.endswith("Agent"):
                assert "train" not in {getattr(node, "name", None) for node in cls.body}, module


def test_every_package_has_a_layer():
    rooms = {room_of(module) for module in MODULES} - {""}
    assert sorted(LAYERS) == sorted(rooms)


def test_imports_run_one_way():
    for module in MODULES:
        room = room_of(module)
        allowed = {"", *LAYERS[: LAYERS.index(room) + 1]} if room else set(LAYERS) | {""}
        wrong = {other for other in direct(module) if room_of(other) not in allowed}
        assert not wrong, f"{module} imports {sorted(wrong)}"


def test_no_circle_of_modules():
    """Annotations count: what must know of each other is one module, or one of them a Protocol."""
    for module in MODULES:
        others = (reachable(other) for other in direct(module))
        assert not any(module in found for found in others), f"{module} is part of a circle"


def test_strangers_do_not_meet():
    for one, other in STRANGERS:
        for module in MODULES:
            if room_of(module) == one:
                wrong = {found for found in reachable(module) if room_of(found) == other}
                assert not wrong, f"{module} imports {sorted(wrong)}"


def test_one_package_steps_the_simulator():
    """Others may read a compiled model; nobody else imports the batch API."""
    for module, path in MODULES.items():
        if room_of(module) == "simulation":
            continue
        for node in ast.walk(tree(path)):
            names = []
            if isinstance(node, ast.Import):
                names = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom):
                names = [f"{node.module}.{alias.name}" for alias in node.names] + [str(node.module)]
            assert not [n for n in names if n.startswith("mujoco.batch")], module
            if isinstance(node, ast.Attribute):
                assert node.attr not in ("mj_step", "mj_step1", "mj_step2"), module


def test_registration_is_the_only_place_that_registers():
    """Names of algorithms, players, models and networks are given to rl_games in one file."""
    verbs = {"register_builder", "register_model", "register_network"}
    for module, path in MODULES.items():
        if room_of(module) == "registration":
            continue
        used = {node.attr for node in ast.walk(tree(path)) if isinstance(node, ast.Attribute)}
        assert not used & verbs, module


def test_quaternions_change_their_order_in_one_place():
    """No list of indices that turns wxyz into xyzw or back outside utils/rotations.py."""
    orders = {(1, 2, 3, 0), (3, 0, 1, 2)}
    for module, path in MODULES.items():
        if module == f"{PACKAGE}.utils.rotations":
            continue
        for node in ast.walk(tree(path)):
            if isinstance(node, (ast.List, ast.Tuple)):
                values = tuple(e.value for e in node.elts if isinstance(e, ast.Constant))
                assert values not in orders, f"{module}:{getattr(node, 'lineno', 0)}"


def test_hydra_and_omegaconf_are_used_through_their_public_interface():
    for path in FILES:
        for node in ast.walk(tree(path)):
            names = []
            if isinstance(node, ast.Import):
                names = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom):
                names = [f"{node.module}.{alias.name}" for alias in node.names]
            for name in names:
                is_theirs = name.split(".")[0] in ("hydra", "omegaconf")
                assert not (is_theirs and "._" in name), f"{path.name}:{node.lineno}: {name}"
