"""The command line: `fdof-jax` or `python -m fdof_jax`.

Arguments are parsed and checked before JAX is imported, which takes a second.
"""

import argparse
import dataclasses
import math
import tempfile
import zipfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from . import __version__
from .shell.tuning_run import METHODS, Job

_OF_JOB = tuple(field.name for field in dataclasses.fields(Job))
_OF_ENSEMBLE = "members", "payload", "start_offset", "speed", "link_error"
_OF_SEARCH = "method", "starts", "seed", "max_steps"


def main(arguments: list[str] | None = None) -> None:
    """Parses the command line, runs the command, and prints its results."""
    parser = _parser()
    options = parser.parse_args(arguments)
    if options.command == "tune":
        _check_tuning(parser, options)
    if options.command != "league":
        _check_folder(parser, "--output", options.output, make=True)
    if options.command == "tune" and options.save is not None:
        _check_folder(parser, "--save", options.save.parent)

    from .shell import commands

    commands.set_up()
    if options.command == "league":
        commands.run_league()
        return
    if options.command == "figures":
        pictures = commands.run_figures(options.output)
    elif options.command == "topologies":
        pictures = commands.run_topologies(options.output)
    elif options.command == "tune":
        try:
            pictures = commands.run_tuning(
                options.output,
                Job(**_given(options, _OF_JOB)),
                options.resume,
                options.save,
                _given(options, _OF_SEARCH),
            )
        except (ValueError, OSError) as error:
            parser.error(str(error))
    else:
        pictures = commands.run_circle(options.output)
    print(f"\npictures in {options.output}/: {', '.join(p.name for p in pictures)}")


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="fdof-jax",
        description="Dynamics of planar open-chain linkages. Without a command, the "
        "RPR arm of the paper's Fig 7 tracks a circle with the paper's PD gains, its "
        "gains are tuned by gradients, and it tracks the circle again.",
    )
    parser.add_argument("--version", action="version", version=__version__)
    _add_output(parser, Path("fdof-output"))
    commands = parser.add_subparsers(dest="command", metavar="command")
    for name, text in (
        ("circle", "track the circle, tune the gains, track it again (the default)"),
        ("figures", "reproduce the paper's Figs 3 to 7"),
        ("topologies", "simulate all seven topologies in one compiled batched call"),
        ("league", "tune the gains of all seven topologies on one circle"),
        ("tune", "tune the gains of Fig 7's arm: circle, bounds, method, robustness"),
    ):
        command = commands.add_parser(
            name, help=text, description=f"{text[0].upper()}{text[1:]}."
        )
        # No default here: it would override an --output given before the command.
        _add_output(command, argparse.SUPPRESS)
        if name == "tune":
            _add_tuning(command)
    return parser


def _add_output(parser: argparse.ArgumentParser, default: Path | str) -> None:
    parser.add_argument(
        "--output",
        type=Path,
        default=default,
        metavar="FOLDER",
        help="where to write the pictures (PNG); fdof-output by default",
    )


