"""Each mistake in a scene is one InputError, which names the file, the key and what is allowed."""

from __future__ import annotations

import pickle
from pathlib import Path

import pytest

from lyra_petsc.errors import InputError
from lyra_petsc.scene.load import load_scene

pytestmark = pytest.mark.quick

GRID = "mesh: {grid: {width: 1, height: 1, nx: 2, ny: 2}}"
BASE = {"mesh": GRID, "material": "material: {cloth: paper}", "time": "time: {end: 1, step: 0.01}"}


def scene_text(part: str) -> str:
    """A valid scene in which ``part`` replaces the block of the same key."""
    first = part.split(":", 1)[0]
    return "\n".join([text for key, text in BASE.items() if key != first] + [part]) + "\n"


SHEET = "density: 1, membrane: {c11: 1, c22: 1, c12: 0, c33: 1}, "

PLANE = "plane: {point: [0, 0, 0], normal: [0, 0, 1]}"
BALL = "{ball: {sphere: {center: [0, 0, 0], radius: 1}}}"

# (block, key in the message, message in the message)
CASES = [
    # unknown keys, at every depth, with the nearest
    ("gravitty: [0, 0, -9.81]", "gravitty", "did you mean 'gravity'"),
    ("mesh: {gird: {}}", "mesh.gird", "did you mean 'grid'"),
    ("mesh: {grid: {widht: 1, height: 1, nx: 2, ny: 2}}", "mesh.grid.widht", "'width'"),
    ("mesh: [{grid: {width: 1, heigth: 1, nx: 2, ny: 2}}]", "mesh[0].grid.heigth", "'height'"),
    ("handles: [{group: a}, {grup: a}]", "handles[1].grup", "'group'"),
    ("handles: [{group: a, start: 0}]", "handles[0].start", "known: "),
    ("material: {cloth: paper, dampng: 1}", "material.dampng", "'damping'"),
    ("output: {checkpoint: {second: 1}}", "output.checkpoint.second", "'seconds'"),
    ("motions: {swing: [{time: 0, rotate: {axis: [0, 0, 1], degree: 1}}]}",
     "motions.swing[0].rotate.degree", "'degrees'"),
    ("solver: {zzz: 1}", "solver.zzz", "known: force_tolerance"),
    ("1: 2", "1", "unknown key"),
    ('"a\\nb\\u202ec": 2', "a b\\u202ec", "unknown key"),
    ('"{message}": 2', "{message}", "unknown key"),
    # wrong types
    ("time: 3", "time", "must be a block with keys (analysis, end, step"),
    ("time: {end: 1, step: '1e-5'}", "time.step", "not '1e-5' (text; write it without quotes)"),
    ("time: {end: true, step: 1}", "time.end", "must be a number, not true"),
    ("gravity: -9.81", "gravity", "three numbers"),
    ("gravity: [0, 0]", "gravity", "three numbers"),
    ("gravity: [0, 0, down]", "gravity", "must be a number, not 'down'"),
    ("handles: {group: a}", "handles", "must be a list"),
    ("handles: 7", "handles", "must be a list, not 7"),
    ("motions: [1]", "motions", "block of names"),
    ("probes: {tip: 3}", "probes.tip", "must be a block"),
    ("output: {reactions: 1}", "output.reactions", "must be true or false, not 1"),
    ("output: {fields: velocity}", "output.fields", "must be a list"),
    ("mesh: {grid: {width: 1, height: 1, nx: 2.0, ny: 2}}", "mesh.grid.nx", "whole number"),
    ("title: 3", "title", "must be text"),
    ("mesh: {file: 3}", "mesh.file", "path of a mesh file"),
    ("handles: [{group: [a]}]", "handles[0].group", "must be text"),
    # contact and obstacles
    ("contact: 3", "contact", "must be a block with keys (gap, thickness, self, friction, untangle)"),
    ("contact: {gap: 0}", "contact.gap", "must be > 0, not 0"),
    ("contact: {thickness: -1}", "contact.thickness", "must be >= 0, not -1"),
    ("contact: {self: 1}", "contact.self", "must be true or false, not 1"),
    ("contact: {friction: -0.1}", "contact.friction", "must be >= 0, not -0.1"),
    ("contact: {friction: rough}", "contact.friction", "must be a number, not 'rough'"),
    ("contact: {friction: {static: 0.3}}", "contact.friction.kinetic", "missing"),
    ("contact: {friction: {static: 0.3, kinetic: 0.4}}", "contact.friction.kinetic", "at most static = 0.3"),
    (f"obstacles: {BALL}", "obstacles", "add the line 'contact: {friction: 0.3}'"),
    ("obstacles: [1]\ncontact: {gap: 1}", "obstacles", "block of names"),
    ("obstacles: {a: }\ncontact: {gap: 1}", "obstacles.a", "must be a block with keys (plane, sphere"),
    ("obstacles: {a: {cube: {}}}\ncontact: {gap: 1}", "obstacles.a.cube", "unknown key"),
    ("obstacles: {a: {friction: 1}}\ncontact: {gap: 1}",
     "obstacles.a", "must have exactly one of plane, sphere, capsule, box, mesh"),
    (f"obstacles: {{a: {{{PLANE}, sphere: {{center: [0, 0, 0], radius: 1}}}}}}\ncontact: {{gap: 1}}",
     "obstacles.a", "must have exactly one of"),
    ("obstacles: {a: {plane: {point: [0, 0, 0], normal: [0, 0, 0]}}}\ncontact: {gap: 1}",
     "obstacles.a.plane.normal", "must be a direction"),
    ("obstacles: {a: {sphere: {center: [0, 0, 0], radius: 0}}}\ncontact: {gap: 1}",
     "obstacles.a.sphere.radius", "must be > 0, not 0"),
    ("obstacles: {a: {sphere: {centre: [0, 0, 0], radius: 1}}}\ncontact: {gap: 1}",
     "obstacles.a.sphere.centre", "did you mean 'center'"),
    ("obstacles: {a: {capsule: {from: [0, 0, 0], to: [0, 0, 0], radius: 1}}}\ncontact: {gap: 1}",
     "obstacles.a.capsule.to", "another point than from; for a ball give sphere"),
    ("obstacles: {a: {box: {min: [0, 0, 0], max: [1, 0, 1]}}}\ncontact: {gap: 1}",
     "obstacles.a.box.max", "must be above min in y: 0 is not above 0"),
    ("obstacles: {a: {mesh: {file: a.step}}}\ncontact: {gap: 1}",
     "obstacles.a.mesh.file", "'a.step' must end in .geo, .msh, .obj"),
    ("obstacles: {a: {mesh: {file: none.obj}}}\ncontact: {gap: 1}", "obstacles.a.mesh.file", "no such file"),
    (f"obstacles: {{a: {{{PLANE}, inside: true}}}}\ncontact: {{gap: 1}}",
     "obstacles.a.inside", "is for sphere, capsule and box"),
    (f"obstacles: {{a: {{{PLANE}, motion: roll}}}}\ncontact: {{gap: 1}}",
     "obstacles.a.motion", "unknown motion 'roll'"),
    (f"obstacles: {{a: {{{PLANE}, motion: {{time: 0}}}}}}\ncontact: {{gap: 1}}",
     "obstacles.a.motion", "must be a list; put '- '"),
    (f"obstacles: {{a: {{{PLANE}, motion: []}}}}\ncontact: {{gap: 1}}",
     "obstacles.a.motion", "at least one keyframe"),
    (f"obstacles: {{a: {{{PLANE}, motion: [{{time: 1}}, {{time: 1}}]}}}}\ncontact: {{gap: 1}}",
     "obstacles.a.motion[1].time", "must be later than the keyframe before (1 s)"),
    (f"obstacles: {{a: {{{PLANE}, motion: [{{time: 0}}, {{time: 1, scale: 2}}]}}}}\ncontact: {{gap: 1}}",
     "obstacles.a.motion", "it scales in keyframe 1, but an obstacle is rigid: leave out scale"),
    (f"obstacles: {{a: {{{PLANE}, motion: m}}}}\ncontact: {{}}\nmotions: {{m: [{{time: 0, scale: 2}}]}}",
     "obstacles.a.motion", "motion 'm' scales in keyframe 0"),
    # not finite, out of range
    ("initial: {velocity: [0, 1.0e+200, 0]}", "initial.velocity", "must not be faster than 1e+08 m/s"),
    ("wind: {velocity: [0, -1.0e+9, 0], density: 1}", "wind.velocity", "faster than 1e+08 m/s"),
    ("handles: [{nodes: [0], axes: [x], symmetry: x}]", "handles[0].symmetry", "leave out axes, clamp"),
    ("handles: [{nodes: [0], stiffness: 1, symmetry: x}]", "handles[0].symmetry", "motion, stiffness"),
    ("handles: [{nodes: [0], from: 1, symmetry: x}]", "handles[0].symmetry", "stands still"),
    ("handles: [{nodes: [0], symmetry: w}]", "handles[0].symmetry", "must be one of x, y, z"),
    ("handles: [{nodes: [0], axes: [x, z], clamp: true, stiffness: 1}]", "handles[0].clamp", "hold all axes"),
    ("gravity: [0, 0, .nan]", "gravity", "finite"),
    ("time: {end: .inf, step: 0.1}", "time.end", "finite"),
    ("time: {end: 1" + "0" * 400 + ", step: 0.1}", "time.end", "below 1.8e308"),
    ("time: {end: 1, step: 0}", "time.step", "must be > 0, not 0"),
    ("time: {end: -1, step: 0.1}", "time.end", "must be > 0"),
    ("mesh: {grid: {width: 1, height: 1, nx: 0, ny: 2}}", "mesh.grid.nx", "a whole number >= 1, not 0"),
    ("mesh: {grid: {width: 1, height: 1, nx: 99999999999, ny: 2}}", "mesh.grid.nx", "<= 2147483646"),
    ("mesh: {grid: {width: 0, height: 1, nx: 2, ny: 2}}", "mesh.grid.width", "> 0"),
    ("mesh: {grid: {width: 1, height: 1, nx: 2, ny: 2, pattern: cross}}", "mesh.grid.pattern", "criss-cross"),
    (GRID[:-1] + ", transform: {scale: 0}}", "mesh.transform.scale", "not be 0"),
    (GRID[:-1] + ", transform: {scale: [1, -1, 1]}}", "mesh.transform.scale", "> 0"),
    (GRID[:-1] + ", transform: {rotate: {axis: [0, 0, 0], degrees: 3}}}",
     "mesh.transform.rotate.axis", "zero vector"),
    (GRID[:-1] + ", size: 0.1}", "mesh.size", ".geo files only"),
    (GRID[:-1] + ", algorithm: delaunay}", "mesh.algorithm", ".geo files only"),
    ("mesh: {file: a.geo, algorithm: delauney}", "mesh.algorithm", "delaunay, frontal"),
    ("material: {cloth: paper, damping: -1}", "material.damping", ">= 0"),
    ("material: {cloth: paper, thicken: 0}", "material.thicken", "> 0"),
    ("wind: {velocity: [1, 0, 0], density: -1}", "wind.density", ">= 0"),
    ("solver: {force_tolerance: 0}", "solver.force_tolerance", "> 0"),
    ("solver: {hessian: exakt}", "solver.hessian", "one of adaptive, regularised, exact"),
    ("output: {every: 0}", "output.every", "> 0"),
    ("handles: [{nodes: [-1]}]", "handles[0].nodes[0]", ">= 0"),
    ("handles: [{nodes: [99999999999999999999]}]", "handles[0].nodes[0]", "<= "),
    ("handles: [{nodes: []}]", "handles[0].nodes", "list of vertex numbers"),
    ("handles: [{nodes: [1, 2, 1]}]", "handles[0].nodes", "vertex 1 twice"),
    ("handles: [{group: a, stiffness: 0}]", "handles[0].stiffness", "> 0"),
    ("handles: [{group: a, axes: [w]}]", "handles[0].axes", "x, y, z"),
    ("handles: [{group: a, axes: [[1]]}]", "handles[0].axes", "x, y, z"),
    ("handles: [{box: [[0, 0, 0], [-1, 1, 1]]}]", "handles[0].box", "lower corner first"),
    ("handles: [{box: [0, 1]}]", "handles[0].box", "three numbers"),
    ("initial: {seed: -1}", "initial.seed", ">= 0"),
    # keys that depend on each other
    ("material:", "material", "missing"),
    ("mesh: []", "mesh", "at least one"),
    ("mesh: {name: a}", "mesh", "exactly one of file, grid"),
    ("mesh: {file: a.obj, grid: {width: 1, height: 1, nx: 2, ny: 2}}", "mesh", "exactly one of file, grid"),
    ("mesh: {file: a.step}", "mesh.file", ".geo, .msh, .obj"),
    ("mesh: {file: none.obj}", "mesh.file", "no such file"),
    ("mesh: [{file: none.obj}]", "mesh[0].file", "no such file"),
    ("mesh: [{grid: {width: 1, height: 1, nx: 1, ny: 1}, name: a}, "
     "{grid: {width: 1, height: 1, nx: 1, ny: 1}, name: a}]", "mesh[1].name", "earlier sheet"),
    ("time: {end: 1}", "time.step", "missing"),
    ("time: {end: 1, step: 1e-16}", "time.step", "is too small, 1e-16: times near 1 s"),
    ("time: {end: 1e300, step: 1e-300}", "time.step", "is too small"),
    ("output: {every: 1e-320}", "output.every", "is too small"),
    ("time: {end: 1, step: automatic}", "time.step", "must be a number or auto, not 'automatic'"),
    ("time: {end: 1, step: auto, tolerance: 0}", "time.tolerance", "must be > 0"),
    ("time: {end: 1, step: auto, tolerance: 2}", "time.tolerance", "fraction of the sheet's size, below 1"),
    ("time: {end: 1, step: 0.1, tolerance: 1e-3}", "time.tolerance", "is for step: auto"),
    ("time: {end: 1, step: 0.1, spectral_radius: 0.5}", "time.spectral_radius", "is for integrator: alpha2"),
    ("time: {end: 1, step: 0.1, integrator: alpha2, spectral_radius: 1.1}",
     "time.spectral_radius", "must be from 0 to 1, not 1.1"),
    ("time: {step: 0.1, integrator: static}", "time.integrator", "write analysis: static"),
    ("time: {end: 1, step: 0.1, integrator: euler}", "time.integrator", "one of beuler, semi-implicit"),
    ("time: {end: 1, step: 0.1, integrator: [euler]}", "time.integrator", "must be one of"),
    ("time: {analysis: statics}", "time.analysis", "must be one of dynamic, static"),
    ("time: {analysis: static, end: 2}", "time.end", "is 1 in a static analysis"),
    ("time: {analysis: static, step: 2}", "time.step", "first increment of the load factor"),
    ("time: {analysis: static, step: auto}", "time.step", "first increment of the load factor"),
    ("time: {analysis: static, integrator: bdf2}", "time.integrator", "no meaning in a static analysis"),
    ("time: {analysis: static}\ninitial: {velocity: [1, 0, 0]}", "initial.velocity", "no meaning in a"),
    ("material: {}", "material", "exactly one way"),
    ("material: {cloth: paper, young: 1}", "material", "cloth and young are given"),
    ("material: {cloth: paper, density: 1}", "material.density", "density_scale"),
    ("material: {cloth: grey-interlock}", "material.cloth", "did you mean 'gray-interlock'"),
    ("material: {cloth: zzz}", "material.cloth", "known: 11oz-black-denim"),
    ("material: {density: 1}", "material", "exactly one way"),
    ("material: {membrane: {c11: 1, c22: 1, c12: 0, c33: 1}}", "material.density", "missing"),
    ("material: {density: 1, bending: 1}", "material.membrane", "missing"),
    ("material: {density: 1, membrane: {c11: 1, c22: 1, c12: 1, c33: 1}}",
     "material.membrane.c12", "positive definite"),
    ("material: {density: 1, membrane: {c11: 1, c22: 1, c33: 1}}", "material.membrane.c12", "missing"),
    ("material: {density: 1, membrane: {c11: 1, c22: 1, c12: 0, c33: 0}}", "material.membrane.c33", "> 0"),
    ("material: {density: 1, membrane: {c11: 1, c22: 1, c12: 0, c33: 1}, bending: [1, 2]}",
     "material.bending", "three numbers"),
    ("material: {density: 1, membrane: {c11: 1, c22: 1, c12: 0, c33: 1}, bending: -1}",
     "material.bending", ">= 0"),
    ("material: {" + SHEET + "bending: {d11: 1, d22: 1, d33: 1}, bending_model: hinge}",
     "material.bending", "are for bending_model: midedge"),
    ("material: {" + SHEET + "bending: {d11: 1, d22: 4, d12: 2, d33: 1}}",
     "material.bending.d12", "below sqrt(d11 d22) = 2 N·m"),
    ("material: {" + SHEET + "bending: {d11: 1, d22: 1}}", "material.bending.d33", "missing"),
    ("material: {" + SHEET + "bending: {d11: 1, d22: 1, d33: 1, d44: 1}}", "material.bending.d44", "d11"),
    ("material: {" + SHEET + "bending_model: midege}", "material.bending_model", "one of hinge, midedge"),
    ("material: {young: 1, poisson: 0.6, thickness: 1, density: 1}", "material.poisson", "from -1 to 0.5"),
    ("material: {young: 1, poisson: -1, thickness: 1, density: 1}", "material.poisson", "must be > -1"),
    ("material: {young: 1, poisson: 0.3, density: 1}", "material.thickness", "missing"),
    ("material: [{cloth: paper}, {cloth: paper}]", "material[1].group", "second material"),
    ("material: [{cloth: paper, group: a}, {cloth: paper, group: a}]", "material[1].group", "'a'"),
    ("wind: {velocity: [1, 0, 0]}", "wind.density", "missing"),
    ("handles: [{}]", "handles[0]", "exactly one of group, nodes, box"),
    ("handles: [{group: a, nodes: [1]}]", "handles[0]", "exactly one of group, nodes, box"),
    ("handles: [{group: a, from: 2, until: 2}]", "handles[0].until", "later than from = 2"),
    ("handles: [{group: a, motion: swing}]", "handles[0].motion", "unknown motion 'swing'"),
    ("motions: {swing: []}", "motions.swing", "at least one keyframe"),
    ("motions: {swing: [{time: 1}, {time: 1}]}", "motions.swing[1].time", "later than the keyframe before"),
    ("loads: [{group: a}]", "loads[0]", "exactly one of force, pressure, traction, moment"),
    ("loads: [{moment: 1, nodes: [0]}]", "loads[0].moment", "needs a group of boundary edges"),
    ("loads: [{force: [0, 0, 1]}]", "loads[0].force", "needs exactly one of group"),
    ("loads: [{pressure: 1, nodes: [1]}]", "loads[0].nodes", "use group"),
    ("loads: [{pressure: 1, traction: [0, 0, 1]}]", "loads[0]", "exactly one of force"),
    ("output: {fields: [velocity, stres]}", "output.fields", "did you mean 'stress'"),
    ("petsc: {-ksp_type: cg}", "petsc.-ksp_type", "without the dash"),
    ("petsc: {ksp_type: [cg]}", "petsc.ksp_type", "must be text, a number"),
    ("petsc: [a]", "petsc", "block of options"),
    ("petsc: {pc_python_type: evil.PC}", "petsc.pc_python_type", "may run code or name a file"),
    ("petsc: {ksp_type: python}", "petsc.ksp_type", "may run code"),
    ("petsc: {sub_pc_type: shell}", "petsc.sub_pc_type", "may run code"),
    ("petsc: {dll_append: evil.so}", "petsc.dll_append", "may run code"),
    ("petsc: {start_in_debugger: }", "petsc.start_in_debugger", "may run code"),
    ("petsc: {options_file: x}", "petsc.options_file", "name a file"),
    ('petsc: {ksp_view: "ascii:out.txt"}', "petsc.ksp_view", "name a file, which a scene must not"),
    ("petsc: {mat_view: binary}", "petsc.mat_view", "name a file"),
    ('petsc: {log_view: ":out.txt"}', "petsc.log_view", "name a file"),
    ("petsc: {ts_monitor_solution_vtk: a.vts}", "petsc.ts_monitor_solution_vtk", "name a file"),
    ("petsc: {ts_save_trajectory: true}", "petsc.ts_save_trajectory", "name a file"),
    ("petsc: {mat_mumps_ooc_tmpdir: a}", "petsc.mat_mumps_ooc_tmpdir", "name a file"),
    ("petsc: {pc_type: ../lu}", "petsc.pc_type", "name a file"),
    ("probes: {tip: {}}", "probes.tip", "exactly one of"),
]  # fmt: skip


