"""Ask pip which binary wheels of all dependencies there are for a vehicle's computer, without having one.

    python systemd/check_wheels.py                     # 64-bit Arm, Python 3.11, 3.12 and 3.13
    python systemd/check_wheels.py --machine x86_64 --python 3.11

pip resolves for another platform, but reads markers (``; platform_machine != 'aarch64'``) as those of the computer that
it runs on, so they are read here: for what we ask for, and again in the answer, for what our dependencies ask for.
Needs the network; nothing is installed. Prints a Markdown table; exit code 1 if something has no wheel.
"""

from __future__ import annotations

import argparse
import json
import re
import subprocess
import sys
import tempfile
import tomllib
from pathlib import Path

from pip._vendor.packaging.requirements import Requirement
from pip._vendor.packaging.utils import canonicalize_name, parse_wheel_filename

ROOT = Path(__file__).resolve().parents[1]
PYTHONS = ("3.11", "3.12", "3.13")
# A wheel for an older C library runs with a newer: Debian 12 and Raspberry Pi OS 12 have 2.36, Ubuntu 22.04 2.35.
LIBRARIES = range(28, 16, -1)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n", maxsplit=1)[0])
    parser.add_argument("--machine", default="aarch64", help="(default: %(default)s)")
    parser.add_argument("--python", nargs="+", default=list(PYTHONS), metavar="X.Y", help="(default: all three)")
    args = parser.parse_args()
    wanted = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["dependencies"]
    found: dict[str, dict[str, str]] = {}
    problems = []
    for python in args.python:
        environment = marker_environment(args.machine, python)
        asked = [strip(text) for text in wanted if applies(text, environment)]
        try:
            report = resolved(asked, args.machine, python)
        except subprocess.CalledProcessError as error:
            problems.append(f"Python {python}: {last_words(error.stderr)}")
            continue
        names = {canonicalize_name(item["metadata"]["name"]) for item in report["install"]}
        for item in report["install"]:
            metadata = item["metadata"]
            name = f"{metadata['name']} {metadata['version']}"
            found.setdefault(name, {})[python] = wheel_of(item["download_info"]["url"], args.machine)
            missing = [
                text
                for text in metadata.get("requires_dist", [])
                if applies(text, environment) and canonicalize_name(Requirement(text).name) not in names
            ]
            problems += [f"Python {python}: {name} needs {text} there, which pip left out here" for text in missing]
    print(f"| package | {' | '.join(f'Python {python}' for python in args.python)} |")
    print("|---|" + "---|" * len(args.python))
    for name in sorted(found, key=str.lower):
        print(f"| {name} | {' | '.join(found[name].get(python, '-') for python in args.python)} |")
    for problem in problems:
        print(f"check_wheels: {problem}", file=sys.stderr)
    return 1 if problems else 0


def marker_environment(machine: str, python: str) -> dict[str, str]:
    """What markers see on a vehicle."""
    return {
        "implementation_name": "cpython",
        "implementation_version": f"{python}.0",
        "os_name": "posix",
        "platform_machine": machine,
        "platform_release": "",
        "platform_system": "Linux",
        "platform_version": "",
        "python_full_version": f"{python}.0",
        "platform_python_implementation": "CPython",
        "python_version": python,
        "sys_platform": "linux",
    }


def applies(text: str, environment: dict[str, str]) -> bool:
    marker = Requirement(text).marker
    return marker is None or marker.evaluate({**environment, "extra": ""})


def strip(text: str) -> str:
    """A requirement without its marker."""
    requirement = Requirement(text)
    requirement.marker = None
    return str(requirement)


def resolved(asked: list[str], machine: str, python: str) -> dict[str, list[dict[str, dict[str, str]]]]:
    """pip's report. Raises: CalledProcessError if it finds no way."""
    tags = [f"manylinux_2_{minor}_{machine}" for minor in LIBRARIES] + [f"manylinux2014_{machine}"]
    environment = marker_environment(machine, python)
    # Pins with markers would be read by this computer, too.
    lines = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    pins = [strip(line) for line in lines if re.match(r"[A-Za-z]", line) and applies(line, environment)]
    with tempfile.TemporaryDirectory() as folder:
        constraints = Path(folder) / "constraints.txt"
        constraints.write_text("\n".join(pins), encoding="utf-8")
        command = [
            sys.executable, "-m", "pip", "install", "--dry-run", "--quiet", "--ignore-installed", "--report", "-",
            "--target", str(Path(folder) / "target"), "--only-binary", ":all:", "--implementation", "cp",
            "--python-version", python, "--constraint", str(constraints),
            *(part for tag in tags for part in ("--platform", tag)), *asked,
        ]  # fmt: skip
        done = subprocess.run(command, capture_output=True, text=True, check=True)
    report: dict[str, list[dict[str, dict[str, str]]]] = json.loads(done.stdout)
    return report


def wheel_of(url: str, machine: str) -> str:
    """ "any" of one without compiled parts, else the C library that it needs."""
    *_, tags = parse_wheel_filename(url.rsplit("/", 1)[-1].replace("%2B", "+"))
    platforms = sorted({tag.platform for tag in tags})
    if platforms == ["any"]:
        return "any"
    libraries = [int(found[1]) for one in platforms if (found := re.fullmatch(rf"manylinux_2_(\d+)_{machine}", one))]
    if f"manylinux2014_{machine}" in platforms:
        libraries.append(17)
    return f"glibc 2.{min(libraries)}" if libraries else platforms[0].removesuffix(f"_{machine}")


def last_words(stderr: str) -> str:
    errors = [line for line in stderr.splitlines() if line.startswith("ERROR")]
    return " ".join(errors[-2:]) or stderr[-300:]


if __name__ == "__main__":
    sys.exit(main())
