"""The schemes of `railnav navigate` beside the filter on the track."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from railnav.cli import _files
from railnav.errors import InputError
from railnav.run import Progress, Run

if TYPE_CHECKING:
    from railnav.navigation import Solution


def check_request(
    scheme: str,
    *,
    run: Path,
    model: Path | None,
    output: Path,
    smooth: bool,
    ranges: Path | None,
    of_track: dict[str, bool],
) -> None:
    """Refuse what does not go together before any work; `of_track` names options that only the filter on the track knows."""
    if scheme in ("track", "map-corrector") and model is None:
        raise InputError(
            f"--scheme {scheme} places a run on a model and none is given",
            remedy="add -m MODEL, or choose a scheme without a map: loose, odometer, decentralised, tight",
        )
    if (scheme == "tight") != (ranges is not None):
        raise InputError(
            "--ranges and --scheme tight go together", remedy="give both, or use --scheme loose, which takes positions"
        )
    if smooth and scheme in ("map-corrector", "decentralised"):
        raise InputError(f"--smooth with --scheme {scheme}", remedy="it only looks back: leave --smooth out")
    if scheme != "track":
        wrong = [name for name, given in of_track.items() if given]
        if wrong:
            raise InputError(f"{wrong[0]} with --scheme {scheme}", remedy="only --scheme track knows it")
        inputs = [*([model] if model else []), *([ranges] if ranges else []), *_files.members(run)]
        _files.check_output(output, _files.SOLUTION_ENDINGS, inputs=inputs)


def navigate_scheme(
    run: Run,
    scheme: str,
    *,
    model: Path | None,
    ranges: Path | None,
    smooth: bool,
    integrity_risk: float,
    progress: Progress | None,
) -> Solution:
    """Navigate a run by a scheme other than "track"; with a model the answers of the schemes without a map lie in its plane."""
    from railnav.navigation.schemes import navigate_inertial
    from railnav.navigation.schemes.arc_run import navigate_arc

    reference = _files.read_model(model) if model is not None else None
    if scheme == "map-corrector":
        assert reference is not None
        return navigate_arc(run, reference, integrity_risk=integrity_risk, progress=progress)
    told = None
    if ranges is not None:
        from railnav.io.ranges import read_ranges

        told = read_ranges(ranges)
    return navigate_inertial(
        run,
        scheme=scheme,
        smooth=smooth,
        integrity_risk=integrity_risk,
        ranges=told,
        frame=reference.frame if reference is not None else None,
        progress=progress,
    )
