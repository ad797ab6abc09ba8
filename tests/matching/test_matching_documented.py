"""The matcher that docs/matchers.md shows does what it says."""

import re
from pathlib import Path

import cv2
import numpy as np
from scenes import field

from ortholoc_edge.geometry.homography import warp_points

DOCUMENT = Path(__file__).resolve().parents[2] / "docs" / "matchers.md"


def test_the_worked_example_matches_a_view_and_bears_holes() -> None:
    [code] = re.findall(r"```python\n(.*?)```", DOCUMENT.read_text(encoding="utf-8"), re.DOTALL)
    names: dict[str, object] = {}
    exec(compile(code, str(DOCUMENT), "exec"), names)
    matcher = names["PatchMatcher"]()
    scene = field(800, 600)
    shift = np.array([[1.0, 0.02, -9.0], [-0.02, 1.0, 14.0], [0, 0, 1.0]])
    seen = cv2.warpPerspective(scene, shift, (800, 600))
    valid = cv2.warpPerspective(np.ones_like(scene), shift, (800, 600), flags=cv2.INTER_NEAREST) > 0
    matches = matcher.match(matcher.extract(scene), matcher.extract(seen, valid))
    errors = matches.map_px - warp_points(shift, matches.query_px)
    right = np.linalg.norm(errors, axis=1) < 3
    assert right.sum() > 200
    assert right.mean() > 0.8
    assert np.abs(np.median(errors[right], axis=0)).max() < 0.2
    assert len(matcher.extract(np.zeros((300, 400), np.uint8))) == 0
    assert len(matcher.extract(scene, np.zeros(scene.shape, np.bool_))) == 0
