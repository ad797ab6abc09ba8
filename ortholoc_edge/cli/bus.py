"""``bus``: what is said on zenoh."""

from __future__ import annotations

import argparse

from ortholoc_edge.adapters.messages import schema_text


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the `bus` subcommands."""
    bus = subparsers.add_parser("bus", help="what is said on zenoh", description=__doc__)
    actions = bus.add_subparsers(dest="action", required=True, metavar="ACTION")
    schema = actions.add_parser(
        "schema",
        help="print the JSON Schema of all messages",
        description="Prints the JSON Schema of everything that is published, asked and commanded under "
        "ortholoc/VEHICLE/, and which message belongs to which key; docs/bus.schema.json is the same, and docs/bus.md "
        "explains it.",
    )
    schema.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    print(schema_text(), end="")
    return 0
