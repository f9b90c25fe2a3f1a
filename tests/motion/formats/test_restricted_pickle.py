import io
import os
import pickle
import struct
import subprocess
import sys
import tracemalloc
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
    [(3, b"numpy.core"), (3, b"numpy._core"), (4, b"numpy._core"), (5, b"numpy._core")],
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


@pytest.mark.parametrize("protocol", [0, 2, 3, 4, 5])
@pytest.mark.parametrize("attack", ["os.system", "builtins.eval", "builtins.exec"])
def test_calls_are_refused_and_not_run(tmp_path: Path, attack: str, protocol: int) -> None:
    marker = tmp_path / "marker"
    touch = f"open({str(marker)!r}, 'w').close()"
    call, name = {
        "os.system": (Call(os.system, f"touch {marker}"), f"{os.system.__module__}.system"),
        "builtins.eval": (Call(eval, touch), "eval"),
        "builtins.exec": (Call(exec, touch), "exec"),
    }[attack]
    for i, content in enumerate((call, {"rotation": {"arr": call}}, [{"deep": (call,)}])):
        # Alone in the file and inside the array that a clip consists of.
        for pickled in (pickle.dumps(content, protocol), pickled_array(content, protocol)):
            path = write_npy(tmp_path / f"{i}.npy", pickled)
            with pytest.raises(MotionFileError, match="refused, nothing was run") as raised:
                load_object_npy(path)
            if protocol > 2:  # Older protocols name _codecs.encode or __builtin__ first.
                assert name in str(raised.value)
            assert "\n" not in str(raised.value)
    assert not marker.exists()


@pytest.mark.parametrize(
    "name",
    [
        "numpy load",
        "numpy.core.multiarray fromfile",
        "numpy.core.multiarray _reconstruct.__globals__",
        "numpy ndarray.tofile",
        "numpy.lib.npyio load",
        "collections namedtuple",
        "builtins getattr",
        "functools partial",
        "_codecs encode",
        "isaacgymenvs_lite.errors UserError",
    ],
)
def test_every_other_name_is_refused(tmp_path: Path, name: str) -> None:
    module, attribute = name.split()
    path = write_npy(tmp_path / "clip.npy", f"c{module}\n{attribute}\n.".encode())
    with pytest.raises(MotionFileError, match=f"imports {module}.{attribute}"):
        load_object_npy(path)


@pytest.mark.parametrize(
    "program",
    [
        b"cnumpy\nndarray\n}b.",  # give the class a state
        b"cnumpy\ndtype\n}b.",
        b"ccollections\nOrderedDict\n}U\x08__call__K\x01sb.",
        b"cnumpy.core.multiarray\nscalar\n(N}tb.",
        b"cnumpy\nndarray\n(K\x01tR.",  # an array without content
        # 255 numbers in 0 bytes:
        b"cnumpy\nndarray\n(tR(K\x01(K\xfftcnumpy\ndtype\n(U\x02f8tRI00\nU\x00tb.",
        b"cnumpy\nndarray\n(tRcnumpy\nndarray\n(tRb.",  # an array as state of an array
        b"Pid\n.",  # persistent id
        b"\x82\x01.",  # extension registry
        b"K\x01.",
        b")R.",
        b"",
    ],
)
def test_malformed_programs_fail_and_change_nothing(tmp_path: Path, program: bytes) -> None:
    with pytest.raises(MotionFileError) as raised:
        load_object_npy(write_npy(tmp_path / "bad.npy", program))
    assert "\n" not in str(raised.value)
    good = write_npy(tmp_path / "good.npy", pickled_array({"a": np.arange(3.0)}))
    np.testing.assert_array_equal(load_object_npy(good)["a"], [0.0, 1.0, 2.0])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        # 10 GB in a file of 300 bytes; pickle itself would make room for them
        ((struct.pack("<Q", 48), struct.pack("<Q", 10**10)), "pickle exhausted before end"),
        ((b"K\x02K\x03\x86", b"K\x02K\xff\x86"), r"of shape \(2, 255\) in 48 bytes"),
        ((b"\x8c\x01C", b"\x8c\x01K"), "axes were exchanged"),
        ((b"\x8c\x02f8", b"\x8c\x02O8"), "an array of type '<O8'"),
    ],
)
def test_buffers_of_protocol_5_that_lie_are_refused(tmp_path: Path, change, message) -> None:
    pickled = pickle.dumps({"a": np.arange(6.0).reshape(2, 3)}, protocol=5)
    assert pickled.count(change[0]) == 1
    path = tmp_path / "clip.pkl"
    path.write_bytes(pickled.replace(*change))
    tracemalloc.start()
    with pytest.raises(MotionFileError, match=message):
        load_pickle(path, "clip")
    assert tracemalloc.get_traced_memory()[1] < 2**29
    tracemalloc.stop()


