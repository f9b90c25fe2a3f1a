"""Hostile motion files made by hand: bombs, promises of sizes, code, slow texts.

Each function yields names and contents of one kind of file; code in them would create the canary.
"""

from __future__ import annotations

import io
import json
import pickle
import struct
import warnings
import zipfile
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

_Files = Iterable[tuple[str, bytes]]

_MB = 2**20


def yaml_texts(canary: Path) -> _Files:
    """Yield texts that any YAML reader has to survive."""
    aliases = "".join(f"a{i}: &a{i} [{','.join([f'*a{i - 1}'] * 9)}]\n" for i in range(1, 12))
    yield "alias_bomb", f"a0: &a0 [x,x,x,x,x,x,x,x,x]\n{aliases}".encode()
    merges = "".join(f"m{i}: &m{i}\n  <<: [{','.join([f'*m{i - 1}'] * 9)}]\n" for i in range(1, 9))
    yield "merge_bomb", f"m0: &m0 {{k: v}}\n{merges}".encode()
    yield "self", b"motions: &a [*a]\n"
    yield "deep_flow", b"[" * 100_000
    yield "deep_mapping", b"".join(b" " * i + b"a:\n" for i in range(900))
    yield "deep_blocks", b"- " * 20_000
    yield "code", f"!!python/object/apply:os.system ['touch {canary}']\n".encode()
    yield "code_2", f"up: !!python/object/apply:pathlib.Path.touch ['{canary}']\n".encode()
    yield "long_key", b"? " + b"k" * 500_000 + b"\n: 1\n"
    yield "long_number", b"unit_m: " + b"9" * 500_000 + b"\n"
    yield "sexagesimal", b"unit_m: " + b"59:" * 100_000 + b"1\n"
    yield "odd_signs", b"\x1b]0;title\x07: 1\n"
    yield "bell", b'"\\a\\e[2J\\n\\u2028": 1\n'
    yield "nul", b"up: \x00\n"
    yield "utf16", "up: +y\n".encode("utf-16")
    yield "many_documents", b"--- a\n" * 10_000
    yield "many_keys", b"".join(b"k%d: 1\n" % i for i in range(30_000))
    yield "directives", b"%YAML 9.9\n%TAG ! tag:x,2000:\n--- !a 1\n"
    yield "spaces", b"a:" + b" " * 900_000 + b"b"
    yield "quotes", b'"' + b"\\x41" * 200_000
    yield "anchors", b"".join(b"- &a%d x\n" % i for i in range(15_000))
    yield "empty", b""
    yield "list_of_numbers", b"motions: [" + b"1," * 300_000 + b"]"


def datasets(canary: Path) -> _Files:
    """Yield data sets of clips."""
    yield from yaml_texts(canary)
    yield "same_clip", b"motions:\n" + b'- {file: "locomotion", weight: 1}\n' * 3000
    yield "same_clips", b"motions:\n" + b"- {file: walk, weight: 1}\n" * 20_000
    yield (
        "same_clips_2",
        b"motions:\n"
        + b"".join(b"- {file: '%swalk', weight: 1}\n" % (b"./" * i) for i in range(600)),
    )
    yield "package", b"motions:\n" + b'- {file: "deepmimic:all", weight: 1}\n' * 5_000
    yield "spaces", b"motions:" + b" " * (2 * _MB - 9) + b"x"
    yield "lines", b"motions:" + b"\n" * (2 * _MB - 9) + b"x"
    yield "plain_text", b"motions: " + b"x" * (2 * _MB - 9)
    yield "quoted_text", b'motions: "' + b"\\n" * (_MB - 9) + b'"'
    yield "comments", b"motions:\n" + b"#\n" * (_MB - 9)
    yield "itself", b"motions:\n- {file: input.yaml, weight: 1}\n"
    for name, weight in (
        ("sum_infinite", "1e308"),
        ("number", "9" * 4000),
        ("huge", "1" + "0" * 309),
        ("tiny", "1e-320"),
        ("nan", ".nan"),
        ("hex", "0x7fffffffffffffff"),
        ("list", "[1]"),
        ("bool", "true"),
        ("boolean_text", "'nan'"),
    ):
        entry = f'- {{file: "clip0.npz", weight: {weight}}}\n'
        yield f"weight_{name}", f"motions:\n{entry * 2}".encode()
    for name, file in (
        ("device", "/dev/zero"),
        ("folder", "."),
        ("memory", "/proc/self/mem"),
        ("nul", "\\0clip"),
        ("long", "a/" * 5000),
        ("longer", "a" * 100_000),
        ("escape", "\\e[31m\\n"),
        ("surrogate", "\\ud800"),
        ("glob", "**/*"),
        ("url", "file:///etc/passwd"),
        ("package_way", "deepmimic:../../../../../etc/passwd"),
        ("package_nul", "deepmimic:\\0"),
    ):
        yield f"file_{name}", f'motions:\n- {{file: "{file}", weight: 1}}\n'.encode()


