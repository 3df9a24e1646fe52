"""Runs the scenes in configs/ and makes the pictures and films of docs/gallery.

    .venv/bin/python scripts/gallery.py [NAME…] [--runs FOLDER] [--ranks P]

Runs that exist in the folder of runs (runs/gallery) are not repeated. Ends with an error if the gallery is
larger than 5 MB.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import imageio_ffmpeg
from PIL import Image

ROOT = Path(__file__).resolve().parent.parent
GALLERY = ROOT / "docs" / "gallery"
LIMIT = 5_000_000
"""Bytes of all pictures and films."""
COMPRESSED = ["-c:v", "libx264", "-crf", "31", "-preset", "veryslow", "-movflags", "+faststart"]
"""Options of ffmpeg for small films."""
GIF = "flag"
"""The scene that moves in the README."""


@dataclass(frozen=True)
class Entry:
    """A scene of the gallery.

    Attributes
    ----------
    at : float
        Time of the picture [s].
    options : tuple of str
        Options of ``render``, for picture and film.
    settings : tuple of str
        Values of ``--set`` for the run.
    speed : float
        Simulated seconds per second of the film.
    """

    at: float
    options: tuple[str, ...] = ()
    settings: tuple[str, ...] = ()
    speed: float = 1.0


ENTRIES = {
    "flag": Entry(1.5, ("--handles", "--wind")),
    "sail": Entry(1.0, ("--handles", "--field", "stress", "--range", "0,120"), speed=0.5),
    "drape": Entry(2.0, ("--handles", "--colors", "#2f6f9f,#f3e7d3")),
    "swing": Entry(0.36, ("--handles", "--field", "speed"), ("output.every=0.01",), speed=0.2),
    "spin": Entry(4.4, ("--handles", "--colors", "#7d3c74,#f0d49a"), ("time.end=7.2",)),
    "paper": Entry(0.4, ("--handles", "--colors", "#eee9dc,#c9a86a"), ("output.every=0.01",), speed=0.2),
    "plate": Entry(1.0, ("--handles", "--field", "curvature"), speed=0.5),
    "buckle": Entry(2.0, ("--handles", "--field", "curvature")),
    "twisted-strip": Entry(2.0, ("--handles", "--field", "curvature")),
    "ball": Entry(1.0, ("--colors", "#2f6f9f,#f3e7d3"), speed=0.5),
    "flag-contact": Entry(1.5, ("--handles", "--wind")),
    "tablecloth": Entry(1.5, ("--colors", "#2f6f9f,#f3e7d3"), speed=0.5),
    "stack": Entry(0.3, speed=0.5),
    "twist": Entry(1.6, ("--handles", "--colors", "#2f6f9f,#f3e7d3")),
    "reef-knot": Entry(1.0, speed=0.5),
    "shell": Entry(1.0, ("--handles", "--field", "curvature")),
    "cushion": Entry(1.0, ("--colors", "#7d3c74,#f0d49a"), speed=0.4),
    "balloon": Entry(1.0, ("--handles",), speed=0.2),
    "miura": Entry(0.7, ("--colors", "#eee9dc,#c9a86a"), speed=0.2),
    "skirt": Entry(
        2.2,
        ("--colors", "#7d3c74,#f0d49a"),
        ("mesh.size=0.0094", "contact.gap=0.003", "output.every=0.02"),
        speed=0.6,
    ),
    "shirt": Entry(
        2.0, ("--colors", "#2f6f9f,#f3e7d3"), ("mesh.size=0.0104", "output.every=0.02"), speed=0.5
    ),
    "crease": Entry(2.5, ("--field", "plastic_curvature"), speed=0.5),
}


def lyra(*words: str, ranks: int = 1) -> None:
    """Run the program; ends the script if it fails."""
    launcher = ["mpirun", "-n", str(ranks)] if ranks > 1 else []
    command = [*launcher, sys.executable, "-m", "lyra_petsc", *words]
    if subprocess.run(command, cwd=ROOT, check=False).returncode != 0:
        raise SystemExit(f"gallery: failed: {' '.join(command)}")


def make(name: str, entry: Entry, runs: Path, ranks: int) -> None:
    """Make the picture and the film of one scene."""
    run = runs / name
    if not (run / "summary.json").exists():
        settings = [word for setting in entry.settings for word in ("--set", setting)]
        lyra("run", f"configs/{name}.yaml", "--out", str(run), "--force", *settings, ranks=ranks)
    lyra("render", str(run), "--at", f"{entry.at:g}", *entry.options)
    with Image.open(run / f"picture-{entry.at:g}.png") as picture:
        picture.save(GALLERY / f"{name}.png", optimize=True)
    film = run / "film.mp4"
    lyra("render", str(run), "--film", str(film), "--speed", f"{entry.speed:g}", *entry.options)
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-y", "-loglevel", "error", "-i", str(film), *COMPRESSED]
    subprocess.run([*command, str(GALLERY / f"{name}.mp4")], check=True)


def main() -> None:
    """Make the pictures and films, and print the size of the gallery."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"of {', '.join(ENTRIES)} (all)")
    parser.add_argument("--runs", type=Path, default=ROOT / "runs" / "gallery", help="folder of the runs")
    parser.add_argument("--ranks", type=int, default=1, help="ranks of a run (1)")
    asked = parser.parse_args()
    unknown = set(asked.names) - set(ENTRIES)
    if unknown:
        parser.error(f"no such scene: {', '.join(sorted(unknown))}")
    GALLERY.mkdir(parents=True, exist_ok=True)
    for name in asked.names or ENTRIES:
        make(name, ENTRIES[name], asked.runs.absolute(), asked.ranks)
    if not asked.names or GIF in asked.names:
        look = ("--size", "420x236", "--fps", "15", "--handles")
        lyra("render", str(asked.runs.absolute() / GIF), "--film", str(GALLERY / f"{GIF}.gif"), *look)
    size = sum(path.stat().st_size for path in GALLERY.iterdir())
    print(f"gallery      {GALLERY}: {size / 1e6:.2f} MB")
    if size > LIMIT:
        raise SystemExit(f"gallery: more than {LIMIT / 1e6:g} MB; make films shorter or smaller")


if __name__ == "__main__":
    main()
