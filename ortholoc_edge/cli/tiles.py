"""`ortholoc-edge tiles`: build, look into, check, sign and forecast with area packs."""

from __future__ import annotations

import argparse

from ortholoc_edge.cli import tiles_build, tiles_forecast, tiles_inspect, tiles_preview, tiles_sign


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the `tiles` subcommands."""
    tiles = subparsers.add_parser("tiles", help="build, check and look into area packs", description=__doc__)
    actions = tiles.add_subparsers(dest="action", required=True, metavar="ACTION")
    for module in (tiles_build, tiles_inspect, tiles_preview, tiles_forecast, tiles_sign):
        module.add_parser(actions)
