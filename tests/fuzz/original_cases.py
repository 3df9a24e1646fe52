"""Cases with mutated conf.json files of the original program."""

from __future__ import annotations

import json
from typing import Any

from hypothesis import strategies as st
from judge import Case
from odd_values import Raw, entry_at, listed, paths_of, varied
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


ORIGINAL = {
    "frame_time": 0.05,
    "frame_steps": 3,
    "end_time": 0.2,
    "cloths": [
        {
            "mesh": "sheet.obj",
            "transform": {"translate": [0.1, 0.0, 0.0], "scale": 1.0, "rotate": [30.0, 0.0, 0.0, 1.0]},
            "materials": [{"data": "table.json", "damping": 0.01, "thicken": 1.0, "bending_mult": 2.0}],
        }
    ],
    "handles": [{"nodes": [0], "end_time": 1.0, "motion": 0}, {"nodes": [3]}],
    "motions": [[{"time": 0, "transform": {"translate": [0.0, 0.1, 0.0]}}, {"time": 0.5, "transform": {}}]],
    "gravity": [0.0, 0.0, -9.8],
    "wind": {"velocity": [0.0, 2.0, 0.0], "density": 1.0},
}
"""A valid conf.json."""
TABLES = ["materials/gray-interlock.json", "paper", "table.json"]


@st.composite
def original_cases(draw: Draw) -> Case:
    """A conf.json with its mesh and a material table."""
    data = draw(varied(ORIGINAL))
    data["cloths"][0]["materials"][0]["data"] = draw(st.sampled_from(TABLES))
    kind = draw(st.sampled_from(["sound", "mutated", "mutated", "damaged"]))
    if kind == "mutated":
        for _ in range(draw(st.integers(1, 2))):
            *path, last = draw(st.sampled_from(paths_of(data)))
            entry_at(data, path)[last] = Raw(draw(st.sampled_from(ODD)))
    comment = draw(st.sampled_from(["", "// a comment\n", "/* one */\n"]))
    text = (comment + _json(data)).encode("utf-8", errors="surrogatepass")
    table = json.dumps(TABLE).encode()
    if kind == "damaged":
        which = draw(st.integers(0, 2))
        text, table = (draw(damaged(text)), table) if which else (text, draw(damaged(table)))
    files = {"conf.json": text, "sheet.obj": SHEET, "table.json": table}
    return Case(f"original-{kind}", files, scene="conf.json")
