"""Lists the clips that one preset is trained on, and prints the table of their results.

    python -m benchmarks.learning clips --minutes 60 --until-learned --resume
    python -m benchmarks.clips [--clips deepmimic shipped PATH ...]

The first command trains one clip after the other with the same settings and the same time limit. It
writes a record after each clip. With `--resume` it continues stopped trainings. `--until-learned`
ends a clip's training early when two measurements in a row are good, see
`benchmarks.learned`. The second command prints the table of all clips, also of clips without a
record. A cell for several seeds holds the median, then the lowest and the highest value. Without
`--clips` both commands take the 20 DeepMimic clips of the package pybullet and the shipped clips. A
folder stands for all clips in it.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

from benchmarks import tables
from benchmarks.experiments import Experiment, find_experiment, override
from benchmarks.learned import allowed_error, is_learned
from benchmarks.played import RESULTS_DIR
from benchmarks.records import Record, read_records, spread_cell
from isaacgymenvs_lite.errors import ConfigError, UserError
from isaacgymenvs_lite.motion.formats.deepmimic import PREFIX, clips_in_package
from isaacgymenvs_lite.motion.loader import (
    load_single_clip,
    shipped_motions,
    shipped_motions_dir,
)

NAME = "clips"
"""The experiment and the folder of its records in benchmarks/results have this name."""
DEFAULT_CLIPS = ("deepmimic", "shipped")
_SUFFIXES = (".npz", ".npy", ".json", ".txt", ".csv")


def named_clips(words: Sequence[str]) -> dict[str, str]:
    """Return label -> motion file for the arguments of `--clips`.

    Args:
        words: `deepmimic` or `shipped` (all clips of this source), folders, or motion files.

    Raises:
        UserError: a clip cannot be read, a folder holds no clip, or two clips have the same name.
    """
    clips: dict[str, str] = {}
    for word in words:
        folder = Path(word).expanduser()
        if word == "deepmimic":
            found = clips_in_package()
        elif word == "shipped":
            folder = shipped_motions_dir()
            # A name with a YAML file is a data set of several clips.
            found = [name for name in shipped_motions() if not (folder / f"{name}.yaml").is_file()]
        elif folder.is_dir():
            found = [str(f.absolute()) for f in sorted(folder.iterdir()) if f.suffix in _SUFFIXES]
            if not found:
                raise ConfigError(f"{word}: no clip in this folder ({', '.join(_SUFFIXES)})")
        else:
            load_single_clip(word)
            found = [str(folder.absolute()) if folder.is_file() else word]
        for file in found:
            label = _label(file)
            if clips.setdefault(label, file) != file:
                raise ConfigError(f"{clips[label]} and {file} have the same name; rename one")
    return clips


def _label(file: str) -> str:
    """Return the name of a clip for folders and tables, for example `deepmimic_walk`."""
    if file.startswith(PREFIX):
        name = file.removeprefix(PREFIX).removeprefix("humanoid3d_")
        return "deepmimic_" + name.replace("/", "_")
    return Path(file).stem


def clip_experiments(words: Sequence[str], extra: Sequence[str] = ()) -> list[Experiment]:
    """Return one experiment for each clip, with the settings of the experiment `clips`.

    Args:
        words: arguments of `named_clips`, which raises for unusable clips.
        extra: additional overrides of all experiments.
    """
    base = find_experiment(NAME)
    return [
        Experiment(label, (*base.settings, override("task.env.motion_file", file), *extra))
        for label, file in named_clips(words).items()
    ]


def table(labels: Sequence[str], records: Mapping[str, Sequence[Record]]) -> str:
    """Return a Markdown table of the clips, and a line that counts the learned clips."""
    headings = (
        "clip",
        "frames (M)",
        "minutes",
        "pose error (m)",
        "at most",
        "motion shown",
        "without a fall",
        "tempo",
        "learned",
    )
    rows: list[Sequence[str]] = []
    for label in labels:
        allowed_m, is_from_paper = allowed_error(label)
        most_m = f"{allowed_m:.3f}, paper" if is_from_paper else f"{allowed_m:.2f}"
        seeds = records.get(label, [])
        if not seeds:
            rows.append((label, "", "", "", most_m, "", "", "", "not trained yet"))
            continue
        learned = sum(map(is_learned, seeds))
        if 0 < learned < len(seeds):
            learned_cell = f"{learned} of {len(seeds)} seeds"
        else:
            learned_cell = "yes" if learned else "no"
        cells = (
            label,
            spread_cell([record.frames / 1e6 for record in seeds], ".1f"),
            spread_cell([record.minutes for record in seeds], ".0f"),
            spread_cell([record.pose_error_m for record in seeds], ".3f"),
            most_m,
            spread_cell([record.motion_shown for record in seeds], ".2f"),
            spread_cell([record.no_fall_share for record in seeds], ".2f"),
            spread_cell([record.tempo for record in seeds], ".2f"),
            learned_cell,
        )
        rows.append(cells)
    done = [records[label] for label in labels if label in records]
    learned = sum(all(map(is_learned, seeds)) for seeds in done)
    summary = f"{learned} of {len(done)} clips are learned, {len(labels) - len(done)} not done."
    return f"{tables.markdown(headings, rows)}\n\n{summary}"


def newest_records(labels: Sequence[str], folder: Path) -> dict[str, list[Record]]:
    """Return label -> the record with most frames of each seed; omit clips without records."""
    found = {}
    for label in labels:
        records = read_records(folder / f"{label}.jsonl")
        newest = {record.seed: record for record in sorted(records, key=lambda r: r.frames)}
        if newest:
            found[label] = [newest[seed] for seed in sorted(newest)]
    return found


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--clips", nargs="+", default=DEFAULT_CLIPS)
    parser.add_argument("--results-dir", type=Path, default=RESULTS_DIR / NAME)
    args = parser.parse_args()
    try:
        labels = list(named_clips(args.clips))
        records = newest_records(labels, args.results_dir)
        print(table(labels, records))
    except UserError as error:
        sys.exit(f"error: {error}")


if __name__ == "__main__":
    main()
