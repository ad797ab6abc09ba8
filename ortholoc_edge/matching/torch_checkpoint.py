"""Reads the tensors of a torch ``.pt`` file without torch and without running what is in it.

Two formats: a zip archive, one pickle beside files of bare numbers; and torch's older one (before 1.6), five pickles
one after another, the numbers behind them.

A pickle is a program. This reader lets through only what ``torch.save`` of a state dict writes: a list of
opcodes, and names that stand for inert records here. Everything else is refused, so a hostile file costs an
error message.
"""

from __future__ import annotations

import io
import lzma
import math
import pickle
import pickletools
import struct
import warnings
import zipfile
import zlib
from collections import OrderedDict
from collections.abc import Callable, Iterator
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from ortholoc_edge.errors import ModelError

# What torch's protocol-2 pickles of state dicts hold. STACK_GLOBAL, INST, OBJ, NEWOBJ and EXT* are left
# out: they make objects by routes that `find_class` sees differently or not at all.
_OPCODES: Final = frozenset(
    (
        *("PROTO", "STOP", "MARK", "GLOBAL", "REDUCE", "BUILD", "BINPERSID", "NONE", "NEWTRUE", "NEWFALSE"),
        *("TUPLE", "TUPLE1", "TUPLE2", "TUPLE3", "EMPTY_TUPLE", "EMPTY_DICT", "EMPTY_LIST"),
        *("SETITEM", "SETITEMS", "APPEND", "APPENDS", "BINPUT", "LONG_BINPUT", "BINGET", "LONG_BINGET"),
        *("BININT", "BININT1", "BININT2", "LONG1", "BINFLOAT", "BINUNICODE", "SHORT_BINSTRING"),
    )
)

# Upper limit of the tensors together; ours are 48 MB. Stops a zip whose members swell without end, and thousands of
# tensors that share one storage.
MAX_TENSOR_BYTES: Final = 1 << 30
_MAX_PICKLE_BYTES: Final = 16 << 20
_MAX_TENSORS: Final = 100_000

# How the older format begins, and the version of it that there is (torch.serialization).
_MAGIC: Final = 0x1950A86A20F9469CFC6C
_PROTOCOL: Final = 1001
# Before each storage's numbers: how many there are.
_COUNT: Final = struct.Struct("<q")

_Array = npt.NDArray[Any]
# A storage's numbers by key and type of the elements.
_Storages = Callable[[str, "np.dtype[Any]"], _Array]


# What zipfile, pickletools, pickle and numpy raise on damaged bytes; NotImplementedError and RuntimeError are
# zipfile's for unknown compression and encryption.
_DAMAGED: Final = (
    zipfile.BadZipFile,
    pickle.UnpicklingError,
    zlib.error,
    lzma.LZMAError,
    struct.error,
    EOFError,
    OSError,
    LookupError,
    ValueError,
    TypeError,
    AttributeError,
    OverflowError,
    MemoryError,
    RecursionError,
    NotImplementedError,
    RuntimeError,
)


class _StorageType:
    """Stands for ``torch.FloatStorage`` and its like. A slotted class so that BUILD has no dict to fill."""

    __slots__ = ("dtype",)

    def __init__(self, dtype: str) -> None:
        self.dtype = dtype


class _Tensor:
    """Where a tensor lies: storage, offset, size and stride in elements. Read after unpickling, fully
    checked."""

    __slots__ = ("offset", "size", "storage", "stride")

    def __init__(self, storage: Any, offset: Any, size: Any, stride: Any) -> None:
        self.storage = storage
        self.offset = offset
        self.size = size
        self.stride = stride


class _RebuildTensor:
    __slots__ = ()

    def __call__(self, storage: Any, offset: Any, size: Any, stride: Any, *_: Any) -> _Tensor:
        return _Tensor(storage, offset, size, stride)


class _RebuildParameter:
    __slots__ = ()

    def __call__(self, data: Any, *_: Any) -> Any:
        return data


_NAMES: Final[dict[tuple[str, str], Any]] = {
    ("collections", "OrderedDict"): OrderedDict,
    ("torch._utils", "_rebuild_tensor_v2"): _RebuildTensor(),
    ("torch._utils", "_rebuild_parameter"): _RebuildParameter(),
    ("torch", "DoubleStorage"): _StorageType("<f8"),
    ("torch", "FloatStorage"): _StorageType("<f4"),
    ("torch", "HalfStorage"): _StorageType("<f2"),
    ("torch", "LongStorage"): _StorageType("<i8"),
    ("torch", "IntStorage"): _StorageType("<i4"),
    ("torch", "ShortStorage"): _StorageType("<i2"),
    ("torch", "CharStorage"): _StorageType("<i1"),
    ("torch", "ByteStorage"): _StorageType("<u1"),
    ("torch", "BoolStorage"): _StorageType("?"),
}


