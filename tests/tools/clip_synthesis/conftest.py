"""The humanoid that the clips are made for."""

from __future__ import annotations

import pytest

from isaacgymenvs_lite.motion.skeleton import Skeleton, skeleton_for_num_dofs


@pytest.fixture
def humanoid() -> Skeleton:
    return skeleton_for_num_dofs(28)
