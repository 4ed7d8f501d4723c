"""Loops over signals, written as plain Python and compiled to machine code at set-up.

Numba compiles them once. The code is stored as an object file beside the source, or in the user's cache if
the installation is read-only, and nowhere if neither is writable. Files of older versions are deleted some
time after their last use. Running the code needs no compiler, whose start takes half a second of CPU.
`NUMBA_DISABLE_JIT=1` runs the Python source instead, with the same results.

A loop allocates nothing: it writes into its array arguments. Arrays must be C-contiguous and have the types
of the signature; others are refused, because the code would read beyond them.
"""

from __future__ import annotations

import ctypes
import functools
import hashlib
import os
import re
import secrets
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import cached_property
from importlib import import_module
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, ParamSpec

import numpy as np

if TYPE_CHECKING:
    from types import ModuleType

    from numpy.typing import NDArray

Given = ParamSpec("Given")

_TYPES: dict[str, tuple[np.dtype[Any], Any, str]] = {
    "float64": (np.dtype(np.float64), ctypes.c_double, "double"),
    "int64": (np.dtype(np.int64), ctypes.c_int64, "i64"),
    "uint8": (np.dtype(np.uint8), ctypes.c_uint8, "i8"),
    "complex128": (np.dtype(np.complex128), None, ""),
}
"""Types of a signature: dtype of the array, scalar type in C, and in LLVM."""
_ARGUMENT = re.compile(r"(\w+)(\[[:, ]+\])?(?:, |$)")
_DIGEST_BYTES = 32
"""Size of a SHA-256 digest [bytes]."""
_FOLDER = "NUMBA_CACHE_DIR"
_KEPT_S = 30 * 86400.0
"""Age since the last use [s] after which machine code of no current loop is deleted: another version of the
program may share the folder, and recompiles what is missing."""

LANES = 16
"""Most walks through a signal in one loop: the numbers of twice as many do not fit the fastest memory."""

_loops: list[Loop[Any]] = []


class Loop(Generic[Given]):
    """A loop that runs as machine code.

    Args:
        loop: in Python.
        signature: types of the arguments, for example ``float64[:, :], int64``; empty for a loop that only
            other loops call.
    """

    def __init__(self, loop: Callable[Given, Any], signature: str) -> None:
        self._loop = loop
        self.name = loop.__name__
        self.signature = signature
        functools.update_wrapper(self, loop)

    @cached_property
    def machine_code(self) -> Callable[..., Any]:
        """The callable: its machine code, or the Python source if `NUMBA_DISABLE_JIT` is set."""
        if os.environ.get("NUMBA_DISABLE_JIT", "0") not in {"", "0"}:
            return self._loop
        return _bind(self.make_object(), _split(self.signature), self.name)

    @property
    def is_compiled(self) -> bool:
        """Whether it runs as machine code."""
        return self.machine_code is not self._loop

    @property
    def _numba_type_(self) -> object:
        """Type of the loop when another loop calls it."""
        return _make_dispatcher(self._loop)._numba_type_

    def find_object(self) -> Path | None:
        """File with its machine code; None if there is none."""
        return next((path for path, _ in self._read_objects()), None)

    def make_object(self) -> bytes:
        """Its machine code, stored for later use if any folder is writable."""
        for _, code in self._read_objects():
            return code
        code = _compile(self._loop, self.signature)
        for folder in self._list_folders():
            with suppress(OSError):
                folder.mkdir(parents=True, exist_ok=True)
                _replace_file(folder / self.file_name, hashlib.sha256(code).digest() + code)
                _delete_unused(folder)
                break
        return code

    def _read_objects(self) -> Iterator[tuple[Path, bytes]]:
        """Files with its complete machine code that may be run, with their content.

        Only code of the user who runs or installed the program is run: others may write into a shared folder.
        """
        believed = {0, os.geteuid(), Path(self._loop.__code__.co_filename).stat().st_uid}
        for folder in self._list_folders():
            path = folder / self.file_name
            with suppress(OSError), path.open("rb") as file:
                if os.fstat(file.fileno()).st_uid not in believed:
                    continue
                with suppress(OSError):
                    # Not every file system records the last access.
                    os.utime(file.fileno())
                content = file.read()
                code = content[_DIGEST_BYTES:]
                if hashlib.sha256(code).digest() == content[:_DIGEST_BYTES]:
                    yield path, code

    @property
    def file_name(self) -> str:
        """Name of the file with its machine code, different for every version of its source."""
        module = self.__module__.rpartition(".")[2]
        return f"{module}.{self.name}-{_hash_source(self._loop.__code__.co_filename, self.signature)}.o"

    def _list_folders(self) -> Iterator[Path]:
        """Folders in which its code may be stored, in order of preference."""
        if asked := os.environ.get(_FOLDER):
            yield Path(asked)
            return
        yield Path(self._loop.__code__.co_filename).parent / "__pycache__"
        with suppress(RuntimeError):
            yield Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "slip"

    def __call__(self, *args: Given.args, **kwargs: Given.kwargs) -> Any:  # noqa: ANN401 - the loop's
        """Run the machine code; the Python source in its place may return a value to another loop."""
        return self.machine_code(*args, **kwargs)


