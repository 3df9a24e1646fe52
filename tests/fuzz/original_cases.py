"""Cases with mutated conf.json files of the original program."""

from __future__ import annotations

import json
from typing import Any

from hypothesis import strategies as st
from judge import Case
from odd_values import Raw, joined, listed, magnitude, paths_of, signed, sometimes, usual, vector
from scene_cases import SHEET
from text_damage import damaged

ODD = listed(r"""
0 -1 1e308 1e309 -1e-320 NaN Infinity -Infinity null true false "" "a" [] {} [[]] [0,0,0] [1,2]
[1e308,1e308,1e308] 1.5 "\u0000" "\ud800" "../../../etc/passwd" "/etc/passwd" 2147483647 99999999999999999999
01 +1 .5 1. 'a' undefined {"a":1,"a":2}
""")
ODD += ["1" + "0" * 400, "1" + "0" * 5000, '"' + "x" * 3000 + '"', "// comment\n1", "/* a */ 2"]
ODD += ["[" * 2000 + "]" * 2000, '{"a":' * 500 + "1" + "}" * 500]
TABLE = {
    "density": 0.2,
    "stretching": [[60.0, 10.0, 60.0, 20.0]] * 6,
    "bending": [[1e-5] * 5] * 3,
}
Draw = Any


def _json(value: Any) -> str:
    if isinstance(value, Raw):
        return str(value)
    if isinstance(value, dict):
        return "{" + ", ".join(f"{json.dumps(key)}: {_json(entry)}" for key, entry in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(map(_json, value)) + "]"
    return json.dumps(value)


PLACEMENT = st.fixed_dictionaries(
    {
        "translate": vector(0.0, 1.0),
        "scale": st.just(1.0) | usual(0.5, 2.0),
        "rotate": st.tuples(signed(0.0, 360.0), vector(0.1, 1.0)).map(lambda two: [two[0], *two[1]]),
    }
)
CLOTH = {
    "mesh": st.just("sheet.obj"),
    "transform": PLACEMENT,
    "materials": st.fixed_dictionaries(
        {
            "data": st.sampled_from(["materials/gray-interlock.json", "paper", "table.json"]),
            "damping": usual(0.0, 0.1),
            "thicken": usual(0.5, 2.0),
            "bending_mult": usual(0.0, 10.0),
        }
    ).map(lambda material: [material]),
}
HANDLE = {
    "nodes": st.lists(st.integers(0, 5), min_size=1, max_size=1),
    "end_time": usual(0.1, 10.0),
    "motion": st.integers(-1, 1),
}
MOTION = st.tuples(PLACEMENT, magnitude()).map(
    lambda two: [{"time": 0, "transform": two[0]}, {"time": two[1], "transform": {}}]
)
ORIGINALS = joined(
    st.fixed_dictionaries(
        {
            "frame_time": usual(0.01, 0.1),
            "frame_steps": st.integers(1, 10),
            "end_time": usual(0.1, 10.0),
            "cloths": st.lists(st.fixed_dictionaries(CLOTH), min_size=1, max_size=2),
            "handles": st.lists(st.fixed_dictionaries(HANDLE), max_size=2),
            "gravity": vector(0.0, 10.0),
        }
    ),
    sometimes(
        2,
        {
            "motions": MOTION.map(lambda motion: [motion]),
            "wind": st.fixed_dictionaries({"velocity": vector(0.0, 10.0), "density": usual(0.0, 2.0)}),
        },
    ),
)
"""A valid conf.json, if its numbers are in range."""


@st.composite
def original_cases(draw: Draw) -> Case:
    """A conf.json with its mesh and a material table."""
    data = draw(ORIGINALS)
    kind = draw(st.sampled_from(["sound", "mutated", "mutated", "damaged"]))
    if kind == "mutated":
        for _ in range(draw(st.integers(1, 2))):
            *path, last = draw(st.sampled_from(paths_of(data)))
            block = data
            for key in path:
                block = block[key]
            block[last] = Raw(draw(st.sampled_from(ODD)))
    comment = draw(st.sampled_from(["", "// a comment\n", "/* one */\n"]))
    text = (comment + _json(data)).encode("utf-8", errors="surrogatepass")
    table = json.dumps(TABLE).encode()
    if kind == "damaged":
        which = draw(st.integers(0, 2))
        text, table = (draw(damaged(text)), table) if which else (text, draw(damaged(table)))
    files = {"conf.json": text, "sheet.obj": SHEET, "table.json": table}
    return Case(f"original-{kind}", files, scene="conf.json")
