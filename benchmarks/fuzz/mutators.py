"""Breaks files: bytes, text, trees of JSON and YAML, arrays, archives and pickles.

All are deterministic: the same file and the same state of the generator give the same result.
"""

from __future__ import annotations

import copy
import io
import json
import pickle
import pickletools
import random
import re
import struct
import warnings
import zipfile
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import yaml

_NUMBER = re.compile(rb"-?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?")
_EXTREME_NUMBERS = (
    *(
        "0",
        "-0.0",
        "-1",
        "1e308",
        "-1e308",
        "1e30",
        "1e999",
        "1e-320",
        "1e6",
        "nan",
        "-inf",
        ".inf",
    ),
    *("2147483648", "-9223372036854775809", "18446744073709551616", "9" * 400, "9" * 5000),
    *("0x7f", "1_0", "1,5", "true", "null", "''", "[]", "{}", "٣", "1e", "--1", "1.2.3"),
)
_ODD_TEXTS = (
    *(b"\0", b"\xff\xfe", b"\xef\xbb\xbf", b"\xed\xa0\x80", "\u2028".encode(), b"\x1b[31m", b"\r"),
    *(b"\n\n", b"\t", b'"', b"'", b"[", b"]", b"{", b"}", b",", b":", b"&a ", b"*a ", b"#", b"- "),
)
_EXTREME_INTEGERS = (0, 1, 0x7F, 0xFF, 2**31 - 1, 2**31, 2**32 - 1, 2**63 - 1, 2**64 - 1)
_EXTREME_VALUES: tuple[Any, ...] = (
    *(None, True, False, 0, -1, 1, 2**31, 2**63, -(2**64), 10**400, 1e308, -1e308, 1e-320, 1e30),
    *(float("nan"), float("inf"), "", "a", "nan", "1e999", "x\ny", "\0", "a" * 5000, [], {}, [[]]),
    *({"a": {}}, [None], [1, "a"], [[1.0], [1.0, 2.0]], {"": 0}, list(range(3000))),
)
_DTYPES = (
    *("<f2", ">f4", "<f4", ">f8", "<f8", "<i1", ">i8", "<u8", "?", "<c16", "S3", "<U2", "O"),
    *("M8[s]", "m8[ns]", np.longdouble, "V4", "<U0"),
)
# Texts are repeated at most up to this size, so that thousands of inputs can be made.
_MAX_BYTES = 1 << 20


def mutate_bytes(data: bytes, rng: random.Random, others: Sequence[bytes]) -> bytes:
    """Flip, cut, repeat, splice and replace bytes at one to six places."""
    broken = bytearray(data)
    for _ in range(rng.choice((1, 1, 2, 3, 6))):
        rng.choice(_BYTE_CHANGES)(broken, rng, others)
        del broken[_MAX_BYTES:]
    return bytes(broken)


def _flip(data: bytearray, rng: random.Random, _others: Sequence[bytes]) -> None:
    for _ in range(rng.choice((1, 1, 4, 32)) if data else 0):
        data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)


def _truncate(data: bytearray, rng: random.Random, _others: Sequence[bytes]) -> None:
    del data[_near(data, rng) :]


def _cut(data: bytearray, rng: random.Random, _others: Sequence[bytes]) -> None:
    start = _near(data, rng)
    del data[start : start + rng.choice((1, 2, 8, 100))]


def _repeat(data: bytearray, rng: random.Random, _others: Sequence[bytes]) -> None:
    start = _near(data, rng)
    data[start:start] = data[start : start + rng.choice((1, 8, 200))] * rng.choice((1, 2, 50))


def _splice(data: bytearray, rng: random.Random, others: Sequence[bytes]) -> None:
    other = rng.choice(others) if others else b""
    start = rng.randrange(len(other) + 1)
    place = _near(data, rng)
    data[place : place + rng.choice((0, 8, 100))] = other[start : start + rng.choice((4, 64, 2000))]


