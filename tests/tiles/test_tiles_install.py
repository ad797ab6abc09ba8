"""A pack takes its place in one step, or in two that the next build mends."""

import fcntl
import logging
import os
import subprocess
import sys

import pytest
from tile_rasters import contents

from ortholoc_edge.errors import MapError
from ortholoc_edge.tiles import install
from ortholoc_edge.tiles.build import PackOptions, build_pack
from ortholoc_edge.tiles.install import work_folder
from ortholoc_edge.tiles.pack import Pack


def folder(path, text):
    path.mkdir(parents=True)
    (path / "manifest.json").write_text(text)
    return path


def text_of(path):
    return (path / "manifest.json").read_text()


@pytest.fixture(params=["exchange", "two steps"])
def way(request, monkeypatch):
    if request.param == "two steps":
        monkeypatch.setattr(install, "_exchanged", lambda one, other: False)
    return request.param


def test_new_name(tmp_path, way):
    install.install(folder(tmp_path / "staged", "new"), tmp_path / "pack")
    assert text_of(tmp_path / "pack") == "new"
    assert [path.name for path in tmp_path.iterdir()] == ["pack"]


def test_replacement(tmp_path, way):
    folder(tmp_path / "pack", "old")
    install.install(folder(tmp_path / "staged", "new"), tmp_path / "pack")
    assert text_of(tmp_path / "pack") == "new"
    assert [path.name for path in tmp_path.iterdir()] == ["pack"]


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="renameat2 is Linux's")
def test_exchange_is_one_step(tmp_path):
    one, other = folder(tmp_path / "one", "1"), folder(tmp_path / "other", "2")
    assert install._exchanged(one, other)
    assert (text_of(one), text_of(other)) == ("2", "1")
    with pytest.raises(OSError, match="No such file"):
        install._exchanged(one, tmp_path / "missing")


def test_second_step_that_fails_puts_the_old_one_back(tmp_path, monkeypatch):
    folder(tmp_path / "pack", "old")
    staged = folder(tmp_path / "staged", "new")
    monkeypatch.setattr(install, "_exchanged", lambda one, other: False)
    rename = install.Path.rename

    def failing(self, target):
        if self.name == "staged":
            raise OSError(5, "Input/output error")
        return rename(self, target)

    monkeypatch.setattr(install.Path, "rename", failing)
    with pytest.raises(OSError, match="Input/output error"):
        install.install(staged, tmp_path / "pack")
    assert text_of(tmp_path / "pack") == "old"


def test_failed_swap_of_a_build_leaves_the_old_pack(wide_scene, tmp_path, monkeypatch):
    out = tmp_path / "pack"
    build_pack(*wide_scene, out, PackOptions(vertical="unknown"))
    before = contents(out)

    def failing(one, other):
        raise OSError(5, "Input/output error")

    with monkeypatch.context() as patch:
        patch.setattr(install, "_exchanged", failing)
        with pytest.raises(MapError, match="Input/output error"):
            build_pack(*wide_scene, out, PackOptions(vertical="unknown", quality=50, force=True))
    assert contents(out) == before
    build_pack(*wide_scene, out, PackOptions(vertical="unknown", quality=50, force=True))
    assert [path.name for path in tmp_path.iterdir()] == ["pack"]


_KILLED_BETWEEN = """
import os, sys
from pathlib import Path
from ortholoc_edge.tiles import install
from ortholoc_edge.tiles.build import PackOptions, build_pack

rename = install.Path.rename

def killed(self, target):
    if self.name == "pack" and self.parent.name == ".pack.building":
        os._exit(9)
    return rename(self, target)

install._exchanged = lambda one, other: False
install.Path.rename = killed
dop, dsm, out = map(Path, sys.argv[1:])
build_pack(dop, dsm, out, PackOptions(vertical="unknown", quality=50, force=True))
"""


@pytest.fixture
def between_the_steps(wide_scene, tmp_path):
    """Path of a pack whose replacement ended between the two renames, and what the old pack was."""
    out = tmp_path / "pack"
    build_pack(*wide_scene, out, PackOptions(vertical="unknown"))
    before = contents(out)
    done = subprocess.run([sys.executable, "-c", _KILLED_BETWEEN, *map(str, (*wide_scene, out))], check=False)
    assert done.returncode == 9
    assert not out.exists()
    return out, before


def test_next_build_puts_the_old_pack_back(wide_scene, between_the_steps, caplog):
    out, before = between_the_steps

    def refuse(staged):
        assert contents(out) == before
        raise MapError("stop here")

    with caplog.at_level(logging.WARNING), pytest.raises(MapError, match="stop here"):
        build_pack(*wide_scene, out, PackOptions(vertical="unknown", quality=50), finish=refuse)
    assert "put back" in caplog.text
    assert contents(out) == before
    assert Pack.open(out).verify() == []
    with pytest.raises(MapError, match="--force"):
        build_pack(*wide_scene, out, PackOptions(vertical="unknown"))


def test_second_build_does_not_mend_what_the_first_one_does(tmp_path):
    """Between the two steps of a living build, another must not touch the old pack."""
    folder(tmp_path / ".pack.replaced", "old")
    hidden = tmp_path / ".pack.building"
    hidden.mkdir()
    handle = os.open(hidden, os.O_RDONLY)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX)
        with pytest.raises(MapError, match="another build"), work_folder(tmp_path / "pack"):
            pass
        assert not (tmp_path / "pack").exists()
    finally:
        os.close(handle)
    with work_folder(tmp_path / "pack"):
        assert text_of(tmp_path / "pack") == "old"


def test_old_pack_beside_the_new_is_removed(tmp_path):
    folder(tmp_path / "pack", "new")
    folder(tmp_path / ".pack.replaced", "old")
    with work_folder(tmp_path / "pack"):
        assert not (tmp_path / ".pack.replaced").exists()
    assert [path.name for path in tmp_path.iterdir()] == ["pack"]
    assert text_of(tmp_path / "pack") == "new"


def test_work_folder_that_was_removed_meanwhile_is_not_used(tmp_path, monkeypatch):
    """Opened here, removed by the build that had the lock, and locked here: the lock is on nothing."""
    lock = fcntl.flock
    removed = []

    def late(handle, how):
        if not removed:
            removed.append(True)
            (tmp_path / ".pack.building").rmdir()
        return lock(handle, how)

    monkeypatch.setattr(install.fcntl, "flock", late)
    with work_folder(tmp_path / "pack") as work:
        assert work.is_dir()
        with pytest.raises(MapError, match="another build"), work_folder(tmp_path / "pack"):
            pass
    assert list(tmp_path.iterdir()) == []


def test_file_system_without_locks_is_said(tmp_path, monkeypatch):
    def refused(handle, how):
        raise OSError(37, "No locks available")

    monkeypatch.setattr(install.fcntl, "flock", refused)
    with pytest.raises(MapError, match=r"No locks available.*another file system"), work_folder(tmp_path / "pack"):
        pass


@pytest.mark.parametrize(("file", "stays"), [("work/a.record", True), ("work/dop_1.tif", True), ("work/a.part", False)])
def test_what_an_error_leaves(tmp_path, caplog, file, stays):
    with caplog.at_level(logging.WARNING), pytest.raises(ZeroDivisionError), work_folder(tmp_path / "pack") as work:
        (work / file).parent.mkdir()
        (work / file).write_text("")
        raise ZeroDivisionError
    assert (tmp_path / ".pack.building" / file).exists() == stays
    assert ("keeps what is done" in caplog.text) == stays
