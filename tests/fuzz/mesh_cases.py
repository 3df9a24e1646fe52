"""Cases with mutated meshes: .obj, .msh of both formats in text and binary, .geo."""

from __future__ import annotations

import struct
from typing import Any

from hypothesis import strategies as st
from judge import Case
from odd_values import listed, pieces
from text_damage import damaged

SCENE = """\
mesh: {{file: {name}{size}}}
material: {{density: 0.15, membrane: {{c11: 800, c22: 800, c12: 160, c33: 240}}, bending: 2.0e-5}}
gravity: [0, 0, -9.81]
handles: [{{{held}}}]
time: {{end: 0.02, step: 0.01}}
"""
POINTS = [(0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (1.0, 1.0, 0.0), (0.0, 1.0, 0.0), (0.5, 0.5, 0.1)]
TRIANGLES = [(1, 2, 5), (2, 3, 5), (3, 4, 5), (4, 1, 5)]
EDGES = [(1, 2), (2, 3)]
NAMES = '$PhysicalNames\n2\n1 7 "edge"\n2 3 "sheet"\n$EndPhysicalNames\n'

POWERS = (15, 31, 32, 53, 62, 63)
INTEGERS = [0, -1, 1, 2, 3, 6, 15, 99, 255, *(2**k for k in POWERS), 2**31 - 1, 2**63 - 1, -(2**31)]
REALS = listed("nan inf -inf 1e308 -1e308 1e309 5e-324 1e-160 0 -0.0 1e16 abc 1,5 0x1p3")

Draw = Any


def _rows(binary: bool, *rows: Any) -> bytes:
    """Rows as bytes; each row is a format for `struct`, followed by numbers."""
    if binary:
        return b"".join(struct.pack(f"<{form}", *numbers) for form, *numbers in rows) + b"\n"
    return "".join(" ".join(map(str, numbers)) + "\n" for _, *numbers in rows).encode()


def _msh(version: str, binary: bool, sections: dict[str, bytes]) -> bytes:
    mark = struct.pack("<i", 1) + b"\n" if binary else b""
    data = f"$MeshFormat\n{version} {int(binary)} 8\n".encode() + mark + b"$EndMeshFormat\n" + NAMES.encode()
    return data + b"".join(
        b"$%b\n%b$End%b\n" % (name.encode(), body, name.encode()) for name, body in sections.items()
    )


def msh_2(*, binary: bool) -> bytes:
    """The sheet in format 2.2."""
    nodes = [("i3d", tag, *point) for tag, point in enumerate(POINTS, 1)]
    elements: list[Any] = []
    parts = [(1, 7, edge) for edge in EDGES] + [(2, 3, triangle) for triangle in TRIANGLES]
    for number, (kind, group, corners) in enumerate(parts, 1):
        head = (kind, 1, 2, number) if binary else (number, kind, 2)
        elements.append((f"{6 + len(corners)}i", *head, group, 1, *corners))
    sections = {"Nodes": nodes, "Elements": elements}
    return _msh(
        "2.2", binary, {n: b"%d\n" % len(rows) + _rows(binary, *rows) for n, rows in sections.items()}
    )


def msh_4(*, binary: bool) -> bytes:
    """The sheet in format 4.1."""
    n, curve, surface = len(POINTS), (0, 0, 0, 1, 1, 0), (0, 0, 0, 1, 1, 0.1)
    nodes = [*(("Q", tag) for tag in range(1, n + 1)), *(("3d", *point) for point in POINTS)]
    edges = [("3Q", i, *edge) for i, edge in enumerate(EDGES, 1)]
    faces = [("4Q", i, *triangle) for i, triangle in enumerate(TRIANGLES, 3)]
    sections: dict[str, list[Any]] = {
        "Entities": [
            ("4Q", 0, 1, 1, 0),
            ("i6dQiQ", 1, *curve, 1, 7, 0),
            ("i6dQiQi", 1, *surface, 1, 3, 1, 1),
        ],
        "Nodes": [("4Q", 1, n, 1, n), ("3iQ", 2, 1, 0, n), *nodes],
        "Elements": [("4Q", 2, 6, 1, 6), ("3iQ", 1, 1, 1, 2), *edges, ("3iQ", 2, 1, 2, 4), *faces],
    }
    return _msh("4.1", binary, {name: _rows(binary, *rows) for name, rows in sections.items()})


OBJ = b"""# a sheet
mtllib other.mtl
o thing
v 0 0 0
v 1 0 0
v 1 1 0
v 0 1 0
v 0.5 0.5 0.1
vt 0 0
vt 1 0
vt 1 1
vt 0 1
vt 0.5 0.5
g all upper
f 1/1 2/2 5/5
f 2/2 3/3 5/5
f 3/3 4/4 5/5
f -2/4 -5/1 -1/5
"""

GEO = b"""h = 0.5;
Point(1) = {0, 0, 0, h}; Point(2) = {1, 0, 0, h};
Point(3) = {1, 1, 0, h}; Point(4) = {0, 1, 0, h};
Line(1) = {1, 2}; Line(2) = {2, 3};
Line(3) = {3, 4}; Line(4) = {4, 1};
Curve Loop(1) = {1, 2, 3, 4};
Plane Surface(1) = {1};
Physical Surface("sheet") = {1};
Physical Curve("edge") = {4};
"""
STATEMENTS = pieces("""
SystemCall "touch mark"; ¦ NonBlockingSystemCall "touch mark"; ¦ OnelabRun("a", "touch mark"); ¦
Save "mark.msh"; ¦ Print "mark.png"; ¦ Printf("a") > "mark"; ¦ CreateDir "mark"; ¦ Include "mesh.geo"; ¦
Include "part.geo"; ¦ Merge "/etc/hosts.msh"; ¦ Exit; ¦ Abort; ¦ Sleep 100; ¦ Error("no"); ¦
Printf("%g", 1); ¦ General.AbortOnError = 4; ¦ General.Verbosity = 99; ¦ EndIf ¦ Return ¦ Mesh 2; ¦
RecombineMesh; ¦ Delete Problem; ¦ Delete { Surface{1}; } ¦ NewModel; ¦ MeshSize {1, 2, 3, 4} = 1e-9; ¦
MeshSize {1} = 0; ¦ Mesh.MeshSizeMax = 1e-7; ¦
Transfinite Curve {1:4} = 3; Transfinite Surface {1}; Recombine Surface {1}; ¦
Transfinite Curve {1:4} = 1000000000; ¦ Mesh.ElementOrder = 3; ¦ Mesh.Algorithm = 99; ¦
Point(1) = {5, 5, 5}; ¦ Point(2147483647) = {0, 0, 0}; ¦ Point(1e300) = {0, 0, 0}; ¦ Line(5) = {1, 99}; ¦
Curve Loop(2) = {1, 2}; ¦ Plane Surface(2) = {77}; ¦ Physical Curve("") = {1}; ¦
Extrude {0, 0, 1} { Surface{1}; Layers{2}; } ¦ x() = {}; y = x(3); ¦
SetFactory("OpenCASCADE"); Disk(7) = {0, 0, 0, 0.5}; ¦
Field[1] = MathEval; Field[1].F = "x"; Background Field = 1; ¦ a = 1/0; ¦ a[] = LinSpace[0, 1, 1e9]; ¦
a = Sqrt(-1); Point(9) = {a, a, a, a}; ¦ h = -1; ¦ Rotate {{0, 0, 1}, {0, 0, 0}, 1} { Surface{1}; } ¦
Dilate {{0, 0, 0}, 0} { Surface{1}; }
""")
STATEMENTS += [
    "For i In {0:1e9}\na = i;\nEndFor",
    "For i In {0:3}\nPoint(10 + i) = {i, 2, 0};\nEndFor",
    "Macro f\nCall f;\nReturn\nCall f;",
    'If (0) E" EndIf SystemCall "touch mark"; //"\nEndIf',
    'Physical Surface("a\\nb") = {1};',
]


def _scene(draw: Draw, name: str) -> bytes:
    held = draw(
        st.sampled_from(["nodes: [0, 1]", "group: sheet", "group: edge", "box: [[-9, -9, -9], [9, 0.1, 9]]"])
    )
    size = (
        draw(st.sampled_from(["", "", ", size: 0.4", ", size: 1e-9", ", size: 1e9"]))
        if name.endswith(".geo")
        else ""
    )
    return SCENE.format(name=name, size=size, held=held).encode()


def _with_odd_words(draw: Draw, data: bytes) -> bytes:
    """Text in which one to three words are replaced."""
    lines = data.split(b"\n")
    for _ in range(draw(st.integers(1, 3))):
        at = draw(st.integers(0, len(lines) - 1))
        words = lines[at].split(b" ")
        word = draw(st.sampled_from(INTEGERS) | st.sampled_from(REALS) | st.integers(0, 9))
        words[draw(st.integers(0, len(words) - 1))] = str(word).encode()
        lines[at] = b" ".join(words)
    return b"\n".join(lines)


def _with_odd_bytes(draw: Draw, data: bytes) -> bytes:
    """Binary data in which one to three numbers are overwritten by other numbers."""
    content = bytearray(data)
    for _ in range(draw(st.integers(1, 3))):
        form = draw(st.sampled_from("iqd"))
        if form == "d":
            word = struct.pack("<d", draw(st.floats()))
        else:
            bits = 32 if form == "i" else 64
            number = draw(st.sampled_from(INTEGERS)) % 2**bits
            word = number.to_bytes(bits // 8, "little")
        at = draw(st.integers(0, len(content) - 1))
        content[at : at + len(word)] = word
    return bytes(content)


@st.composite
def mesh_cases(draw: Draw) -> Case:
    """A small scene with a mutated .obj or .msh."""
    form = draw(st.sampled_from(["obj", "msh2-text", "msh2-binary", "msh4-text", "msh4-binary"]))
    binary = form.endswith("binary")
    data = {"o": OBJ, "2": msh_2(binary=binary), "4": msh_4(binary=binary)}[
        form[0] if form == "obj" else form[3]
    ]
    choice = draw(st.integers(0, 9))
    if choice == 0:
        pass
    elif choice <= 5:
        data = _with_odd_bytes(draw, data) if binary else _with_odd_words(draw, data)
    else:
        data = draw(damaged(data))
    name = "mesh.obj" if form == "obj" else "mesh.msh"
    return Case(f"mesh-{form}", {"scene.yaml": _scene(draw, name), name: data})


@st.composite
def geo_cases(draw: Draw) -> Case:
    """A small scene with a mutated .geo."""
    data = GEO
    for _ in range(draw(st.integers(0, 2))):
        lines = data.split(b"\n")
        lines.insert(draw(st.integers(0, len(lines))), draw(st.sampled_from(STATEMENTS)).encode())
        data = b"\n".join(lines)
    choice = draw(st.integers(0, 3))
    if choice == 0:
        data = draw(damaged(data))
    elif choice == 1:
        data = _with_odd_words(draw, data)
    return Case("geo", {"scene.yaml": _scene(draw, "mesh.geo"), "mesh.geo": data, "part.geo": b"a = 1;\n"})
