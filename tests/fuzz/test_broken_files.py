"""Files of strangers that are broken at random: each is read, or refused in one line.

Hypothesis breaks whole files of every kind: bytes, lines and values of texts, arrays and pickles in
archives. An audit hook of Python sees whether code was run or a file was written elsewhere.
"""

from __future__ import annotations

import io
import json
import os
import pickle
import sys
import tempfile
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

from isaacgymenvs_lite.errors import MAX_MESSAGE, UserError
from tests.fuzz.originals import KINDS, Kind

pytestmark = pytest.mark.slow
pytest.importorskip("pybvh")

# Events of the interpreter that no reader causes.
_CODE = ("os.system", "subprocess.Popen", "os.exec", "os.posix_spawn", "os.fork", "socket.connect")
_CHANGES = ("os.remove", "os.rename", "os.mkdir", "os.rmdir", "os.link", "os.symlink", "os.chmod")
_WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND
_VALUES: tuple[Any, ...] = (
    *(float("nan"), float("inf"), -1e308, 1e-308, -1, 0, 0.5, 2**31, 2**62, "text", "", None),
    *([], {}, [1, 2, 3], [[]], {"a": 1}, True, "nan", "../../etc/passwd", "${a.b}"),
    *("${oc.env:HOME}", "x" * 3000, "\x1b[31m\nb", "package://../../x", [float("nan")] * 3),
)
_TOKENS = (
    *(b"nan", b"-inf", b"1e400", b"-1", b"0", b"", b" ", b"\n", b"\0", b"<", b"/>", b'"', b"'"),
    *(b"{", b"]", b": ", b"- ", b"&a", b"*a", b"!!python/name:os.system", b"\xff", b"\x80", b"R"),
    *(b"cos\nsystem\n", b"(S'true'\ntR.", b"<plugin/>", b'<include file="/etc/passwd"/>'),
)


class Watch:
    """Collects what the interpreter does while a file is read."""

    def __init__(self) -> None:
        self.is_on = False
        self.found: list[str] = []
        self.allowed = [tempfile.gettempdir()]
        sys.addaudithook(self._see)

    def _see(self, event: str, arguments: tuple[Any, ...]) -> None:
        if not self.is_on:
            return
        if event in _CODE:
            self.found.append(f"{event} {arguments!r:.200}")
        writes = event == "open" and isinstance(arguments[2], int) and arguments[2] & _WRITING
        # shutil.rmtree, of a temporary folder, names files within an open folder.
        is_in_open_folder = (
            event in _CHANGES and isinstance(arguments[-1], int) and arguments[-1] > 0
        )
        changes = event in _CHANGES and not is_in_open_folder
        if (changes or writes) and not self._is_allowed(arguments[0]):
            self.found.append(f"{event} {arguments!r:.200}")

    def _is_allowed(self, path: Any) -> bool:
        """Return whether a path is a temporary file, or one that Python writes for itself."""
        if isinstance(path, int):
            return True
        name = os.path.abspath(os.fsdecode(path))
        return "__pycache__" in name or any(name.startswith(folder) for folder in self.allowed)

    @contextmanager
    def watching(self) -> Iterator[None]:
        """Collect events until the block ends."""
        self.found, self.is_on = [], True
        try:
            yield
        finally:
            self.is_on = False


