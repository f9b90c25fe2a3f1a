"""Finds the low-level controller of a high level's training, by an entry of its checkpoint.

A latent has a meaning only for the low-level controller of its training.
"""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Mapping
from typing import Any

from torch import Tensor

from isaacgymenvs_lite.checkpoints import files as checkpoints
from isaacgymenvs_lite.checkpoints.files import LLC_KEY
from isaacgymenvs_lite.errors import CheckpointError
from isaacgymenvs_lite.paths import shipped_policies, user_path

log = logging.getLogger(__name__)

SHIPPED_LLC = "locomotion_skills"
"""Name of the shipped low-level controller."""


def make_reference(llc_checkpoint: str, weights: Mapping[str, Tensor]) -> dict[str, str]:
    """Return {"checkpoint", "fingerprint"}: an absolute path or a shipped name, and a hash."""
    is_shipped = llc_checkpoint in shipped_policies()
    path = llc_checkpoint if is_shipped else str(user_path(llc_checkpoint).absolute())
    return {"checkpoint": path, "fingerprint": _fingerprint(weights)}


def _fingerprint(weights: Mapping[str, Tensor]) -> str:
    digest = hashlib.sha256()
    for name in sorted(weights):
        digest.update(name.encode())
        digest.update(weights[name].detach().cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()[:16]


def shipped_reference(reference: Mapping[str, str]) -> dict[str, str]:
    """Return `reference` with the name of the shipped policy that has these weights."""
    for name, path in shipped_policies().items():
        if _fingerprint(checkpoints.load_checkpoint(path)["model"]) == reference["fingerprint"]:
            return {**reference, "checkpoint": name}
    raise CheckpointError(
        f"the policy was trained over the low-level controller {reference['checkpoint']}, which"
        " does not ship; pack that controller first"
    )


def llc_checkpoint_for(llc_checkpoint: str | None, params: Mapping[str, Any]) -> str:
    """Return the low-level controller of a training or a play: a path or a shipped name.

    The key `llc_checkpoint` decides. If it is None or '', the loaded checkpoint's entry decides.
    Without an entry None means the shipped low level, and '' stays ''. `params` is the section of
    the train file.
    """
    if llc_checkpoint:
        return llc_checkpoint
    if params.get("load_checkpoint"):
        reference = checkpoints.load_checkpoint(params["load_path"]).get(LLC_KEY)
        if reference:
            return str(reference["checkpoint"])
    return SHIPPED_LLC if llc_checkpoint is None else ""


def warn_of_another_llc(
    state: Mapping[str, Any], reference: Mapping[str, str], checkpoint: str
) -> None:
    """Warn if a high level's checkpoint was trained over another low level than the current one."""
    before = state.get(LLC_KEY)
    if before and before["fingerprint"] != reference["fingerprint"]:
        log.warning(
            "checkpoint=%s was trained over the low-level controller %s, whose weights are not"
            " those of %s: its latents may mean other skills here",
            checkpoint,
            before["checkpoint"],
            reference["checkpoint"],
        )
