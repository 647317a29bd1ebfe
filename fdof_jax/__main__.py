"""The command line: `fdof-jax` or `python -m fdof_jax`."""

import argparse
import dataclasses
from pathlib import Path
from typing import Any

import jax
import matplotlib

from . import __version__, showcase, tuning_run
from .bounded_search import METHODS
from .league import circle_scenes, league_table
from .tuning import tune_each


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
    elif options.command == "league":
        _run_league()
        return
    elif options.command == "tune":
        pictures = _run_tuning(parser, options)
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


def _add_tuning(command: argparse.ArgumentParser) -> None:
    job = command.add_argument_group("the circle, and by what gains are judged")
    for name, count, kind, text in (
        ("center", 2, float, "middle of the circle, x y [m]"),
        ("radius", None, float, "of the circle [m]"),
        ("period", None, float, "time of one turn; two are simulated [s]"),
        ("factor", None, float, "the gains stay within this factor of the paper's"),
        ("price", None, float, "of full effort of one joint all the time [m^2]"),
        ("members", None, int, "size of the ensemble"),
        (
            "payload",
            2,
            float,
            "of the ensemble: least and greatest mass at the tip [kg]",
        ),
        ("start-offset", None, float, "of the ensemble: of the tip at the start [m]"),
        ("speed", 2, float, "of the ensemble: least and greatest speed, 1 as said"),
        ("link-error", None, float, "of the ensemble: relative error of masses"),
    ):
        default = getattr(tuning_run.Job, name.replace("-", "_"))
        shown = " ".join(map(str, default)) if count else default
        job.add_argument(
            f"--{name}", nargs=count, type=kind, help=f"{text}; {shown} by default"
        )
    job.add_argument(
        "--over",
        choices=("nominal", "mean", "worst"),
        help="judge gains by the nominal scene, or by the mean or the worst of an "
        "ensemble; nominal by default",
    )
    search = command.add_argument_group("the search")
    # No defaults here: they would override what --resume has read.
    search.add_argument(
        "--method", choices=tuple(METHODS), help="levenberg-marquardt by default"
    )
    search.add_argument("--starts", type=int, help="runs; 1 by default")
    search.add_argument("--seed", type=int, help="of the random starts; 0 by default")
    search.add_argument("--max-steps", type=int, help="50 by default")
    search.add_argument("--save", type=Path, metavar="FILE", help="keep the result")
    search.add_argument(
        "--resume",
        type=Path,
        metavar="FILE",
        help="go on with what --save has kept: its circle, bounds, ensemble and search "
        "(with other random starts)",
    )


def _run_league() -> None:
    _say("tune all seven topologies in one compiled program")
    results = tune_each(circle_scenes(), report=print)
    print(f"\n{league_table(results)}")


def _run_tuning(parser: argparse.ArgumentParser, options: Any) -> list[Path]:
    def of(names):
        return {n: v for n in names if (v := getattr(options, n)) is not None}

    given = of(field.name for field in dataclasses.fields(tuning_run.Job))
    search = of(("method", "starts", "seed", "max_steps"))
    if given and options.resume is not None:
        parser.error(
            f"--resume: the file says what is tuned, also given: {', '.join(given)}"
        )
    of_ensemble = {"members", "payload", "start_offset", "speed", "link_error"}
    if options.over in (None, "nominal") and of_ensemble & set(given):
        parser.error(
            f"--over: mean or worst is needed for {', '.join(of_ensemble & set(given))}"
        )
    try:
        run = tuning_run.run_tuning(
            options.output,
            _say,
            print,
            job=tuning_run.Job(**given),
            resume=options.resume,
            save_to=options.save,
            **search,
        )
    except (ValueError, OSError) as error:
        parser.error(str(error))
    print(f"\n{run.result}")
    for when, report in zip(("before", "after"), run.reports):
        print(f"\n{when} tuning: {report}")
    return run.pictures


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
