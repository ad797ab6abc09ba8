"""Whether `bench` on a Dask cluster gives what one process gives, survives a killed worker, and scales.

    python docs/studies/dask_scaling.py SAMPLES [--matcher orb] [--limit N]

Runs the same benchmark in this process, on a local cluster of one worker, of two, and of two of which one is killed
half-way; prints wall times and whether all tables are alike but for their times. Needs ortholoc-edge[dask] and a
machine on which nothing else runs.
"""

from __future__ import annotations

import argparse
import logging
import os
import signal
import time
from pathlib import Path

from dask.distributed import LocalCluster
from ortholoc_edge.bench import campaign, studies
from ortholoc_edge.bench.campaign import Plan, Settings, Store
from ortholoc_edge.bench.condition import USUAL
from ortholoc_edge.bench.paper import PaperOptions, Task
from ortholoc_edge.bench.samples import find_samples
from ortholoc_edge.parallel import Workers

TIMES = ("CPU s", "wall s")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("samples", type=Path)
    parser.add_argument("--matcher", default="orb")
    parser.add_argument("--working-px", type=int, default=320)
    parser.add_argument("--max-keypoints", type=int, default=500)
    parser.add_argument("--turns", type=int, default=4)
    parser.add_argument("--limit", type=int)
    args = parser.parse_args()
    options = PaperOptions(turns=args.turns)
    setup = campaign.setup_of(args.matcher, args.working_px, args.max_keypoints)
    files = find_samples(args.samples)[: args.limit]
    plan = Plan(args.samples, files, [setup], {setup.name: [USUAL]}, [Task.LOCALIZE], (False, True), options)
    settings = Settings(working_px=args.working_px, max_keypoints=args.max_keypoints, options=options)

    def measured(what: str, workers: Workers, victim: int | None = None) -> tuple[float, list[list[object]]]:
        store, start = Store(settings), time.perf_counter()
        for done, total, failure in campaign.run(plan, store, workers):
            if failure is not None:
                raise SystemExit(failure.why)
            if victim is not None and done == total // 2:
                os.kill(victim, signal.SIGKILL)
                victim = None
        spent = time.perf_counter() - start
        table = studies.main_table(store.pieces(plan.jobs()), Task.LOCALIZE)
        kept = [k for k, column in enumerate(table.columns) if column.heading not in TIMES]
        print(f"{what}: {len(files)} samples in {spent:.1f} s", flush=True)
        print(table.markdown(), flush=True)
        return spent, [[row[k] for k in kept] for row in table.rows]

    _, alone = measured("this process", Workers())
    spent = {}
    for workers in (1, 2):
        with cluster_of(workers) as cluster:
            # A worker's first piece imports everything.
            list(campaign.run(warm_up(plan, workers), Store(settings), Workers(dask=cluster.scheduler_address)))
            spent[workers], table = measured(f"{workers} worker(s)", Workers(dask=cluster.scheduler_address))
            assert table == alone, "the tables differ"
    with cluster_of(2) as cluster:
        victim = next(iter(cluster.workers.values())).pid
        _, table = measured("2 workers, one killed", Workers(dask=cluster.scheduler_address), victim)
        assert table == alone, "the tables differ"
    print(f"all tables alike; 2 workers are {spent[1] / spent[2]:.2f} times as fast as one; load {os.getloadavg()}")


def cluster_of(workers: int) -> LocalCluster:
    return LocalCluster(
        n_workers=workers, threads_per_worker=1, processes=True, host="127.0.0.1", dashboard_address=None,
        silence_logs=logging.ERROR,
    )  # fmt: skip


def warm_up(plan: Plan, workers: int) -> Plan:
    return Plan(plan.source, plan.files[: 4 * workers], plan.matchers, plan.conditions, plan.tasks, plan.adhop, plan.options)


if __name__ == "__main__":
    main()