def _overwrite(data: bytearray, rng: random.Random, _others: Sequence[bytes]) -> None:
    width, code = rng.choice(((1, "B"), (2, "H"), (4, "I"), (8, "Q")))
    value = rng.choice(_EXTREME_INTEGERS) & (256**width - 1)
    place = _near(data, rng)
    data[place : place + width] = struct.pack(rng.choice("<>") + code, value)


def _change_number(data: bytearray, rng: random.Random, _others: Sequence[bytes]) -> None:
    found = list(_NUMBER.finditer(bytes(data[: 1 << 16])))
    if found:
        number = rng.choice(found)
        data[number.start() : number.end()] = rng.choice(_EXTREME_NUMBERS).encode()


def _insert_odd(data: bytearray, rng: random.Random, _others: Sequence[bytes]) -> None:
    place = _near(data, rng)
    data[place:place] = rng.choice(_ODD_TEXTS) * rng.choice((1, 1, 3, 200))


def _near(data: bytearray, rng: random.Random) -> int:
    """Return a place, often one in the first or last 400 bytes, where headers are."""
    size = len(data)
    place = rng.choice((rng.random() * size, rng.random() * 400, size - rng.random() * 400))
    return min(max(0, int(place)), size)


_BYTE_CHANGES = (
    *(_flip, _truncate, _cut, _repeat, _splice, _overwrite, _change_number, _insert_odd),
)


def mutate_text(data: bytes, rng: random.Random, others: Sequence[bytes]) -> bytes:
    """Break a text by its lines, words and numbers, or as bytes."""
    if rng.random() < 0.3:
        return mutate_bytes(data, rng, others)
    lines = data.split(b"\n")
    for _ in range(rng.choice((1, 1, 2, 4))):
        rng.choice(_LINE_CHANGES)(lines, rng)
    return b"\n".join(lines)[:_MAX_BYTES]


def _line(lines: list[bytes], rng: random.Random) -> int:
    """Return the index of a line, often one of the first ten."""
    return rng.randrange(rng.choice((len(lines), min(10, len(lines)))))


def _drop_line(lines: list[bytes], rng: random.Random) -> None:
    if len(lines) > 1:
        del lines[_line(lines, rng)]


def _repeat_line(lines: list[bytes], rng: random.Random) -> None:
    place = _line(lines, rng)
    lines[place:place] = [lines[place]] * rng.choice((1, 2, 500))


def _swap_lines(lines: list[bytes], rng: random.Random) -> None:
    a, b = _line(lines, rng), _line(lines, rng)
    lines[a], lines[b] = lines[b], lines[a]


def _change_word(lines: list[bytes], rng: random.Random) -> None:
    place = _line(lines, rng)
    words = re.split(rb"([\s,:]+)", lines[place])
    index = rng.randrange(len(words))
    other = rng.choice(re.split(rb"([\s,:]+)", lines[_line(lines, rng)]))
    words[index] = rng.choice((b"", other, words[index] * rng.choice((2, 3000))))
    lines[place] = b"".join(words)


def _change_line_number(lines: list[bytes], rng: random.Random) -> None:
    place = _line(lines, rng)
    found = list(_NUMBER.finditer(lines[place]))
    if found:
        number, value = rng.choice(found), rng.choice(_EXTREME_NUMBERS).encode()
        lines[place] = lines[place][: number.start()] + value + lines[place][number.end() :]


def _change_column(lines: list[bytes], rng: random.Random) -> None:
    """Give all lines the same word at the same place."""
    index, value = rng.randrange(50), rng.choice(_EXTREME_NUMBERS).encode()
    separator = rng.choice((b",", b" "))
    for i, line in enumerate(lines):
        words = line.split(separator)
        if len(words) > index:
            words[index] = value
            lines[i] = separator.join(words)


def _add_space(lines: list[bytes], rng: random.Random) -> None:
    place = _line(lines, rng)
    at = rng.randrange(len(lines[place]) + 1)
    space = rng.choice((b" ", b"\t", b"\x0b", b"\xc2\xa0")) * rng.choice((1, 5, 3000))
    lines[place] = lines[place][:at] + space + lines[place][at:]


_LINE_CHANGES = (
    *(_drop_line, _repeat_line, _swap_lines, _change_word, _change_line_number, _change_column),
    _add_space,
)