def npz(canary: Path) -> _Files:
    """Yield archives of a humanoid's clip."""
    yield from _archives(canary, _HUMANOIDS, "body_names")
    yield "zip_bomb_unread_key", _archive(_HUMANOIDS, {"unread": b"\0" * (256 * _MB)})
    bomb = _npy_header("<f4", (2**28,)) + b"\0" * (256 * _MB)
    yield "bomb", _archive(_HUMANOIDS, {"local_rotation": bomb})


def robot_npz(canary: Path) -> _Files:
    """Yield archives of a robot's clip."""
    yield from _archives(canary, _ROBOTS, "joint_names")
    tracking = {"fps": _npy(np.array([50])), "joint_pos": _npy(np.zeros((3, 2)))}
    places = _npy_header("|i1", (2, 4_000_000, 3)) + b"\0" * 24_000_000
    turns = _npy_header("|i1", (2, 4_000_000, 4)) + b"\1" * 32_000_000
    yield "bodies", _archive(tracking, {"body_pos_w": places, "body_quat_w": turns})
    yield "number_types", _archive(_ROBOTS, {"dof_pos": _npy(np.zeros((2, 2 * 10**7), np.int8))})
    twice = io.BytesIO(_archive(_ROBOTS, {}))
    with warnings.catch_warnings(), zipfile.ZipFile(twice, "a") as archive:
        warnings.simplefilter("ignore")  # of the double name
        archive.writestr("fps.npy", _npy(np.array(1e300)))
    yield "twice", twice.getvalue()


def _archives(canary: Path, small: dict[str, bytes], names: str) -> _Files:
    """Yield archives with the members of a valid clip, some of them replaced by hostile ones."""

    def archive(members: dict[str, bytes], method: int = zipfile.ZIP_DEFLATED) -> bytes:
        return _archive(small, members, method)

    yield "promise", archive({"fps": _npy_header("<f4", (2**28,))})
    yield "huge_shape", archive({"fps": _npy_header("<f8", (2**62, 8))})
    yield "negative_shape", archive({"fps": _npy_header("<f8", (-1,))})
    yield "no_size", archive({names: _npy_header("<U0", (2**60,))})
    yield "no_size_2", archive({names: _npy_header("<U0", (10**9, 3))})
    yield "wide_names", archive({names: _npy_header("<U100000000", (2,))})
    yield "bool_shape", archive({"fps": _npy_header("<f8", (True,)) + b"\0" * 8})
    yield "many_dimensions", archive({"fps": _npy_header("<f8", (1,) * 64) + b"\0" * 8})
    yield "too_many_dimensions", archive({"fps": _npy_header("<f8", (1,) * 90) + b"\0" * 8})
    yield "object", archive({"fps": _npy_header("|O", ()) + _code(canary)})
    yield "nested_type", archive({"fps": _npy_text("[" * 3000)})
    yield "code_in_header", archive({"fps": _npy_text("__import__('os').abort()")})
    yield "long_header", archive({"fps": b"\x93NUMPY\x02\x00" + struct.pack("<I", 2**32 - 1)})
    yield "version", archive({"fps": b"\x93NUMPY\x09\x00" + b"\0" * 100})
    yield (
        "many_names",
        archive({names: _npy_header("<U1", (10**7,)) + b"a\0\0\0" * (10**7)}),
    )
    yield "no_npy", archive({"fps": b"text", names: b""})
    yield "many_members", archive({f"k{i}": b"" for i in range(40_000)})
    yield "object_file", b"\x93NUMPY\x01\x00" + _code(canary)
    yield "pickle", _code(canary)
    yield "single_array", _npy_header("<f8", (2**28,))
    yield "odd_names", archive({"\x1b[31m\n/../../fps": b"", "x" * 60_000: b""})
    yield "empty", b""
    for method in (12, 14):  # bzip2, lzma
        yield f"method_{method}", archive({"fps": b"\0" * (4 * _MB)}, method)
    yield (
        "lzma_dictionary",
        _patched(archive({"fps": bytes(1000)}, 14), b"\x5d", struct.pack("<BI", 0x5D, 2**32 - 1)),
    )


