"""What the process that flies loads, and with which settings: each module counts against its memory."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

from ortholoc_sim import demo_pack_path
from replay import rendered

from ortholoc_edge.bench import pack_process

# pyproj brings a PROJ of its own and, for downloads, all that speaks HTTPS; numpy.random brings hmac and secrets.
NOT_IN_FLIGHT = {
    "pyproj", "ssl", "urllib.request", "http.client", "email", "numpy.random", "onnx", "onnxruntime",
    "ortholoc_edge.tiles.build", "ortholoc_edge.tiles.systems",
}  # fmt: skip


def loaded(code: str, *arguments: str, asked: str = "") -> tuple[set[str], list[str]]:
    """Modules of a fresh process after some code, and the lines that the code wrote."""
    *lines, modules = subprocess.run(
        [sys.executable, "-c", f"{code}\nimport json, sys; print(json.dumps(sorted(sys.modules)))", *arguments],
        input=asked,
        capture_output=True,
        text=True,
        timeout=120,
        check=True,
    ).stdout.splitlines()
    return set(json.loads(modules)), lines


def test_run_loads_nothing_that_only_other_commands_need(tmp_path: Path) -> None:
    code = "from ortholoc_edge.cli import main\nassert main() == 78"
    found, _ = loaded(code, "run", "--config", str(tmp_path / "none.toml"))
    assert "ortholoc_edge.daemon" in found
    assert not found & NOT_IN_FLIGHT


def test_a_fix_loads_nothing_more(tmp_path: Path) -> None:
    flight = rendered.write_flight(tmp_path, [rendered.pose()])
    ask = {"pack": str(demo_pack_path()), "flight": str(flight), "matcher": "structural", "features": False}
    found, lines = loaded(
        "from ortholoc_edge.bench.pack_process import serve; serve()",
        json.dumps(ask | {"cache": 8 * 2**20}),
        asked=json.dumps([0, [0.3] * 6]) + "\n",
    )
    assert json.loads(lines[-1])["te_m"] is not None
    assert "rasterio" in found
    assert not found & NOT_IN_FLIGHT


def test_memory_is_measured_with_the_units_settings_of_the_allocator() -> None:
    unit = Path(__file__).parents[2] / "systemd" / "ortholoc-edge.service"
    found = dict(re.findall(r"\b(MALLOC_\w+)=(\d+)", unit.read_text(encoding="utf-8")))
    assert found == pack_process.MALLOC