def mutate_tree(tree: Any, rng: random.Random) -> Any:
    """Return a copy of nested dictionaries and lists with one to four changes.

    Keys are removed, renamed and added, values replaced, wrapped, repeated and nested; numpy
    arrays change as in `mutate_array`.
    """
    changed = copy.deepcopy(tree)
    for _ in range(rng.choice((1, 1, 2, 4))):
        try:
            changed = _changed_somewhere(changed, rng)
        except RecursionError:  # nested before, and now repeated: deep enough
            break
    return changed


def _changed_somewhere(tree: Any, rng: random.Random) -> Any:
    """Go down a random way and change what is there; return the tree."""
    if isinstance(tree, np.ndarray) and rng.random() < 0.9:
        return mutate_array(tree, rng)
    if isinstance(tree, (dict, list)) and tree and rng.random() < 0.8:
        key = rng.choice(list(tree)) if isinstance(tree, dict) else rng.randrange(len(tree))
        if rng.random() < 0.3:
            _change_entry(tree, key, rng)
        else:
            tree[key] = _changed_somewhere(tree[key], rng)
        return tree
    return _replaced(tree, rng)


def _change_entry(tree: Any, key: Any, rng: random.Random) -> None:
    action = rng.randrange(3)
    if action == 0:
        del tree[key]
    elif isinstance(tree, dict):
        new_key = rng.choice(("", "a", f"{key}x", str(key).upper(), "_target_", "x\ny", "k" * 3000))
        tree[new_key] = tree.pop(key) if action == 1 else copy.deepcopy(tree[key])
    else:
        tree[key:key] = [copy.deepcopy(tree[key])] * rng.choice((1, 1, 50))


def _replaced(value: Any, rng: random.Random) -> Any:
    choice = rng.randrange(6)
    if choice == 0 and isinstance(value, float):
        return value * rng.choice((-1, 0, 0.5, 2, 1000, 1e12))
    if choice == 1:
        return [value] * rng.choice((1, 2, 100))
    if choice == 2:
        for _ in range(rng.choice((1, 3, 70, 400))):
            value = rng.choice(([value], {"a": value}))
        return value
    if choice == 3:
        return str(value)[:1000]
    return copy.deepcopy(rng.choice(_EXTREME_VALUES))


def mutate_array(array: npt.NDArray[Any], rng: random.Random) -> Any:
    """Return an array with other values, another shape or another type."""
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore")
        try:
            return rng.choice(_ARRAY_CHANGES)(array.copy(), rng)
        except (TypeError, ValueError, OverflowError):
            return np.array(rng.choice((0, -1, "a", 1e308)))


def _set_values(array: npt.NDArray[Any], rng: random.Random) -> npt.NDArray[Any]:
    values = array.reshape(-1)
    for _ in range(rng.choice((1, 1, 10)) if values.size else 0):
        value = rng.choice((np.nan, np.inf, -np.inf, 1e308, -1e30, 1e12, 0, -1, 1e-320, 2**31))
        values[rng.randrange(values.size)] = value
    return array


def _scale(array: npt.NDArray[Any], rng: random.Random) -> npt.NDArray[Any]:
    return array * rng.choice((0, -1, 1e-3, 100, 1e5, 1e30, 1e200, np.nan))


def _reshape(array: npt.NDArray[Any], rng: random.Random) -> npt.NDArray[Any]:
    array = np.atleast_1d(array)
    choices = (
        array.reshape(-1),
        array[:0],
        array[:1],
        array[None],
        array[..., None],
        array.T,
        array[..., :1],
        np.repeat(array, 3, axis=0),
        array.reshape(-1)[:1].reshape(()),
    )
    return rng.choice(choices)


def _retype(array: npt.NDArray[Any], rng: random.Random) -> npt.NDArray[Any]:
    return array.astype(rng.choice(_DTYPES))


_ARRAY_CHANGES: tuple[Callable[[npt.NDArray[Any], random.Random], Any], ...] = (
    *(_set_values, _scale, _reshape, _retype),
)


