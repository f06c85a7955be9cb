"""Styles of raster layers for QGIS, which loads NAME.qml with NAME.tif."""

from __future__ import annotations

from collections.abc import Sequence
from math import isfinite
from xml.etree.ElementTree import Element, SubElement, indent, tostring

from startrack.output.picture.canvas import Colour

DOCTYPE = "<!DOCTYPE qgis PUBLIC 'http://mrcc.com/qgis.dtd' 'SYSTEM'>"
QGIS_VERSION = "3.22.0"  # whose elements these are; later ones read them


def qgis_style_text(band: int, classes: Sequence[tuple[float, str, Colour]]) -> str:
    """The style (QML) of a raster that shows one `band` (from 1) in colours of `classes`.

    A class has an upper bound, words for the legend and a colour; bounds ascend, and the last may be infinite, but not
    the only one. Where the raster has no value nothing is drawn.
    """
    root = Element("qgis", version=QGIS_VERSION, styleCategories="Symbology")
    pipe = SubElement(root, "pipe")
    lowest, highest = "0", f"{max(bound for bound, *_ in classes if isfinite(bound)):g}"
    renderer = SubElement(
        pipe, "rasterrenderer", type="singlebandpseudocolor", band=str(band), alphaBand="-1", opacity="1",
        nodataColor="", classificationMin=lowest, classificationMax=highest,
    )  # fmt: skip
    SubElement(renderer, "rasterTransparency")
    SubElement(SubElement(renderer, "minMaxOrigin"), "limits").text = "None"  # the bounds are not those of the view
    shader = SubElement(
        SubElement(renderer, "rastershader"), "colorrampshader", colorRampType="DISCRETE", classificationMode="1",
        clip="0", minimumValue=lowest, maximumValue=highest,
    )  # fmt: skip
    for bound, words, colour in classes:
        code = "#" + bytes(colour).hex()
        SubElement(shader, "item", value=f"{bound:g}", label=words, color=code, alpha="255")
    SubElement(root, "blendMode").text = "0"
    indent(root)
    return f"{DOCTYPE}\n{tostring(root, encoding='unicode')}\n"
