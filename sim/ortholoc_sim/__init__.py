"""A simulated country, vehicle, camera and autopilot, to run the daemon against without hardware.

Nothing in `ortholoc_edge` imports this package except the `sim` subcommand.
"""

from __future__ import annotations

from pathlib import Path

from ortholoc_edge.errors import MapError


def demo_pack_path() -> Path:
    """The area pack of the demo world: the copy inside an installed package, else ``tiles/demo`` of the repository.

    Raises: MapError if there is neither.
    """
    here = Path(__file__).resolve().parent
    for path in (here / "demo_pack", here.parents[1] / "tiles" / "demo"):
        if (path / "manifest.json").is_file():
            return path
    raise MapError(
        f"demo pack: not found in {here} nor in {here.parents[1]}/tiles; make it with: "
        "python -m ortholoc_sim.make_demo_pack --out tiles/demo"
    )
