"""Build wheel and sdist, install each into a new environment, and fly a little with it, far from these sources.

    python -m pip install build && python systemd/check_install.py --out dist

Each must tell its help, judge an example configuration, ask a simulated autopilot (`doctor`), and start as a daemon
that gives one a fix (`bench-start`). Needs the network for the dependencies, which are those of constraints.txt.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import venv
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
# What `doctor` found is not asked here, but that it could ask.
DOCTOR_WORKS = (0, 1)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n", maxsplit=1)[0])
    parser.add_argument("--out", type=Path, default=Path("dist"), metavar="DIR", help="(default: %(default)s)")
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="ortholoc-install-") as folder:
        built = Path(folder) / "built"
        subprocess.run([sys.executable, "-m", "build", "--outdir", str(built), str(ROOT)], check=True)
        for package in sorted(built.iterdir()):
            check(package, Path(folder) / package.name.replace(".", "_"))
            package.replace(args.out / package.name)
            print(f"{args.out / package.name}: installed and flew")
    return 0


def check(package: Path, folder: Path) -> None:
    """Raises: CalledProcessError, or ValueError for an answer that is none."""
    venv.create(folder, with_pip=True)
    programs = folder / "bin"
    pip = [str(programs / "pip"), "install", "--quiet", "--constraint", str(ROOT / "constraints.txt"), str(package)]
    subprocess.run(pip, check=True)
    elsewhere = folder / "elsewhere"
    elsewhere.mkdir()
    # Nothing of this checkout's environment, nor of its sources.
    environment = {"PATH": f"{programs}:/usr/bin:/bin", "HOME": str(elsewhere), "LANG": "C.UTF-8"}

    def run(*command: str, codes: tuple[int, ...] = (0,)) -> str:
        done = subprocess.run(
            [str(programs / command[0]), *command[1:]],
            cwd=elsewhere, env=environment, stdout=subprocess.PIPE, text=True, check=False,
        )  # fmt: skip
        if done.returncode not in codes:
            raise subprocess.CalledProcessError(done.returncode, command, done.stdout)
        return done.stdout

    if str(folder) not in run("python", "-c", "import ortholoc_edge, ortholoc_sim; print(ortholoc_edge.__file__)"):
        raise ValueError(f"{package}: what runs is not what was installed")
    run("ortholoc-edge", "--help")
    run("ortholoc-edge", "check-config", str(ROOT / "config" / "simulation.toml"))
    autopilot = subprocess.Popen(
        [str(programs / "python"), "-m", "ortholoc_sim.link", "--udp", "0", "--json"],
        cwd=elsewhere, env=environment, stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    try:
        assert autopilot.stdout is not None
        opened = json.loads(autopilot.stdout.readline())
        json.loads(run("ortholoc-edge", "doctor", "--link", opened["endpoint"], "--json", codes=DOCTOR_WORKS))
    finally:
        autopilot.terminate()
        autopilot.communicate()
    starts = json.loads(run("ortholoc-edge", "bench-start", "--runs", "1", "--json"))["starts"]
    print(f"{package.name}: ready after {starts[0]['ready_s']:.1f} s, first fix after {starts[0]['first_s']:.1f} s")


if __name__ == "__main__":
    sys.exit(main())
