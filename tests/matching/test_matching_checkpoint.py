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
from ortholoc_edge.matching import torch_checkpoint
from ortholoc_edge.matching.torch_checkpoint import read_checkpoint


def _text(value: str) -> bytes:
    return b"X" + struct.pack("<I", len(value)) + value.encode()


def _int(value: int) -> bytes:
    return b"J" + struct.pack("<i", value)


def _ints(values: tuple[int, ...]) -> bytes:
    return b"(" + b"".join(map(_int, values)) + b"t"


def _tensor(
    key: str, offset: int, size: tuple[int, ...], stride: tuple[int, ...], kind: str = "Float", end: bytes = b"tQ",
    count: int = 99,
) -> bytes:  # fmt: skip
    storage = b"(" + _text("storage") + f"ctorch\n{kind}Storage\n".encode() + _text(key) + _text("cpu") + _int(count)
    return (
        b"ctorch._utils\n_rebuild_tensor_v2\n("
        + (storage + end + _int(offset) + _ints(size) + _ints(stride))
        + b"\x89ccollections\nOrderedDict\n)RtR"
    )


def _older(key: str, offset: int, size: tuple[int, ...], stride: tuple[int, ...], kind: str = "Float", **how) -> bytes:
    """The older format's: a storage has a sixth part, of no view."""
    return _tensor(key, offset, size, stride, kind, end=b"NtQ", **{"count": 12, **how})


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


MAGIC = pickle.dumps(0x1950A86A20F9469CFC6C, 2)
VERSION = pickle.dumps(1001, 2)
MACHINE = pickle.dumps({"protocol_version": 1001, "little_endian": True, "type_sizes": {"int": 4}}, 2)


def _older_file(program: bytes, *storages: tuple[str, bytes, int], tail: bytes = b"") -> bytes:
    keys = pickle.dumps([key for key, _, _ in storages], 2)
    numbers = b"".join(struct.pack("<q", count) + data for _, data, count in storages)
    return MAGIC + VERSION + MACHINE + program + keys + numbers + tail


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
TWELVE = ("7001", VALUES.tobytes(), 12)
ONE = ("9", np.array([7], "<i8").tobytes(), 1)
PLAIN_OLDER = _older_file(
    _state_dict(
        whole=_older("7001", 0, (3, 4), (4, 1)),
        part=_older("7001", 5, (2,), (1,)),
        turned=_older("7001", 0, (4, 3), (1, 4)),
        scalar=_older("9", 0, (), (), "Long", count=1),
    ),
    ONE,
    TWELVE,
)


@pytest.mark.parametrize("data", [PLAIN, PLAIN_OLDER], ids=["zip", "older"])
def test_tensors_have_their_type_shape_and_strides(data: bytes) -> None:
    tensors = read_checkpoint(data, "x.pt")
    assert list(tensors) == ["whole", "part", "turned", "scalar"]
    np.testing.assert_array_equal(tensors["whole"], VALUES.reshape(3, 4))
    np.testing.assert_array_equal(tensors["part"], [5, 6])
    np.testing.assert_array_equal(tensors["turned"], VALUES.reshape(3, 4).T)
    assert tensors["scalar"].dtype == np.int64
    assert tensors["scalar"] == 7


def test_a_dictionary_in_the_dictionary_gives_both_names() -> None:
    inner = _state_dict(a=_tensor("0", 0, (2,), (1,)), b=_tensor("0", 2, (2,), (1,)))[2:-1]
    tensors = read_checkpoint(_checkpoint(_state_dict(net=inner, c=_tensor("0", 4, (1,), (1,))), _0=VALUES), "x.pt")
    assert {name: values.tolist() for name, values in tensors.items()} == {
        "net.a": [0, 1], "net.b": [2, 3], "c": [4],
    }  # fmt: skip
    deeper = _state_dict(net=_state_dict(net=inner)[2:-1])
    with pytest.raises(ModelError, match=r"entry 'net\.net' is a OrderedDict, not a tensor"):
        read_checkpoint(_checkpoint(deeper, _0=VALUES), "x.pt")
    # One that holds itself.
    with pytest.raises(ModelError, match=r"entry 'me\.me' is a dict, not a tensor"):
        read_checkpoint(_checkpoint(b"\x80\x02}q\x00" + _text("me") + b"h\x00s."), "x.pt")


class _Runs:
    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[object, tuple[str]]:
        return os.mkdir, (str(self.path),)


@pytest.mark.parametrize("protocol", range(2, pickle.HIGHEST_PROTOCOL + 1))
def test_a_pickle_that_runs_something_is_refused(tmp_path: Path, protocol: int) -> None:
    trap = tmp_path / "sprung"
    program = pickle.dumps(_Runs(trap), protocol=protocol)
    older = [MAGIC, VERSION, MACHINE, program, pickle.dumps([], 2)]
    # In each of the older format's five pickles.
    files = [b"".join([*older[:at], program, *older[at + 1 :]]) for at in range(len(older))]
    for data in (_checkpoint(program), *files):
        with pytest.raises(ModelError, match=r"checkpoint evil\.pt: refused"):
            read_checkpoint(data, "evil.pt")
        assert not trap.exists()


@pytest.mark.parametrize(
    "name",
    ["builtins\neval", "torch\nload", "collections\nnamedtuple", "torch._utils\n_rebuild_wrapper_subclass", "a\\o\nb"],
)
def test_a_name_off_the_list_is_refused(name: str) -> None:
    program = b"\x80\x02c" + name.encode() + b"\n)R."
    for data in (_checkpoint(program), _older_file(program)):
        with pytest.raises(ModelError, match="refused: it asks for"):
            read_checkpoint(data, "evil.pt")


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


