"""Hook of the site: equations as MathML, which browsers show without a script or the network."""

from __future__ import annotations

import html
import re
from typing import Any

from latex2mathml.converter import convert

_EQUATION = re.compile(r'<(span|div) class="arithmatex">\\([(\[])(.*?)\\[)\]]</\1>', re.DOTALL)


def on_page_content(content: str, **_: Any) -> str:
    """Called by MkDocs with the HTML of each page."""
    return _EQUATION.sub(_in_mathml, content)


def _in_mathml(equation: re.Match[str]) -> str:
    display = "block" if equation[2] == "[" else "inline"
    return str(convert(html.unescape(equation[3]).strip(), display=display))