class _RestrictedUnpickler(pickle.Unpickler):
    def find_class(self, module_name: str, global_name: str, /) -> Any:
        try:
            return _NAMES[module_name, global_name]
        except KeyError:
            raise ModelError(
                f"refused: it asks for {module_name}.{global_name}, which no plain set of weights needs"
            ) from None

    def persistent_load(self, pid: Any) -> Any:
        return pid


class _OlderUnpickler(_RestrictedUnpickler):
    """Notes the storages that are asked for.

    Attributes:
        storages: type of the elements and how many there are, by key.
    """

    def __init__(self, file: io.BytesIO) -> None:
        super().__init__(file)
        self.storages: dict[str, tuple[np.dtype[Any], int]] = {}

    def persistent_load(self, pid: Any) -> Any:
        match pid:
            case ("storage", _StorageType(dtype=str(code)), str(key), str(), int(count), None) if count >= 0:
                described = (np.dtype(code), count)
            case _:
                # The last part, a view of another storage, is what torch before 0.4 wrote.
                raise ModelError("a storage is described in an unknown way")
        if self.storages.setdefault(key, described) != described:
            raise ModelError(f"storage {key!r} is described in two ways")
        return pid


def _checked_length(program: bytes) -> int:
    """Bytes of the pickle that ``program`` begins with."""
    end = 0
    # `pickletools` decodes a name with a backslash by a deprecated way; no name on the list has one.
    with warnings.catch_warnings(action="ignore", category=DeprecationWarning):
        for opcode, argument, position in pickletools.genops(program):
            end = int(position or 0) + 1
            if opcode.name not in _OPCODES:
                raise ModelError(f"refused: pickle opcode {opcode.name} is not used by plain weights")
            # The unpickler sizes its memo by the largest index it meets: four bytes could ask for 64 GiB.
            if opcode.name == "LONG_BINPUT" and int(argument or 0) > len(program):
                raise ModelError("refused: its pickle's memo index is larger than the pickle")
    return end


def _array(tensor: Any, name: str, storages: _Storages) -> _Array:
    """A view of the tensor's storage."""
    if not isinstance(tensor, _Tensor):
        raise ModelError(f"entry {name!r} is a {type(tensor).__name__}, not a tensor")
    match (tensor.storage, tensor.offset, tensor.size, tensor.stride):
        case (
            ("storage", _StorageType(dtype=str(code)), str(key), *_),
            int(offset),
            tuple(size),
            tuple(stride),
        ):
            pass
        case _:
            raise ModelError(f"tensor {name!r} is described in an unknown way")
    numbers = (offset, *size, *stride)
    if len(size) != len(stride) or not all(isinstance(n, int) and 0 <= n < 1 << 40 for n in numbers):
        raise ModelError(f"tensor {name!r} has an impossible shape")
    dtype = np.dtype(code)
    flat = storages(key, dtype)
    last = offset + sum((n - 1) * step for n, step in zip(size, stride, strict=True))
    if 0 not in size and last >= len(flat):
        raise ModelError(f"tensor {name!r} reaches past its storage of {len(flat)} values")
    if math.prod(size) > len(flat):
        raise ModelError(f"tensor {name!r} repeats values of its storage, which weights do not")
    strides = [step * dtype.itemsize for step in stride]
    return np.lib.stride_tricks.as_strided(flat[offset:], size, strides, writeable=False)


def _named(entries: Any) -> Iterator[tuple[str, Any]]:
    """What a dictionary has by name; what a dictionary in it has, by both names with a dot between."""
    if not isinstance(entries, dict) or not all(isinstance(name, str) for name in entries):
        raise ModelError("its content is not a dictionary of tensors")
    for name, entry in entries.items():
        if not isinstance(entry, dict):
            yield name, entry
            continue
        if not all(isinstance(inner, str) for inner in entry):
            raise ModelError(f"entry {name!r} is not a dictionary of tensors")
        for inner, tensor in entry.items():
            yield f"{name}.{inner}", tensor


