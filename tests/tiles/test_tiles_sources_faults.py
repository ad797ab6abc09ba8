"""Damaged and foreign files as sources: pixels, or an error that names the file; nothing else."""

import gzip
import shutil
import zipfile

import numpy as np
import pytest
import rasterio.shutil
from test_tiles_sources import CRS, GRID, picture, raster, relief, zipped
from test_tiles_sources_prepare import cloud, listed, text

from ortholoc_edge.errors import MapError
from ortholoc_edge.geometry.grid import RasterGrid
from ortholoc_edge.tiles.sources import discover, prepare, read_dop, read_dsm, with_common_stretch


def originals(folder):
    """One small file of each format: (path, kind)."""
    plain = raster(folder / "plain.tif", picture())
    files = [
        (plain, "dop"),
        (
            raster(folder / "deflate.tif", picture(4), compress="DEFLATE", tiled=True, blockxsize=16, blockysize=16),
            "dop",
        ),
        (raster(folder / "jpeg.tif", picture(), compress="JPEG", photometric="YCBCR"), "dop"),
        (raster(folder / "deep.tif", picture(dtype="uint16"), compress="LZW"), "dop"),
        (raster(folder / "dsm.tif", relief(), compress="DEFLATE", predictor=3, nodata=-9999), "dsm"),
        (raster(folder / "lerc.tif", relief(), compress="LERC_ZSTD", crs="EPSG:25832+7837"), "dsm"),
    ]
    for driver, suffix in (("JP2OpenJPEG", "jp2"), ("PNG", "png"), ("JPEG", "jpg"), ("VRT", "vrt"), ("HFA", "img")):
        path = folder / f"other.{suffix}"
        rasterio.shutil.copy(plain, path, driver=driver)
        files.append((path, "dop"))
    files.append((zipped(folder / "packed.zip", plain, compression=zipfile.ZIP_DEFLATED), "dop"))
    files.append((zipped(folder / "stored.zip", folder / "dsm.tif"), "dsm"))
    table = text(listed(relief(), GRID)).encode()
    for name, content in (("dom.xyz", table), ("dom.xyz.gz", gzip.compress(table, mtime=0))):
        (folder / name).write_bytes(content)
        files.append((folder / name, "dsm"))
    rows = "\n".join(" ".join(f"{h:.2f}" for h in row) for row in relief()[0])
    head = "ncols 60\nnrows 40\nxllcorner 350000\nyllcorner 5649980\ncellsize 0.5\n"
    (folder / "dom.asc").write_text(head + rows)
    files.append((folder / "dom.asc", "dsm"))
    files.append((cloud(folder / "bdom.laz", listed(relief(), GRID)), "dsm"))
    files.append((cloud(folder / "bdom.las", listed(relief(), GRID)), "dsm"))
    return files


def damaged(content, rng):
    """Cut, flipped in a few bits, or with a stretch of something else; the head is hit as often as the rest."""
    data = bytearray(content)
    match rng.integers(4):
        case 0:
            return bytes(data[: rng.integers(len(data))])
        case 1:
            reach = len(data) if rng.random() < 0.5 else min(len(data), 600)
            for place in rng.integers(0, reach, rng.integers(1, 12)):
                data[place] ^= 1 << rng.integers(8)
        case 2:
            start = int(rng.integers(len(data)))
            stretch = rng.integers(0, 256, rng.integers(1, 200)).astype(np.uint8).tobytes()
            data[start : start + len(stretch)] = stretch
        case _:
            for place in rng.integers(0, min(len(data), 400), rng.integers(1, 6)):
                data[place] = rng.choice([0, 255, 127, 128, 1])
    return bytes(data)


def use(path, kind, work):
    """All that a build does with a source. Returns: whether it could be used."""
    try:
        sources = with_common_stretch(discover([path], kind, assign_crs=CRS))
        for source in sources:
            plain = prepare(source, work)
            off = RasterGrid(40, 40, GRID.west + 1.1, GRID.top - 2.3, 0.6, -0.6)
            for grid, crs in ((GRID, CRS), (off, CRS), (off, "EPSG:25833")):
                if kind == "dop":
                    got = read_dop(plain, grid, crs)
                    assert got.rgb.shape[1:] == got.valid.shape == (grid.height, grid.width)
                else:
                    assert read_dsm(plain, grid, crs).shape == (grid.height, grid.width)
    except MapError as err:
        assert path.parent.name in str(err), err
        return False
    return True


FORMATS = 18


@pytest.mark.parametrize("index", range(FORMATS))
def test_damaged_files_give_pixels_or_a_named_error(tmp_path, index):
    pytest.importorskip("laspy")
    folder = tmp_path / "whole"
    folder.mkdir()
    files = originals(folder)
    assert len(files) == FORMATS
    path, kind = files[index]
    assert use(path, kind, tmp_path / "work")
    rng, refused = np.random.default_rng(index), 0
    for trial in range(ROUNDS):
        broken = tmp_path / f"broken{trial}" / path.name
        # What the file needs beside it: the mosaic its tile, pictures their georeference.
        shutil.copytree(folder, broken.parent)
        broken.write_bytes(damaged(path.read_bytes(), rng))
        refused += not use(broken, kind, tmp_path / f"work{trial}")
    assert refused > 0


ROUNDS = 12


@pytest.mark.parametrize("index", range(FORMATS))
def test_other_formats_under_this_name(tmp_path, index):
    pytest.importorskip("laspy")
    folder = tmp_path / "whole"
    folder.mkdir()
    files = originals(folder)
    path, kind = files[index]
    for number, (other, _) in enumerate(files):
        foreign = tmp_path / f"foreign{number}" / path.name
        foreign.parent.mkdir()
        foreign.write_bytes(other.read_bytes())
        use(foreign, kind, tmp_path / "work")
    for content in (b"", b"\0" * 5000, b"II*\0" + b"\xff" * 3000, b"<html>not found</html>", b"PK\x03\x04" * 50):
        foreign.write_bytes(content)
        assert not use(foreign, kind, tmp_path / "work")
