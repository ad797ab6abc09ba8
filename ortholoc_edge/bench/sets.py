"""Sets of recorded frames below a folder of data."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from ortholoc_edge.bench.samples import sample_paths
from ortholoc_edge.errors import DatasetError


@dataclass(frozen=True, slots=True)
class RecordedSet:
    """A flight with its two rasters, or a folder of samples.

    Attributes:
        place: that it shows: a flight and the samples cut from it have the same.
    """

    name: str
    place: str
    folder: Path
    dop: Path | None
    dsm: Path | None


def find_sets(data: Path) -> list[RecordedSet]:
    """Those of a folder, of the folders in it, and of folders ``samples`` in either.

    Raises: DatasetError if there are none.
    """
    found: dict[Path, RecordedSet] = {}
    for folder in sorted(path for path in [data, *data.glob("*")] if path.is_dir()):
        name = folder.resolve().name
        dop, dsm = sorted(folder.glob("*_dop.tif")), sorted(folder.glob("*_dsm.tif"))
        if list(folder.glob("*_flight.csv")) and dop and dsm:
            found.setdefault(folder, RecordedSet(name, name, folder, dop[0], dsm[0]))
        elif sample_paths(folder):
            found.setdefault(folder, RecordedSet(name, name, folder, None, None))
        samples = folder / "samples"
        if sample_paths(samples):
            found.setdefault(samples, RecordedSet(f"{name} samples", name, samples, None, None))
    if not found:
        raise DatasetError(f"{data}: no set there; see docs/sequences.md")
    return list(found.values())