def _tensors(entries: Any, storages: _Storages) -> dict[str, _Array]:
    tensors: dict[str, _Array] = {}
    total = 0
    for name, tensor in _named(entries):
        view = _array(tensor, name, storages)
        total += view.nbytes
        if total > MAX_TENSOR_BYTES or len(tensors) >= _MAX_TENSORS:
            raise ModelError(f"its tensors are more than {_MAX_TENSORS} or {MAX_TENSOR_BYTES} bytes")
        tensors[name] = view.copy()
    return tensors


def _read_zip(data: bytes) -> dict[str, _Array]:
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        programs = [info for info in archive.infolist() if info.filename.endswith("/data.pkl")]
        if len(programs) != 1 or programs[0].file_size > _MAX_PICKLE_BYTES:
            raise ModelError("it does not hold one pickle of ordinary size")
        if sum(info.file_size for info in archive.infolist()) > MAX_TENSOR_BYTES:
            raise ModelError(f"it unpacks to more than {MAX_TENSOR_BYTES} bytes")
        prefix = programs[0].filename.removesuffix("data.pkl")
        # Older torch writes no such member and was little-endian throughout.
        if f"{prefix}byteorder" in archive.namelist() and archive.read(f"{prefix}byteorder") != b"little":
            raise ModelError("it is big-endian, which this reader does not know")
        program = archive.read(programs[0])
        _checked_length(program)
        entries = _RestrictedUnpickler(io.BytesIO(program)).load()

        def storage(key: str, dtype: np.dtype[Any]) -> _Array:
            return np.frombuffer(archive.read(f"{prefix}data/{key}"), dtype=dtype)

        return _tensors(entries, storage)


def _read_older(data: bytes) -> dict[str, _Array]:
    """The five pickles are: a magic number, the format's version, the machine, the content, and the storages' keys in
    the order in which their numbers follow."""
    end = 0

    def unpickler() -> _OlderUnpickler:
        nonlocal end
        # A copy no longer than a pickle may be: what is behind it is not looked at before its turn.
        program = data[end : end + _MAX_PICKLE_BYTES]
        length = _checked_length(program)
        end += length
        return _OlderUnpickler(io.BytesIO(program[:length]))

    if unpickler().load() != _MAGIC:
        raise ValueError("no torch file's magic number")
    if (version := unpickler().load()) != _PROTOCOL:
        raise ModelError(f"its format is of version {version!r}, this reader knows {_PROTOCOL}")
    machine = unpickler().load()
    if not isinstance(machine, dict) or machine.get("little_endian") is not True:
        raise ModelError("it is not little-endian, which this reader does not know")
    content = unpickler()
    entries = content.load()
    keys = unpickler().load()
    if not isinstance(keys, list) or len(keys) != len(content.storages) or set(keys) != set(content.storages):
        raise ModelError("the storages that it lists are not those that its tensors are in")
    numbers: dict[str, _Array] = {}
    for key in keys:
        dtype, count = content.storages[key]
        (written,) = _COUNT.unpack_from(data, end)
        end += _COUNT.size
        if written != count or count > (len(data) - end) // dtype.itemsize:
            raise ModelError(f"storage {key!r} should have {count} values; {written} are announced, or the file is cut")
        numbers[key] = np.frombuffer(data, dtype, count, end)
        end += numbers[key].nbytes
    if end != len(data):
        raise ModelError(f"{len(data) - end} bytes follow its last storage")

    def storage(key: str, dtype: np.dtype[Any]) -> _Array:
        # A description need not have come by way of `persistent_load`.
        if key not in numbers or numbers[key].dtype != dtype:
            raise ModelError(f"storage {key!r} of {dtype} is not among those that it lists")
        return numbers[key]

    return _tensors(entries, storage)


def _read(data: bytes) -> dict[str, _Array]:
    return _read_zip(data) if data.startswith(b"PK") else _read_older(data)


def read_checkpoint(data: bytes, what: str) -> dict[str, _Array]:
    """Tensors of a ``.pt`` or ``.pth`` file as arrays of their own type, in the file's order.

    Args:
        data: the file's bytes.
        what: its name, for messages.
    Returns: by name; those of a dictionary in the dictionary by both names with a dot between.
    Raises: ModelError for anything that is not a plain dictionary of tensors, damaged or hostile files included.
    """
    try:
        return _read(data)
    except ModelError as err:
        raise ModelError(f"checkpoint {what}: {err}; use the published file") from err.__cause__
    except _DAMAGED as err:
        raise ModelError(
            f"checkpoint {what}: damaged or of another format ({err!r}); fetch it again"
        ) from err
