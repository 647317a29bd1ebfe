"""The command line: `fdof-jax` or `python -m fdof_jax`."""

import argparse
from pathlib import Path

import jax
import matplotlib

from . import __version__, showcase


def main(arguments: list[str] | None = None) -> None:
    """Parse the command line, run what it names, print the results."""
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
    ):
        command = commands.add_parser(
            name, help=text, description=f"{text[0].upper()}{text[1:]}."
        )
        # No default here: it would override an --output given before the command.
        _add_output(command, argparse.SUPPRESS)
    options = parser.parse_args(arguments)

    matplotlib.use("agg")  # pictures are written, never shown
    jax.config.update("jax_enable_x64", True)
    if options.command == "figures":
        pictures = showcase.run_figures(options.output, _say)
    elif options.command == "topologies":
        solutions, picture = showcase.run_topologies(options.output, _say)
        for topology, (_, solution) in solutions.items():
            print(f"  {topology}: {int(solution.stats['num_steps'])} steps")
        pictures = [picture]
    else:
        run = showcase.run_circle(options.output, _say, print)
        _print_circle(run)
        pictures = run.pictures
    print(f"\npictures in {options.output}/: {', '.join(p.name for p in pictures)}")


def _add_output(parser: argparse.ArgumentParser, default: Path | str) -> None:
    parser.add_argument(
        "--output",
        type=Path,
        default=default,
        metavar="FOLDER",
        help="where to write the pictures (PNG); fdof-output by default",
    )


def _say(text: str) -> None:
    print(f"{text} ...", flush=True)


def _print_circle(run: showcase.CircleRun) -> None:
    before, after = run.before, run.after
    joints = "T2", "F2", "T4"
    kp_units, kd_units = (
        ("N m/rad", "N/m", "N m/rad"),
        ("N m s/rad", "N s/m", "N m s/rad"),
    )
    rows = [
        ("tip error, whole run: rms [mm]", 1e3 * before.rms, 1e3 * after.rms),
        ("  largest [mm]", 1e3 * before.largest, 1e3 * after.largest),
        ("second period: rms [mm]", 1e3 * before.rms_second, 1e3 * after.rms_second),
        ("  largest [mm]", 1e3 * before.largest_second, 1e3 * after.largest_second),
    ]
    for k, joint in enumerate(joints):
        rows.append((f"kp of {joint} [{kp_units[k]}]", before.kp[k], after.kp[k]))
    for k, joint in enumerate(joints):
        rows.append((f"kd of {joint} [{kd_units[k]}]", before.kd[k], after.kd[k]))
    for k, joint in enumerate(joints):
        share = 100 * before.saturated[k], 100 * after.saturated[k]
        rows.append((f"time at the limit of {joint} [%]", *share))
    print(f"\n{'':34}{'paper':>12}{'tuned':>12}")
    for label, first, second in rows:
        print(f"{label:34}{first:12.5g}{second:12.5g}")
    history = run.tuned.history
    print(
        f"\ntuning: {len(history.loss) - 1} iterations, {run.tuned.message}; projected "
        f"gradient {history.gradient_norm[0]:.2g} -> {history.gradient_norm[-1]:.2g}"
    )
    times = ", ".join(
        f"{what} {seconds:.1f} s" for what, seconds in run.wall_times.items()
    )
    print(f"time, compilation included: {times}")


if __name__ == "__main__":
    main()