@pytest.mark.parametrize(("part", "key", "message"), CASES, ids=[case[0][:50] for case in CASES])
def test_message_names_file_key_and_remedy(tmp_path: Path, part: str, key: str, message: str) -> None:
    path = tmp_path / "bad.yaml"
    path.write_text(scene_text(part))
    with pytest.raises(InputError) as caught:
        load_scene(path)
    error = caught.value
    assert error.key == key
    assert message in error.message
    assert error.file == str(path)
    assert "\n" not in str(error)
    assert len(str(error)) < 600
    assert str(pickle.loads(pickle.dumps(error))) == str(error)


def test_the_number_of_further_mistakes_is_reported(tmp_path: Path) -> None:
    path = tmp_path / "bad.yaml"
    path.write_text(
        "mesh: {grid: {width: 0, height: 0, nx: 1, ny: 1}}\nmaterial: {cloth: x}\ntime: {end: 1}\n"
    )
    with pytest.raises(InputError, match=r"width: must be > 0, not 0 \(and 3 more\)"):
        load_scene(path)


SURROGATES: list[tuple[str, str]] = [
    ("title", 'title: "\\uD800"'),
    ("mesh[1].name", 'mesh: [{grid: {width: 1, height: 1, nx: 1, ny: 1}}, {file: a.obj, name: "\\uDFFFx"}]'),
    ("mesh.file", 'mesh: {file: "\\uDCFF.obj"}'),
    ("material.cloth", 'material: {cloth: "gray\\uD800"}'),
    ("material.group", 'material: {cloth: gray-interlock, group: "\\uD800"}'),
    (
        "material.law",
        'material: {cloth: gray-interlock, law: {warp: "\\uD800.csv", weft: b.csv, shear: c.csv}}',
    ),
    ("handles[0].group", 'handles: [{group: "\\uD800"}]'),
    ("handles[0].motion", 'handles: [{nodes: [0], motion: "\\uD800"}]'),
    ("motions", 'motions: {"\\uD800": [{time: 0}]}'),
    ("probes", 'probes: {"\\uD800": {nodes: [0]}}'),
    ("obstacles", 'obstacles: {"a\\uDC00b": {sphere: {center: [0, 0, 0], radius: 1}}}\ncontact: {}'),
    ("obstacles.b.mesh.file", 'obstacles: {b: {mesh: {file: "\\uD800.obj"}}}\ncontact: {}'),
    ("loads[0].group", 'loads: [{pressure: 1, group: "\\uD800"}]'),
    ("petsc.ksp_type", 'petsc: {ksp_type: "\\uD800"}'),
    ("petsc", 'petsc: {"\\uD800": 1}'),
    ("output.fields", 'output: {fields: ["\\uD800"]}'),
    ("time.integrator", 'time: {end: 1, step: 1, integrator: "\\uD800"}'),
    ("", '"\\uD800": 1'),
]


