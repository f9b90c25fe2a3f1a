"""How a data set of many clips slows the training of skills down, and its start.

    python -m benchmarks.many_clips [--clips 16 87] [--seconds 15] [--rounds 3] [--epochs 12]
        [key=value ...]

Trains HumanoidASE with sword and shield in turns (A B A B ...), each in a process of its own, on
data sets as ASE's: poselib's files and a YAML file that lists them. The clips are the shipped ones
again and again, with as many frames as so many seconds at 30 fps have. Prints the time from the
command to the end of the first epoch, the frames per second of the epochs after it, and the ratio
of each round.
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
from itertools import cycle, islice
from pathlib import Path

import yaml

from benchmarks.learning_curve import read_learning_curve
from benchmarks.machine import describe_machine
from benchmarks.start_and_memory import run_training
from isaacgymenvs_lite.motion.convert import ConvertSettings, convert
from isaacgymenvs_lite.motion.loader import load_single_clip, shipped_motions
from isaacgymenvs_lite.motion.skeleton import skeleton_for_num_dofs

_FPS = 30.0
_NUM_DOFS = 31
_DATA_SET = "locomotion"  # of the shipped clips, no clip itself
_SWORD_AND_SHIELD = (
    "task=HumanoidASE",
    "task.env.asset.assetFileName=mjcf/amp_humanoid_sword_shield.xml",
    "task.env.keyBodies=[right_hand,left_hand,right_foot,left_foot,sword,shield]",
)


def write_data_set(folder: Path, num_clips: int, seconds: float) -> Path:
    """Write clips of `seconds` * 30 frames each, and the YAML file that lists them."""
    skeletons = [skeleton_for_num_dofs(28)]
    sources = [name for name in shipped_motions() if name != _DATA_SET]
    files = []
    for number, source in enumerate(islice(cycle(sources), num_clips)):
        clip, _ = load_single_clip(source, skeletons)
        fps = _FPS * seconds / clip.length_s
        without_hands = folder / f"{number:03}_{source}.txt"  # in which any humanoid has its poses
        files.append(without_hands.with_suffix(".npy").name)
        convert(source, str(without_hands), ConvertSettings())
        settings = ConvertSettings(fps=fps, num_dofs=_NUM_DOFS)
        convert(str(without_hands), str(folder / files[-1]), settings)
    data_set = folder / f"clips_{num_clips}.yaml"
    motions = [{"file": file, "weight": 1.0} for file in files]
    data_set.write_text(yaml.safe_dump({"motions": motions}), encoding="utf-8")
    return data_set


def train(data_set: Path, epochs: int, overrides: list[str]) -> tuple[float, float]:
    """Return seconds to the end of the first epoch, and frames per second after it."""
    words = (f"task.env.motion_file={data_set}", f"max_iterations={epochs}", *overrides)
    with tempfile.TemporaryDirectory() as folder:
        first_epoch_s = run_training((*_SWORD_AND_SHIELD, *words), folder)
        (summaries,) = Path(folder).glob("runs/*/summaries")
        fps = read_learning_curve(summaries)["fps"].values
    return first_epoch_s, float(statistics.median(fps[1:]))


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--clips", type=int, nargs=2, default=[16, 87], help="in the data sets")
    parser.add_argument("--seconds", type=float, default=15.0, help="of each clip")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--epochs", type=int, default=12)
    parser.add_argument("overrides", nargs="*")
    args = parser.parse_intermixed_args()
    print(describe_machine())
    with tempfile.TemporaryDirectory() as folder:
        data_sets = []
        for num_clips in args.clips:
            part = Path(folder) / str(num_clips)
            part.mkdir()
            data_sets.append(write_data_set(part, num_clips, args.seconds))
        ratios = []
        for number in range(args.rounds):
            speeds = []
            for num_clips, data_set in zip(args.clips, data_sets, strict=True):
                first_s, fps = train(data_set, args.epochs, args.overrides)
                speeds.append(fps)
                print(
                    f"round {number + 1}, {num_clips} clips: first epoch after {first_s:.1f} s,"
                    f" {fps:,.0f} frames/s",
                    flush=True,
                )
            ratios.append(speeds[1] / speeds[0])
    few, many = args.clips
    print(
        f"{many} clips / {few} clips: {statistics.median(ratios):.2f}"
        f" ({min(ratios):.2f} to {max(ratios):.2f})"
    )


if __name__ == "__main__":
    main()
