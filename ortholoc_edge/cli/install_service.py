"""``install-service``: the systemd unit, its user and its folders, put where they belong; and taken away again."""

from __future__ import annotations

import argparse
import contextlib
import os
import sys
from dataclasses import dataclass
from pathlib import Path

from ortholoc_edge.errors import ConfigError, OrtholocError

# Where the files in systemd/ expect the virtual environment.
_PREFIX = "/opt/ortholoc-edge"
_CONFIG = Path("etc/ortholoc-edge/config.toml")
_TARGETS = {
    "ortholoc-edge.service": Path("etc/systemd/system/ortholoc-edge.service"),
    "ortholoc-edge.sysusers": Path("etc/sysusers.d/ortholoc-edge.conf"),
    "ortholoc-edge.tmpfiles": Path("etc/tmpfiles.d/ortholoc-edge.conf"),
}


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add ``install-service``."""
    parser = subparsers.add_parser(
        "install-service",
        help="install the daemon as a systemd service",
        description="Writes the hardened systemd unit, the user that it runs as, its folders, and an example "
        "configuration where there is none; a configuration that is there is never touched. Prints what it did and the "
        "commands that come next: it starts nothing itself. systemd/README.md explains the unit.",
    )
    parser.add_argument(
        "--prefix", type=Path, default=Path(sys.prefix), metavar="VENV", help="virtual environment that has "
        "bin/ortholoc-edge (default: this one, %(default)s)",
    )  # fmt: skip
    parser.add_argument("--root", type=Path, default=Path("/"), metavar="DIR", help="of the system to install into, an "
                        "image that is mounted, say (default: %(default)s)")  # fmt: skip
    parser.add_argument("--uninstall", action="store_true", help="remove what this command installs; configuration, "
                        "packs and logs stay")  # fmt: skip
    parser.add_argument("--dry-run", action="store_true", help="only say what would be done")
    parser.set_defaults(run=run)


@dataclass(frozen=True, slots=True)
class _Step:
    """One file. ``content`` None removes it."""

    path: Path
    content: str | None
    mode: int = 0o644

    def describe(self) -> str:
        """What is to be done; empty where nothing is."""
        if self.content is None:
            return f"remove {self.path}" if self.path.exists() else ""
        if not self.path.exists():
            return f"write {self.path}"
        return "" if self.path.read_bytes() == self.content.encode() else f"replace {self.path}"

    def do(self) -> None:
        if self.content is None:
            self.path.unlink()
            return
        self.path.parent.mkdir(parents=True, exist_ok=True)
        part = self.path.with_name(f".{self.path.name}.part")
        try:
            part.write_text(self.content, encoding="utf-8")
            part.chmod(self.mode)
            # The old file or the new one, whatever happens in between.
            part.rename(self.path)
        except OSError:
            with contextlib.suppress(OSError):
                part.unlink(missing_ok=True)
            raise


def run(args: argparse.Namespace) -> int:
    if not args.root.is_dir():
        raise ConfigError(f"--root: {args.root} is no folder; mount the image there first")
    prefix = args.prefix.absolute()
    steps = _removal(args.root) if args.uninstall else _installation(args.root, prefix)
    done = 0
    for step in steps:
        try:
            what = step.describe()
            if what and not args.dry_run:
                step.do()
        except OSError as error:
            raise OrtholocError(
                f"{step.path}: {error.strerror}; run this as root (sudo), or name another --root"
            ) from error
        if what:
            done += 1
            print(f"{'would ' if args.dry_run else ''}{what}")
    if not done:
        print("nothing to do")
    config = args.root / _CONFIG
    if args.uninstall:
        if config.exists():
            print(f"kept {config}, and what is in /var/lib/ortholoc-edge and /var/log/ortholoc-edge")
    elif not any(step.path == config for step in steps):
        print(f"kept {config}")
    if args.root == Path("/"):
        print(_next_commands(args.uninstall, prefix))
    return 0


def _installation(root: Path, prefix: Path) -> list[_Step]:
    program = prefix / "bin" / "ortholoc-edge"
    # The prefix is that of the system that is installed into, which is mounted under the root.
    if not os.access(root / program.relative_to("/"), os.X_OK):
        raise ConfigError(
            f"--prefix: {root / program.relative_to('/')} is no program; make a virtual environment at {prefix} and "
            "install ortholoc-edge into it first"
        )
    if prefix.parts[1:2] in (("home",), ("root",), ("run",), ("tmp",)):
        raise ConfigError(
            f"--prefix: {prefix} is hidden from the service (ProtectHome=, PrivateTmp=); take {_PREFIX}, say"
        )
    if any(c.isspace() or c in "%$\"'\\" for c in str(prefix)):
        raise ConfigError(f"--prefix: {prefix} has characters that a unit would need quoted; choose another place")
    steps = [
        _Step(root / target, service_file(name).replace(_PREFIX, str(prefix))) for name, target in _TARGETS.items()
    ]
    if not (root / _CONFIG).exists():
        # tmpfiles gives it to the service's group; until then nobody else is to read it.
        steps.append(_Step(root / _CONFIG, example_config(), 0o640))
    return steps


def _removal(root: Path) -> list[_Step]:
    return [_Step(root / target, None) for target in _TARGETS.values()]


def _next_commands(uninstalled: bool, prefix: Path) -> str:
    if uninstalled:
        return "\nNext, as root:\n  systemctl disable --now ortholoc-edge; systemctl daemon-reload"
    return (
        "\nNext, as root:\n"
        "  systemd-sysusers && systemd-tmpfiles --create && systemctl daemon-reload\n"
        f"  $EDITOR /{_CONFIG}\n"
        f"  {prefix}/bin/ortholoc-edge doctor --config /{_CONFIG}\n"
        "  systemctl enable --now ortholoc-edge && systemctl status ortholoc-edge"
    )


def service_file(name: str) -> str:
    """A file of systemd/: the copy inside an installed package, else the repository's."""
    return _shipped(name, "systemd")


def example_config() -> str:
    """config/example.toml, from the same places."""
    return _shipped("example.toml", "config")


def _shipped(name: str, folder: str) -> str:
    package = Path(__file__).resolve().parents[1]
    for path in (package / "shipped" / name, package.parent / folder / name):
        if path.is_file():
            return path.read_text(encoding="utf-8")
    raise OrtholocError(f"{name}: not found in {package}/shipped nor in {package.parent}/{folder}; install the package")
