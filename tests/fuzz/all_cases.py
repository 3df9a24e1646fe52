"""The kinds of cases, by name."""

from __future__ import annotations

from hypothesis import strategies as st
from judge import Case
from original_cases import original_cases
from scene_cases import scene_cases, text_bombs

KINDS: dict[str, st.SearchStrategy[Case]] = {
    "scenes": scene_cases(),
    "bombs": text_bombs(),
    "originals": original_cases(),
}