@pytest.mark.parametrize(("key", "line"), SURROGATES, ids=[case[0] for case in SURROGATES])
def test_half_of_a_surrogate_pair_is_refused_wherever_text_stands(
    tmp_path: Path, key: str, line: str
) -> None:
    path = tmp_path / "scene.yaml"
    first = line.partition(":")[0]
    base = {
        "mesh": "mesh: {grid: {width: 1, height: 1, nx: 1, ny: 1}}",
        "material": "material: {cloth: gray-interlock}",
        "time": "time: {end: 1, step: 1}",
    }
    path.write_text("\n".join([*(text for name, text in base.items() if name != first), line]) + "\n")
    with pytest.raises(InputError) as caught:
        load_scene(path, meshes_needed=False)
    str(caught.value).encode()  # what is said can be written
    assert (caught.value.key or "").startswith(key)


def test_a_character_that_json_writes_as_two_surrogates_is_read(tmp_path: Path) -> None:
    path = tmp_path / "scene.yaml"
    path.write_text(scene_text('title: "\\uD83D\\uDE00 flag"'))
    assert load_scene(path).title == "\N{GRINNING FACE} flag"


UNREADABLE = [
    (b"", "is empty"),
    (b" \n\t\n", "is empty"),
    (b"\xff\xfe\x00t", "not UTF-8"),
    (b"title: \xe9\n", "not UTF-8 text (byte 7)"),
    (b"title: \x00\n", "not YAML"),
    (b"a: [1, 2\n", "line"),
    (b"a: 1\nb: {x: 1}\na: 2\n", "line 3: 'a' is given twice, first in line 1"),
    (b"wind: {density: 1, density: 2}\n", "line 1: 'density' is given twice"),
    (b"handles:\n  - group: left\n    'group': top\n", "line 3: 'group' is given twice, first in line 2"),
    (b"a: 1\nwind:\n\tvelocity: [0, 1, 0]\n", "line 3, column 1: a tab, which YAML does not take here"),
    (b"time:\n  end: 1\n \tstep: 0.1\n", "line 3, column 2: a tab"),
    (b"title:\tx\n", "line 1, column 7: a tab"),
    (b"a: 1\ntime {end: 1, step: 2}\n", "line 2: 'time' needs a colon and a blank"),
    (b"mesh {grid: {width: 1}}\n", "line 1: 'mesh' needs a colon"),
    (b"a: 1\ntime\n  end: 1\n", "line 2: 'time' needs a colon"),
    (b"time:\n  end 1\n  step: 2\n", "line 2: 'end' needs a colon"),
    (b"time:\n  end: 1\n\n  step 2\nb: 1\n", "line 4: 'step' needs a colon"),
    (b"gravity [0, 0, -1]\nb: 2\n", "line 1: 'gravity' needs a colon"),
    (b"a: 1\nend:0.1\n", "line 2: 'end' needs a colon"),
    (b"time: {end 1, step: 2}\n", "line 1: 'end' needs a colon"),
    (b"time: {end: 1,\n  step:2}\n", "line 2: 'step' needs a colon"),
    (b"handles:\n  - group left\n    motion: x\n", "line 2: 'group' needs a colon"),
    (b"title: a: b\n", "line 1, column 9: a second colon in one value; put text with colons in quotes"),
    (b"time:\n  end: 1\n   step: 2\n", "line 3, column 8: indented differently"),
    (b"time:\n  end: 1\n step: 2\n", "line 3, column 2: indented differently"),
    (b"- a\n- b\n", "must be a block of keys"),
    (b"just words\n", "must be a block of keys"),
    (b"---\na: 1\n---\nb: 2\n", "document"),
    (b"a: !!python/object:os.system x\n", "could not determine a constructor"),
    (b"a: *nowhere\n", "undefined alias"),
    (b"a: 2001-13-45\n", "not YAML"),
    (b"{[1]: 2, {a: b}: 3}\n", ""),
    (b"a: " + b"[" * 800 + b"\n", ""),
    (b"mesh: &m [*m]\n", "refers to itself"),
    (b"%YAML 9.9\n---\na: 1\n", ""),
]


