"""Route and area files as the programs write them, around a place in Dresden (UTM zone 33, near 32)."""

import json

HOME = (51.05, 13.70)


def simple(command, lat, lon, altitude, frame=3):
    return {
        "AMSLAltAboveTerrain": None,
        "Altitude": altitude,
        "AltitudeMode": 1,
        "autoContinue": True,
        "command": command,
        "doJumpId": 1,
        "frame": frame,
        "params": [0, 0, 0, None, lat, lon, altitude],
        "type": "SimpleItem",
    }


def survey(points, polygon, items=(), calc=None):
    return {
        "type": "ComplexItem",
        "complexItemType": "survey",
        "version": 5,
        "angle": 0,
        "entryLocation": 0,
        "polygon": polygon,
        "TransectStyleComplexItem": {
            "CameraCalc": calc or {"DistanceToSurface": 80, "DistanceToSurfaceRelative": True, "version": 1},
            "FollowTerrain": False,
            "Items": list(items),
            "TurnAroundDistance": 10,
            "VisualTransectPoints": points,
            "version": 1,
        },
    }


def plan(items, home=(*HOME, 113.0)):
    return {
        "fileType": "Plan",
        "geoFence": {"circles": [{"circle": {"center": [0.0, 0.0], "radius": 9e6}}], "polygons": [], "version": 2},
        "groundStation": "QGroundControl",
        "mission": {
            "cruiseSpeed": 15,
            "firmwareType": 12,
            "globalPlanAltitudeMode": 1,
            "hoverSpeed": 5,
            "items": items,
            "plannedHomePosition": None if home is None else list(home),
            "vehicleType": 2,
            "version": 2,
        },
        "rallyPoints": {"points": [[10.0, 10.0, 5.0]], "version": 2},
        "version": 1,
    }


def mission():
    """Take-off, a waypoint, a survey whose items QGroundControl has worked out, a region of interest, the way home."""
    grid = [[51.052, 13.702], [51.056, 13.702], [51.056, 13.704], [51.052, 13.704]]
    items = [simple(16, *point, 80) for point in grid]
    items.insert(1, simple(206, 0, 0, 0, frame=2))
    return plan(
        [
            simple(22, *HOME, 60),
            simple(16, 51.051, 13.701, 150, frame=0),
            simple(195, 40.0, 10.0, 0),
            survey(grid, [[51.052, 13.702], [51.056, 13.702], [51.056, 13.704], [51.052, 13.704]], items),
            simple(20, 0, 0, 0, frame=2),
        ]
    )


def written(path, content):
    path.write_text(content if isinstance(content, str) else json.dumps(content), encoding="utf-8")
    return path


WAYPOINTS = """QGC WPL 110
0\t1\t0\t16\t0\t0\t0\t0\t51.050000\t13.700000\t113.000000\t1
1\t0\t3\t22\t0\t0\t0\t0\t0.000000\t0.000000\t50.000000\t1
2\t0\t3\t16\t0\t0\t0\t0\t51.052000\t13.702000\t100.000000\t1
3\t0\t2\t178\t0\t12\t0\t0\t0.000000\t0.000000\t0.000000\t1
4\t0\t10\t16\t0\t0\t0\t0\t51.054000\t13.704000\t90.000000\t1
5\t0\t3\t20\t0\t0\t0\t0\t0.000000\t0.000000\t0.000000\t1
"""

KML = """<?xml version="1.0" encoding="UTF-8"?>
<kml xmlns="http://www.opengis.net/kml/2.2" xmlns:gx="http://www.google.com/kml/ext/2.2"><Document>
<!-- drawn by hand -->
<Placemark><name>start</name><Point><coordinates>13.7,51.05,0</coordinates></Point></Placemark>
<Folder><Placemark><name>way</name><LineString><altitudeMode>absolute</altitudeMode>
<coordinates>
 13.700,51.050,200 13.702, 51.052, 210
 13.704,51.054,220
</coordinates></LineString></Placemark></Folder>
<Placemark><gx:Track><altitudeMode>relativeToGround</altitudeMode>
<when>2026-01-01T00:00:00Z</when><gx:coord>13.70 51.05 90</gx:coord>
<when>2026-01-01T00:00:10Z</when><gx:coord>13.71 51.05 95</gx:coord></gx:Track></Placemark>
<Placemark><name>field</name><MultiGeometry><Polygon>
<outerBoundaryIs><LinearRing><coordinates>13.70,51.05 13.71,51.05 13.71,51.06 13.70,51.06 13.70,51.05</coordinates>
</LinearRing></outerBoundaryIs>
<innerBoundaryIs><LinearRing><coordinates>13.704,51.054 13.706,51.054 13.706,51.056 13.704,51.056 13.704,51.054
</coordinates></LinearRing></innerBoundaryIs></Polygon></MultiGeometry></Placemark>
</Document></kml>
"""