@pytest.mark.parametrize(
    ("tensor", "storages", "words"),
    [
        (_older("7001", 1, (3, 4), (4, 1)), [TWELVE], "past its storage"),
        (_older("7001", -1, (3,), (1,)), [TWELVE], "impossible shape"),
        (_older("7001", 0, (1 << 20, 1 << 20), (0, 0)), [TWELVE], "repeats"),
        (_older("8", 0, (1,), (1,)), [TWELVE], "not those that its tensors are in"),
        (_older("7001", 0, (1,), (1,)), [TWELVE, ONE], "not those that its tensors are in"),
        (_older("7001", 0, (1,), (1,)), [TWELVE, TWELVE], "not those that its tensors are in"),
        (_older("7001", 0, (1,), (1,), count=13), [TWELVE], "should have 13 values; 12 are announced"),
        (_older("7001", 0, (1,), (1,), count=-1), [TWELVE], "unknown way"),
        (_older("7001", 0, (1,), (1,), count=1 << 30), [("7001", b"", 1 << 30)], "the file is cut"),
        (_older("7001", 0, (1,), (1,), "Double"), [TWELVE], "the file is cut"),
        (_tensor("7001", 0, (1,), (1,)), [TWELVE], "unknown way"),
        # A view of another storage, as torch before 0.4 wrote.
        (_tensor("7001", 0, (1,), (1,), end=_ints((1, 2)) + b"tQ"), [TWELVE], "unknown way"),
        (_ints((1, 2)), [], "not a tensor"),
    ],
)
def test_impossible_older_content_is_an_error_that_says_so(
    tensor: bytes, storages: list[tuple[str, bytes, int]], words: str
) -> None:
    with pytest.raises(ModelError, match=words):
        read_checkpoint(_older_file(_state_dict(w=tensor), *storages), "odd.pth")


def test_a_storage_of_two_types_is_refused() -> None:
    floats, doubles = _older("7001", 0, (2,), (1,)), _older("7001", 0, (6,), (1,), "Double")
    with pytest.raises(ModelError, match="two ways"):
        read_checkpoint(_older_file(_state_dict(a=floats, b=doubles), TWELVE), "odd.pth")
    # A description that the reader of storages never saw would reach past the numbers.
    unseen = _tensor("7001", 0, (12,), (1,), "Double", end=b"Nt", count=12)
    with pytest.raises(ModelError, match="of float64 is not among those"):
        read_checkpoint(_older_file(_state_dict(a=floats, b=unseen), TWELVE), "odd.pth")


def test_the_older_formats_head_and_end_are_checked() -> None:
    program = _state_dict(w=_older("7001", 0, (12,), (1,)))
    plain = _older_file(program, TWELVE)
    assert len(read_checkpoint(plain, "x.pth")["w"]) == 12
    with pytest.raises(ModelError, match="version 1002"):
        read_checkpoint(plain.replace(VERSION, pickle.dumps(1002, 2)), "x.pth")
    for other in ({"little_endian": False}, [1], {}):
        with pytest.raises(ModelError, match="not little-endian"):
            read_checkpoint(plain.replace(MACHINE, pickle.dumps(other, 2)), "x.pth")
    with pytest.raises(ModelError, match="3 bytes follow"):
        read_checkpoint(plain + b"abc", "x.pth")


def test_files_that_are_no_checkpoint_are_errors() -> None:
    for data in (b"", b"PK", pickle.dumps({"a": 1}, protocol=2), PLAIN_OLDER[:-1], MAGIC, MAGIC + VERSION + MACHINE):
        with pytest.raises(ModelError, match=r"damaged or of another format|the file is cut"):
            read_checkpoint(data, "old.pt")


@pytest.mark.parametrize("limit", ["_MAX_TENSORS", "MAX_TENSOR_BYTES"])
def test_many_tensors_of_one_storage_are_bounded(monkeypatch: pytest.MonkeyPatch, limit: str) -> None:
    tensors = {f"w{number}": _older("7001", 0, (12,), (1,)) for number in range(40)}
    data = _older_file(_state_dict(**tensors), TWELVE)
    assert len(read_checkpoint(data, "many.pth")) == 40
    monkeypatch.setattr(torch_checkpoint, limit, 39 if limit == "_MAX_TENSORS" else 40 * VALUES.nbytes - 1)
    with pytest.raises(ModelError, match="its tensors are more than"):
        read_checkpoint(data, "many.pth")


@settings(max_examples=150, deadline=None)
@given(st.booleans(), st.data())
def test_damaged_bytes_give_tensors_or_a_model_error(older: bool, drawn: st.DataObject) -> None:
    plain = PLAIN_OLDER if older else PLAIN
    at, end = drawn.draw(st.integers(0, len(plain) - 1)), drawn.draw(st.integers(0, len(plain)))
    replacement = drawn.draw(st.binary(min_size=1, max_size=4))
    for data in (plain[:at] + replacement + plain[at + len(replacement) :], plain[:end]):
        try:
            tensors = read_checkpoint(data, "damaged.pt")
        except ModelError:
            continue
        assert all(isinstance(array, np.ndarray) for array in tensors.values())


@settings(max_examples=200, deadline=None)
@given(st.binary(max_size=60))
def test_random_programs_give_tensors_or_a_model_error(program: bytes) -> None:
    content = b"\x80\x02ccollections\nOrderedDict\n)R(" + program + b"u."
    for data in (_checkpoint(content, _0=VALUES.tobytes()), _older_file(content, TWELVE)):
        with contextlib.suppress(ModelError):
            read_checkpoint(data, "random.pt")
