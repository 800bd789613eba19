"""GPX and KML are read back by a parser of XML, with the values that were written."""

from __future__ import annotations

from xml.etree import ElementTree as Tree

import numpy as np

from pfbench.files.track_files import format_gpx, format_kml

TRACKS = {
    "ekf <smoothed> & more": np.array([[52.123456789, 13.4, -3.5], [52.2, -179.999999999, 8848.0]]),
    "ukf": np.array([[-33.0, 151.0, 0.0]]),
}


def test_gpx_has_every_point_with_latitude_first() -> None:
    space = {"g": "http://www.topografix.com/GPX/1/1"}
    root = Tree.fromstring(format_gpx(TRACKS))
    assert root.tag == f"{{{space['g']}}}gpx"
    assert root.attrib["version"] == "1.1"
    for track, (name, points) in zip(root.findall("g:trk", space), TRACKS.items(), strict=True):
        assert track.findtext("g:name", namespaces=space) == name
        read = [
            (float(p.attrib["lat"]), float(p.attrib["lon"]), float(p.findtext("g:ele", "", space)))
            for p in track.findall("g:trkseg/g:trkpt", space)
        ]
        np.testing.assert_allclose(read, points, atol=1e-9)


def test_kml_has_every_point_with_longitude_first() -> None:
    space = {"k": "http://www.opengis.net/kml/2.2"}
    root = Tree.fromstring(format_kml(TRACKS, "my <log>"))
    assert root.findtext("k:Document/k:name", namespaces=space) == "my <log>"
    marks = root.findall("k:Document/k:Placemark", space)
    for mark, (name, points) in zip(marks, TRACKS.items(), strict=True):
        assert mark.findtext("k:name", namespaces=space) == name
        text = mark.findtext("k:LineString/k:coordinates", "", space)
        read = np.array([place.split(",") for place in text.split()], float)
        np.testing.assert_allclose(read, points[:, [1, 0, 2]], atol=1e-9)
