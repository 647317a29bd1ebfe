"""The command line: `fdof-jax` or `python -m fdof_jax`.

JAX, whose import takes a second, is imported after the arguments have been parsed.
"""

import argparse
import math
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

from . import __version__

_COMMANDS = {
    "circle": "track the circle, tune the gains, track it again (the default)",
    "figures": "reproduce the paper's Figs 3 to 7",
    "topologies": "simulate all seven topologies by one compiled program",
    "league": "tune the gains of all seven topologies on one circle",
    "tune": "tune the gains of Fig 7's arm: circle, bounds, method, robustness",
}


def _number(kind: Callable[[str], Any], least: float, above: bool = False) -> Callable:
    """Returns a reader of finite numbers of at least `least`, or above it."""

    def read(text: str) -> Any:
        value = kind(text)
        if not least <= value < math.inf or (above and value == least):
            bound = "above" if above else "of at least"
            expected = f"expected a number {bound} {least}, got {text[:200]!r}"
            raise argparse.ArgumentTypeError(expected)
        return value

    read.__name__ = kind.__name__  # of messages
    return read


# Options of `tune`, as argparse takes them. The library checks what is left to check.
_ENDS: dict[str, Any] = dict(nargs=2, metavar=("LEAST", "GREATEST"))
_AMOUNT, _COUNT = _number(float, 0), _number(int, 1)
_METHODS = ["levenberg-marquardt", "l-bfgs"]
_OPTIONS: dict[str, dict[str, Any]] = {
    "center": dict(
        type=float, nargs=2, metavar=("X", "Y"),
        help="middle of the circle [m]; -4 2 by default",
    ),
    "radius": dict(type=_AMOUNT, help="radius of the circle [m]; 0.75 by default"),
    "period": dict(type=float, help="time of one turn [s], of two; 5 by default"),
    "price": dict(type=_AMOUNT, help="price of a joint's constant full effort [m^2]"),
    "members": dict(type=_COUNT, help="scenes of an ensemble; 16 by default"),
    "payload": dict(type=_AMOUNT, **_ENDS, help="ensemble: mass at the tip [kg]"),
    "start-offset": dict(type=_AMOUNT, help="ensemble: tip's offset at the start [m]"),
    "speed": dict(
        type=_number(float, 0, above=True), **_ENDS,
        help="ensemble: factor on the speed",
    ),
    "link-error": dict(
        type=_AMOUNT, help="ensemble: relative error of links' mass data"
    ),
    "over": dict(
        choices=["mean", "worst"], help="of the ensemble; mean by default"
    ),
    "factor": dict(
        type=_number(float, 1, above=True),
        help="bounds of the gains over the paper's; 4 by default",
    ),
    "method": dict(choices=_METHODS, help="levenberg-marquardt by default"),
    "starts": dict(
        type=_COUNT, help="runs; later ones from random gains; 1 by default"
    ),
    "seed": dict(type=_number(int, 0), help="seed of random gains; 0 by default"),
    "max-steps": dict(type=_COUNT, help="steps of a run; 50 by default"),
}  # fmt: skip


def main(arguments: list[str] | None = None) -> None:
    """Parses the command line, runs the command, and prints its results."""
    parser = _parser()
    options = vars(parser.parse_args(arguments))
    command, output = options.pop("command"), options.pop("output")
    try:
        output.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=output).close()
    except OSError as error:
        parser.error(
            f"--output: cannot write into {str(output)[:200]!r}: {error.strerror}."
        )

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
            for option, settings in _OPTIONS.items():
                command.add_argument(f"--{option}", **settings)
    return parser


def _folder(text: str) -> Path:
    if "://" in text:  # which `Path` would take for a folder
        expected = f"expected a folder on this machine, got {text[:200]!r}"
        raise argparse.ArgumentTypeError(expected)
    return Path(text)


def _add_output(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--output",
        type=_folder,
        metavar="FOLDER",
        help="where to write the files; fdof-output by default",
    )


if __name__ == "__main__":
    main()