def _add_tuning(command: argparse.ArgumentParser) -> None:
    real = _number(float, "a finite number", lambda x: True)
    not_negative = _number(float, "a finite number of at least 0", lambda x: x >= 0)
    not_zero = _number(float, "a finite number other than 0", lambda x: x != 0)
    above_one = _number(float, "a finite number above 1", lambda x: x > 1)
    speed = _number(float, "a finite number of at least 0.001", lambda x: x >= 1e-3)
    share = _number(float, "a number from 0 to below 1", lambda x: 0 <= x < 1)
    count = _number(int, "a whole number of at least 1", lambda n: n >= 1)
    seed = _number(int, "a whole number of at least 0", lambda n: n >= 0)
    job = command.add_argument_group("the circle and the loss")
    ends = "LEAST", "GREATEST"
    for name, parts, kind, text in (
        ("center", ("X", "Y"), real, "middle of the circle [m]"),
        ("radius", None, not_negative, "radius of the circle [m]"),
        ("period", None, not_zero, "time of one turn; two are simulated [s]"),
        ("factor", None, above_one, "the gains stay within this factor of the paper's"),
        ("price", None, not_negative, "price of a joint's constant full effort [m^2]"),
        ("members", None, count, "ensemble: number of scenes"),
        ("payload", ends, not_negative, "ensemble: mass at the tip [kg]"),
        ("start-offset", None, not_negative, "ensemble: tip's offset at the start [m]"),
        ("speed", ends, speed, "ensemble: factor on the speed"),
        ("link-error", None, share, "ensemble: relative error of links' mass data"),
    ):
        default = vars(Job)[name.replace("-", "_")]
        shown = " ".join(map(str, default)) if parts else default
        job.add_argument(
            f"--{name}",
            nargs=len(parts) if parts else None,
            metavar=parts,
            type=kind,
            help=f"{text}; {shown} by default",
        )
    job.add_argument(
        "--over",
        choices=("nominal", "mean", "worst"),
        help="judge gains by the nominal scene, or by the mean or the worst of an "
        "ensemble; nominal by default",
    )
    search = command.add_argument_group("the search")
    # No defaults here: they would override those read by --resume.
    search.add_argument(
        "--method", choices=METHODS, help="optimiser; levenberg-marquardt by default"
    )
    search.add_argument(
        "--starts", type=count, help="runs; later ones from random gains; 1 by default"
    )
    search.add_argument("--seed", type=seed, help="seed of random gains; 0 by default")
    search.add_argument("--max-steps", type=count, help="steps of a run; 50 by default")
    search.add_argument(
        "--save", type=_new_file, metavar="FILE", help="save the result"
    )
    search.add_argument(
        "--resume",
        type=_saved_run,
        metavar="FILE",
        help="continue a run saved by --save with its circle, bounds, ensemble and "
        "search (with other random starts)",
    )


# Converters of arguments; argparse prints the error with the name of the option.


def _number(
    kind: type[int] | type[float], expected: str, fits: Callable[[Any], bool]
) -> Callable[[str], int | float]:
    def converted(text: str) -> int | float:
        try:
            value = kind(text)
        except ValueError:
            value = math.nan
        # Comparisons with NaN are false.
        if abs(value) < math.inf and fits(value):
            return value
        raise argparse.ArgumentTypeError(f"expected {expected}, got {text!r}.")

    return converted


def _new_file(text: str) -> Path:
    path = Path(text)
    if path.is_dir():
        raise argparse.ArgumentTypeError(f"expected a file, got the folder {text!r}.")
    return path


def _saved_run(text: str) -> Path:
    try:
        with open(text, "rb") as file:
            archive = zipfile.is_zipfile(file)  # as `fdof_jax.save` writes
    except OSError as error:
        raise argparse.ArgumentTypeError(
            f"cannot read {text!r}: {error.strerror}."
        ) from error
    if not archive:
        raise argparse.ArgumentTypeError(
            f"expected a file written by `fdof-jax tune --save`, got {text!r}."
        )
    return Path(text)


# Checks of several arguments together, and of folders


def _given(options: argparse.Namespace, names: Sequence[str]) -> dict[str, Any]:
    """Options among `names` that are given on the command line."""
    return {n: v for n in names if (v := vars(options)[n]) is not None}


def _check_tuning(parser: argparse.ArgumentParser, options: argparse.Namespace) -> None:
    """Exits with status 2 if options of `tune` contradict each other."""
    given = _given(options, _OF_JOB)
    if given and options.resume is not None:
        parser.error(
            f"--resume: the file says what is tuned, also given: {', '.join(given)}"
        )
    ensemble = _given(options, _OF_ENSEMBLE)
    if ensemble and options.over in (None, "nominal"):
        parser.error(f"--over: mean or worst is needed for {', '.join(ensemble)}")
    for name in ("payload", "speed"):
        least, greatest = given.get(name, (0, 0))
        if least > greatest:
            parser.error(
                f"--{name}: expected the least before the greatest, got {least:g} and "
                f"{greatest:g}."
            )


def _check_folder(
    parser: argparse.ArgumentParser, option: str, folder: Path, make: bool = False
) -> None:
    """Exits with status 2 unless files can be written into the folder."""
    try:
        if make:
            folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()
    except OSError as error:
        parser.error(f"{option}: cannot write into {str(folder)!r}: {error.strerror}.")


if __name__ == "__main__":
    main()