def poselib(canary: Path) -> _Files:
    """Yield .npy files of one pickled object."""
    header = _npy_header("|O", ())
    array = b"cnumpy.core.multiarray\n_reconstruct\n(tR"
    dtype = b"cnumpy\ndtype\n"
    yield "code", header + _code(canary)
    yield "code_4", header + pickle.dumps(_Touch(canary), protocol=4)
    yield "global_only", header + b"cos\nsystem\n."
    shared = b"]q\1" + b"".join(b"](h%ch%ceq%c" % (i, i, i + 1) for i in range(1, 60))
    yield (
        "shared_name",
        header + array + b"(K\1(t" + dtype + b"(" + shared + b"tR" + b"\x89]t" + b"b.",
    )
    yield (
        "shared_order",
        (header + array + b"(K\1(t" + dtype + b"(X\2\0\0\0f8tR(K\3" + shared + b"tb\x89]tb."),
    )
    yield (
        "shared_tuple",
        header
        + array
        + b")q\1"
        + b"".join(b"h%ch%c\x86q%c" % (i, i, i + 1) for i in range(1, 60))
        + b".",
    )
    yield "shared_lists", header + _one_object(array, dtype, shared)
    yield "list_of_itself", header + _one_object(array, dtype, b"]q\1h\1a")
    yield "deep_lists", header + _one_object(array, dtype, b"]" * 100_000 + b"a" * 99_999)
    yield "deep_tuples", header + _one_object(array, dtype, b")" + b"\x85" * 100_000)
    yield "many_dictionaries", header + b"}" * (20 * _MB)
    yield "many_marks", header + b"(" * (20 * _MB)
    yield "many_pops", header + b"N0" * (10 * _MB)
    yield "memo", header + b"N" + b"r" + struct.pack("<I", 2**31 - 1) + b"."
    yield "memo_text", header + b"Np" + b"9" * 4000 + b"\n."
    yield "length", header + b"X" + struct.pack("<I", 2**32 - 1)
    yield "length_8", header + b"\x8e" + struct.pack("<Q", 2**62)
    yield "frame", header + b"\x80\x04\x95" + struct.pack("<Q", 2**62)
    yield "long_integer", header + b"\x8b" + struct.pack("<i", 2**31 - 1)
    yield "integer_text", header + b"I" + b"9" * 4 * _MB + b"\n."
    yield "float_text", header + b"F" + b"9" * 4 * _MB + b"\n."
    huge_shape = b"(K\1(" + b"\x8a\x08" + struct.pack("<q", 2**60) + b"K\0t"
    yield (
        "empty_shape",
        header + _one_object(array, dtype, array + huge_shape + dtype + b"(X\2\0\0\0f8tR\x89C\0tb"),
    )
    wide = b"(K\1(" + b"\x8a\x05" + struct.pack("<q", 2**33)[:5] + b"t"
    yield (
        "no_size",
        header + _one_object(array, dtype, array + wide + dtype + b"(X\2\0\0\0U0tR\x89C\0tb"),
    )
    yield (
        "name_of_names",
        header + _one_object(array, dtype, b"}(X\x08\0\0\0__name__" + shared + b"u"),
    )
    yield "persistent", header + b"Nq\0Q."
    yield "header_only", header
    yield "header_promise", b"\x93NUMPY\x02\x00" + struct.pack("<I", 2**32 - 1)
    yield "header_nested", _npy_text("(" * 9000)
    yield "numbers", _npy_header("<f8", (2**30,))
    yield "empty", b""


