"""The reader of torch checkpoints: what it reads, and that it runs nothing."""

import contextlib
import io
import os
import pickle
import struct
import zipfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ortholoc_edge.errors import ModelError
from ortholoc_edge.matching.torch_checkpoint import read_checkpoint


def _text(value: str) -> bytes:
    return b"X" + struct.pack("<I", len(value)) + value.encode()


def _int(value: int) -> bytes:
    return b"J" + struct.pack("<i", value)


def _ints(values: tuple[int, ...]) -> bytes:
    return b"(" + b"".join(map(_int, values)) + b"t"


def _tensor(key: str, offset: int, size: tuple[int, ...], stride: tuple[int, ...], kind: str = "Float") -> bytes:
    storage = b"(" + _text("storage") + f"ctorch\n{kind}Storage\n".encode() + _text(key) + _text("cpu") + _int(99)
    return (
        b"ctorch._utils\n_rebuild_tensor_v2\n("
        + (storage + b"tQ" + _int(offset) + _ints(size) + _ints(stride))
        + b"\x89ccollections\nOrderedDict\n)RtR"
    )


def _state_dict(**tensors: bytes) -> bytes:
    items = b"".join(_text(name) + tensor for name, tensor in tensors.items())
    return b"\x80\x02ccollections\nOrderedDict\n)R(" + items + b"u."


def _checkpoint(program: bytes, **storages: bytes) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr("archive/data.pkl", program)
        for key, data in storages.items():
            archive.writestr(f"archive/data/{key.removeprefix('_')}", data)
    return file.getvalue()


VALUES = np.arange(12, dtype="<f4")
PLAIN = _checkpoint(
    _state_dict(
        whole=_tensor("0", 0, (3, 4), (4, 1)),
        part=_tensor("0", 5, (2,), (1,)),
        turned=_tensor("0", 0, (4, 3), (1, 4)),
        scalar=_tensor("1", 0, (), (), "Long"),
    ),
    _0=VALUES.tobytes(),
    _1=np.array([7], "<i8").tobytes(),
)


def test_tensors_have_their_type_shape_and_strides() -> None:
    tensors = read_checkpoint(PLAIN, "x.pt")
    assert list(tensors) == ["whole", "part", "turned", "scalar"]
    np.testing.assert_array_equal(tensors["whole"], VALUES.reshape(3, 4))
    np.testing.assert_array_equal(tensors["part"], [5, 6])
    np.testing.assert_array_equal(tensors["turned"], VALUES.reshape(3, 4).T)
    assert tensors["scalar"].dtype == np.int64
    assert tensors["scalar"] == 7


class _Runs:
    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[object, tuple[str]]:
        return os.mkdir, (str(self.path),)


@pytest.mark.parametrize("protocol", range(2, pickle.HIGHEST_PROTOCOL + 1))
def test_a_pickle_that_runs_something_is_refused(tmp_path: Path, protocol: int) -> None:
    trap = tmp_path / "sprung"
    program = pickle.dumps(_Runs(trap), protocol=protocol)
    with pytest.raises(ModelError, match=r"checkpoint evil\.pt: refused"):
        read_checkpoint(_checkpoint(program), "evil.pt")
    assert not trap.exists()


@pytest.mark.parametrize(
    "name",
    ["builtins\neval", "torch\nload", "collections\nnamedtuple", "torch._utils\n_rebuild_wrapper_subclass"],
)
def test_a_name_off_the_list_is_refused(name: str) -> None:
    program = b"\x80\x02c" + name.encode() + b"\n)R."
    with pytest.raises(ModelError, match="refused: it asks for"):
        read_checkpoint(_checkpoint(program), "evil.pt")


@pytest.mark.parametrize(
    ("program", "words"),
    [
        (b"\x80\x02Nr\xff\xff\xff\xff.", "memo index"),
        (_state_dict(w=_tensor("0", 1, (3, 4), (4, 1))), "past its storage"),
        (_state_dict(w=_tensor("0", -1, (3,), (1,))), "impossible shape"),
        (_state_dict(w=_tensor("0", 0, (1 << 20, 1 << 20), (0, 0))), "repeats"),
        (_state_dict(w=_tensor("0", 0, (7, 6), (1, 1))), "repeats"),
        (_state_dict(w=_tensor("9", 0, (1,), (1,))), "damaged"),
        (_state_dict(w=_ints((1, 2))), "not a tensor"),
        (b"\x80\x02]N.", "not a dictionary|damaged"),
    ],
)
def test_impossible_content_is_an_error_that_says_so(program: bytes, words: str) -> None:
    with pytest.raises(ModelError, match=words):
        read_checkpoint(_checkpoint(program, _0=VALUES.tobytes()), "odd.pt")


def test_old_format_and_empty_files_are_errors() -> None:
    for data in (b"", b"PK", pickle.dumps({"a": 1}, protocol=2)):
        with pytest.raises(ModelError, match="damaged or of another format"):
            read_checkpoint(data, "old.pt")


@settings(max_examples=150, deadline=None)
@given(st.integers(0, len(PLAIN) - 1), st.binary(min_size=1, max_size=4), st.integers(0, len(PLAIN)))
def test_damaged_bytes_give_tensors_or_a_model_error(at: int, replacement: bytes, end: int) -> None:
    for data in (PLAIN[:at] + replacement + PLAIN[at + len(replacement) :], PLAIN[:end]):
        try:
            tensors = read_checkpoint(data, "damaged.pt")
        except ModelError:
            continue
        assert all(isinstance(array, np.ndarray) for array in tensors.values())


@settings(max_examples=200, deadline=None)
@given(st.binary(max_size=60))
def test_random_programs_give_tensors_or_a_model_error(program: bytes) -> None:
    data = _checkpoint(b"\x80\x02ccollections\nOrderedDict\n)R(" + program + b"u.", _0=VALUES.tobytes())
    with contextlib.suppress(ModelError):
        read_checkpoint(data, "random.pt")
