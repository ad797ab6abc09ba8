import cv2
import numpy as np
import pytest

from ortholoc_edge.tiles import collar
from ortholoc_edge.tiles.collar import Collar, windows


@pytest.mark.parametrize("shape", [(1, 1), (7, 40), (64, 64), (61, 83)])
@pytest.mark.parametrize("share", [0.0, 0.3, 0.55, 0.65, 1.0])
def test_steps_give_what_the_whole_raster_gives(monkeypatch, shape, share):
    """Regions that wind through many steps, against one labelling of the whole raster."""
    monkeypatch.setattr(collar, "CHUNK_PX", 8)
    marked = np.random.default_rng(3).random(shape) < share
    _, labels = cv2.connectedComponents(marked.astype(np.uint8), connectivity=4)
    edge = np.unique(np.concatenate([labels[0], labels[-1], labels[:, 0], labels[:, -1]]))
    expected = np.isin(labels, edge[edge > 0])

    def read(window):
        rows, columns = window.toslices()
        return marked[rows, columns]

    found = Collar(shape[1], shape[0], read)
    assert found.cells == expected.sum()
    for window in windows(shape[1], shape[0]):
        assert np.array_equal(found.mask(window), expected[window.toslices()])
