"""The Python interface, on any number of ranks."""

import gc
import os
import signal
import subprocess
import sys

import numpy as np
import pytest

import lyra_petsc
from lyra_petsc.mesh.gmsh_sandbox import supported_layers

SCENE = {
    "mesh": {"grid": {"width": 1.0, "height": 1.0, "nx": 4, "ny": 4}},
    "material": {
        "density": 0.15,
        "membrane": {"c11": 800, "c22": 800, "c12": 160, "c33": 240},
        "bending": 2.0e-5,
        "damping": 0.005,
    },
    "gravity": [0, 0, -9.81],
    "handles": [{"nodes": [0, 4]}],
    "time": {"end": 0.05, "step": 0.01},
    "output": {"every": 0.02, "fields": ["velocity", "stress"]},
}


@pytest.mark.parallel(2)
def test_a_run_is_read_after_it(shared_tmp, comm):
    taken = []
    run = lyra_petsc.run(SCENE, shared_tmp / "out", on_step=lambda report: taken.append(report.time))

    assert run.finished
    np.testing.assert_allclose(taken, [0.01, 0.02, 0.03, 0.04, 0.05])
    np.testing.assert_allclose(run.times, [0.0, 0.02, 0.04, 0.05])
    assert run.positions[-1].shape == (25, 3)
    assert run.positions[-1][12, 2] < -0.005  # fell
    np.testing.assert_array_equal(run.positions[-1][[0, 4]], run.rest[[0, 4]])  # held
    with pytest.raises(lyra_petsc.InputError, match="exists; name another folder"):
        lyra_petsc.run(SCENE, shared_tmp / "out")
    comm.barrier()
    longer = lyra_petsc.load(SCENE, {"time.end": 0.06})
    assert lyra_petsc.run(longer, shared_tmp / "out", resume=True).times[-1] == pytest.approx(0.06)


@pytest.mark.parallel(2)
def test_a_loop_over_the_steps_agrees_with_a_run(shared_tmp, comm):
    run = lyra_petsc.run(SCENE, shared_tmp / "out")
    steps = []
    with lyra_petsc.Simulation(SCENE) as simulation:
        assert simulation.time == 0.0
        start = simulation.gather(simulation.positions)
        assert not simulation.finished
        for step in simulation:
            steps.append(step)
        assert simulation.finished
        position = simulation.gather(simulation.positions)
        velocity = simulation.gather(steps[-1].velocities)
        stress = simulation.gather(simulation.field("stress"), on="triangle")
        mesh, vertices = simulation.mesh, simulation.vertices
        owned = simulation.positions
    with pytest.raises(lyra_petsc.InputError, match="closed"):
        simulation.step()

    assert [step.number for step in steps] == [1, 2, 3, 4, 5]
    assert steps[-1].time == pytest.approx(0.05)
    np.testing.assert_allclose(
        [s.energies["kinetic"] for s in steps], run.history["kinetic_energy"][1:], rtol=1e-7
    )
    assert not np.array_equal(steps[0].positions, steps[1].positions)  # copies
    assert comm.allreduce(len(vertices)) == 25
    np.testing.assert_allclose(owned, run.positions[-1][vertices], atol=1e-9)
    if comm.rank == 0:
        np.testing.assert_array_equal(start, mesh.positions)
        np.testing.assert_allclose(position, run.positions[-1], atol=1e-9)
        np.testing.assert_allclose(velocity, run.velocities[-1], atol=1e-7)
        np.testing.assert_allclose(stress, run.field("stress")[-1], atol=1e-5)
        np.testing.assert_array_equal(mesh.triangles, run.triangles)
    else:
        assert position is None
        assert mesh is None


