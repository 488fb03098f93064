"""KML and GeoJSON tracks, for maps."""

from __future__ import annotations

from pathlib import Path
from xml.sax.saxutils import escape

import msgspec
import numpy as np

from factorgraph_dvl.files.exporting.trajectories import ExportedMotion, iso_times
from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.geometry.vectors import Array

# Points of a track. Chosen: viewers become slow with more.
_MOST_POINTS = 20_000
# Marks with a time and standard deviations in a KML file.
_MARKS = 200


def write_kml(motion: ExportedMotion, path: Path) -> None:
    """Write the track as a line, with marks of time that bear standard deviations, in KML 2.2.

    Heights are above the ellipsoid, which a viewer takes for the sea.
    """
    t = motion.trajectory
    rows = _thinned(motion, _MOST_POINTS)
    line = " ".join(_coordinates(t.geodetic[k]) for k in rows)
    marks = []
    when = iso_times(motion.utc) if np.isfinite(motion.utc).all() else []
    for k in _thinned(motion, _MARKS):
        data = {
            "time_s": f"{t.time[k]:.3f}",
            **{
                f"std_{axis}_m": f"{t.position_std[k, i]:.4g}"
                for i, axis in enumerate("enu")
                if np.isfinite(t.position_std[k, i])
            },
            "heading_deg": f"{t.rph[k, 2] / DEG % 360.0:.3f}",
        }
        values = "".join(
            f'<Data name="{key}"><value>{value}</value></Data>' for key, value in data.items()
        )
        stamp = f"<TimeStamp><when>{when[k]}</when></TimeStamp>" if when else ""
        marks.append(
            f"<Placemark><name>{t.time[k]:.0f} s</name><visibility>0</visibility>{stamp}"
            f"<ExtendedData>{values}</ExtendedData><Point><altitudeMode>absolute</altitudeMode>"
            f"<coordinates>{_coordinates(t.geodetic[k])}</coordinates></Point></Placemark>"
        )
    path.write_text(
        '<?xml version="1.0" encoding="UTF-8"?>\n<kml xmlns="http://www.opengis.net/kml/2.2">\n'
        f"<Document><name>{escape(motion.name)}</name>"
        f"<description>{escape(motion.summary)}</description>\n"
        '<Style id="track"><LineStyle><color>ffb27200</color><width>3</width></LineStyle>'
        "</Style>\n"
        "<Placemark><name>track</name><styleUrl>#track</styleUrl><LineString>"
        "<altitudeMode>absolute</altitudeMode>"
        f"<coordinates>{line}</coordinates></LineString></Placemark>\n"
        f"<Folder><name>times</name>{''.join(marks)}</Folder>\n</Document>\n</kml>\n",
        encoding="utf-8",
    )


def write_geojson(motion: ExportedMotion, path: Path) -> None:
    """Write the track as a LineString, with times and standard deviations of its points.

    Heights are above the ellipsoid, as RFC 7946 has them.
    """
    t = motion.trajectory
    rows = _thinned(motion, _MOST_POINTS)
    degrees = np.column_stack([t.geodetic[rows, 1] / DEG, t.geodetic[rows, 0] / DEG])
    places = np.column_stack([np.round(degrees, 9), np.round(t.geodetic[rows, 2], 4)])
    properties = {
        "name": motion.name,
        "verdict": motion.summary,
        "time_s": t.time[rows].tolist(),
        **{f"std_{axis}_m": t.position_std[rows, i].tolist() for i, axis in enumerate("enu")},
    }
    if np.isfinite(motion.utc).all():
        properties["coordTimes"] = iso_times(motion.utc[rows])
    content = {
        "type": "FeatureCollection",
        "features": [
            {
                "type": "Feature",
                "properties": properties,
                "geometry": {"type": "LineString", "coordinates": places.tolist()},
            }
        ],
    }
    path.write_bytes(msgspec.json.encode(content) + b"\n")


def _coordinates(geodetic: Array) -> str:
    return f"{geodetic[1] / DEG:.9f},{geodetic[0] / DEG:.9f},{geodetic[2]:.3f}"


def _thinned(motion: ExportedMotion, most: int) -> Array:
    """Return rows with a position, evenly, and not too many."""
    known = np.flatnonzero(np.isfinite(motion.trajectory.geodetic).all(axis=1))
    return known[np.unique(np.linspace(0, known.size - 1, min(most, known.size)).astype(int))]
