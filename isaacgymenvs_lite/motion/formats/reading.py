"""What the readers of clips share: error texts and JSON, which two of the formats are."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from isaacgymenvs_lite.errors import MotionFileError, one_line


def read_json(path: str | Path) -> dict[str, Any]:
    """Return the JSON object in the file at `path`.

    Raises:
        MotionFileError: the file is no JSON text or holds no object.
    """
    try:
        data = json.loads(Path(path).read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise MotionFileError(
            f"{path}: is no JSON text ({one_line(error)}); expected a poselib or DeepMimic clip"
        ) from error
    if not isinstance(data, dict):
        raise MotionFileError(
            f"{path}: holds a JSON {type(data).__name__}, expected the object of a clip"
        )
    return data
