"""What the flying process does not load unless it is used."""

from __future__ import annotations

import subprocess
import sys


def test_zenoh_is_not_loaded_while_the_bus_is_off() -> None:
    code = "import sys, ortholoc_edge.daemon; sys.exit('zenoh' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_nothing_that_flies_loads_the_exporter() -> None:
    code = (
        "import sys, ortholoc_edge.daemon, ortholoc_edge.matching.pairs, ortholoc_edge.matching.superpoint, "
        "ortholoc_edge.matching.dedode; "
        "sys.exit(any(name.startswith(('torch', 'ortholoc_edge.export')) for name in sys.modules))"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_the_command_line_loads_no_torch_until_it_exports() -> None:
    code = "import sys, ortholoc_edge.cli.models; sys.exit('torch' in sys.modules or 'onnx' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_the_page_is_not_loaded_while_it_is_off_and_brings_no_library_when_it_is_on() -> None:
    code = """
import sys, ortholoc_edge.daemon
assert "ortholoc_edge.adapters.page.ground_page" not in sys.modules
before = set(sys.modules)
import ortholoc_edge.adapters.page.ground_page
new = {name.split(".")[0] for name in set(sys.modules) - before}
sys.exit(str(new) if new & {"ssl", "http", "email", "asyncio", "socketserver", "html"} else 0)
"""
    done = subprocess.run([sys.executable, "-c", code], check=False, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
