from __future__ import annotations

import pytest

from isaacgymenvs_lite.errors import UnavailableError, UserError
from isaacgymenvs_lite.isaacgymenvs_compat.stand_ins import StandInModule

gymapi = StandInModule("isaacgym.gymapi", "use something else")


def test_names_can_be_inherited_from_and_stand_in_signatures() -> None:
    class Own(gymapi.SimParams):
        def first(self, params: gymapi.Vec3 | None = None) -> gymapi.Vec3:
            return params

    assert not isinstance(3, gymapi.SimParams)
    assert not hasattr(gymapi, "__all__")
    with pytest.raises(UnavailableError, match=r"isaacgym\.gymapi\.SimParams: use something else"):
        Own()


@pytest.mark.parametrize("use", [lambda: gymapi.acquire_gym(), lambda: gymapi.acquire_gym(1, a=2)])
def test_a_call_says_what_to_do(use) -> None:
    with pytest.raises(UserError, match=r"^isaacgym\.gymapi\.acquire_gym: use something else$"):
        use()