def compiled(signature: str = "") -> Callable[[Callable[Given, Any]], Callable[Given, Any]]:
    """Decorator that runs a loop as machine code.

    Args:
        signature: types of its arguments, for example ``float64[:, :], int64``; empty for a loop that only
            other loops of its file call.
    """

    def decorate(function: Callable[Given, Any]) -> Callable[Given, Any]:
        loop = Loop(function, signature)
        if signature:
            _loops.append(loop)
        return loop

    return decorate


def deal_lanes(count: int) -> Iterator[tuple[int, NDArray[np.int64], int]]:
    """Walks through a signal dealt to loops that take some of them at once.

    A walk waits for its own roots and divisions in each cell; the processor does those of several walks
    meanwhile, if the loop has ``for k in range(lanes)`` around few statements, without a branch, on rows of
    one array that are `LANES` apart. Each walk ends at the same numbers, to the last bit, as it does alone.

    Yields:
        The first walk of a loop; the walk of every lane, the last one repeated in a pack that is not full;
        how many of the lanes are wanted.
    """
    pack = _find_pack()
    for first in range(0, count, LANES):
        wanted = min(count - first, LANES)
        lanes = -(-wanted // pack) * pack if wanted > 1 else 1
        yield first, first + np.minimum(np.arange(lanes), wanted - 1), wanted


def compile_loops() -> Iterator[str]:
    """Compile the imported loops that have no machine code yet; yields the name of each compiled loop."""
    for loop in _loops:
        if loop.is_compiled:
            yield loop.name


def list_caches() -> set[str | None]:
    """Folders with stored loops, None for a loop that cannot be stored; empty if none is compiled."""
    paths = [loop.find_object() for loop in _loops if loop.is_compiled]
    return {None if path is None else str(path.parent) for path in paths}


@functools.cache
def _load_compiler() -> ModuleType:
    """LLVM without Numba, to link and to write object files."""
    return import_module("llvmlite.binding")


@functools.cache
def _find_pack() -> int:
    """Walks that the processor computes at a time: a loop of another count does the rest one by one."""
    return 8 if _load_compiler().get_host_cpu_features().get("avx512f") else 4


@functools.cache
def _hash_source(source: str, signature: str) -> str:
    """Dependencies of the machine code of a loop: its file, the compiler and the processor."""
    binding = _load_compiler()
    features = binding.get_host_cpu_features().flatten()
    parts = [signature, version("numba"), version("llvmlite"), binding.get_host_cpu_name(), features]
    parts += [str(object.__basicsize__), str(LANES)]
    content = b"\0".join([*(part.encode() for part in parts), Path(source).read_bytes()])
    return hashlib.sha256(content).hexdigest()[:16]


def _replace_file(path: Path, content: bytes) -> None:
    """Write a file atomically, with the permissions of the umask."""
    draft = path.with_name(f".{path.name}.{secrets.token_hex(8)}")
    try:
        with draft.open("xb") as file:
            file.write(content)
        draft.replace(path)
    except OSError:
        draft.unlink(missing_ok=True)
        raise


def _delete_unused(folder: Path) -> None:
    """Delete machine code of older versions of the imported files that has not been used for long."""
    present = {loop.file_name for loop in _loops}
    modules = {name.partition(".")[0] for name in present}
    for path in folder.glob(f"*.*-{'[0-9a-f]' * 16}.o"):
        if path.name not in present and path.name.partition(".")[0] in modules:
            with suppress(OSError):
                if time.time() - path.stat().st_mtime > _KEPT_S:
                    path.unlink()


def _split(signature: str) -> list[tuple[str, int]]:
    """Type and number of axes of every argument; a scalar has none."""
    return [(kind, axes.count(":")) for kind, axes in _ARGUMENT.findall(signature)]


@functools.cache
def _make_dispatcher(loop: Callable[..., object]) -> Any:  # noqa: ANN401 - the compiler's
    how = {"_nrt": False, "error_model": "numpy", "no_cpython_wrapper": True, "no_cfunc_wrapper": True}
    return import_module("numba").njit(**how)(loop)


def _compile(loop: Callable[..., object], signature: str) -> bytes:
    """Object file with one function, ``enter``, whose arguments are scalars and array objects."""
    types = import_module("numba.core.types")
    arguments = _split(signature)
    plain = [(getattr(types, kind), axes) for kind, axes in arguments]
    taken = tuple(types.Array(kind, axes, "C") if axes else kind for kind, axes in plain)
    dispatcher = _make_dispatcher(loop)
    dispatcher.compile(taken)
    inner = dispatcher.overloads[taken].fndesc.mangled_name
    code = dispatcher.inspect_llvm(taken) + _write_entry(inner, arguments)
    _start()
    module = _load_compiler().parse_assembly(code)
    module.verify()
    return bytes(_make_target().emit_object(module))


def _write_entry(inner: str, arguments: list[tuple[str, int]]) -> str:
    """The function ``enter`` in LLVM IR: it unpacks arrays and calls the loop.

    An array object has the layout of NumPy's C interface (``PyArrayObject``): data, number of axes, lengths
    and strides, 8 bytes each, after the header of every object.
    """
    # Output pointers of the loop: its (empty) return value and the description of an error.
    taken, passed = [], ["ptr %nothing", "ptr %error"]
    lines = ["%nothing = alloca ptr", "%error = alloca ptr"]
    for number, (kind, axes) in enumerate(arguments):
        name = f"%a{number}"
        if not axes:
            llvm = _TYPES[kind][2]
            taken.append(f"{llvm} {name}")
            passed.append(f"{llvm} {name}")
            continue
        taken.append(f"ptr {name}")
        for field, offset in (("data", 0), ("lengths", 16), ("strides", 24)):
            at = object.__basicsize__ + offset
            lines += [
                f"{name}.{field}.at = getelementptr i8, ptr {name}, i64 {at}",
                f"{name}.{field} = load ptr, ptr {name}.{field}.at",
            ]
        for field in ("lengths", "strides"):
            for axis in range(axes):
                one = f"{name}.{field}.{axis}"
                lines += [
                    f"{one}.at = getelementptr i64, ptr {name}.{field}, i64 {axis}",
                    f"{one} = load i64, ptr {one}.at",
                ]
        lines.append(f"{name}.size.0 = add i64 {name}.lengths.0, 0")
        for axis in range(1, axes):
            lines.append(f"{name}.size.{axis} = mul i64 {name}.size.{axis - 1}, {name}.lengths.{axis}")
        passed += ["ptr null", "ptr null", f"i64 {name}.size.{axes - 1}", f"i64 {_TYPES[kind][0].itemsize}"]
        passed.append(f"ptr {name}.data")
        passed += [f"i64 {name}.{field}.{axis}" for field in ("lengths", "strides") for axis in range(axes)]
    body = "\n  ".join([*lines, f'%status = call i32 @"{inner}"({", ".join(passed)})', "ret i32 %status"])
    return f"\ndefine i32 @enter({', '.join(taken)}) {{\n  {body}\n}}\n"


@functools.cache
def _start() -> Any:  # noqa: ANN401 - the linker
    binding = _load_compiler()
    binding.initialize_native_target()
    binding.initialize_native_asmprinter()
    return binding.create_lljit_compiler(_make_target())


def _make_target() -> Any:  # noqa: ANN401 - the linker's
    binding = _load_compiler()
    cpu, features = binding.get_host_cpu_name(), binding.get_host_cpu_features().flatten()
    return binding.Target.from_default_triple().create_target_machine(
        cpu=cpu, features=features, opt=3, jit=True
    )


_linked: list[object] = []
"""Linked code remains for the life of the process."""


def _bind(code: bytes, arguments: list[tuple[str, int]], name: str) -> Callable[..., None]:
    """A function that checks its arguments and calls the machine code."""
    binding = _load_compiler()
    library = binding.JITLibraryBuilder().add_object_img(code).add_current_process().export_symbol("enter")
    linked = library.link(_start(), f"{name}{len(_linked)}")
    _linked.append(linked)
    taken = [ctypes.py_object if axes else _TYPES[kind][1] for kind, axes in arguments]
    enter = ctypes.PYFUNCTYPE(ctypes.c_int32, *taken)(linked["enter"])
    arrays = [(number, _TYPES[kind][0], axes) for number, (kind, axes) in enumerate(arguments) if axes]

    def call(*args: Any) -> None:  # noqa: ANN401 - as the signature has it
        for number, kind, axes in arrays:
            array = args[number]
            if array.dtype != kind or array.ndim != axes or not array.flags.c_contiguous:
                what = f"argument {number + 1} of {name} is no C-contiguous array of {kind} with {axes} axes"
                raise TypeError(what)
        if enter(*args):
            what = f"{name} divided by zero"
            raise ZeroDivisionError(what)

    return call