def robot_pickles(canary: Path) -> _Files:
    """Yield pickles: poselib's without the header, and what only protocol 5 has."""
    header = _npy_header("|O", ())
    for name, content in poselib(canary):
        yield name, content.removeprefix(header)
    yield "code_5", pickle.dumps(_Touch(canary), protocol=5)
    for name, size in (("buffer", 10**10), ("longer_buffer", 2**64 - 1)):
        yield name, b"\x80\x05\x96" + struct.pack("<Q", size) + b"."
    yield "buffers_elsewhere", b"\x80\x05\x97\x98."
    buffer = b"cnumpy._core.numeric\n_frombuffer\n("
    yield "buffer_of_lists", buffer + b"]]]]tR."
    yield "buffer_of_itself", buffer + b"C\0cnumpy\ndtype\n(X\2\0\0\0f8tR(K\0tX\1\0\0\0CtRq\1h\1b."
    texts = ["x" * (4 * _MB), *("y" for _ in range(10**5))]
    yield "texts", pickle.dumps({"fps": 30, "frames": texts}, protocol=4)
    numbers = np.zeros((10**5, 1000), np.int8)
    yield "number_types", pickle.dumps({"fps": 30, "frames": numbers}, protocol=5)


def json_clips(canary: Path) -> _Files:
    """Yield .json files, poselib's or DeepMimic's."""
    yield from _json_texts()
    yield "name", json.dumps({"__name__": {"a": ["x\ny"] * 100_000}}).encode()
    yield "keys", json.dumps({f"k{i}" * 20: i for i in range(20_000)}).encode()
    array = {"arr": {"__ndarray__": [1.0], "shape": [2**40, 0]}, "context": {"dtype": "f8"}}
    for key, dtype in (("V", "V2147483647"), ("U", "U2000000000"), ("list", "f8," * 3000)):
        yield (
            f"type_{key}",
            json.dumps(
                {
                    "__name__": "SkeletonMotion",
                    "fps": 30,
                    "skeleton_tree": {
                        "node_names": ["a"],
                        "parent_indices": {"arr": [1], "context": {"dtype": dtype}},
                    },
                }
            ).encode(),
        )
    yield (
        "shape",
        json.dumps(
            {
                "__name__": "SkeletonMotion",
                "fps": 30,
                "skeleton_tree": {"node_names": ["a"], "parent_indices": array},
            }
        ).encode(),
    )
    yield (
        "fps",
        json.dumps({"__name__": "SkeletonMotion", "fps": 10**400, "skeleton_tree": {}}).encode(),
    )
    del canary  # the format cannot name code


def deepmimic(canary: Path) -> _Files:
    """Yield DeepMimic's text files."""
    del canary  # the format cannot name code
    yield from _json_texts()

    turns = [float(column in (0, 4, 8, 12, 17, 21, 26, 31, 35)) for column in range(40)]

    def clip(*durations: Any, place: Any = 0.0) -> bytes:
        rows = [[duration, place, 1.0, 0.0, *turns] for duration in durations]
        return json.dumps({"Loop": "none", "Frames": rows}).encode()

    yield "long_frame", clip(2e5, 0.01, 0.01, 0.01, 0)
    yield "longer_frame", clip(0.01, 0.01, 1e300, 0.01, 0)
    yield "short_frames", clip(1e-300, 1e-300, 1e-300, 10.0, 0)
    yield "short_frames_2", clip(1e-5, 1e-5, 1e-5, 10.0, 10.0, 0)
    yield "fast", clip(1e-308, 1e-308, 0)
    yield "slow", clip(1e12, 1e12, 0)
    yield "far", clip(0.03, 0.03, 0.03, place=1e308)
    yield "large_integer", clip(0.03, 10**400, 0)
    yield "texts", clip("0.03", "0.03", "0")
    yield "no_numbers", clip(None, None, None)
    yield "nested", clip([1], [2], [3])


