"""Mutation of the bytes of a file: changes, deletions, copies, encodings, line ends."""

from __future__ import annotations

from typing import Any

from hypothesis import strategies as st

PIECES = (
    b"\0 \xff \xef\xbb\xbf # { } [ ] : , - \" ' | > 1e999 nan inf - 0 // /* */ \\ \xc3 \xf0\x9f\x98\x80 "
    b"\x1b[31m \xe2\x80\xa8 \x85 $End ; ~"
).split()
PIECES += [
    b"\r",
    b"\r\n",
    b"\n",
    b"\t",
    b" ",
    b"---\n",
    b"...\n",
    b"%YAML 1.1\n---\n",
    b"&a ",
    b"*a ",
    b"<<: ",
]
PIECES += [b"!!python/object:os.system ", b"9" * 30, b"f 1 2 3\n"]


def _coded(text: bytes, name: str) -> bytes:
    try:
        return text.decode("utf-8").encode(name)
    except UnicodeError:
        return text


@st.composite
def damaged(draw: Any, content: bytes) -> bytes:
    """``content`` after one to four mutations."""
    data = bytearray(content)
    for _ in range(draw(st.integers(1, 4))):
        size = len(data)
        at = draw(st.integers(0, size))
        what = draw(st.integers(0, 9))
        if what <= 1 and size:
            data[min(at, size - 1)] = draw(st.integers(0, 255))
        elif what <= 4:
            data[at:at] = draw(st.sampled_from(PIECES))
        elif what == 5:
            del data[at:]
        elif what == 6:
            del data[at : at + draw(st.integers(1, 20))]
        elif what == 7:
            end = min(size, at + draw(st.integers(1, 200)))
            other = draw(st.integers(0, size))
            data[other:other] = data[at:end] * draw(st.integers(1, 3))
        elif what == 8:
            data = bytearray(data.replace(b"\n", draw(st.sampled_from([b"\r\n", b"\r", b"\n\n", b" "]))))
        else:
            coding = draw(st.sampled_from(["utf-8-sig", "utf-16", "utf-32", "latin-1", "cp037"]))
            data = bytearray(_coded(bytes(data), coding))
    return bytes(data)
