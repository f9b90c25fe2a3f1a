"""How torch's idle threads wait, by the order of imports and the user's settings."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

# Every variable for how OpenMP waits or how many threads there are.
NAMES = ("OMP_WAIT_POLICY", "GOMP_SPINCOUNT", "KMP_BLOCKTIME", "OMP_NUM_THREADS", "MKL_NUM_THREADS")


def said(code: str, **variables: str) -> str:
    """Return what a new interpreter writes, without the variables of this one."""
    clean = {name: value for name, value in os.environ.items() if name not in NAMES}
    command = [sys.executable, "-c", code]
    done = subprocess.run(
        command, env={**clean, **variables}, capture_output=True, text=True, check=True
    )
    return done.stdout.strip()


POLICY = "import os; print(os.environ.get('OMP_WAIT_POLICY'))"


def test_the_package_sets_the_policy_before_torch_is_there():
    assert said(f"import isaacgymenvs_lite, sys; print('torch' in sys.modules); {POLICY}") == (
        "False\nPASSIVE"
    )


@pytest.mark.parametrize(
    ("variables", "policy"),
    [({"OMP_WAIT_POLICY": "ACTIVE"}, "ACTIVE"), ({"GOMP_SPINCOUNT": "1000"}, "None")],
    ids=["policy", "spin count"],
)
def test_what_the_user_says_stays(variables: dict[str, str], policy: str):
    code = f"import isaacgymenvs_lite.utils.openmp as o; print(o.threads_spin()); {POLICY}"
    assert said(code, **variables) == f"False\n{policy}"


@pytest.mark.slow
def test_after_torch_nothing_is_set_and_it_is_known():
    code = f"import torch, isaacgymenvs_lite.utils.openmp as o; print(o.threads_spin()); {POLICY}"
    assert said(code) == "True\nNone"