def csv(canary: Path) -> _Files:
    """Yield tables."""
    del canary  # the format cannot name code
    yield "one_column", b"time [s]\n" + b"0\n" * 100_000
    yield "commas", b"," * (8 * _MB)
    yield "same_columns", b",".join([b"time [s]"] * 200_000) + b"\n0\n"
    yield "lines", b"\n" * (16 * _MB)
    yield "lines_cr", b"\r" * (16 * _MB)
    yield "comments", b"# fps: 30\n" * _MB
    yield "comment_spaces", b"#" + b" " * 100_000 + b"fps:" + b" " * 100_000 + b"\n1\n1\n"
    yield "header_spaces", b"time" + b" " * 100_000 + b"x\n1\n"
    yield "header_spaces_2", b" " * 20_000 + b"[" + b" " * 20_000 + b"\n1\n"
    yield "header_brackets", b"a[s] [s" + b" " * 50_000 + b"]x\n1\n"
    yield "quote", b'"' + b"a\n" * 200_000
    yield "long_cell", b"a" * 100_000 + b" [m]\n1\n"
    yield "nul", b"time [s]\0\n1\n"
    yield "fps", b"# fps: 1e308\nroot_x [m]\n1\n"
    yield "fps_digits", b"# fps: " + b"9" * 5000 + b"\nroot_x [m]\n1\n"
    yield "escape", b"\x1b[2J\x07 [m],\n1,1\n"
    yield "empty", b""


def bvh(canary: Path) -> _Files:
    """Yield motion capture."""
    del canary  # the format cannot name code
    joint = b"{\nOFFSET 0 0 0\nCHANNELS 3 Zrotation Yrotation Xrotation\n"
    motion = b"MOTION\nFrames: 2\nFrame Time: 0.03\n"
    root = b"HIERARCHY\nROOT a\n{\nOFFSET 0 0 0\nCHANNELS 6 Xposition Yposition Zposition Zrotation"
    root += b" Yrotation Xrotation\n"
    end = b"End Site\n{\nOFFSET 0 1 0\n}\n}\n"
    yield "deep", root + b"".join(b"JOINT j%d\n" % i + joint for i in range(20_000))
    yield (
        "deep_closed",
        root + b"".join(b"JOINT j%d\n" % i + joint for i in range(900)) + b"}" * 999,
    )
    yield "wide", root + b"".join(b"JOINT j%d\n" % i + joint + end for i in range(20_000)) + b"}\n"
    yield "no_joints", b"HIERARCHY\n" + motion
    yield "frames", root + end + motion.replace(b"2", b"9" * 18) + b"0 " * 6
    yield "frame_time", root + end + motion.replace(b"0.03", b"1e-300") + b"0 0 0 0 0 0\n" * 2
    yield "frame_time_0", root + end + motion.replace(b"0.03", b"0") + b"0 0 0 0 0 0\n" * 2
    yield "frame_time_inf", root + end + motion.replace(b"0.03", b"1e999") + b"0 0 0 0 0 0\n" * 2
    yield "far", root + end + motion + b"1e308 0 0 0 0 0\n" * 2
    yield "angles", root + end + motion + b"0 0 0 1e300 0 0\n" * 2
    yield "bones", root.replace(b"0 0 0", b"1e200 0 0") + end + motion + b"0 0 0 0 0 0\n" * 2
    yield "root_spaces", b"ROOT" + b" " * 300_000 + b"\nMOTION\n"
    yield "channel_spaces", root + b"CHANNELS 3" + b" " * 300_000 + b"\nMOTION\n"
    yield "channels", root.replace(b"6", b"9" * 4000) + end + motion
    yield "many_channels", root + b"CHANNELS 3" + b" Xposition" * 200_000 + b"\n" + motion
    yield "lines", b"\n" * (16 * _MB)
    yield "numbers", root + end + motion + b"1 " * (8 * _MB)
    yield "one_column", root + end + motion + b"1\n" * (4 * _MB)
    yield "name", root.replace(b"ROOT a", b"ROOT " + b"a" * _MB) + end + motion
    yield "escape", root.replace(b"ROOT a", b"ROOT \x1b[2J\x07") + end + motion
    yield "empty", b""


