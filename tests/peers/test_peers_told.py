"""What is said of the peers elsewhere is what is tested here; needs none of them."""

from .peer_process import INSTALL, REQUIREMENTS, ROOT, VARIABLE, pinned


def test_document_names_versions_and_command():
    told = (ROOT / "docs" / "link.md").read_text(encoding="utf-8")
    assert f"MAVProxy {pinned()['MAVProxy']} " in told and f"MAVSDK {pinned()['mavsdk']} " in told
    assert INSTALL in told and VARIABLE in told


def test_peers_speak_the_codec_that_we_pin():
    """MAVProxy's screen and log are read by the same definitions that wrote our frames."""
    ours = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    assert {f"{name}=={pinned()[name]}" for name in ("pymavlink", "pyserial")} <= set(ours)


def test_ci_can_not_skip_them():
    script = (ROOT / ".ci" / "run").read_text(encoding="utf-8")
    assert f"--no-deps -r {REQUIREMENTS.relative_to(ROOT)}\n" in script
    assert script.index(f'export {VARIABLE}="$PWD/.venv-peers/bin/python"') < script.index("-m pytest")