@pytest.mark.parametrize(("content", "message"), UNREADABLE, ids=[repr(case[0][:20]) for case in UNREADABLE])
@pytest.mark.parametrize("overrides", [[], ["time.end=1"]], ids=["plain", "set"])
def test_unreadable_files(tmp_path: Path, content: bytes, message: str, overrides: list[str]) -> None:
    path = tmp_path / "bad.yaml"
    path.write_bytes(content)
    with pytest.raises(InputError) as caught:
        load_scene(path, overrides)
    if not overrides or "a block" not in message:  # an override needs a block first
        assert message in caught.value.message
    assert caught.value.file == str(path)
    assert "\n" not in str(caught.value)


def test_merged_keys_and_anchors_of_a_usual_size_are_read(tmp_path: Path) -> None:
    path = tmp_path / "good.yaml"
    path.write_text(
        "mesh: {grid: &g {width: 1, height: 1, nx: 2, ny: 2}}\nmaterial: {cloth: paper}\n"
        "time: {end: 1, step: 0.1}\n"
        "handles: [&h {nodes: [0]}, {<<: *h, stiffness: 10}, {box: [&a [0, 0, 0], *a]}]\n"
    )
    scene = load_scene(path)
    assert scene.handles[1].nodes == [0]
    assert scene.handles[1].stiffness == 10


def test_a_huge_file_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "bad.yaml"
    with path.open("wb") as file:
        file.truncate(10**12)  # a hole: no bytes on disk
    with pytest.raises(InputError, match="holds 1000000000000 bytes; at most 33554432 are read"):
        load_scene(path)


def test_missing_file_and_directory(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such file"):
        load_scene(tmp_path / "none.yaml")
    with pytest.raises(InputError, match="is a directory"):
        load_scene(tmp_path)
    with pytest.raises(InputError, match=r"cannot be read|no such file"):
        load_scene(tmp_path / ("x" * 5000))
    with pytest.raises(InputError, match=r"cannot be read|no such file"):
        load_scene("a\0b")
