"""Mosaics of a pack's tiles as GDAL virtual rasters, so that a GIS opens a layer as one raster.

Nothing here is read in flight: `tiles.store` has the tiles from the manifest.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from xml.etree import ElementTree as ET

from ortholoc_edge.tiles.cog import BLOCK_PX
from ortholoc_edge.tiles.lattice import PixelBox
from ortholoc_edge.tiles.manifest import Dop, Dsm, Tile, layer_box

DOP_VRT, DSM_VRT = "dop.vrt", "dsm.vrt"


def mosaic(layer: Dop | Dsm, crs: str | None) -> bytes:
    """A VRT, for the root of the pack, of all tiles of a layer; where there is no tile, there is no data.

    Args:
        crs: "EPSG:n" or WKT of the pack; None: local metres.
    """
    box = layer_box(layer.tiles)
    grid = layer.lattice.grid(box)
    root = ET.Element("VRTDataset", rasterXSize=str(box.width), rasterYSize=str(box.height))
    if crs is not None:
        # Without dataAxisToSRSAxisMapping: then GDAL takes easting first, also for systems that say northing first.
        _text(root, "SRS", crs)
    _text(root, "GeoTransform", ", ".join(repr(v) for v in (grid.west, grid.dx, 0.0, grid.top, 0.0, grid.dy)))
    if isinstance(layer, Dop):
        for number, colour in enumerate(("Red", "Green", "Blue"), start=1):
            band = ET.SubElement(root, "VRTRasterBand", dataType="Byte", band=str(number))
            _text(band, "ColorInterp", colour)
            band.extend(_sources(layer.tiles, box, "Byte", str(number)))
        mask = ET.SubElement(ET.SubElement(root, "MaskBand"), "VRTRasterBand", dataType="Byte")
        mask.extend(_sources(layer.tiles, box, "Byte", "mask,1"))
    else:
        band = ET.SubElement(root, "VRTRasterBand", dataType="Float32", band="1")
        _text(band, "NoDataValue", repr(layer.nodata))
        _text(band, "UnitType", "m")
        _text(band, "ColorInterp", "Gray")
        band.extend(_sources(layer.tiles, box, "Float32", "1"))
    # They hold no pixels: GDAL reads the overviews of the tiles for them. Exact, since tiles nest on every level.
    overviews = [str(2**level) for level in layer.stored[1:]]
    if overviews:
        _text(root, "OverviewList", " ".join(overviews))
    ET.indent(root)
    return ET.tostring(root, encoding="unicode").encode() + b"\n"


def _sources(tiles: Sequence[Tile], box: PixelBox, data_type: str, band: str) -> Iterator[ET.Element]:
    for tile in tiles:
        source = ET.Element("SimpleSource")
        _text(source, "SourceFilename", tile.file).set("relativeToVRT", "1")
        _text(source, "SourceBand", band)
        width, height = str(tile.width), str(tile.height)
        # With these GDAL opens a tile when it reads it, not all of them at once.
        ET.SubElement(
            source,
            "SourceProperties",
            RasterXSize=width,
            RasterYSize=height,
            DataType=data_type,
            BlockXSize=str(BLOCK_PX),
            BlockYSize=str(BLOCK_PX),
        )
        ET.SubElement(source, "SrcRect", xOff="0", yOff="0", xSize=width, ySize=height)
        left, upper = str(tile.column - box.column), str(tile.row - box.row)
        ET.SubElement(source, "DstRect", xOff=left, yOff=upper, xSize=width, ySize=height)
        yield source


def _text(parent: ET.Element, tag: str, text: str) -> ET.Element:
    element = ET.SubElement(parent, tag)
    element.text = text
    return element
