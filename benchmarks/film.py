"""Films a trained policy for a page, without a display.

    python -m benchmarks.film TARGET --out FILE.webp [key=value ...]
        [--seconds 3] [--skip 0] [--envs 1] [--runs-dir runs/benchmarks]

The target is a checkpoint, a run folder or an experiment, see `benchmarks.evaluate`. The command
films the first policy of the target with mean actions. The film has one panel for each environment.
A policy that imitates a clip is shown next to its clip, both from the same phase. `--out` ends in
.webp or .mp4. `isaacgymenvs-lite demo` films the shipped policies. The command needs the extra
[video].
"""

from __future__ import annotations

import argparse
import logging
import sys
from pathlib import Path
from typing import Any

from benchmarks.played import find_targets
from benchmarks.protocol import SEED, play_checkpoint
from benchmarks.runs import DEFAULT_RUNS_DIR
from isaacgymenvs_lite.errors import UserError
from isaacgymenvs_lite.evaluation.evaluate import evaluate
from isaacgymenvs_lite.rendering.tracks import PoseRecorder
from isaacgymenvs_lite.rendering.video import draw_tracks, save_video
from isaacgymenvs_lite.rendering.view import View
from isaacgymenvs_lite.viewers.reference_overlay import reference_track

PANEL = (400, 300)
"""A panel has this width and height in pixels. Several panels have half of the width."""
MAX_FPS = 20.0
"""A film keeps at most this many frames per second, which limits the size of the file."""


def film(
    player: Any, env: Any, out: Path, seconds: float, skip_seconds: float, num_shown: int
) -> Path:
    """Play one episode in each environment and film the first environments.

    Args:
        player: has `act(obs)`.
        env: the player's task.
        out: a .webp or .mp4 file.
        seconds: length of the film, which is shorter if all episodes end earlier.
        skip_seconds: length of the omitted beginning.
        num_shown: number of filmed environments.

    Raises:
        UserError: this machine cannot draw or encode, or the file cannot be written.
    """
    first, steps = round(skip_seconds / env.dt), max(1, round(seconds / env.dt))
    recorder = PoseRecorder(env, first + steps, range(num_shown))
    observe = getattr(player, "on_step", None)

    def on_step(dones: Any, infos: Any) -> None:
        recorder.step()
        if observe is not None:
            observe(dones, infos)

    evaluate(env, player.act, env.num_envs, on_step=on_step)
    model = env.simulation.model
    tracks, markers = recorder.tracks(), recorder.markers()
    labels: tuple[str, ...] = ()
    has_clips = hasattr(env, "motion_lib")
    if has_clips and num_shown == 1 and not any(any(shown) for shown in markers):
        tracks.insert(0, reference_track(env, tracks[0]))
        labels, markers = ("reference clip", "policy"), []
    stride = -(-round(1.0 / env.dt) // round(MAX_FPS))
    width, height = PANEL
    images = draw_tracks(
        model,
        [track[first::stride] for track in tracks],
        labels,
        markers=markers[first::stride],
        width=width if len(tracks) == 1 else width // 2,
        height=height,
        view=None if has_clips else View.of_model(model),
    )
    return save_video(out, images, 1.0 / (env.dt * stride))


def main(words: list[str] | None = None) -> None:
    """Play and film a policy."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("what", nargs="+", help="a checkpoint, run folder or experiment; overrides")
    parser.add_argument("--out", type=Path, required=True, help="film to write, .webp or .mp4")
    parser.add_argument("--seconds", type=float, default=3.0)
    parser.add_argument("--skip", type=float, default=0.0, help="omit the first seconds")
    parser.add_argument("--envs", type=int, default=1, help="number of filmed environments")
    parser.add_argument("--runs-dir", type=Path, default=DEFAULT_RUNS_DIR)
    parser.add_argument("--seed", type=int, default=SEED)
    args = parser.parse_intermixed_args(words)
    logging.basicConfig(level=logging.WARNING, format="%(levelname)s: %(message)s")
    sizes = {"num_envs": args.envs, "task.env.numEnvs": args.envs}
    try:
        _, checkpoint = find_targets(args.what, args.runs_dir)[0]
        path = play_checkpoint(
            checkpoint,
            lambda player, env: film(player, env, args.out, args.seconds, args.skip, args.envs),
            {**sizes, "task.task.randomize": False},
            args.seed,
            overrides=tuple(word for word in args.what if "=" in word),
        )
    except UserError as error:
        sys.exit(f"error: {error}")
    print(f"wrote {path}, {path.stat().st_size / 1024:.0f} KiB")


if __name__ == "__main__":
    main()
