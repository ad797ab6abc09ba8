"""The systemd unit and what installs it, tried with systemd's own tools where they are; the Debian package."""

from __future__ import annotations

import os
import re
import shutil
import signal
import stat
import subprocess
import sys
import zipfile
from pathlib import Path

import confined
import pytest
from adapters.fake_autopilot import UdpWire
from adapters.hovering import TRUTH, HoveringAutopilot, wait_for
from replay import rendered
from test_bus import free_port
from test_reload import Running

from ortholoc_edge.cli import EXIT_CONFIG, EXIT_FAILED, main
from ortholoc_edge.config import read_config

ROOT = Path(__file__).resolve().parents[2]
UNIT = ROOT / "systemd" / "ortholoc-edge.service"
INSTALLED = {
    "etc/systemd/system/ortholoc-edge.service": UNIT,
    "etc/sysusers.d/ortholoc-edge.conf": ROOT / "systemd" / "ortholoc-edge.sysusers",
    "etc/tmpfiles.d/ortholoc-edge.conf": ROOT / "systemd" / "ortholoc-edge.tmpfiles",
}
MOST_EXPOSURE = 2.0


def needs(*programs: str) -> pytest.MarkDecorator:
    missing = [program for program in programs if shutil.which(program) is None]
    return pytest.mark.skipif(bool(missing), reason=f"{', '.join(missing)}: not on this computer")


@pytest.fixture
def system(tmp_path: Path) -> Path:
    """A system to install into, which has the program already."""
    program = tmp_path / "system" / "opt" / "ortholoc-edge" / "bin" / "ortholoc-edge"
    program.parent.mkdir(parents=True)
    program.write_text("#!/bin/sh\n", encoding="utf-8")
    program.chmod(0o755)
    return tmp_path / "system"


def install(system: Path, *more: str, prefix: str = "/opt/ortholoc-edge") -> int:
    return main(["install-service", "--root", str(system), "--prefix", prefix, *more])


def files(system: Path) -> set[str]:
    return {str(path.relative_to(system)) for path in (system / "etc").rglob("*") if path.is_file()}


# -- install-service -----------------------------------------------------------


