"""Writes a policy into one file: isaacgymenvs-lite export checkpoint=... format=onnx.

    isaacgymenvs-lite export checkpoint=walk                          # walk.onnx
    isaacgymenvs-lite export checkpoint=last                          # policy.onnx
    isaacgymenvs-lite export checkpoint=last task=Ant format=torchscript out=ant.pt
    isaacgymenvs-lite export checkpoint=old.pth task=Ant train=/path/to/AntPPO.yaml

The exported policy includes the normalisers. Therefore its inputs are raw observations, and its
outputs are actions within the task's limits. `checkpoint` is a .pth file, `last` (the newest
checkpoint of all runs or of `task=`), or a shipped policy. The settings of the task and the
training come from the run and can be overridden as on the command line of train.py. For a robot's
task the model is also written, so that play_onnx.py can play the policy without this package.
"""

from __future__ import annotations

import argparse
import dataclasses
import sys

from isaacgymenvs_lite.command_line import run_command
from isaacgymenvs_lite.export.export import ExportSettings, export_policy

_OWN_KEYS = tuple(field.name for field in dataclasses.fields(ExportSettings))


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; return the exit code."""
    words = sys.argv[1:] if arguments is None else arguments
    others = [word for word in words if "=" in word and word.partition("=")[0] not in _OWN_KEYS]
    own = [word for word in words if word not in others]
    parser = argparse.ArgumentParser(prog="isaacgymenvs-lite export", description=__doc__)
    return run_command(
        parser, ExportSettings, lambda settings: export_policy(settings, others), own
    )


if __name__ == "__main__":
    sys.exit(main())
