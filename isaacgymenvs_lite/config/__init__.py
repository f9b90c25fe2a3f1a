"""The configuration: composition, checks, and what becomes of a train file.

`compose` makes a tree, `check_config` refuses a wrong one, `prepare_train_params` turns its train
section into what rl_games loads.
"""

from isaacgymenvs_lite.config.compose import compose
from isaacgymenvs_lite.config.devices import check_device
from isaacgymenvs_lite.config.launch import LaunchSettings, check_config
from isaacgymenvs_lite.config.minibatch import fit_minibatch
from isaacgymenvs_lite.config.resolvers import register_resolvers
from isaacgymenvs_lite.config.seeds import resolve_seed
from isaacgymenvs_lite.config.startup_notes import cpu_defaults_note, physx_only_keys, startup_notes
from isaacgymenvs_lite.config.train_files import load_train_file
from isaacgymenvs_lite.config.train_params import KnownNames, prepare_train_params

__all__ = [
    "KnownNames",
    "LaunchSettings",
    "check_config",
    "check_device",
    "compose",
    "cpu_defaults_note",
    "fit_minibatch",
    "load_train_file",
    "physx_only_keys",
    "prepare_train_params",
    "register_resolvers",
    "resolve_seed",
    "startup_notes",
]
