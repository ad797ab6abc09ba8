"""Build a Debian package: the daemon with all that it needs, for a computer that has no internet.

    python systemd/build_deb.py --out dist

Run it on the architecture and with the Python that the vehicle's Debian has (Debian 12: 3.11), as on a Raspberry Pi OS
or in a container of it: dependencies are binary wheels, pinned by constraints.txt, and go into /opt/ortholoc-edge/lib,
where they are in nobody's way. Unit, user and folders come from systemd/; /etc/ortholoc-edge/config.toml is a conffile,
which dpkg never overwrites. Nothing is enabled or started by installing it.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import platform
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PREFIX = "opt/ortholoc-edge"

LAUNCHER = """#!/usr/bin/python3 -s
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "lib"))
from ortholoc_edge.cli import main

sys.exit(main())
"""

POSTINST = """#!/bin/sh
set -e
if [ "$1" = configure ]; then
    systemd-sysusers ortholoc-edge.conf
    systemd-tmpfiles --create ortholoc-edge.conf
    if [ -d /run/systemd/system ]; then systemctl daemon-reload; fi
    if [ -z "$2" ]; then
        echo "ortholoc-edge: edit /etc/ortholoc-edge/config.toml, then systemctl enable --now ortholoc-edge"
    fi
fi
"""

PRERM = """#!/bin/sh
set -e
if [ "$1" = remove ] && [ -d /run/systemd/system ]; then systemctl disable --now ortholoc-edge || true; fi
"""

# Packs in /var/lib/ortholoc-edge are the operator's.
POSTRM = """#!/bin/sh
set -e
if [ -d /run/systemd/system ]; then systemctl daemon-reload || true; fi
if [ "$1" = purge ]; then rm -rf /var/log/ortholoc-edge; fi
"""


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--out", type=Path, default=Path("dist"), metavar="DIR", help="(default: %(default)s)")
    parser.add_argument("--wheel", type=Path, metavar="FILE", help="of ortholoc-edge (default: built from this folder)")
    parser.add_argument("--no-dependencies", action="store_true", help="leave them out: they come from elsewhere")
    args = parser.parse_args()
    if shutil.which("dpkg-deb") is None:
        print("build_deb: dpkg-deb is not here; run this on Debian, or install dpkg", file=sys.stderr)
        return 1
    args.out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="ortholoc-deb-") as folder:
        stage = Path(folder) / "stage"
        wheel = args.wheel or build_wheel(Path(folder))
        install(wheel, stage / PREFIX / "lib", dependencies=not args.no_dependencies)
        version = wheel.name.split("-")[1]
        files(stage)
        architecture = "all" if args.no_dependencies else output("dpkg", "--print-architecture")
        control(stage, version, architecture)
        target = args.out / f"ortholoc-edge_{version}_{architecture}.deb"
        run("dpkg-deb", "--build", "--root-owner-group", "-Zxz", "-z2", str(stage), str(target))
    print(target)
    return 0


def build_wheel(folder: Path) -> Path:
    run(sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--wheel-dir", str(folder), str(ROOT))
    (wheel,) = folder.glob("ortholoc_edge-*.whl")
    return wheel


def install(wheel: Path, lib: Path, *, dependencies: bool) -> None:
    command = [sys.executable, "-m", "pip", "install", "--quiet", "--target", str(lib)]
    if dependencies:
        # No compiler runs: what has no wheel for this computer is told.
        command += ["--only-binary", ":all:", "--constraint", str(ROOT / "constraints.txt")]
    else:
        command += ["--no-deps", "--no-index"]
    run(*command, str(wheel))
    # Scripts of dependencies, with this computer's paths in them.
    shutil.rmtree(lib / "bin", ignore_errors=True)


def files(stage: Path) -> None:
    """All but the Python packages."""
    copies = {
        "systemd/ortholoc-edge.service": "usr/lib/systemd/system/ortholoc-edge.service",
        "systemd/ortholoc-edge.sysusers": "usr/lib/sysusers.d/ortholoc-edge.conf",
        "systemd/ortholoc-edge.tmpfiles": "usr/lib/tmpfiles.d/ortholoc-edge.conf",
        "config/example.toml": "etc/ortholoc-edge/config.toml",
        "README.md": "usr/share/doc/ortholoc-edge/README.md",
        "systemd/README.md": "usr/share/doc/ortholoc-edge/service.md",
        "LICENSE": "usr/share/doc/ortholoc-edge/copyright",
        "THIRD_PARTY_NOTICES.md": "usr/share/doc/ortholoc-edge/THIRD_PARTY_NOTICES.md",
    }
    for source, target in copies.items():
        (stage / target).parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(ROOT / source, stage / target)
        (stage / target).chmod(0o644)
    # It may hold the password of a camera; systemd-tmpfiles gives it to the service's group.
    (stage / "etc/ortholoc-edge/config.toml").chmod(0o640)
    launcher = stage / PREFIX / "bin" / "ortholoc-edge"
    launcher.parent.mkdir(parents=True)
    launcher.write_text(LAUNCHER, encoding="utf-8")
    launcher.chmod(0o755)
    link = stage / "usr/bin/ortholoc-edge"
    link.parent.mkdir(parents=True)
    link.symlink_to(f"/{PREFIX}/bin/ortholoc-edge")


def control(stage: Path, version: str, architecture: str) -> None:
    major, minor = (int(part) for part in platform.python_version_tuple()[:2])
    installed_kib = sum(path.stat().st_size for path in stage.rglob("*") if path.is_file()) // 1024
    debian = stage / "DEBIAN"
    debian.mkdir()
    # Compiled extensions are of one Python.
    python = f"python3 (>= {major}.{minor}), python3 (<< {major}.{minor + 1})"
    (debian / "control").write_text(
        f"Package: ortholoc-edge\nVersion: {version}\nArchitecture: {architecture}\nSection: science\n"
        "Priority: optional\nMaintainer: OrthoLoC Edge <ortholoc-edge@localhost>\n"
        f"Depends: {python}, systemd (>= 247), kmod\nInstalled-Size: {installed_kib}\n"
        "Description: position for drones without GNSS\n"
        " Localizes a drone by its camera against an orthophoto and a surface model, and sends vision position\n"
        " estimates to ArduPilot or PX4 over MAVLink.\n",
        encoding="utf-8",
    )
    (debian / "conffiles").write_text("/etc/ortholoc-edge/config.toml\n", encoding="utf-8")
    for name, script in (("postinst", POSTINST), ("prerm", PRERM), ("postrm", POSTRM)):
        (debian / name).write_text(script, encoding="utf-8")
        (debian / name).chmod(0o755)
    sums = "".join(
        f"{hashlib.md5(path.read_bytes(), usedforsecurity=False).hexdigest()}  {path.relative_to(stage)}\n"
        for path in sorted(stage.rglob("*"))
        if path.is_file() and not path.is_symlink() and debian not in path.parents
    )
    (debian / "md5sums").write_text(sums, encoding="utf-8")


def run(*command: str) -> None:
    subprocess.run(command, check=True, env={**os.environ, "PIP_DISABLE_PIP_VERSION_CHECK": "1"})


def output(*command: str) -> str:
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()


if __name__ == "__main__":
    sys.exit(main())
