"""Many samples: taken up again where a run was cut off, the same on any number of processes and on a cluster, and said
what went wrong."""

from __future__ import annotations

import json
import logging
import os
import signal
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import pytest
from made_samples import made

from ortholoc_edge.bench import campaign, studies
from ortholoc_edge.bench.campaign import RESULTS, Failure, Piece, Plan, Settings, Store
from ortholoc_edge.bench.condition import USUAL, Condition
from ortholoc_edge.bench.paper import PaperOptions, Task
from ortholoc_edge.bench.samples import find_samples, write_sample
from ortholoc_edge.errors import ConfigError, DatasetError, OrtholocError
from ortholoc_edge.parallel import Workers

OPTIONS = PaperOptions(turns=1)
SETTINGS = Settings(working_px=320, max_keypoints=300, options=OPTIONS)
HALF = Condition(covisibility=0.5)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four samples in two of the data set's folders."""
    folder = tmp_path_factory.mktemp("samples")
    sample = made()
    for split, name in (("val", "A_R0000"), ("val", "A_xDOP0000"), ("train", "B_R0000"), ("train", "B_R0001")):
        write_sample(replace(sample, name=name), folder / split)
    return folder


def plan(
    folder: Path, matchers: str = "orb,sift", conditions: tuple[Condition, ...] = (USUAL,), **changes: Any
) -> Plan:
    setups = [campaign.setup_of(name, 320, 300) for name in matchers.split(",")]
    by_matcher = {setup.name: conditions for setup in setups}
    made_plan = Plan(folder, find_samples(folder), setups, by_matcher, [Task.LOCALIZE], (False, True), OPTIONS)
    return replace(made_plan, **changes)


_OPEN: list[Store] = []


@pytest.fixture(autouse=True)
def closed() -> Iterator[None]:
    yield
    while _OPEN:
        _OPEN.pop().close()


def stored(folder: Path) -> Store:
    """One after the other, as runs are."""
    while _OPEN:
        _OPEN.pop().close()
    _OPEN.append(Store(SETTINGS, folder))
    return _OPEN[-1]


def finished(asked: Plan, store: Store, workers: Workers = Workers()) -> list[tuple[int, int, Failure | None]]:  # noqa: B008
    return list(campaign.run(asked, store, workers))


def untimed(pieces: list[Piece]) -> list[Any]:
    """All but the times, which no two runs share."""
    return [
        (p.sample, p.matcher, [msgspec.structs.replace(r, cpu_s=0.0, wall_s=0.0) for r in p.results]) for p in pieces
    ]


def test_pieces_are_one_sample_and_matcher_each(folder: Path) -> None:
    asked, store = plan(folder), Store(SETTINGS)
    told = finished(asked, store)
    assert [(done, total) for done, total, _ in told] == [(k, 8) for k in range(9)]
    pieces = store.pieces(asked.jobs())
    assert [(piece.sample, piece.matcher) for piece in pieces[:3]] == [
        ("train/B_R0000.npz", "orb"), ("train/B_R0000.npz", "sift"), ("train/B_R0001.npz", "orb"),
    ]  # fmt: skip
    assert {(str(piece.kind), str(piece.split)) for piece in pieces} == {("R", "train"), ("R", "val"), ("xDOP", "val")}
    for piece in pieces:
        assert 20.0 < piece.tilt_deg < 30.0
        assert 80.0 < piece.height_m < 110.0
        assert [result.adhop for result in piece.results] == [False, True]


