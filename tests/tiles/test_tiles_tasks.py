"""Pieces of work: the same bytes wherever they run, done once, and never trusted blindly."""

import dataclasses
import logging
import signal
import socket
import time
from pathlib import Path

import pytest
from tile_rasters import contents

from ortholoc_edge.errors import ConfigError, MapError
from ortholoc_edge.parallel import Workers, check_seen
from ortholoc_edge.tiles import build, tasks
from ortholoc_edge.tiles.area import read_area
from ortholoc_edge.tiles.build import PackOptions, build_pack
from ortholoc_edge.tiles.lattice import Lattice, PixelBox
from ortholoc_edge.tiles.tasks import DopJob, DsmJob, PrepareJob, Record, finished, job_name, run_all

OPTIONS = PackOptions(vertical="unknown")
DOP_TILES, DSM_TILES = 4, 2


def built(scene, out, *, workers=None, **options):
    return build_pack(*scene, out, dataclasses.replace(OPTIONS, **options), workers=workers)


@pytest.fixture(scope="module")
def expected(wide_scene, tmp_path_factory):
    """What an uninterrupted build in one process gives, by quality."""
    made = {}

    def get(quality=85):
        if quality not in made:
            out = tmp_path_factory.mktemp("expected") / "pack"
            made[quality] = contents(built(wide_scene, out, quality=quality).path)
        return made[quality]

    return get


class Interrupted(Exception):  # noqa: N818
    pass


@pytest.fixture
def ran(monkeypatch):
    """Names of the kinds of work that ran; after ``ran.limit`` tiles the build is interrupted."""

    class Ran(list):
        limit = 10**9

        @property
        def tiles(self):
            return [kind for kind in self if kind != "PrepareJob"]

    calls = Ran()

    def counted(job, folder):
        if not isinstance(job, PrepareJob) and len(calls.tiles) >= calls.limit:
            raise Interrupted
        calls.append(type(job).__name__)
        return original(job, folder)

    original = tasks.run_job
    monkeypatch.setattr(tasks, "run_job", counted)
    return calls


def test_scene_has_several_tiles(expected):
    names = [name for name in expected() if name.endswith(".tif")]
    assert sum(name.startswith("dop/") for name in names) == DOP_TILES
    assert sum(name.startswith("dsm/") for name in names) == DSM_TILES


def test_processes_give_the_same_bytes(wide_scene, tmp_path, expected):
    # An area travels to the workers as a pickle, and must be the same piece of work there.
    area = read_area("400950,5299100,402000,5299850", None)
    one = built(wide_scene, tmp_path / "one", area=area)
    two = built(wide_scene, tmp_path / "two", area=area, workers=Workers(2))
    assert contents(one.path) == contents(two.path)
    assert contents(built(wide_scene, tmp_path / "all", workers=Workers(3)).path) == expected()


@pytest.mark.parametrize("after", [0, 3, 5])
def test_interrupted_build_does_only_the_rest(wide_scene, tmp_path, expected, ran, after):
    out = tmp_path / "pack"
    ran.limit = after
    with pytest.raises(Interrupted):
        built(wide_scene, out)
    assert not out.exists()
    assert len(ran.tiles) == after
    ran.clear()
    ran.limit = 10**9
    built(wide_scene, out)
    assert len(ran.tiles) == DOP_TILES + DSM_TILES - after
    assert contents(out) == expected()
    assert [path.name for path in tmp_path.iterdir()] == ["pack"]


def test_another_quality_keeps_the_heights(wide_scene, tmp_path, expected, ran, monkeypatch):
    out = tmp_path / "pack"

    def full(staged, target):
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(build, "install", full)
        with pytest.raises(MapError, match="No space left"):
            built(wide_scene, out)
    assert sorted(ran.tiles) == ["DopJob"] * DOP_TILES + ["DsmJob"] * DSM_TILES
    ran.clear()
    built(wide_scene, out, quality=50)
    assert ran.tiles == ["DopJob"] * DOP_TILES
    assert contents(out) == expected(50)


def test_touched_source_is_read_again(wide_scene, tmp_path, ran):
    out = tmp_path / "pack"
    sources = [tmp_path / path.name for path in wide_scene]
    for copy, path in zip(sources, wide_scene, strict=True):
        copy.write_bytes(path.read_bytes())
    with pytest.raises(ZeroDivisionError):
        build_pack(*sources, out, OPTIONS, progress=lambda done, what: 1 / (done < 0.9))
    ran.clear()
    later = sources[1].stat().st_mtime_ns + 10**9
    build.os.utime(sources[1], ns=(later, later))
    built(sources, out)
    assert ran.tiles == ["DsmJob"] * DSM_TILES


