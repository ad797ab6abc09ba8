"""Errors of fixes against what they say of themselves, by how rough the surface is and how much of the view agrees.

    ortholoc-edge sim --scenario gnss_lost_changed --seeds 20 --packs PACKS --out OUT
    python docs/studies/covariance.py OUT/gnss_lost_changed PACKS/PACK

See covariance.md.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import cv2
import numpy as np
import rasterio

# The view from 120 m with the scenarios' camera, half of its sides.
HALF_VIEW_M = (70, 55)
ROUGH_OVER_M = 4.0


def fixes(folder: Path, pack: Path) -> np.ndarray:
    """A row per fix: roughness (m), part that agrees, error east, north, up (m), of attitude (deg), sigma of each (m,
    deg), NEES over its degrees of freedom of pose, position and attitude."""
    with rasterio.open(pack / "dsm.vrt") as source:
        heights, transform = source.read(1, masked=True), source.transform
    filled = heights.filled(float(np.ma.median(heights))).astype(np.float32)
    rough = np.abs(filled - cv2.GaussianBlur(filled, (0, 0), ROUGH_OVER_M / transform.a))
    rows = []
    for path in sorted(folder.glob("seed-*/frames.jsonl")):
        for line in path.read_text(encoding="utf-8").splitlines():
            frame = json.loads(line)
            if "fix_m" not in frame:
                continue
            column, row = (round(v) for v in ~transform @ tuple(frame["truth_m"][:2]))
            wide, high = (round(half / transform.a) for half in HALF_VIEW_M)
            seen = rough[max(row - high, 0) : row + high, max(column - wide, 0) : column + wide]
            pose, position, attitude = frame["nees"]
            rows.append(
                [seen.mean(), frame["quality"], *frame["error_m"], frame["error_deg"], *frame["sigma_m"],
                 np.linalg.norm(frame["sigma_deg"]), pose / 6, position / 3, attitude / 3]
            )  # fmt: skip
    return np.array(rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("flights", type=Path, help="folder with seed-*/frames.jsonl")
    parser.add_argument("pack", type=Path)
    args = parser.parse_args()
    table = fixes(args.flights, args.pack)
    unsettled = 1.25 * table[:, 0] * (1.0 - table[:, 1])
    print("| unsettled m | fixes | error E, N, U rms m | says m | attitude rms deg | says deg | NEES/dof pose | position | attitude |")
    print("|---|---|---|---|---|---|---|---|---|")
    limits = np.quantile(unsettled, [0.0, 0.25, 0.5, 0.75, 0.9, 1.0])
    for low, high in [*zip(limits[:-1], limits[1:], strict=True), (0.0, np.inf)]:
        some = table[(unsettled >= low) & (unsettled <= high)]
        errors = np.sqrt((some[:, 2:6] ** 2).mean(axis=0))
        says = np.sqrt((some[:, 6:10] ** 2).mean(axis=0))
        print(
            f"| {low:.2f} to {high:.2f} | {len(some)} | " + ", ".join(f"{v:.2f}" for v in errors[:3]) + " | "
            + ", ".join(f"{v:.2f}" for v in says[:3]) + f" | {errors[3]:.2f} | {says[3]:.2f} | "
            + " | ".join(f"{v:.2f}" for v in some[:, 10:].mean(axis=0)) + " |"
        )


if __name__ == "__main__":
    main()