def test_a_run_that_was_cut_off_goes_on(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out = tmp_path / "out"
    asked = plan(folder)
    for count, _ in enumerate(campaign.run(asked, stored(out), Workers())):
        if count == 3:
            break
    lines = (out / RESULTS).read_bytes()
    assert lines.count(b"\n") == 3
    # The power went while it wrote.
    with (out / RESULTS).open("ab") as file:
        file.write(lines.splitlines()[0][:70])
    ran: list[str] = []
    real = campaign.run_job
    monkeypatch.setattr(campaign, "run_job", lambda job: (ran.append(job.key), real(job))[1])
    store = stored(out)
    told = finished(asked, store)
    assert (told[0][:2], told[-1][:2], len(ran)) == ((3, 8), (8, 8), 5)
    assert (out / RESULTS).read_bytes().startswith(lines)
    whole = Store(SETTINGS)
    finished(asked, whole)
    assert untimed(store.pieces(asked.jobs())) == untimed(whole.pieces(asked.jobs()))


def test_what_is_asked_later_is_added(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out = tmp_path / "out"
    finished(plan(folder, "orb"), stored(out))
    seen: list[tuple[Condition, ...]] = []
    real = campaign.run_job
    monkeypatch.setattr(campaign, "run_job", lambda job: (seen.append(job.conditions), real(job))[1])
    more, store = plan(folder, "orb", (USUAL, HALF)), stored(out)
    finished(more, store)
    assert seen == [(HALF,)] * 4
    for piece in store.pieces(more.jobs()):
        assert [r.condition for r in piece.results] == [USUAL, USUAL, HALF, HALF]
    # And of what is there only what is asked for is shown.
    (first, *_) = store.pieces(plan(folder, "orb", adhop=(True,)).jobs())
    assert [(r.condition, r.adhop) for r in first.results] == [(USUAL, True)]


def test_a_sample_that_has_changed_is_measured_again(folder: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    asked = plan(folder, "orb")
    finished(asked, stored(out))
    changed = folder / "val" / "A_R0000.npz"
    os.utime(changed, (1_700_000_000, 1_700_000_000))
    store = stored(out)
    assert [job.sample for job in asked.jobs() if store.missing(job) is not None] == ["val/A_R0000.npz"]


def test_other_settings_do_not_go_into_one_table(folder: Path, tmp_path: Path) -> None:
    stored(tmp_path).close()
    with pytest.raises(ConfigError, match=r"holds a run with working_px 320 instead of 640;.*another --out"):
        Store(msgspec.structs.replace(SETTINGS, working_px=640), tmp_path)
    (tmp_path / campaign.SETTINGS).write_text("[]", encoding="utf-8")
    with pytest.raises(ConfigError, match=r"settings\.json: not a benchmark's settings"):
        stored(tmp_path)


def test_two_runs_at_once_do_not_share_a_folder(tmp_path: Path) -> None:
    first = stored(tmp_path)
    with pytest.raises(ConfigError, match="another run uses it"):
        Store(SETTINGS, tmp_path)
    first.close()
    Store(SETTINGS, tmp_path).close()


def test_a_damaged_line_is_named(folder: Path, tmp_path: Path) -> None:
    asked = plan(folder, "orb")
    finished(asked, stored(tmp_path))
    path = tmp_path / RESULTS
    lines = path.read_bytes().splitlines(keepends=True)
    path.write_bytes(lines[0] + b"{}\n" + lines[1])
    with pytest.raises(DatasetError, match=r"results\.jsonl, line 2: damaged"):
        stored(tmp_path)


def test_a_bad_sample_is_told_and_the_others_go_on(folder: Path, tmp_path: Path) -> None:
    bad = tmp_path / "samples"
    bad.mkdir()
    (bad / "C_R0000.npz").write_bytes(b"no archive")
    (bad / "C_R0001.npz").symlink_to(folder / "val" / "A_R0000.npz")
    asked, store = plan(bad, "orb"), Store(SETTINGS)
    failures = [failure for *_, failure in finished(asked, store) if failure is not None]
    assert [failure.sample for failure in failures] == ["C_R0000.npz"]
    assert "not a readable OrthoLoC sample" in failures[0].why
    assert [piece.sample for piece in store.pieces(asked.jobs())] == ["C_R0001.npz"]


def test_another_model_than_the_runs_ends_it(folder: Path) -> None:
    asked = plan(folder, "orb")
    other = [msgspec.structs.replace(asked.matchers[0], model_sha256="0" * 64)]
    with pytest.raises(OrtholocError, match="matcher orb: this machine's model has SHA-256 None, the run's 0000"):
        finished(replace(asked, matchers=other), Store(SETTINGS))


def test_a_defect_is_told_with_where_it_was(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: object) -> None:
        raise ZeroDivisionError("surprise")

    monkeypatch.setattr(campaign, "measured", broken)
    with pytest.raises(OrtholocError, match=r"(?s)B_R0000\.npz, orb: failed unexpectedly.*surprise"):
        finished(plan(folder, "orb"), Store(SETTINGS))


def test_a_full_disk_is_said(folder: Path) -> None:
    store = Store(SETTINGS)
    store.folder = Path("/dev/full/nothing")
    with pytest.raises(OrtholocError, match=r"/dev/full/nothing: can't write results"):
        finished(plan(folder, "orb"), store)


def test_processes_give_the_same(folder: Path) -> None:
    asked, alone, together = plan(folder, "orb"), Store(SETTINGS), Store(SETTINGS)
    finished(asked, alone)
    finished(asked, together, Workers(2))
    assert untimed(together.pieces(asked.jobs())) == untimed(alone.pieces(asked.jobs()))


@pytest.mark.filterwarnings("default")  # Dask's own, of its threads and its event loop.
def test_a_cluster_gives_the_same_though_a_worker_is_killed(folder: Path) -> None:
    distributed = pytest.importorskip("dask.distributed")
    asked, alone, there = plan(folder), Store(SETTINGS), Store(SETTINGS)
    finished(asked, alone)
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, host="127.0.0.1", dashboard_address="127.0.0.1:0",
        silence_logs=logging.ERROR,
    ) as cluster:  # fmt: skip
        victim = next(iter(cluster.workers.values())).pid
        told = []
        for done in campaign.run(asked, there, Workers(dask=cluster.scheduler_address)):
            told.append(done)
            if len(told) == 2:
                os.kill(victim, signal.SIGKILL)
    assert told[-1][:2] == (8, 8)
    assert untimed(there.pieces(asked.jobs())) == untimed(alone.pieces(asked.jobs()))
    for task in asked.tasks:
        tables = [studies.main_table(store.pieces(asked.jobs()), task) for store in (alone, there)]
        times = [k for k, column in enumerate(tables[0].columns) if column.heading in ("CPU s", "wall s")]
        rows = [[[c for k, c in enumerate(row) if k not in times] for row in table.rows] for table in tables]
        assert rows[0] == rows[1]


def test_results_read_back_as_they_were(folder: Path, tmp_path: Path) -> None:
    asked = plan(folder, "sift", (USUAL, HALF))
    store = stored(tmp_path)
    finished(asked, store)
    assert stored(tmp_path).pieces(asked.jobs()) == store.pieces(asked.jobs())
    line = json.loads((tmp_path / RESULTS).read_text("utf-8").splitlines()[0])
    assert line["results"][0]["condition"]["covisibility"] == 1.0