@pytest.fixture(scope="module")
def watch() -> Watch:
    return Watch()


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A folder for each kind, with a whole file, which is read once: imports write caches."""
    made = {}
    for name, kind in KINDS.items():
        folder = tmp_path_factory.mktemp(name) / "robot"
        folder.mkdir()
        kind.write(folder / kind.file)
        if name not in ("checkpoint", "legacy_checkpoint"):
            kind.read(folder / kind.file)
        made[name] = folder
    return made


@pytest.mark.parametrize("name", KINDS)
@settings(
    max_examples=100,
    phases=(Phase.generate,),  # shrinking takes minutes
    deadline=None,
    derandomize=True,
    database=None,
    suppress_health_check=list(HealthCheck),
)
@given(data=st.data())
def test_a_broken_file_is_read_or_refused_in_one_line(
    name: str, data: st.DataObject, watch: Watch, folders: dict[str, Path]
) -> None:
    kind = KINDS[name]
    whole = _whole(kind, folders[name])
    path = folders[name].with_name("broken") / kind.file
    path.parent.mkdir(exist_ok=True)
    for file in folders[name].iterdir():
        (path.parent / file.name).write_bytes(file.read_bytes())
    path.write_bytes(_broken(kind, whole, data))
    with watch.watching():
        refusal = _refusal(kind, path)
    assert not watch.found
    assert refusal is None or ("\n" not in refusal and len(refusal) <= MAX_MESSAGE)
    if kind.names_file and refusal is not None:
        assert path.name in refusal


def _whole(kind: Kind, folder: Path) -> bytes:
    return (folder / kind.file).read_bytes()


def _refusal(kind: Kind, path: Path) -> str | None:
    try:
        kind.read(path)
    except UserError as error:
        return str(error)
    return None


# --- ways to break a file ------------------------------------------------------------------------


def _broken(kind: Kind, whole: bytes, data: st.DataObject) -> bytes:
    suffix = Path(kind.file).suffix
    by_kind = {
        ".npz": _broken_arrays,
        ".pth": _broken_archive,
        ".yaml": _broken_tree,
        ".json": _broken_tree,
        ".pkl": _broken_dictionary,
    }
    ways = [_broken_bytes]
    if suffix in by_kind:
        ways.append(by_kind[suffix])
    if suffix not in (".npz", ".npy", ".pkl", ".pth"):
        ways.append(_broken_lines)
    return data.draw(st.sampled_from(ways))(whole, data)


def _broken_bytes(whole: bytes, data: st.DataObject) -> bytes:
    """Put tokens and random bytes in place of parts, or cut the file."""
    content = whole
    for _ in range(data.draw(st.integers(1, 4))):
        start = data.draw(st.integers(0, len(content)))
        length = data.draw(st.sampled_from([0, 1, 1, 4, 40, len(content)]))
        new = data.draw(st.one_of(st.sampled_from(_TOKENS), st.binary(max_size=8)))
        content = content[:start] + new + content[start + length :]
    return content


def _broken_lines(whole: bytes, data: st.DataObject) -> bytes:
    """Leave out, double or exchange lines, and words of them."""
    lines = whole.split(b"\n")
    for _ in range(data.draw(st.integers(1, 3))):
        one, other = (data.draw(st.integers(0, len(lines) - 1)) for _ in range(2))
        words = lines[one].split(b" ")
        word = data.draw(st.integers(0, len(words) - 1))
        words[word] = data.draw(st.sampled_from((*_TOKENS, *lines[other].split(b" ")[:3])))
        choices = [lines[other], b"", b" ".join(words), lines[one] + b"\n" + lines[other]]
        lines[one] = data.draw(st.sampled_from(choices))
    return b"\n".join(lines)


def _changed(tree: Any, data: st.DataObject) -> Any:
    """Replace one or two values, anywhere in nested dictionaries and lists."""
    for _ in range(data.draw(st.integers(1, 2))):
        places = list(_places(tree))
        if places:
            section, key = data.draw(st.sampled_from(places))
            section[key] = data.draw(st.sampled_from(_VALUES))
    return tree


def _places(tree: Any) -> Iterator[tuple[Any, Any]]:
    if isinstance(tree, dict):
        keys = list(tree)
    elif isinstance(tree, list):
        keys = list(range(min(len(tree), 50)))
    else:
        return
    for key in keys:
        yield tree, key
        yield from _places(tree[key])


def _broken_tree(whole: bytes, data: st.DataObject) -> bytes:
    tree = _changed(yaml.safe_load(whole), data)
    if whole.startswith(b"{"):
        return json.dumps(tree).encode()
    return yaml.safe_dump(tree, sort_keys=False).encode()


def _broken_dictionary(whole: bytes, data: st.DataObject) -> bytes:
    return pickle.dumps(_changed(pickle.loads(whole), data), data.draw(st.integers(0, 5)))


def _broken_arrays(whole: bytes, data: st.DataObject) -> bytes:
    """Replace an array by another shape, type or values, or leave it out."""
    arrays = dict(np.load(io.BytesIO(whole)))
    key = data.draw(st.sampled_from(sorted(arrays)))
    old = arrays.pop(key)
    numbers = old if old.dtype.kind in "fiu" else np.zeros(old.shape)
    new = data.draw(
        st.sampled_from(
            [
                None,
                old[..., None],
                old.ravel()[:3],
                old.astype(object),
                old.astype("U8"),
                numbers * np.nan,
                numbers.astype(np.float64) * 1e300,
                numbers.astype(np.int8),
                np.zeros((0, *old.shape[1:])),
            ]
        )
    )
    if new is not None:
        arrays[key] = new
    stream = io.BytesIO()
    np.savez(stream, **arrays)
    return stream.getvalue()


def _broken_archive(whole: bytes, data: st.DataObject) -> bytes:
    """Break the pickle in a checkpoint; the archive itself stays whole."""
    if not zipfile.is_zipfile(io.BytesIO(whole)):
        return _broken_bytes(whole, data)
    stream = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(whole)) as old, zipfile.ZipFile(stream, "w") as new:
        for name in old.namelist():
            content = old.read(name)
            is_pickle = name.endswith("data.pkl")
            new.writestr(name, _broken_bytes(content, data) if is_pickle else content)
    return stream.getvalue()
