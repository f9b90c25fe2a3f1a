"""Describes this installation in a few lines, which users can paste into an issue.

`isaacgymenvs-lite check` without a file prints this description. Each line says whether a part of
the installation works, or how to repair it.
"""

from __future__ import annotations

import contextlib
import os
import platform
import shutil
import sys
import time
from collections.abc import Callable, Iterator
from importlib.metadata import PackageNotFoundError, requires, version
from importlib.util import find_spec
from pathlib import Path

import torch
from packaging.requirements import Requirement

from isaacgymenvs_lite import __version__
from isaacgymenvs_lite.config.compose import compose
from isaacgymenvs_lite.env_factory import make_from_config
from isaacgymenvs_lite.errors import UserError, one_line
from isaacgymenvs_lite.paths import cfg_dir
from isaacgymenvs_lite.rendering.display import check_display
from isaacgymenvs_lite.rendering.gl import ensure_gl
from isaacgymenvs_lite.utils.optional_packages import EXTRAS
from isaacgymenvs_lite.utils.precision import measure_bfloat16_speedup, supports_bfloat16
from isaacgymenvs_lite.utils.threads import thread_count

DISTRIBUTION = "isaacgymenvs-lite"
# Free space for a run of 5,000 epochs, which writes a hundred checkpoints of a few megabytes.
_LEAST_FREE_GIB = 2.0
_GIB = 2**30
_NUM_STEPS = 20


def describe_installation() -> tuple[list[str], bool]:
    """Return the lines of the description, and whether a training can start."""
    problems = list[str]()
    rows: list[tuple[str, Callable[[], str]]] = [
        ("package", _package),
        ("machine", _machine),
        ("needs", lambda: _needs(problems)),
        ("extras", _extras),
        ("threads", _threads),
        ("precision", _precision),
        ("GPU", _gpu),
        ("pictures", lambda: _or_reason(lambda: f"{ensure_gl()} draws without a screen")),
        ("window", lambda: _or_reason(lambda: check_display() or "can be opened")),
        ("disk", lambda: _disk(problems)),
        ("physics", lambda: _physics(problems)),
    ]
    lines = [f"{name + ':':12}{row()}" for name, row in rows]
    lines.append("a training can start" if not problems else "a training cannot start; see above")
    return lines, not problems


def _package() -> str:
    checkout = cfg_dir().parent
    where = f"checkout {checkout}" if (checkout / "pyproject.toml").is_file() else str(checkout)
    return f"isaacgymenvs_lite {__version__}, {where}"


def _machine() -> str:
    memory = ""
    if hasattr(os, "sysconf"):  # Windows lacks this function.
        gib = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / _GIB
        memory = f", {gib:.0f} GiB"
    return (
        f"{platform.platform()}, {cpu_name()}, {thread_count()} of {os.cpu_count()} CPUs{memory};"
        f" Python {platform.python_version()} in {sys.prefix}"
    )


def cpu_name() -> str:
    """Return the processor's name in the operating system."""
    info = Path("/proc/cpuinfo")
    if info.is_file():
        for line in info.read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


def _needs(problems: list[str]) -> str:
    found, unfit = list[str](), list[str]()
    try:
        needed = list(_requirements())
    except PackageNotFoundError:
        return "unknown: the package is not installed; pip install -e . in the checkout"
    for requirement in needed:
        try:
            installed = version(requirement.name)
            fits = requirement.specifier.contains(installed, prereleases=True)
        except PackageNotFoundError:
            installed, fits = "missing", False
        found.append(f"{requirement.name} {installed}" + ("" if fits else " (unfit)"))
        if not fits:
            unfit.append(f'"{requirement.name}{requirement.specifier}"')
    problems += unfit
    return ", ".join(found) + (f"; pip install {' '.join(unfit)}" if unfit else "")


def _requirements() -> Iterator[Requirement]:
    """Yield the requirements of the installed package on this machine, without its extras."""
    for text in requires(DISTRIBUTION) or ():
        requirement = Requirement(text)
        if requirement.marker is None or requirement.marker.evaluate({"extra": ""}):
            yield requirement


def _extras() -> str:
    by_extra: dict[str, list[str]] = {}
    for module, extra in EXTRAS.items():
        by_extra.setdefault(extra, []).append(module)
    there = {extra for extra, modules in by_extra.items() if all(map(find_spec, modules))}
    text = ", ".join(sorted(there)) or "none"
    missing = ", ".join(sorted(by_extra.keys() - there))
    return f"{text}; not installed: {missing}" if missing else text


def _threads() -> str:
    names = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OMP_WAIT_POLICY")
    variables = [f"{name}={os.environ[name]}" for name in names if name in os.environ]
    return ", ".join([f"torch {torch.get_num_threads()}, physics {thread_count()}", *variables])


def _precision() -> str:
    if not supports_bfloat16():
        return "float32: this CPU has no instructions for bfloat16"
    return f"bfloat16 is {measure_bfloat16_speedup():.1f} times as fast as float32"


def _gpu() -> str:
    if not torch.cuda.is_available():
        return "none that torch can use: networks and physics run on the CPU"
    names = [torch.cuda.get_device_name(index) for index in range(torch.cuda.device_count())]
    return f"{', '.join(names)}: for networks (rl_device=cuda:0); physics runs on the CPU"


def _or_reason(attempt: Callable[[], str]) -> str:
    try:
        return attempt()
    except UserError as error:
        return one_line(error)


def _disk(problems: list[str]) -> str:
    folder = Path.cwd()
    free = shutil.disk_usage(folder).free / _GIB
    text = f"{free:.0f} GiB free in {folder}"
    if not os.access(folder, os.W_OK):
        problems.append("folder")
        return f"{text}, which cannot be written: runs need another folder"
    return text if free >= _LEAST_FREE_GIB else f"{text}: a long run may need more"


def _physics(problems: list[str]) -> str:
    """Test the model, the clips and the simulator by steps of HumanoidAMP in 64 environments."""
    try:
        with contextlib.closing(
            make_from_config(
                compose(["task=HumanoidAMP", "num_envs=64"]), sim_device="cpu", rl_device="cpu"
            )
        ) as task:
            task.reset_done()
            actions = torch.zeros(task.num_envs, task.num_actions)
            began = time.perf_counter()
            for _ in range(_NUM_STEPS):
                task.step(actions)
            steps_per_s = _NUM_STEPS * task.num_envs / (time.perf_counter() - began)
    except UserError as error:
        problems.append("physics")
        return one_line(error)
    return f"HumanoidAMP with 64 environments makes {steps_per_s:,.0f} steps/s"
