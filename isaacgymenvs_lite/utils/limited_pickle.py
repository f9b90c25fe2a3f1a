"""Base of the unpicklers of foreign files: it executes few instructions, none of them harmful.

A pickle is a program. Subclasses decide which functions it may call; this class keeps it from
ending the process or exhausting its memory: the unpickler in C reserves memory for
the highest number that a file gives a value, the hash of a tuple of tuples of tuples overflows
the stack, and one byte can make an object of 64.
"""

from __future__ import annotations

import pickle
from abc import abstractmethod
from collections.abc import Callable, Mapping
from typing import IO, Any, ClassVar

# What torch.save and numpy.save write, with protocols 2 to 4; of protocol 0 those that are needed
# to read a file up to the first name that it imports.
_OPCODES = (
    *("PROTO", "FRAME", "STOP", "MARK", "POP", "POP_MARK"),
    *("GLOBAL", "STACK_GLOBAL", "REDUCE", "BUILD", "BINPERSID"),
    *("EMPTY_DICT", "SETITEM", "SETITEMS", "EMPTY_LIST", "APPEND", "APPENDS"),
    *("EMPTY_TUPLE", "TUPLE", "TUPLE1", "TUPLE2", "TUPLE3"),
    *("NONE", "NEWTRUE", "NEWFALSE", "BININT", "BININT1", "BININT2", "LONG1", "BINFLOAT"),
    *("BINUNICODE", "SHORT_BINUNICODE", "SHORT_BINSTRING"),
    *("BINBYTES", "SHORT_BINBYTES", "BINBYTES8"),
    *("PUT", "GET", "UNICODE", "INT", "FLOAT", "LIST", "DICT"),
    *("MEMOIZE", "BINGET", "LONG_BINGET", "BINPUT", "LONG_BINPUT"),
)

_PythonUnpickler: Any = pickle._Unpickler  # type: ignore[attr-defined]


class _CountingDispatch(dict[int, Any]):
    """The instructions of an unpickler; raises `error` when more than `limit` were executed."""

    def __init__(self, dispatch: Mapping[int, Any], limit: int, error: ValueError) -> None:
        super().__init__(dispatch)
        self._left, self._error = limit, error

    def __getitem__(self, code: int) -> Any:
        self._left -= 1
        if self._left < 0:
            raise self._error
        return super().__getitem__(code)

    def __missing__(self, code: int) -> Any:
        raise ValueError(f"the instruction {chr(code)!r}, which no file here needs")


class LimitedUnpickler(_PythonUnpickler):
    """Python's unpickler (the implementation in Python) with the instructions above.

    Attributes:
        key_types: allowed types of dictionary keys; cheap to hash.
        error: raised for any other dictionary, and for a file that goes on for too long.
        max_instructions: that a file may have; a clip has 300, a large checkpoint 50,000.
    """

    stack: list[Any]
    append: Callable[[Any], None]
    pop_mark: Callable[[], list[Any]]
    read: Callable[[int], bytes]
    key_types: ClassVar[tuple[type, ...]] = (str, int)
    error: ClassVar[type[ValueError]] = ValueError
    max_instructions: ClassVar[int] = 1_000_000
    dispatch: ClassVar[dict[int, Any]] = {
        getattr(pickle, name)[0]: _PythonUnpickler.dispatch[getattr(pickle, name)[0]]
        for name in _OPCODES
    }

    def __init__(self, stream: IO[bytes], **options: Any) -> None:
        super().__init__(stream, **options)
        too_long = self.error(f"a pickle of more than {self.max_instructions:,} instructions")
        # Of this instance only: the class keeps the plain table.
        counting = _CountingDispatch(self.dispatch, self.max_instructions, too_long)
        object.__setattr__(self, "dispatch", counting)

    @abstractmethod
    def find_class(self, module: str, name: str) -> Any:
        """Return the object of a name; raise for all names that a file does not need."""

    @abstractmethod
    def build(self, instance: Any, state: Any) -> None:
        """Give an object its state; raise ValueError for one that takes none."""

    def load_build(self) -> None:
        """Set the state of the newest object."""
        state = self.stack.pop()
        self.build(self.stack[-1], state)

    def load_setitem(self) -> None:
        """Put an entry into a dictionary."""
        value, key = self.stack.pop(), self.stack.pop()
        self._put(key, value)

    def load_setitems(self) -> None:
        """Put entries into a dictionary."""
        entries = self.pop_mark()
        for key, value in zip(entries[::2], entries[1::2], strict=True):
            self._put(key, value)

    def load_dict(self) -> None:
        """Begin a dictionary, an empty one as pickle writes it."""
        if self.pop_mark():
            raise self.error("a dictionary that is filled when it is made")
        self.stack.append({})

    def _put(self, key: Any, value: Any) -> None:
        if not isinstance(key, self.key_types) or not isinstance(self.stack[-1], dict):
            raise self.error("a dictionary with other keys than texts and integers")
        self.stack[-1][key] = value

    dispatch[pickle.BUILD[0]] = load_build
    dispatch[pickle.DICT[0]] = load_dict
    dispatch[pickle.SETITEM[0]] = load_setitem
    dispatch[pickle.SETITEMS[0]] = load_setitems