def _json_texts() -> _Files:
    yield "deep_lists", b"[" * 200_000
    yield "deep_objects", b'{"a":' * 200_000
    yield "nested_frames", b'{"Frames":' + b"[" * 900 + b"]" * 900 + b"}"
    yield "many_lists", b'{"Frames":[' + b"[]," * (5 * _MB) + b"[]]}"
    yield "many_objects", b'{"Frames":[' + b"{}," * (5 * _MB) + b"{}]}"
    yield "many_numbers", b'{"Frames":[[' + b"1," * (8 * _MB) + b"1]]}"
    yield "many_floats", b'{"Frames":[[' + b"1.5," * (5 * _MB) + b"1]]}"
    yield "spaces", b" " * (40 * _MB)
    yield "too_long", b'{"Frames":[' + b"[]," * (25 * _MB) + b"[]]}"
    yield "digits", b'{"Frames":' + b"9" * (2 * _MB) + b"}"
    yield "escape", b'{"\\u001b[2J\\n\\u2028": 1}'
    yield "surrogates", b'{"Frames": [["\\ud800"]]}'
    yield "list", b"[1]"
    yield "utf16", '{"Frames": []}'.encode("utf-16")
    yield "empty", b""


class _Touch:
    """Creates a file when it is unpickled by a careless reader."""

    def __init__(self, canary: Path) -> None:
        self._canary = canary

    def __reduce__(self) -> tuple[Any, ...]:
        return Path.touch, (self._canary,)


def _code(canary: Path) -> bytes:
    return pickle.dumps(_Touch(canary), protocol=2)


def _one_object(array: bytes, dtype: bytes, content: bytes) -> bytes:
    """Return the pickle of a 0-d array of one object."""
    return array + b"(K\1)" + dtype + b"(X\2\0\0\0O8tR\x89](" + content + b"etb."


def _npy_header(dtype: str, shape: tuple[int, ...]) -> bytes:
    return _npy_text(repr({"descr": dtype, "fortran_order": False, "shape": shape}))


def _npy_text(header: str) -> bytes:
    text = header.encode() + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text


def _archive(
    small: dict[str, bytes], members: dict[str, bytes], method: int = zipfile.ZIP_DEFLATED
) -> bytes:
    """Return an archive with the members of a valid clip, `small`, and these in their place."""
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", method, compresslevel=1) as out:
        for key, content in (small | members).items():
            out.writestr(f"{key}.npy", content)
    return stream.getvalue()


def _npy(value: np.ndarray) -> bytes:
    stream = io.BytesIO()
    np.save(stream, value)
    return stream.getvalue()


def _patched(data: bytes, old: bytes, new: bytes) -> bytes:
    place = data.find(old)
    return data[:place] + new + data[place + len(new) :]


_HUMANOIDS = {
    "fps": _npy(np.array(30.0)),
    "body_names": _npy(np.array(["a"])),
    "parent_indices": _npy(np.array([-1])),
    "local_translation": _npy(np.zeros((1, 3))),
    "local_rotation": _npy(np.tile((0.0, 0.0, 0.0, 1.0), (3, 1, 1))),
    "root_translation": _npy(np.zeros((3, 3))),
}
_ROBOTS = {
    "fps": _npy(np.array(30.0)),
    "joint_names": _npy(np.array(["a", "b"])),
    "root_pos": _npy(np.zeros((3, 3))),
    "root_rot": _npy(np.tile((0.0, 0.0, 0.0, 1.0), (3, 1))),
    "dof_pos": _npy(np.zeros((3, 2))),
}
