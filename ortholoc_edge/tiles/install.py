"""A finished folder to its place, so that there is always the old one or the new one, whatever happens when."""

from __future__ import annotations

import ctypes
import errno
import fcntl
import logging
import os
import shutil
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from ortholoc_edge.errors import MapError

logger = logging.getLogger(__name__)

_AT_FDCWD = -100
_RENAME_EXCHANGE = 2
# Records of finished pieces of work, and sources that were made plain.
_WORTH_KEEPING = (".record", ".tif")


@contextmanager
def work_folder(out: Path) -> Iterator[Path]:
    """The hidden folder beside ``out`` where a build is prepared, locked against a second build.

    It outlives an error or a kill, so that the next build goes on there; it is removed after success. An old pack
    that an exchange in two steps left without a name is put back first.
    Raises: MapError if it cannot be made or another build has it.
    """
    folder = out.parent / f".{out.name}.building"
    handle = _locked(folder, out)
    try:
        _put_back(out)
        try:
            yield folder
        except BaseException:
            # Hours of work are kept for the next build, a refusal leaves nothing.
            if any(path.suffix in _WORTH_KEEPING for path in folder.rglob("*")):
                logger.warning("%s: keeps what is done for the next build of this pack", folder)
            else:
                shutil.rmtree(folder, ignore_errors=True)
            raise
        shutil.rmtree(folder, ignore_errors=True)
    finally:
        os.close(handle)


def _locked(folder: Path, out: Path) -> int:
    """Make the folder and lock it; its descriptor, which holds the lock."""
    while True:
        try:
            folder.mkdir(parents=True, exist_ok=True)
            handle = os.open(folder, os.O_RDONLY)
        except OSError as err:
            raise MapError(f"{folder}: cannot be made ({err.strerror}); check the path and its permissions") from err
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            mine = os.fstat(handle)
            # The build that had the lock may have removed the folder since it was opened here.
            if folder.exists() and os.path.samestat(mine, folder.stat()):
                return handle
        except OSError as err:
            os.close(handle)
            if err.errno not in (errno.EWOULDBLOCK, errno.EACCES):
                raise MapError(f"{folder}: cannot be locked ({err.strerror}); choose another file system") from err
            raise MapError(f"{out}: another build is writing this pack; wait for it or stop it") from err
        os.close(handle)


def _put_back(out: Path) -> None:
    """Mend an exchange in two steps that was cut off. Only under the lock: it may be another build's at this moment."""
    aside = _aside(out)
    try:
        if aside.exists() and out.exists():
            shutil.rmtree(aside)
        elif aside.exists():
            logger.warning("%s: put back; a build was cut off while it replaced it", out)
            aside.rename(out)
    except OSError as err:
        raise MapError(f"{aside}: the pack that was at {out} cannot be put back ({err}); rename it by hand") from err


def install(staged: Path, out: Path) -> None:
    """Give ``staged`` the name ``out``. What was there before is deleted; until then it can be opened.

    Raises: OSError.
    """
    sync_tree(staged)
    if not out.exists():
        staged.rename(out)
    elif _exchanged(staged, out):
        _sync(out.parent)
        shutil.rmtree(staged, ignore_errors=True)
    else:
        # No exchange on this file system: for a moment there is no pack of this name; `work_folder` mends that.
        aside = _aside(out)
        out.rename(aside)
        try:
            staged.rename(out)
        except BaseException:
            aside.rename(out)
            raise
        _sync(out.parent)
        shutil.rmtree(aside, ignore_errors=True)
    _sync(out.parent)


def sync_tree(folder: Path) -> None:
    """Everything below ``folder`` on the disk itself."""
    for path in (*folder.rglob("*"), folder):
        _sync(path)


def _aside(out: Path) -> Path:
    return out.parent / f".{out.name}.replaced"


def _exchanged(one: Path, other: Path) -> bool:
    """Swap two names in one step; False where the system cannot."""
    if not sys.platform.startswith("linux"):
        return False
    rename = getattr(ctypes.CDLL(None, use_errno=True), "renameat2", None)
    if rename is None:
        return False
    if rename(_AT_FDCWD, os.fsencode(one), _AT_FDCWD, os.fsencode(other), _RENAME_EXCHANGE) == 0:
        return True
    code = ctypes.get_errno()
    if code in (errno.ENOSYS, errno.EINVAL, errno.ENOTSUP):
        return False
    raise OSError(code, os.strerror(code), str(other))


def _sync(path: Path) -> None:
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