@pytest.mark.parallel(2)
def test_forces_on_obstacles_after_each_step(shared_tmp, comm):
    floor = {"plane": {"point": [0, 0, -0.01], "normal": [0, 0, 1]}}
    ball = {"sphere": {"center": [0, 0, -1], "radius": 0.99}}
    scene = SCENE | {"contact": {"friction": 0.3}, "obstacles": {"floor": floor, "ball": ball}}
    forces = []
    with lyra_petsc.Simulation(scene) as simulation:
        forces.append(simulation.obstacle_forces)
        for _ in simulation:
            forces.append(simulation.obstacle_forces)
    run = lyra_petsc.run(scene, shared_tmp / "out")
    names = ["fx", "fy", "fz", "tx", "ty", "tz", "normal", "friction"]
    table = np.column_stack([np.asarray(run.obstacles[name]) for name in names])
    assert list(forces[0]) == ["floor", "ball"]
    assert table[-2, 2] < -0.1
    expected = np.concatenate([[force["floor"], force["ball"]] for force in forces])
    np.testing.assert_allclose(table.astype(float), expected, atol=1e-9)


def test_scenes_are_loaded_and_changed(tmp_path):
    flag = lyra_petsc.load()
    assert flag.title.startswith("Flag")
    changed = flag.changed(
        {"time.end": np.float64(0.1), "wind.velocity": np.array([0, 8, 0]), "handles[0].until": 1}
    )
    assert (changed.time.end, changed.wind.velocity, changed.handles[0].until) == (0.1, (0.0, 8.0, 0.0), 1.0)
    assert flag.time.end != 0.1
    assert changed.changed({"wind": None}).wind is None
    floor = {"plane": {"point": [0, 0, -3], "normal": [0, 0, 1]}}
    obstructed = changed.changed({"contact": {}, "obstacles": {"a": floor, "b": floor}})
    assert list(obstructed.changed({"obstacles.a": None}).obstacles) == ["b"]
    assert changed.source == flag.source
    # defaults follow the change: a static analysis has no integrator
    static = lyra_petsc.load(SCENE, {"time": {"analysis": "static"}})
    assert static.time.integrator is None
    assert lyra_petsc.load(SCENE) == lyra_petsc.load(lyra_petsc.load(SCENE))
    (tmp_path / "sub").mkdir()
    (tmp_path / "sub" / "sheet.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    text = "mesh: {file: sheet.obj}\nmaterial: {cloth: gray-interlock}\n"
    (tmp_path / "sub" / "scene.yaml").write_text(text + "time: {end: 1, step: 0.1}\n")
    scene = lyra_petsc.load(tmp_path / "sub" / "scene.yaml")
    assert scene.changed({"time.end": 2}).mesh[0].file == tmp_path / "sub" / "sheet.obj"


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"time.stepp": 1}, r"time\.stepp: unknown key, did you mean 'step'"),
        ({"time.end": float("nan")}, r"time\.end: must be a finite number"),
        ({"material.density": np.array([1.0])}, r"material\.density: must be a number"),
        ({"handles[4].until": 1}, r"handles is a list; give an index"),
        ({"": 1}, r"must read key\.path"),
        ({"mesh": {"file": "nowhere.obj"}}, r"mesh\.file: no such file"),
    ],
)
def test_mistakes_are_one_line(changes, words):
    with pytest.raises(lyra_petsc.InputError, match=words) as caught:
        lyra_petsc.load(SCENE, changes)
    assert "\n" not in str(caught.value)
    assert "--set" not in str(caught.value)


def test_many_simulations_in_one_process(tmp_path):
    def options():
        from petsc4py import PETSc

        return PETSc.Options().getAll()

    before = options()
    for nx in (1, 2, 3, 2):
        with lyra_petsc.Simulation(
            lyra_petsc.load(SCENE, {"mesh.grid.nx": nx, "petsc.ksp_rtol": 1e-9})
        ) as one:
            other = lyra_petsc.Simulation(one.scene)  # at the same time
            first = one.step()
            np.testing.assert_allclose(other.step().positions, first.positions, atol=1e-12)
            with pytest.raises(lyra_petsc.InputError, match="has other PETSc options"):
                lyra_petsc.Simulation(SCENE)
            with pytest.raises(lyra_petsc.InputError, match="has other PETSc options"):
                lyra_petsc.run(SCENE, tmp_path / "out")
            other.close()
    assert options() == before
    # forgotten without being closed
    lyra_petsc.Simulation(SCENE).step()
    gc.collect()
    with pytest.raises(lyra_petsc.InputError, match="no vertex 77"):
        lyra_petsc.Simulation(lyra_petsc.load(SCENE, {"handles[0].nodes": [77], "petsc.ksp_rtol": 1e-9}))
    assert options() == before