def test_installs_unit_user_folders_and_an_example(system: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert install(system, "--dry-run") == 0
    assert not (system / "etc").exists()
    assert capsys.readouterr().out.count("would write") == 4
    assert install(system) == 0
    out = capsys.readouterr().out
    assert files(system) == {*INSTALLED, "etc/ortholoc-edge/config.toml"}
    for name, source in INSTALLED.items():
        assert (system / name).read_bytes() == source.read_bytes()
        assert f"write {system / name}" in out
    config = system / "etc" / "ortholoc-edge" / "config.toml"
    assert read_config(config).bus.enabled is False
    assert stat.S_IMODE(config.stat().st_mode) == 0o640
    assert install(system) == 0
    assert capsys.readouterr().out.splitlines() == ["nothing to do", f"kept {config}"]


def test_a_configuration_is_never_touched(system: Path, capsys: pytest.CaptureFixture[str]) -> None:
    config = system / "etc" / "ortholoc-edge" / "config.toml"
    config.parent.mkdir(parents=True)
    config.write_text("# mine\n", encoding="utf-8")
    unit = system / "etc" / "systemd" / "system" / "ortholoc-edge.service"
    unit.parent.mkdir(parents=True)
    unit.write_text("[Service]\nof an older version\n", encoding="utf-8")
    assert install(system) == 0
    out = capsys.readouterr().out
    assert f"kept {config}" in out and f"replace {unit}" in out
    assert config.read_text(encoding="utf-8") == "# mine\n"
    assert install(system, "--uninstall") == 0
    assert f"kept {config}" in capsys.readouterr().out
    assert files(system) == {"etc/ortholoc-edge/config.toml"}
    assert install(system, "--uninstall") == 0
    assert "nothing to do" in capsys.readouterr().out


def test_another_prefix_is_in_the_unit(system: Path) -> None:
    (system / "srv").mkdir()
    (system / "opt" / "ortholoc-edge").rename(system / "srv" / "edge")
    assert install(system, prefix="/srv/edge") == 0
    unit = (system / "etc" / "systemd" / "system" / "ortholoc-edge.service").read_text(encoding="utf-8")
    assert "ExecStart=/srv/edge/bin/ortholoc-edge run --config /etc/ortholoc-edge/config.toml\n" in unit
    assert "/opt/" not in unit


@pytest.mark.parametrize(
    ("prefix", "words"),
    [("/opt/nothing", "is no program; make a virtual environment"), ("/home/me/venv", "hidden from the service")],
)
def test_a_prefix_that_can_not_work(
    system: Path, prefix: str, words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    if prefix.startswith("/home"):
        shutil.copytree(system / "opt" / "ortholoc-edge", system / prefix.lstrip("/"))
    assert install(system, prefix=prefix) == EXIT_CONFIG
    assert words in capsys.readouterr().err
    assert not (system / "etc").exists()


def test_what_can_not_be_written_is_named(system: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (system / "etc").write_text("in the way", encoding="utf-8")
    assert install(system) == EXIT_FAILED
    err = capsys.readouterr().err
    assert "etc/systemd/system/ortholoc-edge.service" in err and "as root" in err
    assert main(["install-service", "--root", str(system / "nowhere")]) == EXIT_CONFIG


# -- the unit, by systemd's own tools ------------------------------------------


def verified(system: Path) -> tuple[int, str]:
    done = subprocess.run(
        ["systemd-analyze", "verify", f"--root={system}", "ortholoc-edge.service"],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    return done.returncode, done.stdout + done.stderr


@needs("systemd-analyze")
def test_systemd_finds_nothing_wrong_with_the_unit(system: Path) -> None:
    install(system)
    # What the unit refers to.
    shutil.copytree("/usr/lib/systemd/system", system / "usr/lib/systemd/system", symlinks=True)
    (system / "bin").mkdir()
    shutil.copy("/bin/kill", system / "bin" / "kill")
    assert verified(system) == (0, "")
    unit = system / "etc" / "systemd" / "system" / "ortholoc-edge.service"
    unit.write_text(unit.read_text("utf-8").replace("WatchdogSec=10", "WatchdogSek=10"), encoding="utf-8")
    assert "WatchdogSek" in verified(system)[1], "it would have told"


@needs("systemd-analyze")
def test_the_unit_exposes_little() -> None:
    done = subprocess.run(
        ["systemd-analyze", "security", "--offline=true", "--no-pager", str(UNIT)],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    found = re.search(r"Overall exposure level.*: ([\d.]+)", done.stdout)
    assert found is not None, done.stdout + done.stderr
    assert float(found[1]) <= MOST_EXPOSURE


@needs("systemd-sysusers", "systemd-tmpfiles")
@pytest.mark.skipif(os.geteuid() != 0, reason="giving files to another user needs root")
def test_user_and_folders(system: Path) -> None:
    install(system)
    for name in ("passwd", "group"):
        shutil.copy(f"/etc/{name}", system / "etc" / name)
    subprocess.run(["systemd-sysusers", f"--root={system}"], check=True, capture_output=True)
    subprocess.run(["systemd-tmpfiles", f"--root={system}", "--create"], check=True, capture_output=True)
    entries = [line.split(":") for line in (system / "etc" / "passwd").read_text("utf-8").splitlines()]
    (uid, gid), shell = next((map(int, e[2:4]), e[6]) for e in entries if e[0] == "ortholoc-edge")
    assert shell.endswith("nologin")
    groups = dict(line.split(":")[::3] for line in (system / "etc" / "group").read_text("utf-8").splitlines())
    assert "ortholoc-edge" in groups["video"] and "ortholoc-edge" in groups["dialout"]
    for folder in ("var/lib/ortholoc-edge", "var/log/ortholoc-edge"):
        found = (system / folder).stat()
        assert (found.st_uid, found.st_gid, stat.S_IMODE(found.st_mode)) == (uid, gid, 0o750)
    config = (system / "etc" / "ortholoc-edge" / "config.toml").stat()
    assert (config.st_uid, config.st_gid, stat.S_IMODE(config.st_mode)) == (0, gid, 0o640), "which it may only read"


def test_what_the_documents_say_of_the_unit_is_in_it() -> None:
    unit = UNIT.read_text(encoding="utf-8")
    for line in (
        "Type=notify", "WatchdogSec=10", "User=ortholoc-edge", "RestartPreventExitStatus=78", "DevicePolicy=closed",
        "ProtectSystem=strict", "StateDirectory=ortholoc-edge", "LogsDirectory=ortholoc-edge", "MemoryMax=1280M",
    ):  # fmt: skip
        assert f"\n{line}\n" in unit


@needs("systemd-analyze")
@pytest.mark.skipif(
    not confined.HEADER.is_file() or os.uname().machine != "x86_64",
    reason=f"{confined.HEADER}: not on this computer; it has the numbers of the system calls",
)
def test_the_daemon_flies_within_what_the_unit_lets_it(tmp_path: Path) -> None:
    """Every system call of a flight with log and bus is one of the unit's, and none makes memory executable; here a
    forbidden one would end it. And where it hangs, the watchdog's SIGABRT tells where."""
    groups = re.findall(r"^SystemCallFilter=(\S+)$", UNIT.read_text(encoding="utf-8"), re.MULTILINE)
    assert groups == ["@system-service", "~@privileged"]
    assert "MemoryDenyWriteExecute=yes" in UNIT.read_text(encoding="utf-8")
    photo = rendered.write_picture(tmp_path / "photos" / "photo_000.jpg", rendered.picture(TRUTH))
    for number in range(1, 200):
        photo.with_name(f"photo_{number:03d}.jpg").hardlink_to(photo)
    autopilot = HoveringAutopilot(UdpWire())
    running = Running(
        tmp_path,
        f"udpout:127.0.0.1:{autopilot.wire.port}",
        (str(Path(confined.__file__)), *groups, "--"),
        f'[log]\nfolder = "{tmp_path / "log"}"\nframes = "all"\n'
        f'[bus]\nenabled = true\nlisten = ["tcp/127.0.0.1:{free_port()}"]\nimage_rate_hz = 5.0\n',
    )
    try:
        running.told_until(lambda line: line == "READY=1")
        wait_for(lambda: len(autopilot.messages("ODOMETRY")) >= 3, "three estimates")
        running.reload(running.text + "[tracker]\njump_m = 6.0\n")
        running.logged("reload: tracker.jump_m is now 6.0")
        running.told_until(lambda line: line.startswith("STATUS=track"))
        assert any((tmp_path / "log").glob("flight-*.mcap"))
        running.process.send_signal(signal.SIGABRT)
        # It looks at threads that run on, and may stumble over one; it ends all the same.
        assert running.process.wait(10.0) in (-signal.SIGABRT, -signal.SIGSEGV)
        told = running.log()
    finally:
        running.close()
        autopilot.close()
    assert "Fatal Python error: Aborted" in told


def test_the_confinement_of_these_tests_confines() -> None:
    command = [sys.executable, str(Path(confined.__file__)), "@basic-io", "--", "--version"]
    if not confined.HEADER.is_file() or shutil.which("systemd-analyze") is None:
        pytest.skip("no systemd-analyze, or no numbers of the system calls")
    assert subprocess.run(command, capture_output=True, check=False).returncode == -signal.SIGSYS


# -- the Debian package --------------------------------------------------------


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """In place of the one that hatchling makes, which may not be here and takes long to install: one command."""
    path = tmp_path_factory.mktemp("wheel") / "ortholoc_edge-9.8.7-py3-none-any.whl"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("ortholoc_edge/__init__.py", "")
        archive.writestr("ortholoc_edge/cli/__init__.py", "import sys\ndef main():\n    print(sys.argv[1:])\n")
        info = "ortholoc_edge-9.8.7.dist-info"
        archive.writestr(f"{info}/METADATA", "Metadata-Version: 2.1\nName: ortholoc-edge\nVersion: 9.8.7\n")
        archive.writestr(f"{info}/WHEEL", "Wheel-Version: 1.0\nRoot-Is-Purelib: true\nTag: py3-none-any\n")
        archive.writestr(f"{info}/RECORD", "")
    return path


@needs("dpkg-deb")
def test_the_debian_package_has_all_in_its_place(wheel: Path, tmp_path: Path) -> None:
    build = [sys.executable, str(ROOT / "systemd" / "build_deb.py"), "--out", str(tmp_path)]
    done = subprocess.run(
        [*build, "--wheel", str(wheel), "--no-dependencies"], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    package = tmp_path / "ortholoc-edge_9.8.7_all.deb"
    assert done.stdout.strip().endswith(str(package))
    fields = subprocess.run(["dpkg-deb", "-f", str(package)], capture_output=True, text=True, check=True).stdout
    assert "Package: ortholoc-edge\nVersion: 9.8.7\n" in fields
    assert f"python3 (>= 3.{sys.version_info.minor}), python3 (<< 3.{sys.version_info.minor + 1})" in fields
    unpacked = tmp_path / "unpacked"
    subprocess.run(["dpkg-deb", "-R", str(package), str(unpacked)], check=True)
    for name, source in {
        "usr/lib/systemd/system/ortholoc-edge.service": UNIT,
        "usr/lib/sysusers.d/ortholoc-edge.conf": ROOT / "systemd" / "ortholoc-edge.sysusers",
        "usr/lib/tmpfiles.d/ortholoc-edge.conf": ROOT / "systemd" / "ortholoc-edge.tmpfiles",
        "etc/ortholoc-edge/config.toml": ROOT / "config" / "example.toml",
    }.items():
        assert (unpacked / name).read_bytes() == source.read_bytes()
    assert (unpacked / "DEBIAN" / "conffiles").read_text("utf-8") == "/etc/ortholoc-edge/config.toml\n"
    for script in ("postinst", "prerm", "postrm"):
        subprocess.run(["sh", "-n", str(unpacked / "DEBIAN" / script)], check=True)
    sums = subprocess.run(["md5sum", "--check", "--quiet", "DEBIAN/md5sums"], cwd=unpacked, check=False)
    assert sums.returncode == 0
    # The program that the unit starts takes its own packages before all others.
    program = unpacked / "opt" / "ortholoc-edge" / "bin" / "ortholoc-edge"
    assert os.access(program, os.X_OK)
    launched = subprocess.run(
        [sys.executable, str(program), "run", "--help"], capture_output=True, text=True, check=False, cwd=tmp_path
    )
    assert (launched.returncode, launched.stdout) == (0, "['run', '--help']\n"), launched.stderr
