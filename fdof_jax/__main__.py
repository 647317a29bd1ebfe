"""The command line: `fdof-jax` or `python -m fdof_jax`.

JAX, whose import takes a second, is imported after the arguments have been parsed.
"""

import argparse
import tempfile
from pathlib import Path

from . import __version__

_COMMANDS = {
    "circle": "track the circle, tune the gains, track it again (the default)",
    "figures": "reproduce the paper's Figs 3 to 7",
    "topologies": "simulate all seven topologies in one compiled batched call",
    "league": "tune the gains of all seven topologies on one circle",
    "tune": "tune the gains of Fig 7's arm: circle, bounds, method, robustness",
}
# Options of `tune`: type of the numbers, their names if there are two, and the help.
_ENDS = "LEAST", "GREATEST"
_OPTIONS = {
    "center": (float, ("X", "Y"), "middle of the circle [m]; -4 2 by default"),
    "radius": (float, None, "radius of the circle [m]; 0.75 by default"),
    "period": (float, None, "time of one turn [s], of two; 5 by default"),
    "price": (float, None, "price of a joint's constant full effort [m^2]"),
    "members": (int, None, "number of scenes of an ensemble; 16 by default"),
    "payload": (float, _ENDS, "ensemble: mass at the tip [kg]"),
    "start-offset": (float, None, "ensemble: tip's offset at the start [m]"),
    "speed": (float, _ENDS, "ensemble: factor on the speed"),
    "link-error": (float, None, "ensemble: relative error of links' mass data"),
    "over": (str, None, "mean or worst of the ensemble; mean by default"),
    "factor": (float, None, "bounds of the gains over the paper's; 4 by default"),
    "method": (str, None, "levenberg-marquardt (the default), l-bfgs or adam"),
    "starts": (int, None, "runs; later ones from random gains; 1 by default"),
    "seed": (int, None, "seed of random gains; 0 by default"),
    "max-steps": (int, None, "steps of a run; 50 by default"),
}


def main(arguments: list[str] | None = None) -> None:
    """Parses the command line, runs the command, and prints its results."""
    parser = _parser()
    options = vars(parser.parse_args(arguments))
    command, output = options.pop("command"), options.pop("output")
    try:
        output.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=output).close()
    except OSError as error:
        parser.error(f"--output: cannot write into {str(output)!r}: {error.strerror}.")

    from .shell import commands

    try:
        files = commands.run(command, output, options)
    except ValueError as error:  # names the option
        parser.error(str(error))
    print(f"\nfiles in {output}/: {', '.join(file.name for file in files)}")


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="fdof-jax",
        description="Dynamics of planar open-chain linkages. Without a command, the "
        "RPR arm of the paper's Fig 7 tracks a circle with the paper's PD gains, its "
        "gains are tuned by gradients, and it tracks the circle again.",
    )
    parser.add_argument("--version", action="version", version=__version__)
    _add_output(parser)
    commands = parser.add_subparsers(dest="command", metavar="command")
    parser.set_defaults(command="circle", output=Path("fdof-output"))
    for name, text in _COMMANDS.items():
        command = commands.add_parser(
            name,
            help=text,
            description=f"{text[0].upper()}{text[1:]}.",
            # Only what is given is passed on, so that the library's defaults hold.
            argument_default=argparse.SUPPRESS,
        )
        _add_output(command)
        if name == "tune":
            for option, (kind, parts, words) in _OPTIONS.items():
                command.add_argument(
                    f"--{option}",
                    type=kind,
                    nargs=len(parts) if parts else None,
                    metavar=parts,
                    help=words,
                )
    return parser


def _add_output(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--output",
        type=Path,
        metavar="FOLDER",
        help="where to write the files; fdof-output by default",
    )


if __name__ == "__main__":
    main()