def mutate_json(data: bytes, rng: random.Random, others: Sequence[bytes]) -> bytes:
    """Break a JSON text by its tree, or as text."""
    if rng.random() < 0.4:
        return mutate_text(data, rng, others)
    return json.dumps(mutate_tree(json.loads(data), rng)).encode("utf-8", "surrogatepass")


def mutate_yaml(data: bytes, rng: random.Random, others: Sequence[bytes]) -> bytes:
    """Break a YAML text by its tree, or as text."""
    if rng.random() < 0.5:
        return mutate_text(data, rng, others)
    tree = mutate_tree(yaml.safe_load(data), rng)
    try:
        return yaml.safe_dump(tree).encode("utf-8", "surrogatepass")
    except (yaml.YAMLError, RecursionError, ValueError):
        return mutate_text(data, rng, others)


def mutate_npz(data: bytes, rng: random.Random, others: Sequence[bytes]) -> bytes:
    """Break an .npz archive by its arrays, by their headers, or as bytes."""
    if rng.random() < 0.25:
        return mutate_bytes(data, rng, others)
    with np.load(io.BytesIO(data)) as archive:
        arrays = dict(archive)
    if rng.random() < 0.7:
        tree = mutate_tree(arrays, rng)
        arrays = tree if isinstance(tree, dict) else {"all": tree}
    members = {str(key): _as_npy(value) for key, value in arrays.items()}
    if rng.random() < 0.4:
        key = rng.choice(list(members) or [""])
        members[key] = mutate_bytes(members.get(key, b""), rng, others)
    stream = io.BytesIO()
    method = rng.choice((zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED))
    with zipfile.ZipFile(stream, "w", method) as out:
        for key, content in members.items():
            out.writestr(f"{key.encode('utf-8', 'replace').decode()}.npy"[:60000], content)
    return stream.getvalue()


def _as_npy(value: Any) -> bytes:
    stream = io.BytesIO()
    try:
        np.save(stream, np.asarray(value), allow_pickle=True)
    except (ValueError, TypeError, OverflowError, RecursionError):
        np.save(stream, np.array(0))
    return stream.getvalue()


def mutate_object_npy(data: bytes, rng: random.Random, others: Sequence[bytes]) -> bytes:
    """Break the .npy file of one pickled object by its tree, by its instructions, or as bytes."""
    choice = rng.random()
    if choice < 0.3:
        return mutate_bytes(data, rng, others)
    header_size = _object_header_size(data)
    if choice < 0.55:
        return data[:header_size] + mutate_pickle(data[header_size:], rng, others)
    content = pickle.loads(data[header_size:])  # our own file
    holder = np.empty((), dtype=object)
    holder[()] = mutate_tree(content[()], rng)
    return data[:header_size] + pickle.dumps(holder, protocol=rng.choice((2, 3, 4)))


def _object_header_size(data: bytes) -> int:
    stream = io.BytesIO(data)
    np.lib.format.read_magic(stream)
    np.lib.format.read_array_header_1_0(stream)
    return stream.tell()


def mutate_pickle(data: bytes, rng: random.Random, others: Sequence[bytes]) -> bytes:
    """Remove, repeat, exchange and insert instructions of a pickle."""
    try:
        places = [position or 0 for _, _, position in pickletools.genops(data)]
    except (ValueError, UnicodeDecodeError):
        return mutate_bytes(data, rng, others)
    ends = [*places[1:], len(data)]
    parts = [data[start:end] for start, end in zip(places, ends, strict=True)]
    for _ in range(rng.choice((1, 1, 2, 5))):
        place = rng.randrange(len(parts))
        action = rng.randrange(4)
        if action == 0:
            del parts[place]
        elif action == 1:
            parts[place:place] = [parts[place]] * rng.choice((1, 3, 300))
        elif action == 2:
            other = rng.randrange(len(parts))
            parts[place], parts[other] = parts[other], parts[place]
        else:
            parts.insert(place, rng.choice(pickletools.opcodes).code.encode("latin-1"))
        if not parts:
            break
    return b"".join(parts)
