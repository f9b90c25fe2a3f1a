"""How fast PPO trains on Ant: here, and with rl_games over EnvPool's Ant.

    pip install envpool==1.2.5
    python -m benchmarks.against_envpool [--num-envs 4096] [--threads 2] [--rounds 3]
        [--envpool-task Ant-v4] [--as-published] [key=value for both]

Both train with cfg/train/AntPPO.yaml (network, horizon, minibatches, gradient steps), in turns,
each in a process of its own. EnvPool's model is put to the integrator, the time step and the number
of physics steps of ours; `--as-published` leaves it as it is (Runge-Kutta, 5 x 0.01 s: 20
evaluations of the dynamics in a control step where ours has 2). What remains different: its
observations (27 numbers for Ant-v4, 105 with the contact forces of Ant-v5; ours 60), rewards, and
when it falls.
Prints the frames per second of whole epochs and their ratio.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import os
import shutil
import statistics
import sys
import tempfile
import xml.etree.ElementTree as ElementTree
from pathlib import Path
from typing import Any

if "ours" in sys.argv:
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # as train.py, before torch is imported

import mujoco
import torch
from omegaconf import DictConfig, OmegaConf

from benchmarks.from_inside import (
    EpochTimes,
    epochs_replaced,
    last_number_of,
    train_from_inside,
)
from benchmarks.machine import describe_machine
from isaacgymenvs_lite.config.compose import compose
from isaacgymenvs_lite.env_factory import make_from_config, seed_everything
from isaacgymenvs_lite.learning.ppo import PPOAgent

_WARM_UP_EPOCHS = 3
_MODELS = Path("mujoco", "assets_gym")  # in EnvPool's folder of files


def main() -> None:
    """Measure and print."""
    args = _parser().parse_intermixed_args()
    if args.side:
        print(frames_per_second(args))
        return
    try:
        import envpool  # type: ignore[import-not-found]
    except ImportError:
        sys.exit("error: EnvPool is not installed; pip install envpool==1.2.5")
    words = ["--num-envs", str(args.num_envs), "--threads", str(args.threads), *args.overrides]
    words += ["--epochs", str(args.epochs), "--envpool-task", args.envpool_task]
    words += ["--as-published"] * args.as_published
    pairs = []
    for _ in range(args.rounds):
        ours, theirs = (
            last_number_of("benchmarks.against_envpool", "--side", side, *words)
            for side in ("ours", "envpool")
        )
        pairs.append((ours, theirs))
    ratios = [ours / theirs for ours, theirs in pairs]
    ours, theirs = (statistics.median(column) for column in zip(*pairs, strict=True))
    how = "as published" if args.as_published else "with our integrator and time steps"
    print(f"{describe_machine()}, envpool {envpool.__version__}")
    print(
        f"PPO on Ant, {args.num_envs} environments, {args.threads} threads: {ours:,.0f} frames/s;"
        f" rl_games over EnvPool's {args.envpool_task} {how} {theirs:,.0f} frames/s;"
        f" ratio median {statistics.median(ratios):.2f}"
        f" (min {min(ratios):.2f}, max {max(ratios):.2f}, {args.rounds} rounds)"
    )


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("overrides", nargs="*", help="settings, key=value")
    parser.add_argument("--num-envs", type=int, default=4096)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--epochs", type=int, default=15)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--envpool-task", default="Ant-v4")
    parser.add_argument("--as-published", action="store_true", help="EnvPool's own integrator")
    parser.add_argument("--side", choices=["ours", "envpool"], help="one number: frames per second")
    return parser


def frames_per_second(args: argparse.Namespace) -> float:
    """Train on one side and return the frames per second of the median epoch."""
    seed_everything(0)
    with tempfile.TemporaryDirectory() as folder:
        cfg = compose(
            [
                "task=Ant",
                f"num_envs={args.num_envs}",
                f"num_threads={args.threads}",
                f"+train.params.config.train_dir={folder}",
                *args.overrides,
            ]
        )
        if args.side == "ours":
            times = EpochTimes(PPOAgent.train_epoch, _WARM_UP_EPOCHS, args.epochs)
            train_from_inside(cfg, PPOAgent, times)
        else:
            times = train_over_envpool(cfg, args, Path(folder))
    return times.frames_per_epoch / statistics.median(times.seconds)


def train_over_envpool(cfg: DictConfig, args: argparse.Namespace, folder: Path) -> EpochTimes:
    """Train rl_games' own agent over EnvPool, with torch's threads as rl_games sets them."""
    from rl_games.algos_torch.a2c_continuous import A2CAgent
    from rl_games.torch_runner import Runner

    settings: dict[str, Any] = {} if args.as_published else model_like_ours(cfg, folder)
    params: Any = OmegaConf.to_container(cfg.train.params, resolve=True)
    params["torch_threads"] = args.threads
    params["config"] |= {
        "env_name": "envpool",
        "env_config": {"env_name": args.envpool_task, "num_threads": args.threads, **settings},
        "device": "cpu",
        "device_name": "cpu",
        # On a CPU its switch for CUDA's autocast has no effect but a warning.
        "mixed_precision": False,
    }
    times = EpochTimes(A2CAgent.train_epoch, _WARM_UP_EPOCHS, args.epochs)
    with contextlib.redirect_stdout(io.StringIO()), epochs_replaced(A2CAgent, times):
        runner = Runner()
        runner.load({"params": params})
        torch.set_num_threads(args.threads)
        runner.run({"train": True})
    return times


def model_like_ours(cfg: DictConfig, folder: Path) -> dict[str, Any]:
    """Write EnvPool's model with our integrator and time step; return settings that name it."""
    import envpool  # type: ignore[import-not-found]

    small = cfg.copy()
    small.task.env.numEnvs = 1
    env = make_from_config(small, sim_device="cpu", rl_device="cpu")
    options, substeps = env.simulation.model.opt, env.simulation.substeps
    integrator = mujoco.mjtIntegrator(options.integrator).name.removeprefix("mjINT_").lower()
    timestep = options.timestep
    env.close()
    files = Path(envpool.make_spec("Ant-v4").config.base_path)
    shutil.copytree(files / _MODELS, folder / _MODELS)
    path = folder / _MODELS / "ant.xml"
    tree = ElementTree.parse(path)
    option = tree.getroot().find("option")
    if option is None:
        raise RuntimeError(f"{path}: expected an <option>")
    option.set("integrator", integrator)
    option.set("timestep", str(timestep))
    tree.write(path)
    return {"base_path": str(folder), "frame_skip": substeps}


if __name__ == "__main__":
    main()
