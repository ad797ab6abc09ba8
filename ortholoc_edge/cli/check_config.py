"""``check-config``: whether a configuration can be flown with, what is in force, and what every key means."""

from __future__ import annotations

import argparse
import json
import math
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
from msgspec import Struct, inspect

from ortholoc_edge.cli.install_service import example_config
from ortholoc_edge.config import Config, read_config, without_secrets
from ortholoc_edge.reload import may_change

_TABLE = re.compile(r"^\[([\w.]+)\](?:\s+# (.*))?$")
_KEY = re.compile(r"^(?:# )?(\w+) = (.+?)(?:\s+# (.*))?$")
_MORE = re.compile(r"^\s+# (.*)$")


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add ``check-config``."""
    parser = subparsers.add_parser(
        "check-config",
        help="whether a configuration is right; what every key means",
        description="Reads a configuration as the daemon does: keys that do not exist, values out of range and tables "
        "that contradict each other are named, with exit status 78. What only the vehicle shows is `doctor`'s.",
    )
    parser.add_argument("file", type=Path, nargs="?", metavar="FILE", help="TOML")
    parser.add_argument("--json", action="store_true", help="print all values in force, without what is secret")
    parser.add_argument("--reference", action="store_true", help="print docs/configuration.md: every key")
    parser.set_defaults(run=run, usage_error=parser.error)


def run(args: argparse.Namespace) -> int:
    if (args.file is None) != args.reference:
        args.usage_error("give a FILE, or --reference")
    if args.reference:
        print(reference(), end="")
        return 0
    config = read_config(args.file)
    if args.json:
        print(json.dumps(without_secrets(config), indent=2))
    else:
        if idle := config.camera.idle_keys():
            print(
                f"{args.file}: [camera] {', '.join(idle)}: {config.camera.kind} has no use for "
                f"{'it' if len(idle) == 1 else 'them'}, so nothing is set by {'it' if len(idle) == 1 else 'them'}; "
                "set it where the frames come from (docs/cameras.md), and leave it out here"
            )
        given = sum(1 for _ in _leaves(msgspec.to_builtins(config)))
        print(f"{args.file}: can be flown with; {given} values in force, see them with --json")
        if config.intrinsics.file is not None:
            camera = config.intrinsics.camera()
            wide_deg = math.degrees(2.0 * math.atan(0.5 * camera.width / camera.fx))
            print(
                f"intrinsics of {config.intrinsics.file}: {camera.width} x {camera.height} px, focal length "
                f"{camera.focal_px:.1f} px ({wide_deg:.0f} degrees wide), distortion {list(camera.distortion)}"
            )
    return 0


def _leaves(table: dict[str, Any]) -> Iterator[Any]:
    for value in table.values():
        if isinstance(value, dict):
            yield from _leaves(value)
        else:
            yield value


# -- the reference -------------------------------------------------------------------------------------

_HEAD = """# Configuration, key by key

`ortholoc-edge check-config --reference` prints this page from the code: types, ranges and defaults are those that the
daemon checks, the words those of [config/example.toml](../config/example.toml). "None": left out, there is no value. ↻:
takes effect in flight when the file is read again (SIGHUP, `systemctl reload`); the others at the next start.
`ortholoc-edge check-config FILE` tells whether a file is right. Examples for vehicles: [config/](../config/README.md).
"""


@dataclass(frozen=True, slots=True)
class _Told:
    """What the example says: of tables, and of keys by their dotted name."""

    tables: dict[str, str]
    keys: dict[str, str]


def reference() -> str:
    """docs/configuration.md."""
    told = read_example(example_config())
    return _HEAD + "".join(_section(name, kind, told) for name, kind in _tables(Config))


def read_example(text: str) -> _Told:
    """The comments of an example configuration, which stand behind what they are about and may go on below it."""
    tables: dict[str, str] = {}
    keys: dict[str, str] = {}
    table, last = "", ""
    for line in text.splitlines():
        if found := _TABLE.match(line):
            table, last = found[1], ""
            tables[table] = found[2] or ""
        elif found := _KEY.match(line):
            last = f"{table}.{found[1]}"
            keys[last] = found[3] or ""
        elif (found := _MORE.match(line)) and last:
            keys[last] = f"{keys[last]} {found[1]}".strip()
        elif line.startswith("# ") and table:
            tables[table] = f"{tables[table]} {line[2:]}".strip()
            last = ""
    return _Told(tables, keys)


def _tables(kind: type[Struct], prefix: str = "") -> Iterator[tuple[str, type[Struct]]]:
    info = inspect.type_info(kind)
    assert isinstance(info, inspect.StructType)
    if prefix:
        yield prefix, kind
    for field in info.fields:
        if isinstance(field.type, inspect.StructType):
            yield from _tables(field.type.cls, f"{prefix}.{field.name}" if prefix else field.name)


def _section(name: str, kind: type[Struct], told: _Told) -> str:
    info = inspect.type_info(kind)
    assert isinstance(info, inspect.StructType)
    lines = [f"\n## [{name}]\n"]
    if told.tables.get(name):
        lines.append(f"{told.tables[name]}\n")
    lines += ["| key | type and range | default | |", "|---|---|---|---|"]
    for field in info.fields:
        if isinstance(field.type, inspect.StructType):
            continue
        key = f"{name}.{field.name}"
        mark = " ↻" if may_change(key) else ""
        words = _cell(told.keys.get(key, "").removeprefix("example "))
        lines.append(f"| `{field.name}`{mark} | {_cell(_type(field.type))} | {_default(field)} | {words} |")
    return "\n".join(lines) + "\n"


def _cell(words: str) -> str:
    return words.replace("|", "\\|")


def _default(field: inspect.Field) -> str:
    if field.required:
        return "must be given"
    value = field.default if field.default is not msgspec.NODEFAULT else field.default_factory()
    return "none" if value is None else f"`{json.dumps(value, ensure_ascii=False)}`"


def _type(kind: inspect.Type) -> str:
    match kind:
        case inspect.UnionType():
            told = " or ".join(_type(one) for one in kind.types if not isinstance(one, inspect.NoneType))
        case inspect.BoolType():
            told = "true or false"
        case inspect.IntType():
            told = f"integer{_range(kind)}"
        case inspect.FloatType():
            told = f"number{_range(kind)}"
        case inspect.StrType():
            told = "text" if kind.pattern is None else f"text like `{kind.pattern}`"
        case inspect.LiteralType():
            told = ", ".join(f"`{json.dumps(value)}`" for value in kind.values)
        case inspect.TupleType():
            told = f"{len(kind.item_types)} of: {_type(kind.item_types[0])}"
        case inspect.VarTupleType():
            told = f"list of {_type(kind.item_type)}"
        case _:
            raise TypeError(f"{kind} has no description; add it here")
    return told


def _range(kind: inspect.IntType | inspect.FloatType) -> str:
    low = f"{kind.ge:g} and more" if kind.ge is not None else f"above {kind.gt:g}" if kind.gt is not None else ""
    high = f"up to {kind.le:g}" if kind.le is not None else f"below {kind.lt:g}" if kind.lt is not None else ""
    if kind.ge is not None and kind.le is not None:
        return f", {kind.ge:g} to {kind.le:g}"
    return "".join(f", {part}" for part in (low, high) if part)