def test_buffers_beside_the_file_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "clip.pkl"
    path.write_bytes(pickle.dumps(np.arange(6.0), protocol=5, buffer_callback=[].append))
    with pytest.raises(MotionFileError, match=r"out-of-band buffers.*without buffer_callback"):
        load_pickle(path, "clip")


def test_object_arrays_inside_are_refused(tmp_path: Path) -> None:
    inner = np.array([{}, []], dtype=object)
    with pytest.raises(MotionFileError, match="an array of objects"):
        load_object_npy(write_npy(tmp_path / "clip.npy", pickled_array({"arr": inner})))


def test_truncated_empty_and_other_files(tmp_path: Path) -> None:
    path = tmp_path / "clip.npy"
    whole = write_npy(path, pickled_array({"a": np.arange(100.0)})).read_bytes()
    for size in (len(whole) - 20, 200, 130):
        path.write_bytes(whole[:size])
        with pytest.raises(MotionFileError, match="that can be read"):
            load_object_npy(path)
    path.write_bytes(b"")
    with pytest.raises(MotionFileError, match="the file is empty"):
        load_object_npy(path)
    for content in (b"not numpy at all", whole[:50]):
        path.write_bytes(content)
        with pytest.raises(MotionFileError, match="no readable numpy header"):
            load_object_npy(path)
    np.save(path, np.zeros((2, 3)))
    with pytest.raises(MotionFileError, match=r"holds an array of float64 of shape \(2, 3\)"):
        load_object_npy(path)


def _nested(depth: int) -> bytes:
    return b")" + b"\x85" * depth  # (((...),),)


@pytest.mark.parametrize(
    "pickled",
    [
        # The value with the number 2^30: the unpickler in C makes room for all before it.
        pytest.param(b"\x80\x02Nr\x00\x00\x00\x40.", id="number of a value"),
        pytest.param(b"\x80\x02}" + _nested(200_000) + b"Ns.", id="deep key"),
        pytest.param(b"\x80\x02" + b"]" * 200_000 + b"a" * 199_999 + b".", id="deep list"),
        pytest.param(b"\x80\x04\x8a\xff" + b"\x01" * 255 + b".", id="long number"),
        pytest.param(b"\x80\x04\x8e" + b"\xff" * 7 + b"\x00.", id="bytes longer than the file"),
    ],
)
def test_pickles_that_are_made_to_break_a_reader_are_one_line(pickled, tmp_path):
    """In a process of its own, with 2 GB: a crash of the reader fails the test, not the suite."""
    path = write_npy(tmp_path / "clip.npy", pickled)
    script = (
        "import resource, sys\n"
        "from isaacgymenvs_lite.motion.formats.restricted_pickle import load_object_npy\n"
        "resource.setrlimit(resource.RLIMIT_DATA, (2**31, 2**31))\n"
        "try:\n    load_object_npy(sys.argv[1])\n"
        "except Exception as error:\n    print(type(error).__name__, error)\n"
    )
    command = [sys.executable, "-c", script, str(path)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr[-500:]
    assert done.stdout.startswith("MotionFileError ")
    assert len(done.stdout.splitlines()) == 1


def test_lists_that_name_each_other_are_not_written_out(tmp_path):
    """40 lists of ten times the one before: a small file with 10^40 values."""
    lists: list[Any] = [0]
    for _ in range(40):
        lists = [lists] * 10
    with pytest.raises(MotionFileError, match="more values"):
        load_object_npy(write_npy(tmp_path / "clip.npy", pickled_array(lists)))


def test_an_array_that_is_named_often_is_not_copied_often(tmp_path):
    content = [np.zeros(10_000)] * 100
    with pytest.raises(MotionFileError, match="larger than the file"):
        load_object_npy(write_npy(tmp_path / "clip.npy", pickled_array(content)))
