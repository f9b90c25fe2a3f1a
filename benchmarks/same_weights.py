"""Checks that two checkouts train equal weights in three seeded epochs of each agent.

    python -m benchmarks.same_weights                     # prints a hash for each agent
    python -m benchmarks.same_weights ../other_checkout   # compares with another checkout

The hashes depend on the machine and on the versions of torch and MuJoCo. Therefore compare two
checkouts on one machine. The program exits with 1 if a hash differs.
"""

import hashlib
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import torch

COMMON = ("seed=5", "num_envs=16", "max_iterations=3", "num_threads=1", "headless=True")
# `auto` chooses the precision by a measurement, which depends on the load of the machine.
PRECISION = "++train.params.config.mixed_precision=False"
SHORT = ("train.params.config.horizon_length=8", "train.params.config.minibatch_size=64")
TRAININGS = {
    "PPO": ("task=Ant", *SHORT),
    "AMP": ("task=HumanoidAMP", *SHORT),
    "GenAMP": ("task=HumanoidASE", *SHORT),
    "HRL": ("task=HumanoidASE", "train=HumanoidASEHRLPPO", *SHORT),
    "SAC": ("task=AntSAC", "train=AntSAC", "train.params.config.num_warmup_steps=1"),
    "LSTM": ("task=AnymalTerrain", "train=AnymalTerrainPPO_LSTM", *SHORT),
}


def weights_hash(checkout: Path, words: tuple[str, ...]) -> str:
    """Train with a checkout's train.py and hash all tensors of the newest checkpoint."""
    with tempfile.TemporaryDirectory() as folder:
        runs = f"++train.params.config.train_dir={folder}"
        subprocess.run(
            [sys.executable, "train.py", *words, *COMMON, PRECISION, runs],
            cwd=checkout,
            check=True,
            capture_output=True,
        )
        newest = max(Path(folder).rglob("nn/*.pth"), key=lambda file: file.stat().st_mtime_ns)
        state = torch.load(newest, map_location="cpu", weights_only=True)
    digest = hashlib.sha256()
    for name, tensor in sorted(tensors_in(state)):
        digest.update(name.encode())
        digest.update(tensor.contiguous().numpy().tobytes())
    return digest.hexdigest()[:16]


def tensors_in(state: object, path: str = "") -> Iterator[tuple[str, torch.Tensor]]:
    """Yield path and tensor of each tensor in a checkpoint."""
    if isinstance(state, torch.Tensor):
        yield path, state
    elif isinstance(state, dict):
        for key, value in state.items():
            yield from tensors_in(value, f"{path}.{key}")


def main() -> int:
    """Print the hashes of each agent and return the exit code."""
    checkouts = [Path.cwd(), *(Path(argument) for argument in sys.argv[1:])]
    differs = False
    for agent, words in TRAININGS.items():
        hashes = [weights_hash(checkout, words) for checkout in checkouts]
        differs |= len(set(hashes)) > 1
        print(agent, *hashes, "differ" if len(set(hashes)) > 1 else "", flush=True)
    return int(differs)


if __name__ == "__main__":
    sys.exit(main())
