import io
import os
import pickle
from collections import OrderedDict
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from isaacgymenvs_lite.errors import MotionFileError
from isaacgymenvs_lite.motion.formats.restricted_pickle import load_object_npy, load_pickle


def write_npy(path: Path, pickled: bytes) -> Path:
    """Write the numpy header of a 0-d object array and then `pickled`."""
    stream = io.BytesIO()
    header = {"descr": "|O", "fortran_order": False, "shape": ()}
    np.lib.format.write_array_header_1_0(stream, header)
    path.write_bytes(stream.getvalue() + pickled)
    return path


def pickled_array(content: Any, protocol: int = 3) -> bytes:
    array = np.empty((), dtype=object)
    array[()] = content
    return pickle.dumps(array, protocol=protocol)


class Call:
    """An object whose pickle calls `function(*args)` when it is loaded."""

    def __init__(self, function: Any, *args: Any) -> None:
        self._call = (function, args)

    def __reduce__(self) -> tuple[Any, tuple[Any, ...]]:
        return self._call


@pytest.mark.parametrize(
    ("protocol", "numpy_module"),
    [(3, b"numpy.core"), (5, b"numpy._core")],
)
def test_plain_content_comes_back(tmp_path: Path, protocol: int, numpy_module: bytes) -> None:
    content: OrderedDict[str, Any] = OrderedDict(
        floats=np.arange(6, dtype=np.float32).reshape(2, 3),
        fortran=np.asfortranarray(np.arange(6.0).reshape(2, 3)),
        big_endian=np.arange(3, dtype=">i4"),
        names=np.array(["pelvis", "torso"]),
        fps=np.float64(29.97),
        zero_d=np.array(60, dtype=np.int32),
        nested={"flag": True, "list": [1, "two"]},
    )
    pickled = pickled_array(content, protocol).replace(b"numpy._core", numpy_module)
    loaded = load_object_npy(write_npy(tmp_path / "clip.npy", pickled))
    assert set(loaded) == set(content)
    for key in ("floats", "fortran", "big_endian", "names", "zero_d"):
        np.testing.assert_array_equal(loaded[key], content[key])
        assert loaded[key].dtype == content[key].dtype
    assert loaded["fps"] == 29.97
    assert loaded["nested"] == content["nested"]


@pytest.mark.parametrize(("attack", "protocol"), [("os.system", 0), ("builtins.eval", 5)])
def test_calls_are_refused_and_not_run(tmp_path: Path, attack: str, protocol: int) -> None:
    marker = tmp_path / "marker"
    touch = f"open({str(marker)!r}, 'w').close()"
    call, name = {
        "os.system": (Call(os.system, f"touch {marker}"), f"{os.system.__module__}.system"),
        "builtins.eval": (Call(eval, touch), "eval"),
    }[attack]
    for i, content in enumerate((call, {"rotation": {"arr": call}}, [{"deep": (call,)}])):
        # The object is alone in the file, then inside the array of a clip.
        for pickled in (pickle.dumps(content, protocol), pickled_array(content, protocol)):
            path = write_npy(tmp_path / f"{i}.npy", pickled)
            with pytest.raises(MotionFileError, match="refused, nothing was run") as raised:
                load_object_npy(path)
            if protocol > 2:  # Older protocols name _codecs.encode or __builtin__ first.
                assert name in str(raised.value)
            assert "\n" not in str(raised.value)
    assert not marker.exists()


def test_every_other_name_is_refused(tmp_path: Path) -> None:
    for name in (
        "numpy load",
        "numpy.core.multiarray _reconstruct.__globals__",
        "builtins getattr",
    ):
        module, attribute = name.split()
        path = write_npy(tmp_path / "clip.npy", f"c{module}\n{attribute}\n.".encode())
        with pytest.raises(MotionFileError, match=f"imports {module}.{attribute}"):
            load_object_npy(path)


def test_malformed_programs_are_one_line_and_change_nothing(tmp_path: Path) -> None:
    for program in (
        b"cnumpy\ndtype\n}b.",  # give the class a state
        b"ccollections\nOrderedDict\n}U\x08__call__K\x01sb.",
        b"cnumpy.core.multiarray\nscalar\n(N}U\x0c__defaults__(K\x01K\x02tstb.",
        b"cnumpy\nndarray\n(K\x01tR.",  # an array without content
        # 255 numbers in 0 bytes:
        b"cnumpy\nndarray\n(tR(K\x01(K\xfftcnumpy\ndtype\n(U\x02f8tRI00\nU\x00tb.",
        b"cnumpy\nndarray\n(tRcnumpy\nndarray\n(tRb.",  # an array as state of an array
        b"Pid\n.",  # persistent id
        b"",
    ):
        with pytest.raises(MotionFileError) as raised:
            load_object_npy(write_npy(tmp_path / "bad.npy", program))
        assert "\n" not in str(raised.value)
        good = write_npy(
            tmp_path / "good.npy", pickled_array({"a": np.arange(3.0), "b": np.float32(2)})
        )
        np.testing.assert_array_equal(load_object_npy(good)["a"], [0.0, 1.0, 2.0])


def test_arrays_of_protocol_5(tmp_path: Path) -> None:
    arrays = np.arange(24.0).reshape(2, 3, 4, order="F")
    path = tmp_path / "clip.pkl"
    path.write_bytes(pickle.dumps({"a": arrays, "turned": arrays.transpose(1, 2, 0)}, protocol=5))
    loaded = load_pickle(path, "clip")
    np.testing.assert_array_equal(loaded["a"], arrays)
    np.testing.assert_array_equal(loaded["turned"], arrays.transpose(1, 2, 0))


def test_object_arrays_inside_are_refused(tmp_path: Path) -> None:
    inner = np.array([{}, []], dtype=object)
    with pytest.raises(MotionFileError, match=r"an array of type .\|O8"):
        load_object_npy(write_npy(tmp_path / "clip.npy", pickled_array({"arr": inner})))


def test_truncated_empty_and_other_files(tmp_path: Path) -> None:
    path = tmp_path / "clip.npy"
    whole = write_npy(path, pickled_array({"a": np.arange(100.0)})).read_bytes()
    for size in (len(whole) - 20, 200, 130):
        path.write_bytes(whole[:size])
        with pytest.raises(MotionFileError, match="that can be read"):
            load_object_npy(path)
    for content in (b"", b"not numpy at all", whole[:50]):
        path.write_bytes(content)
        with pytest.raises(MotionFileError, match="no poselib clip"):
            load_object_npy(path)
    np.save(path, np.zeros((2, 3)))
    with pytest.raises(MotionFileError, match=r"holds an array of float64 of shape \(2, 3\)"):
        load_object_npy(path)
