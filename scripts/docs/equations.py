"""MkDocs hook that turns equations into MathML, which browsers show without scripts or network access."""

from __future__ import annotations

import html
import re
from typing import Any

from latex2mathml.converter import convert

_EQUATION = re.compile(r'<(span|div) class="arithmatex">\\([(\[])(.*?)\\[)\]]</\1>', re.DOTALL)


def on_page_content(content: str, **_: Any) -> str:
    """Called by MkDocs with the HTML of each page."""
    return _EQUATION.sub(_to_mathml, content)


def _to_mathml(equation: re.Match[str]) -> str:
    display = "block" if equation[2] == "[" else "inline"
    return str(convert(html.unescape(equation[3]).strip(), display=display))
