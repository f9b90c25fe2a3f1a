"""Finds the low-level controller that a high-level policy was trained with.

A high-level policy's latents have a meaning only for this controller, which an entry of the
high-level checkpoint identifies.
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
    """Return {"checkpoint": absolute path or shipped name, "fingerprint": hash of the weights}."""
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
    """Return `reference` with the name of the shipped policy that has the same weights."""
    for name, path in shipped_policies().items():
        if _fingerprint(checkpoints.load_checkpoint(path)["model"]) == reference["fingerprint"]:
            return {**reference, "checkpoint": name}
    raise CheckpointError(
        f"the policy was trained over the low-level controller {reference['checkpoint']}, which"
        " does not ship; pack that controller first"
    )


def llc_checkpoint_for(llc_checkpoint: str | None, params: Mapping[str, Any]) -> str:
    """Return the path or shipped name of the low-level controller for a training or a play.

    The key `llc_checkpoint` is used if it is set. If `llc_checkpoint` is None or '', the entry of
    the loaded checkpoint is used. If the checkpoint has no entry, None selects the shipped
    low-level controller, and '' is returned unchanged. `params` is the section of the train file.
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
    """Warn if a high-level checkpoint was trained with another low-level controller."""
    before = state.get(LLC_KEY)
    if before and before["fingerprint"] != reference["fingerprint"]:
        log.warning(
            "checkpoint=%s was trained over the low-level controller %s, whose weights are not"
            " those of %s: its latents may mean other skills here",
            checkpoint,
            before["checkpoint"],
            reference["checkpoint"],
        )
