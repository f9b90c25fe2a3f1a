"""The names of IsaacGymEnvs' `utils.dr_utils`.

Two functions work. All other names can only be imported, because their functions call Isaac Gym.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from isaacgymenvs_lite.isaacgymenvs_compat.stand_ins import StandInModule
from isaacgymenvs_lite.schema import read_section
from isaacgymenvs_lite.tasks.randomization.randomizer import bucketed, draw
from isaacgymenvs_lite.tasks.randomization.settings import AttributeSettings

_stand_ins = StandInModule(
    "isaacgymenvs.utils.dr_utils",
    "it sets properties through Isaac Gym; here task.task.randomize=True does all of it, for tasks"
    " of one's own too (docs/migration.md, Domain randomisation)",
)
apply_random_samples = _stand_ins.apply_random_samples
check_buckets = _stand_ins.check_buckets
get_default_setter_args = _stand_ins.get_default_setter_args
get_property_getter_map = _stand_ins.get_property_getter_map
get_property_setter_map = _stand_ins.get_property_setter_map

_WHERE = "attr_randomization_params"


def generate_random_samples(
    attr_randomization_params: Mapping[str, Any],
    shape: int | tuple[int, ...],
    curr_gym_step_count: int,
    extern_sample: npt.ArrayLike | None = None,
) -> npt.NDArray[np.float64]:
    """Return random values, which the caller adds to properties or by which it multiplies them.

    Args:
        attr_randomization_params: `range`, `distribution`, `operation`, and `schedule` with
            `schedule_steps`, as in task files.
        shape: shape of the result.
        curr_gym_step_count: number of simulator calls so far; the schedule depends on this number.
        extern_sample: values that replace the random values; only the schedule is applied to them.
    """
    settings = read_section(
        AttributeSettings, {**attr_randomization_params, "num_buckets": None}, _WHERE
    )
    if extern_sample is None:
        sizes = (shape,) if isinstance(shape, int) else tuple(shape)
        return draw(settings, curr_gym_step_count, sizes).numpy()
    factor = settings.factor(curr_gym_step_count)
    rest = 1.0 - factor if settings.operation == "scaling" else 0.0
    return factor * np.asarray(extern_sample, dtype=np.float64) + rest


def get_bucketed_val(
    new_prop_val: npt.ArrayLike, attr_randomization_params: Mapping[str, Any]
) -> npt.NDArray[np.float64]:
    """Return values, rounded down to one of `num_buckets` evenly spaced values of the range."""
    settings = read_section(AttributeSettings, attr_randomization_params, _WHERE)
    return bucketed(torch.as_tensor(new_prop_val, dtype=torch.float64), settings).numpy()
