"""The verbs and their options; their work is in the modules of the same names.

Some modules declare their verbs themselves. All verbs are registered at the end.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import click

from lyra_petsc import __version__
from lyra_petsc.cli.new import new
from lyra_petsc.cli.options import (
    SETTINGS,
    Session,
    add_help,
    example,
    out,
    prints,
    scene,
    settings,
    trust_mesh,
    verb,
)
from lyra_petsc.cli.render import export, render, report
from lyra_petsc.cli.view import Served, server_options, view
from lyra_petsc.errors import InputError, suggest


class _Verbs(click.Group):
    """Resolves verbs; help goes to rank 0 only."""

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        name = args[0]
        if ctx.resilient_parsing:  # shell completion
            return super().resolve_command(ctx, args)
        if self.get_command(ctx, name) is None:
            hint = (
                "give a verb first, as in: run " + name
                if Path(name).suffix
                else suggest(name, list(self.commands))
            )
            raise InputError(f"unknown verb, {hint}", key=name)
        return super().resolve_command(ctx, args)


@click.group(
    cls=_Verbs,
    context_settings=SETTINGS,
    invoke_without_command=True,
    epilog=example("lyra-petsc new kite", "mpirun -n 2 lyra-petsc run kite.yaml"),
)
@add_help
@prints("--version", lambda _: f"lyra-petsc {__version__}", "Show the version and exit.")
@click.pass_context
def verbs(ctx: click.Context) -> None:
    """Thin-shell simulation (cloth, membranes, plates) in parallel on PETSc.

    mpirun -n P lyra-petsc VERB [SCENE] [--our options] [-petsc options]
    """
    if ctx.invoked_subcommand is None and ctx.obj.comm.rank == 0:
        click.echo(ctx.get_help())


@verb(
    "mpirun -n 2 lyra-petsc run configs/flag.yaml --set time.end=1 -ksp_monitor",
    "lyra-petsc run configs/flag.yaml --resume",
)
@scene
@settings
@out
@click.option("--force", is_flag=True, help="Replace the results in DIR.")
@click.option("--resume", is_flag=True, help="Continue from the newest checkpoint.")
@trust_mesh
@click.option("--live", is_flag=True, help="Show the run in the browser while it is running.")
@server_options
def run(
    comm: Any, /, live: bool, host: str | None, port: int | None, no_browser: bool, **options: Any
) -> None:
    """Simulate SCENE (default: a flag in the wind)."""
    from lyra_petsc.cli.run import run as run_scene

    run_scene(comm, served=Served.of_live(live, host, port, no_browser), **options)


@verb(
    "lyra-petsc check configs/flag.yaml --set mesh.size=0.02",
    "lyra-petsc check runs/flag",
    start=lambda session: session,
)
@click.argument("path", required=False, type=click.Path(path_type=Path), metavar="[SCENE|RUN]")
@settings
@trust_mesh
@click.option("--schema", is_flag=True, help="Print the JSON Schema of scene files, for editors.")
@click.option(
    "--crossings", is_flag=True, help="Exit code 1 if triangles cross in RUN, also without contact."
)
def check(
    session: Session,
    path: Path | None,
    settings: tuple[str, ...],
    trust_mesh: bool,
    schema: bool,
    crossings: bool,
) -> int:
    """Check SCENE and print what a run would do; or count crossing triangles in the states of RUN."""
    from lyra_petsc.parallel import on_root

    if crossings and path is None:
        raise InputError("needs the folder of a run, as in: check runs/flag --crossings", key="--crossings")
    if path is not None and (crossings or on_root(session.comm, lambda: os.path.isdir(path))):
        if settings or trust_mesh or schema:
            raise InputError("for the folder of a run there is no option but --crossings", file=path)
        from lyra_petsc.cli.check_run import check_run

        return check_run(session.without_petsc(), path, crossings=crossings)
    if schema:
        from lyra_petsc.scene.json_schema import schema_text

        if session.without_petsc().rank == 0:
            click.echo(schema_text(), nl=False)
        return 0
    comm = session.start_petsc()  # else PETSc would start without its options by the import
    from lyra_petsc.cli.check import check as check_scene

    check_scene(comm, path, settings, trust_mesh=trust_mesh)
    return 0


@verb("lyra-petsc verify --quick", "lyra-petsc verify --list")
@click.argument("names", nargs=-1, metavar="[NAME]...")
@click.option("--quick", is_flag=True, help="Only the coarser resolutions of each case.")
@click.option("--list", "listed", is_flag=True, help="Name the cases; runs nothing.")
@out
@click.option("--force", is_flag=True, help="Write into DIR also if it exists.")
def verify(comm: Any, /, names: tuple[str, ...], **asked: Any) -> int:
    """Run the cases with exact or published answers (default: all); exit code 1 if a verdict fails."""
    from lyra_petsc.cli.experiments import verify as verify_cases

    return verify_cases(comm, names, **asked)


@verb("lyra-petsc study configs/swing.yaml --vary integrator=beuler,bdf2 --vary dt=0.02,0.01")
@scene
@settings
@trust_mesh
@click.option(
    "--vary",
    multiple=True,
    metavar="KEY=V,V,…",
    help="What varies: dt, mesh, integrator, tolerance, ksp_rtol (any PETSc option), any key of the scene; "
    "may be repeated, all combinations are run.",
)
@click.option("--reference", metavar="auto|finer|exact:NAME|run:DIR", help="The reference for errors.")
@click.option("--quantities", metavar="NAME,NAME,…", help="position, energy, probes, or a probe's name.")
@click.option("--repeats", type=int, metavar="N", help="How often each combination is timed (3).")
@click.option("--ranks", type=int, metavar="P", help="Start one mpirun on P ranks for each case.")
@out
@click.option("--force", is_flag=True, help="Replace the results in DIR.")
@click.option("--resume", is_flag=True, help="Continue without repeating finished combinations.")
@click.option("--job", type=click.Path(path_type=Path), hidden=True)
def study(comm: Any, /, job: Path | None, **asked: Any) -> None:
    """Error against run time: run, time and compare combinations of settings of SCENE."""
    from lyra_petsc.extras import require_packages

    require_packages("study")
    if job is not None:
        from lyra_petsc.cli.experiments import stop_check
        from lyra_petsc.experiments.study.jobs import run_job

        run_job(comm, job, stop_check(comm))
    else:
        from lyra_petsc.cli.study import study as study_scene

        study_scene(comm, **asked)


@verb("lyra-petsc stress --quick", "mpirun -n 2 lyra-petsc stress configs/drape.yaml --list")
@scene
@settings
@trust_mesh
@click.option("--only", multiple=True, metavar="NAME,NAME,…", help="Only these cases or families.")
@click.option("--quick", is_flag=True, help="Fewer cases, on a coarser sheet: less than a minute.")
@click.option("--full", is_flag=True, help="All values, and their products.")
@click.option("--list", "listed", is_flag=True, help="Name the cases; runs nothing.")
@out
@click.option("--force", is_flag=True, help="Write into DIR also if it exists.")
@click.option("--ranks", type=int, metavar="P", help="Start one mpirun on P ranks for each case.")
@click.option("--job", type=click.Path(path_type=Path), hidden=True)
def stress(comm: Any, /, **asked: Any) -> int:
    """Run stiff and extreme cases, on a hanging sheet or on SCENE; exit code 1 if a verdict fails."""
    from lyra_petsc.cli.experiments import stress as stress_cases

    return stress_cases(comm, **asked)


@verb(
    "lyra-petsc fabric bending gray-interlock",
    "mpirun -n 2 lyra-petsc fabric cantilever scene.yaml",
    "lyra-petsc fabric all --cloth 11oz-black-denim",
)
@click.argument("test")
@click.argument("material", required=False)
@click.option("--cloth", metavar="NAME", help="A cloth of the library, instead of MATERIAL.")
@settings
@out
@click.option("--force", is_flag=True, help="Write into DIR also if it exists.")
@click.option("--ranks", type=int, metavar="P", help="Start one mpirun on P ranks for each test.")
@click.option("--only", hidden=True)
@click.option("--job", type=click.Path(path_type=Path), hidden=True)
def fabric(comm: Any, /, **asked: Any) -> int:
    """Run a standard textile test on MATERIAL, a cloth of the library or a scene's first material.

    TEST is tensile, shear, bending, cantilever, loop, cusick, or all of them.
    """
    from lyra_petsc.cli.experiments import fabric as textile_tests

    return textile_tests(comm, **asked)


@verb("lyra-petsc fit strip.yaml", "mpirun -n 2 lyra-petsc fit strip.yaml -tao_type blmvm --resume")
@scene
@settings
@trust_mesh
@out
@click.option("--force", is_flag=True, help="Replace the results in DIR.")
@click.option("--resume", is_flag=True, help="Continue without repeating evaluations.")
@click.option("--ranks", type=int, metavar="P", help="Start one mpirun on P ranks.")
def fit(comm: Any, /, **asked: Any) -> int:
    """Find parameters of SCENE from measurements, given by its block fit, with 95 % intervals."""
    from lyra_petsc.cli.fit import fit as fit_numbers

    return fit_numbers(comm, **asked)


@verb("lyra-petsc info")
def info(comm: Any) -> None:
    """Print versions, and parts that do not fit together."""
    from lyra_petsc.cli.info import info as describe

    text = describe(comm)
    if comm.rank == 0:
        click.echo(text)


for command in (check, export, fabric, fit, info, new, render, report, run, stress, study, verify, view):
    verbs.add_command(command)