def test_a_failed_step_is_an_exception(tmp_path):
    scene = lyra_petsc.load(SCENE, {"solver.max_iterations": 1, "petsc.ts_adapt_dt_min": 0.01})
    with pytest.raises(lyra_petsc.SolverError) as caught, lyra_petsc.Simulation(scene) as simulation:
        list(simulation)
    assert "\n" not in str(caught.value)
    with pytest.raises(lyra_petsc.SolverError):
        lyra_petsc.run(scene, tmp_path / "out")
    assert len(lyra_petsc.Run(tmp_path / "out").positions) == 1
    lyra_petsc.run(SCENE, tmp_path / "next")  # the next is not touched by it


def test_mesh_scripts_read_other_folders_on_request(tmp_path):
    if "Landlock" not in supported_layers():
        pytest.skip("the kernel has no Landlock")
    corners = "Point(1) = {0,0,0,0.5}; Point(2) = {1,0,0,0.5}; Point(3) = {0,1,0,0.5};"
    sides = "Line(1) = {1,2}; Line(2) = {2,3}; Line(3) = {3,1};"
    surface = "Curve Loop(1) = {1,2,3}; Plane Surface(1) = {1};"
    (tmp_path / "corners.geo").write_text(f"{corners}\n")
    (tmp_path / "inside").mkdir()
    (tmp_path / "inside" / "m.geo").write_text("\n".join(['Include "../corners.geo";', sides, surface, ""]))
    scene = SCENE | {"mesh": {"file": str(tmp_path / "inside" / "m.geo")}, "handles": [{"nodes": [0]}]}
    with pytest.raises(lyra_petsc.InputError, match=r"corners\.geo"):
        lyra_petsc.run(scene, tmp_path / "out")
    assert len(lyra_petsc.run(scene, tmp_path / "out", trust_mesh=True)) > 1


def test_an_interrupt_finishes_the_step_and_writes_a_checkpoint(tmp_path):
    def interrupt(report):
        if report.step == 2:
            os.kill(os.getpid(), signal.SIGINT)

    before = signal.getsignal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt, match="after step"):
        lyra_petsc.run(SCENE, tmp_path / "out", on_step=interrupt)
    assert signal.getsignal(signal.SIGINT) == before
    run = lyra_petsc.run(SCENE, tmp_path / "out", resume=True)
    assert list(run.history["step"]) == [0, 1, 2, 3, 4, 5]


def test_the_import_loads_no_large_packages():
    program = """
import sys, lyra_petsc
assert lyra_petsc.__version__
assert {"run", "load", "Simulation", "Run"} <= set(dir(lyra_petsc))
heavy = {"numpy", "h5py", "numba", "pydantic", "mpi4py", "petsc4py"}
assert not heavy & sys.modules.keys()
grid = {"grid": {"width": 1, "height": 1, "nx": 1, "ny": 1}}
time = {"end": 1, "step": 0.1}
lyra_petsc.load({"mesh": grid, "material": {"cloth": "gray-interlock"}, "time": time})
assert not {"mpi4py.MPI", "petsc4py.PETSc", "numba"} & sys.modules.keys()
try:
    lyra_petsc.nothing
except AttributeError as error:
    assert "nothing" in str(error)
else:
    raise AssertionError
"""
    subprocess.run([sys.executable, "-c", program], check=True)


def test_names_that_no_file_can_have_are_refused() -> None:
    for name in ("\ud800", "a\0b"):
        with pytest.raises(lyra_petsc.InputError, match="no file can have the name"):
            lyra_petsc.Run(name)
        with pytest.raises(lyra_petsc.InputError, match="out: no file can have the name"):
            lyra_petsc.run(lyra_petsc.load(SCENE), name)