def _damage(kind, path):
    data = bytearray(path.read_bytes())
    if kind == "cut":
        del data[len(data) // 2 :]
    elif kind == "empty":
        data.clear()
    else:
        data[len(data) // 2 if kind == "middle" else -1] ^= 1
    path.write_bytes(data)


@pytest.mark.parametrize("kind", ["cut", "empty", "middle", "end", "gone"])
@pytest.mark.parametrize("what", ["records", "tiles"])
def test_damaged_leftovers_are_done_again(wide_scene, tmp_path, expected, ran, what, kind):
    out = tmp_path / "pack"
    ran.limit = 4
    with pytest.raises(Interrupted):
        built(wide_scene, out)
    left = [p for p in (tmp_path / ".pack.building" / "work").iterdir() if p.is_file()]
    files = sorted(p for p in left if (p.suffix == ".record") == (what == "records"))
    assert len(files) == 4
    for path in files[:2]:
        if kind == "gone":
            path.unlink()
        else:
            _damage(kind, path)
    ran.clear()
    ran.limit = 10**9
    built(wide_scene, out)
    assert len(ran.tiles) == DOP_TILES + DSM_TILES - 4 + 2
    assert contents(out) == expected()


def test_second_build_is_refused(wide_scene, tmp_path):
    out = tmp_path / "pack"
    refused = []

    def second(fraction, message):
        if fraction > 0.3 and not refused:
            with pytest.raises(MapError, match="another build is writing this pack") as caught:
                built(wide_scene, out)
            refused.append(caught.value)

    pack = build_pack(*wide_scene, out, OPTIONS, progress=second)
    assert refused
    assert pack.verify() == []
    assert [path.name for path in tmp_path.iterdir()] == ["pack"]


def test_name_of_a_job_is_of_all_that_goes_in(wide_scene):
    source = build.discover([wide_scene[0]], "dop")[0]
    lattice = Lattice.over((0, 0, 1000, 1000), 2.0)
    area, other = (read_area(f"400950,5299100,40{k}500,5299850", None).on_map("EPSG:32633") for k in (1, 2))
    job = DopJob((source,), lattice, PixelBox(0, 0, 64, 64), "EPSG:32633", area, "webp", 75)
    assert job_name(job) == job_name(tasks_over_a_pipe(job))
    changed = [
        dataclasses.replace(job, **change)
        for change in (
            {"sources": (source, source)},
            {"lattice": Lattice.over((0, 0, 1000, 1000), 4.0)},
            {"box": PixelBox(64, 0, 64, 64)},
            {"crs": "EPSG:32632"},
            {"area": None},
            {"area": other},
            {"compression": "jpeg"},
            {"quality": 74},
        )
    ]
    heights = DsmJob((source,), lattice, job.box, job.crs, area, 0.02, 16)
    changed += [heights, dataclasses.replace(heights, max_z_error_m=0.03)]
    changed += [dataclasses.replace(heights, max_hole_cells=0)]
    assert len({job_name(one) for one in (job, *changed)}) == 1 + len(changed)


def tasks_over_a_pipe(job):
    import pickle

    return pickle.loads(pickle.dumps(pickle.loads(pickle.dumps(job))))


@dataclasses.dataclass(frozen=True)
class Kill:
    """A piece of work whose process dies as for lack of memory."""

    number: int


def _die(job, folder):
    signal.raise_signal(signal.SIGKILL)


def test_death_of_a_process_is_said(tmp_path, monkeypatch):
    monkeypatch.setattr(tasks, "_guarded", _die)
    with pytest.raises(MapError, match=r"process of the build died.*--jobs 1"):
        list(run_all([Kill(1), Kill(2), Kill(3)], tmp_path, Workers(2)))


def _raise(job, folder):
    raise [ValueError("surprise"), MemoryError(), ConfigError("yours"), MapError("theirs")][job.number]


@pytest.mark.parametrize(
    ("number", "kind", "message"),
    [
        (0, MapError, "unexpectedly, please report it:\n(.*\n)*ValueError: surprise"),
        (1, MapError, "--jobs 1"),
        (2, ConfigError, "yours"),
        (3, MapError, "theirs"),
    ],
)
def test_errors_of_a_piece_come_back_as_the_package_s(tmp_path, monkeypatch, number, kind, message):
    monkeypatch.setattr(tasks, "run_job", _raise)
    with pytest.raises(kind, match=message):
        tasks._unpacked(tasks._guarded(Kill(number), tmp_path))


def test_finished_without_anything(tmp_path, wide_scene):
    source = build.discover([wide_scene[1]], "dsm")[0]
    job = DsmJob((source,), Lattice.over(source.grid.bounds, 4.0), PixelBox(0, 0, 64, 64), source.crs, None, 0.02, 16)
    assert finished(job, tmp_path) is None
    [(_, record)] = run_all([job], tmp_path)
    assert isinstance(record, Record)
    assert finished(job, tmp_path) == record


# -- Dask ----------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def cluster():
    """A scheduler and two worker processes on this machine."""
    distributed = pytest.importorskip("dask.distributed")
    with distributed.LocalCluster(
        n_workers=2,
        threads_per_worker=1,
        processes=True,
        host="127.0.0.1",
        dashboard_address="127.0.0.1:0",
        silence_logs=logging.ERROR,
    ) as made:
        yield made


@pytest.mark.filterwarnings("default")  # Dask's own, of its threads and its event loop.
def test_dask_gives_the_same_bytes(wide_scene, tmp_path, expected, cluster):
    workers = Workers(dask=cluster.scheduler_address)
    pack = built(wide_scene, tmp_path / "pack", workers=workers)
    assert contents(pack.path) == expected()
    area = read_area("400950,5299100,402000,5299850", None)
    pack = built(wide_scene, tmp_path / "part", area=area, workers=workers)
    assert contents(pack.path) == contents(built(wide_scene, tmp_path / "alone", area=area).path)


@pytest.mark.filterwarnings("default")
def test_dask_takes_up_what_was_done(wide_scene, tmp_path, expected, cluster, ran):
    out = tmp_path / "pack"
    ran.limit = 5
    with pytest.raises(Interrupted):
        built(wide_scene, out)
    before = {p: p.stat().st_mtime_ns for p in (tmp_path / ".pack.building" / "work").glob("*.record")}
    assert len(before) == 5
    seen = {}

    def look(fraction, message):
        seen.update({p: p.stat().st_mtime_ns for p in before if p.exists()})

    build_pack(*wide_scene, out, OPTIONS, look, Workers(dask=cluster.scheduler_address))
    assert seen == before
    assert contents(out) == expected()


@pytest.mark.filterwarnings("default")
def test_dask_error_of_a_piece_is_the_builder_s(wide_scene, tmp_path, cluster):
    broken = tmp_path / "broken.tif"
    broken.write_bytes(wide_scene[1].read_bytes()[:200_000])
    with pytest.raises(MapError, match=r"broken\.tif: cannot be read"):
        built((wide_scene[0], broken), tmp_path / "pack", workers=Workers(dask=cluster.scheduler_address))


@pytest.mark.filterwarnings("default")
def test_dask_worker_must_see_the_folder(wide_scene, tmp_path, cluster, monkeypatch):
    class Elsewhere:
        """A client whose second worker has another file system."""

        def run(self, function, probe):
            assert function(probe)
            return {"tcp://one:1": True, "tcp://two:2": False}

    with pytest.raises(ConfigError, match=r"worker tcp://two:2 does not see .*all workers share"):
        check_seen(Elsewhere(), tmp_path, "tcp://s:1")


@pytest.mark.filterwarnings("default")
def test_dask_without_workers(wide_scene, tmp_path):
    distributed = pytest.importorskip("dask.distributed")
    with (
        distributed.LocalCluster(
            n_workers=0, host="127.0.0.1", dashboard_address="127.0.0.1:0", silence_logs=logging.ERROR
        ) as empty,
        pytest.raises(ConfigError, match=r"has no workers; start some with: dask worker"),
    ):
        built(wide_scene, tmp_path / "pack", workers=Workers(dask=empty.scheduler_address))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.filterwarnings("default")
def test_dask_wrong_address(wide_scene, tmp_path):
    pytest.importorskip("dask.distributed")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    start = time.monotonic()
    with pytest.raises(ConfigError, match="no scheduler answers"):
        built(wide_scene, tmp_path / "pack", workers=Workers(dask=f"tcp://127.0.0.1:{port}"))
    assert time.monotonic() - start < 15.0
    with pytest.raises(ConfigError, match="no scheduler answers"):
        built(wide_scene, tmp_path / "pack", workers=Workers(dask="nonsense://x"))
    assert list(tmp_path.iterdir()) == []
    assert not Path("dask-worker-space").exists()
