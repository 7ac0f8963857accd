"""A model leaves for other programs and comes back; a receiver's log becomes a run.

    python examples/other_programs.py

The bundled line goes out as LandXML for a design office and as railML 3.2 for an interlocking tool, is read back, and compared metre by
metre. Then a drive's fixes are written as the NMEA log that a receiver would have made, and that log is read as a run.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np

import railnav as rn
from railnav.io.landxml_writer import write_landxml
from railnav.io.logs import convert_log, read_bare_log
from railnav.io.railml_writer import write_railml
from railnav.io.run import write_run
from railnav.simulation import SERVICE, Leg

DRIVE = Leg(("77R-01", "77R-02", "77R-03"), start=100.0, finish=600.0)


def apart(one: rn.TrackModel, other: rn.TrackModel) -> float:
    """Greatest distance in plan and height between the same offsets of two models, m."""
    worst = 0.0
    for track in one.track_id:
        offset = np.arange(0.0, min(one.length(track), other.length(track)), 1.0)
        p, q = one.at(track, offset), other.at(track, offset)
        off = np.hypot(np.hypot(p.easting - q.easting, p.northing - q.northing), np.nan_to_num(p.height - q.height))
        worst = max(worst, float(off.max()))
    return worst


def main(seed: int = 1) -> tuple[dict[str, float], int]:
    """Write, read back, compare."""
    line = rn.demo_line()
    run, _ = rn.simulate(line, DRIVE, seed=seed, outfit=SERVICE, run_id="drive")
    worst: dict[str, float] = {}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_landxml(line, folder / "line.xml")
        write_railml(line, folder / "line.railml")
        for file in ("line.xml", "line.railml"):
            worst[file] = apart(line, rn.read_network(folder / file))
            print(f"{file}: {(folder / file).stat().st_size / 1e3:.0f} kB, back within {worst[file] * 1e3:.2f} mm")
        write_run(run, folder / "drive")
        convert_log(folder / "drive", folder / "drive.nmea")
        again, _ = read_bare_log(folder / "drive.nmea")
        assert again.gnss is not None
        print(f"drive.nmea: {len(again.gnss)} fixes from {again.start:%H:%M:%S}")
        return worst, len(again.gnss)


if __name__ == "__main__":
    main()
