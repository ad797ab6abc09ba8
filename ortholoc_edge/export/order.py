"""What `models build` is asked for, and the files that it takes: licence, hashes, fetching. Needs no PyTorch."""

from __future__ import annotations

import http.client
import urllib.error
import urllib.request
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from ortholoc_edge.errors import ConfigError, ModelError
from ortholoc_edge.matching.exported import ExportedMatcher, WeightsFile, file_sha256, where_from

_TIMEOUT_S: Final = 60.0
_CHUNK_BYTES: Final = 1 << 20

Size = tuple[int, int]


@dataclass(frozen=True, slots=True)
class Order:
    """What to build of.

    Attributes:
        weights: files by part.
        sha256: their hashes by part, as the user knows them.
        fetch: whether what is not given may be fetched from its official address.
        accept_non_commercial: the yes that such a licence takes.
        random_weights: instead of files; only for tests.
        small: of random weights: a network of the same kind with fewer layers.
        size, fine_size: (width, height) px instead of the catalogue's.
        wheel: a copy of the pinned wheel with the networks' code.
    """

    weights: Mapping[str, Path] = field(default_factory=dict)
    sha256: Mapping[str, str] = field(default_factory=dict)
    fetch: bool = False
    accept_non_commercial: bool = False
    random_weights: bool = False
    small: bool = False
    size: Size | None = None
    fine_size: Size | None = None
    wheel: Path | None = None


def check_order(entry: ExportedMatcher, order: Order) -> None:
    """Raises: ModelError for a licence without the yes that it takes, and for files that are missing; ConfigError for
    an order that contradicts itself."""
    parts = [file.part for file in entry.files]
    for given in (*order.weights, *order.sha256):
        if given not in parts:
            raise ConfigError(f"matcher {entry.name} has no weights {given!r}; its parts are {', '.join(parts)}")
    if entry.non_commercial and not order.accept_non_commercial:
        raise ModelError(
            f"matcher {entry.name}: the licence of its weights and code ({entry.licence}) forbids commercial use; "
            "if yours is not, say so with --accept-non-commercial"
        )
    if order.random_weights:
        if order.weights or order.fetch:
            raise ConfigError(f"matcher {entry.name}: random weights or files of weights, not both")
        return
    if order.small:
        raise ConfigError(f"matcher {entry.name}: published weights fit the whole network only")
    lacking = [file for file in entry.files if file.part not in order.weights]
    if lacking and not order.fetch:
        several = len(entry.files) > 1
        flags = " ".join(f"--weights {f'{file.part}=' if several else ''}{file.file}" for file in lacking)
        fetchable = all(file.address is not None and file.sha256 is not None for file in lacking)
        remedy = f", or let them be fetched with --fetch ({', '.join(str(file.address) for file in lacking)})"
        raise ModelError(f"matcher {entry.name} needs {where_from(entry)}; give {flags}{remedy if fetchable else ''}")


def checked(path: Path, file: WeightsFile, sha256: str | None) -> tuple[str, bool]:
    """The file's hash, and whether it was compared with one that we or the user know.

    Raises: ModelError if it differs or can't be read.
    """
    try:
        actual = file_sha256(path)
    except OSError as err:
        raise ModelError(f"weights {path} can't be read ({err.strerror}); check the path") from err
    for expected, whose in ((file.sha256, f"of {file.file} of {file.project}"), (sha256, "that was given")):
        if expected is not None and actual != expected.lower():
            raise ModelError(
                f"weights {path}: SHA-256 is {actual}, {whose} {expected.lower()}; get {file.file} from {file.project}"
            )
    return actual, file.sha256 is not None or sha256 is not None


def fetch(file: WeightsFile, folder: Path) -> Path:
    """The file from its official address, kept in ``folder``; nothing is fetched where it is there already.

    Raises: ModelError if it can't be had, differs, or has no address or no hash that it could be compared with.
    """
    by_hand = f"get {file.file} from {file.project} yourself and give it with --weights"
    if file.address is None or file.sha256 is None:
        lacks = "address" if file.address is None else "SHA-256"
        raise ModelError(
            f"weights {file.file} of {file.project} can't be fetched: no lasting {lacks} is known; {by_hand}"
        )
    target = folder / file.file
    if target.is_file() and file_sha256(target) == file.sha256:
        return target
    folder.mkdir(parents=True, exist_ok=True)
    partial = folder / f".{file.file}.partial"
    try:
        with urllib.request.urlopen(file.address, timeout=_TIMEOUT_S) as answer, partial.open("wb") as out:
            while chunk := answer.read(_CHUNK_BYTES):
                out.write(chunk)
        checked(partial, file, None)
        partial.replace(target)
    except (urllib.error.URLError, http.client.HTTPException, TimeoutError) as err:
        raise ModelError(f"weights {file.address} can't be fetched ({err}); check the network, or {by_hand}") from err
    finally:
        partial.unlink(missing_ok=True)
    return target
