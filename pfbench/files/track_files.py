"""Tracks as GPX 1.1 and KML 2.2, which maps and viewers read."""

from __future__ import annotations

from collections.abc import Mapping
from xml.etree import ElementTree as Tree

from pfbench.files.table_file import Array

_GPX = {"version": "1.1", "creator": "pfbench", "xmlns": "http://www.topografix.com/GPX/1/1"}
_KML = {"xmlns": "http://www.opengis.net/kml/2.2"}
_COLOURS = ("ffb07b00", "ff00589e", "ff369e2b", "ff6a3d9a")  # alpha, blue, green, red


def format_gpx(tracks: Mapping[str, Array]) -> str:
    """Write tracks as GPX. Times are left out, since those of a log need not be UTC.

    Returns the text. Shapes: tracks by name, each latitude, longitude, deg, and height, m, [T, 3].
    """
    root = Tree.Element("gpx", _GPX)
    for name, points in tracks.items():
        track = Tree.SubElement(root, "trk")
        Tree.SubElement(track, "name").text = name
        segment = Tree.SubElement(track, "trkseg")
        for latitude, longitude, height in points:
            at = {"lat": f"{latitude:.9f}", "lon": f"{longitude:.9f}"}
            Tree.SubElement(Tree.SubElement(segment, "trkpt", at), "ele").text = f"{height:.3f}"
    return _to_text(root)


def format_kml(tracks: Mapping[str, Array], name: str) -> str:
    """Write tracks as lines of a KML document on the ground.

    Returns the text. Shapes: tracks by name, each latitude, longitude, deg, and height, m, [T, 3].
    """
    root = Tree.Element("kml", _KML)
    document = Tree.SubElement(root, "Document")
    Tree.SubElement(document, "name").text = name
    for number, (label, points) in enumerate(tracks.items()):
        mark = Tree.SubElement(document, "Placemark")
        Tree.SubElement(mark, "name").text = label
        style = Tree.SubElement(Tree.SubElement(mark, "Style"), "LineStyle")
        Tree.SubElement(style, "color").text = _COLOURS[number % len(_COLOURS)]
        Tree.SubElement(style, "width").text = "3"
        line = Tree.SubElement(mark, "LineString")
        Tree.SubElement(line, "altitudeMode").text = "clampToGround"
        places = (f"{lon:.9f},{lat:.9f},{height:.3f}" for lat, lon, height in points)
        Tree.SubElement(line, "coordinates").text = " ".join(places)
    return _to_text(root)


def _to_text(root: Tree.Element) -> str:
    """Return an element as an indented document."""
    Tree.indent(root)
    return f'<?xml version="1.0" encoding="UTF-8"?>\n{Tree.tostring(root, encoding="unicode")}\n'
