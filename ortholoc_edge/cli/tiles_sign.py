"""``tiles sign`` and ``tiles keygen``: say who made a pack."""

from __future__ import annotations

import argparse
from pathlib import Path

from ortholoc_edge.tiles.manifest import SIGNATURE_NAME
from ortholoc_edge.tiles.signature import PASSPHRASE_VARIABLE, generate, sign


def add_parser(actions: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add both subcommands."""
    signing = actions.add_parser(
        "sign",
        help="sign a pack",
        description=f"Write {SIGNATURE_NAME}: an Ed25519 signature over the pack's manifest, which has the SHA-256 of"
        " every file. The daemon requires it where its configuration names a public key.",
    )
    signing.add_argument("pack", type=Path, help="directory of the pack")
    signing.add_argument(
        "--key",
        type=Path,
        required=True,
        metavar="FILE",
        help=f"private key, PEM (of an encrypted one the passphrase is taken from ${PASSPHRASE_VARIABLE})",
    )
    signing.set_defaults(run=_sign)

    keygen = actions.add_parser(
        "keygen",
        help="make a pair of keys to sign packs with",
        description="Write a new private key to PREFIX.pem, readable by its owner alone, and the public key to"
        f" PREFIX.pub.pem. The private one is encrypted if ${PASSPHRASE_VARIABLE} is set; it belongs on the computer"
        " that makes packs, never on a drone.",
    )
    keygen.add_argument("--out", type=Path, required=True, metavar="PREFIX", help="path without an ending")
    keygen.set_defaults(run=_keygen)


def _sign(args: argparse.Namespace) -> int:
    sign(args.pack, args.key)
    print(args.pack / SIGNATURE_NAME)
    return 0


def _keygen(args: argparse.Namespace) -> int:
    for path in generate(args.out):
        print(path)
    return 0
