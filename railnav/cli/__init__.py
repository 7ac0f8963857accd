"""The command `railnav`: arguments -> library call -> table or JSON; library errors -> one line and an exit code.

Nothing heavy is imported here: a verb's module is loaded when the verb is asked for, so that `railnav --help` stays quick.
"""

from __future__ import annotations

import importlib
import sys
from io import TextIOWrapper

import click

from railnav.cli._verb import Failure, describe

#: Each verb's module and its one line in `railnav --help`, in the order of the work.
VERBS: dict[str, tuple[str, str]] = {
    "demo": ("demo", "Simulate a survey and a service run, build, navigate, evaluate, and write a report."),
    "import": (
        "import_",
        "Turn a track network (OpenStreetMap, GeoJSON, LandXML, railML, layers, elements) into a reference track model.",
    ),
    "build": ("build", "Build a reference track model from survey runs."),
    "update": ("update", "Refine a stored model with later runs; the old raw data are not needed."),
    "diff": ("diff", "Compare two models: where the track moved, by how much, and how sure that is."),
    "navigate": ("navigate", "Place a run on a model: track, offset, speed, and how sure that is."),
    "evaluate": ("evaluate", "Compare a solution with the truth: errors along and across, track selection, integrity."),
    "monitor": ("monitor", "Work out track geometry channels from runs on a model, and hold them against limits."),
    "lining": ("lining", "Plan slews and lifts from the measured track to its design or a smoothed target."),
    "calibrate": (
        "calibrate",
        "Calibrate an inertial unit from positions: bias, scale and misalignment, with standard deviations.",
    ),
    "diagnose": ("diagnose", "Say whether an inertial unit is healthy, or which sensor failed and why."),
    "align": (
        "align",
        "Align a standing vehicle: roll, pitch, gyrocompass heading and latitude, with confidence intervals.",
    ),
    "allan": (
        "allan",
        "Measure the noise of an inertial unit at rest: Allan deviation, drawn, and the parameters that explain it.",
    ),
    "simulate": ("simulate", "Simulate a run over a model, with its truth."),
    "alignment": (
        "alignment",
        "Fit straights, transitions, arcs, gradients, vertical curves and cant ramps to a model's tracks.",
    ),
    "draw": ("draw", "Draw plan, curvature, cant and gradient along chainage, as engineers know them."),
    "info": ("info", "Describe a model, a run or a solution."),
    "validate": ("validate", "Check a model or a run and report every defect at once."),
    "datum": ("datum", "List datums, compare and pin their transformations, and fit one to common points."),
    "corridor": ("corridor", "Fit a low-distortion plane to a whole line, and write it as a frame file."),
    "chainage": (
        "chainage",
        "Turn published addresses into places on tracks and back, and list the kilometres of lines.",
    ),
    "store": ("store", "List the models of a shared store, and their versions."),
    "convert": ("convert", "Write a model, a solution, a run or a log in another format."),
    "view": ("view", "Draw a model or a solution as a picture or a page."),
}

INTERRUPTED = 130


class VerbGroup(click.Group):
    """The verbs, loaded on demand; errors become one line on stderr and an exit code."""

    def list_commands(self, ctx: click.Context) -> list[str]:  # noqa: ARG002 - click's signature
        """Name the verbs in the order of the work."""
        return list(VERBS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:  # noqa: ARG002 - click's signature
        """Load one verb."""
        if cmd_name not in VERBS:
            return None
        command: click.Command = importlib.import_module(f"railnav.cli.{VERBS[cmd_name][0]}").command
        return command

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """Find the verb; for a misspelled one, name the nearest."""
        if args and args[0] not in VERBS and not args[0].startswith("-"):
            from difflib import get_close_matches

            near = get_close_matches(args[0], VERBS, 1)
            hint = f"did you mean {near[0]!r}?" if near else f"the verbs are {', '.join(VERBS)}"
            ctx.fail(f"no verb {args[0]!r}; {hint}")
        return super().resolve_command(ctx, args)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:  # noqa: ARG002 - click's signature
        """List the verbs without loading them."""
        with formatter.section("Verbs"):
            formatter.write_dl([(verb, short) for verb, (_, short) in VERBS.items()])

    def invoke(self, ctx: click.Context) -> object:
        """Run a verb; bad data or a bad request is one line and exit code 1, never a traceback."""
        from railnav.errors import RailnavError

        for stream in (sys.stdout, sys.stderr):
            if isinstance(stream, TextIOWrapper):
                stream.reconfigure(errors="replace")  # a terminal without a sign shows "?", it does not stop the work
        try:
            return super().invoke(ctx)
        except BrokenPipeError:
            raise  # the reader left (`railnav info | head`): click ends quietly
        except (RailnavError, OSError) as error:
            raise Failure(describe(error)) from error
        except KeyboardInterrupt:
            click.echo("\nrailnav: interrupted", err=True)
            ctx.exit(INTERRUPTED)


def _version(ctx: click.Context, _: click.Parameter, value: bool) -> None:
    if not value or ctx.resilient_parsing:
        return
    from railnav import __version__

    click.echo(f"railnav {__version__}")
    ctx.exit()


@click.group(
    cls=VerbGroup,
    subcommand_metavar="VERB ...",
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 110},
)
@click.option("--version", is_flag=True, is_eager=True, expose_value=False, callback=_version, help="Show the version.")
def main() -> None:
    """Reference track models from survey runs, and trains held to them.

    \b
    Start with:
      railnav demo

    Then, with logs of your own (a folder with a run.toml for each drive):

    \b
      railnav build logs/* -o line.gpkg
      railnav navigate logs/monday -m line.gpkg -o solution.gpkg

    Every verb has --help with an example, and --json for machines. Exit code 0: done; 1: the data or the request is at
    fault, and one line says what; 2: usage.
    """  # noqa: D301 - \b is click's mark for lines to keep as they are
