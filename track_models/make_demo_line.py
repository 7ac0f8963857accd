"""Make the bundled fictitious line as a GeoPackage: the same file contents every time.

    python track_models/make_demo_line.py [track_models/demo_line.gpkg]

The line is laid out from its alignment elements in `railnav.simulation.bundled`; nothing is downloaded. What it consists of
stands in track_models/demo_line.md.
"""

from __future__ import annotations

import sys
from pathlib import Path


def main(output: Path) -> None:
    """Write the model."""
    from railnav.simulation import demo_line
    from railnav.track import validate

    model = demo_line()
    defects = validate(model)
    if defects:
        raise SystemExit("\n".join(f"{d.kind}: {d.where}: {d.detail}" for d in defects))
    model.to_file(output)
    print(f"{output}: {len(model.track_id)} tracks, {model.lengths.sum() / 1e3:.1f} km, {len(model.offset)} knots")


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).with_name("demo_line.gpkg"))
