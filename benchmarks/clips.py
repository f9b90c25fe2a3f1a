"""The clips that one preset is tried on: their list and the table of their results.

    python -m benchmarks.learning clips --minutes 60 --until-learned --resume
    python -m benchmarks.clips [--clips deepmimic shipped PATH ...]

The first command trains one clip after the other, each with the same settings and for the same
time, and writes a record after each; it goes on where it was stopped. `--until-learned` ends a
clip's training before its time, when two measurements in a row are as good as the table asks. The
second prints the table of all clips, those that are not done yet among them; of several seeds,
medians with the extremes behind them. Without `--clips` both take the 20 clips of DeepMimic in the
package pybullet and the clips that ship. A folder means all clips in it.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

from benchmarks import tables
from benchmarks.evaluate import RESULTS_DIR
from benchmarks.experiments import Experiment, find_experiment, override
from benchmarks.learned import allowed_error, is_learned
from benchmarks.records import Record, read_records, spread_cell
from isaacgymenvs_lite.errors import ConfigError, UserError
from isaacgymenvs_lite.motion.formats.deepmimic import PREFIX, clips_in_package
from isaacgymenvs_lite.motion.loader import (
    load_single_clip,
    shipped_motions,
    shipped_motions_dir,
)

NAME = "clips"
"""Of the experiment, and of the folder of its records in benchmarks/results."""
DEFAULT_CLIPS = ("deepmimic", "shipped")
_SUFFIXES = (".npz", ".npy", ".json", ".txt", ".csv")


def named_clips(words: Sequence[str]) -> dict[str, str]:
    """Return label -> motion file of the clips that words name.

    Args:
        words: `deepmimic` and `shipped` are all clips of a kind, a folder the clips in it; others
            are motion files.

    Raises:
        UserError: there are no such clips.
    """
    clips: dict[str, str] = {}
    for word in words:
        folder = Path(word).expanduser()
        if word == "deepmimic":
            found = clips_in_package()
        elif word == "shipped":
            found = [name for name in shipped_motions() if not _is_data_set(name)]
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


def _is_data_set(name: str) -> bool:
    return (shipped_motions_dir() / f"{name}.yaml").is_file()


def _label(file: str) -> str:
    """Return the name of a clip in folders and tables, such as `deepmimic_walk`."""
    if file.startswith(PREFIX):
        name = file.removeprefix(PREFIX).removeprefix("humanoid3d_")
        return "deepmimic_" + name.replace("/", "_")
    return Path(file).stem


def clip_experiments(words: Sequence[str], extra: Sequence[str] = ()) -> list[Experiment]:
    """Return one experiment for each clip, all with the settings of the experiment `clips`.

    Args:
        words: see `named_clips`.
        extra: further overrides, for all of them.

    Raises:
        UserError: there are no such clips.
    """
    base = find_experiment(NAME)
    return [
        Experiment(label, (*base.settings, override("task.env.motion_file", file), *extra))
        for label, file in named_clips(words).items()
    ]


def table(labels: Sequence[str], records: Mapping[str, Sequence[Record]]) -> str:
    """Return the table of clips for docs/, and a line that counts those that are learned."""
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
        allowed_m, is_papers = allowed_error(label)
        most_m = f"{allowed_m:.3f}, paper" if is_papers else f"{allowed_m:.2f}"
        seeds = records.get(label, [])
        if not seeds:
            rows.append((label, "", "", "", most_m, "", "", "", "not trained yet"))
            continue
        cells = (
            label,
            spread_cell([record.frames / 1e6 for record in seeds], ".1f"),
            spread_cell([record.minutes for record in seeds], ".0f"),
            spread_cell([record.pose_error_m for record in seeds], ".3f"),
            most_m,
            spread_cell([record.motion_shown for record in seeds], ".2f"),
            spread_cell([record.no_fall_share for record in seeds], ".2f"),
            spread_cell([record.tempo for record in seeds], ".2f"),
            _learned_cell(seeds),
        )
        rows.append(cells)
    done = [records[label] for label in labels if label in records]
    learned = sum(all(map(is_learned, seeds)) for seeds in done)
    summary = f"{learned} of {len(done)} clips are learned, {len(labels) - len(done)} not done."
    return f"{tables.markdown(headings, rows)}\n\n{summary}"


def _learned_cell(seeds: Sequence[Record]) -> str:
    learned = sum(map(is_learned, seeds))
    if 0 < learned < len(seeds):
        return f"{learned} of {len(seeds)} seeds"
    return "yes" if learned else "no"


def newest_records(labels: Sequence[str], folder: Path) -> dict[str, list[Record]]:
    """Return the record with most frames of each seed, by seed, of each clip that has one."""
    found = {}
    for label in labels:
        records = read_records(folder / f"{label}.jsonl")
        newest = {record.seed: record for record in sorted(records, key=lambda r: r.frames)}
        if newest:
            found[label] = [newest[seed] for seed in sorted(newest)]
    return found


def main() -> None:
    """Print the table, and draw."""
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
